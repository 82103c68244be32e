"""The formats of `export`. A new one is a row of this table, and a module of its name with a function `write`."""

from __future__ import annotations

from typing import NamedTuple

from taichi_msm.outputs.table import NUMBERED


class Format(NamedTuple):
    """An export format."""

    means: str  # what it is for, in few words
    needs: tuple[str, ...]  # the entries of a scene's `output` that it is made from
    files: tuple[str, ...]  # their names as regular expressions, for `entries.files`
    uses: tuple[str, ...] = ()  # further entries of `output`, of which it would have more
    pairs: bool = False  # whether it numbers pairs of frames, not runs


def _each(*patterns: str) -> tuple[str, ...]:
    """Give the patterns of files that are there for each run: in a folder of its own, or of the only run in none."""
    return (*patterns, *(f"{NUMBERED}/{pattern}" for pattern in patterns))


FORMATS = {
    "kitti": Format(
        "optical flow",
        needs=("flow",),
        uses=("occlusion", "png"),
        files=(
            rf"training/image_2/{NUMBERED}_1[01]\.png",
            rf"training/flow_occ/{NUMBERED}_10\.png",
            rf"training/flow_noc/{NUMBERED}_10\.png",
        ),
        pairs=True,
    ),
    "tapvid": Format("tracks of points", needs=("tracks", "png"), files=(r"tapvid\.pkl",)),
    "vtk": Format(
        "for ParaView", needs=("trajectory",), files=_each(r"[0-9]{4,}\.vtu", r"surface\.pvd", r"picture\.png")
    ),
    "gltf": Format("for Blender and browsers", needs=("trajectory",), files=_each(r"surface\.glb")),
    "obj": Format(
        "for other programs with surfaces",
        needs=("trajectory",),
        files=_each(r"[0-9]{4,}\.obj", r"surface\.mtl", r"picture\.png"),
    ),
}
