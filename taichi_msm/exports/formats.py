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
    cameras: tuple[str, ...] = ()  # what it shows: nothing that a camera sees, ANY camera, or those of these names
    module: str = ""  # if it has another name than the format


def _each(*patterns: str) -> tuple[str, ...]:
    """Give the patterns of files that are there for each run: in a folder of its own, or of the only run in none."""
    return (*patterns, *(f"{NUMBERED}/{pattern}" for pattern in patterns))


# A camera that is chosen, or the only one.
ANY = ("",)

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
        cameras=ANY,
    ),
    "tapvid": Format("tracks of points", needs=("tracks", "png"), files=(r"tapvid\.pkl",), cameras=ANY),
    "tapvid3d": Format("tracks of points in space", needs=("tracks", "png"), files=(rf"{NUMBERED}\.npz",), cameras=ANY),
    "stir": Format(
        "tracks of points in stereo",
        needs=("tracks", "png"),
        files=(
            rf"{NUMBERED}/calib\.json",
            rf"{NUMBERED}/(?:left|right)/seq00/frames/0ms-[0-9]+ms-visible\.mp4",
            rf"{NUMBERED}/(?:left|right)/seq00/[0-9]+ms_icg(?:start|end)\.png",
            rf"{NUMBERED}/(?:left|right)/seq00/segmentation/icg(?:start|end)seg\.png",
        ),
        cameras=("left", "right"),
    ),
    "vtk": Format(
        "for ParaView", needs=("trajectory",), files=_each(r"[0-9]{4,}\.vtu", r"surface\.pvd", r"picture\.png")
    ),
    "gltf": Format("for Blender and browsers", needs=("trajectory",), files=_each(r"surface\.glb")),
    "obj": Format(
        "for other programs with surfaces",
        needs=("trajectory",),
        files=_each(r"[0-9]{4,}\.obj", r"surface\.mtl", r"picture\.png"),
    ),
    "csv": Format(
        "forces and tracks as tables",
        needs=(),
        uses=("forces", "tracks"),
        files=(r"forces\.csv", r"tracks\.csv"),
        cameras=ANY,
        module="tables",
    ),
}
