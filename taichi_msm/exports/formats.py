"""The formats of `export`. A new one is a row of this table, and a module of its name with a function `write`."""

from __future__ import annotations

from typing import NamedTuple


class Format(NamedTuple):
    """An export format."""

    means: str  # what it is for, in few words
    needs: tuple[str, ...]  # the entries of a scene's `output` that it is made from
    files: tuple[str, ...]  # their names as regular expressions, for `entries.files`
    uses: tuple[str, ...] = ()  # further entries of `output`, of which it would have more


FORMATS = {
    "kitti": Format(
        "optical flow",
        needs=("flow",),
        uses=("occlusion", "png"),
        files=(
            r"training/image_2/[0-9]{6,}_1[01]\.png",
            r"training/flow_occ/[0-9]{6,}_10\.png",
            r"training/flow_noc/[0-9]{6,}_10\.png",
        ),
    ),
    "tapvid": Format("tracks of points", needs=("tracks", "png"), files=(r"tapvid\.pkl",)),
    "vtk": Format("for ParaView", needs=("trajectory",), files=(r"[0-9]{4,}\.vtu", r"surface\.pvd", r"picture\.png")),
    "gltf": Format("for Blender and browsers", needs=("trajectory",), files=(r"surface\.glb",)),
    "obj": Format(
        "for other programs with surfaces",
        needs=("trajectory",),
        files=(r"[0-9]{4,}\.obj", r"surface\.mtl", r"picture\.png"),
    ),
}
