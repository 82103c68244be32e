"""The formats of `export`. A new one is a row of this table, and a module of its name with a function `write`.

The runs that an export is of, and how a format takes them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import NamedTuple

from taichi_msm.errors import Count, FilesError
from taichi_msm.runs.directory import MAX_RECORD_BYTES, list_files
from taichi_msm.runs.finished import FinishedRun, read_run, reading
from taichi_msm.scene.outputs import NUMBERED, RECORD, RUNS, SWEEP
from taichi_msm.system.files import read_regular


class Format(NamedTuple):
    """An export format."""

    description: str  # what it is for, in few words
    required_outputs: tuple[str, ...]  # the entries of a scene's `output` that it is made from
    file_patterns: tuple[str, ...]  # their names as regular expressions, for `directory.files`
    optional_outputs: tuple[str, ...] = ()  # further entries of `output`, of which it would have more
    numbers_pairs: bool = False  # whether it numbers pairs of frames, not runs
    cameras: tuple[str, ...] = ()  # what it shows: nothing that a camera sees, ANY camera, or those of these names
    module: str = ""  # if it has another name than the format


def _patterns_per_run(*patterns: str) -> tuple[str, ...]:
    """Give the patterns of files that are there for each run: in a folder of its own, or of the only run in none."""
    return (*patterns, *(f"{NUMBERED}/{pattern}" for pattern in patterns))


# A camera that is chosen, or the only one.
ANY_CAMERA = ("",)

FORMATS = {
    "kitti": Format(
        "optical flow",
        required_outputs=("flow",),
        optional_outputs=("occlusion", "png"),
        file_patterns=(
            rf"training/image_2/{NUMBERED}_1[01]\.png",
            rf"training/flow_occ/{NUMBERED}_10\.png",
            rf"training/flow_noc/{NUMBERED}_10\.png",
        ),
        numbers_pairs=True,
        cameras=ANY_CAMERA,
    ),
    "tapvid": Format(
        "tracks of points", required_outputs=("tracks", "png"), file_patterns=(r"tapvid\.pkl",), cameras=ANY_CAMERA
    ),
    "tapvid3d": Format(
        "tracks of points in space",
        required_outputs=("tracks", "png"),
        file_patterns=(rf"{NUMBERED}\.npz",),
        cameras=ANY_CAMERA,
    ),
    "stir": Format(
        "tracks of points in stereo",
        required_outputs=("tracks", "png"),
        file_patterns=(
            rf"{NUMBERED}/calib\.json",
            rf"{NUMBERED}/(?:left|right)/seq00/frames/0ms-[0-9]+ms-visible\.mp4",
            rf"{NUMBERED}/(?:left|right)/seq00/[0-9]+ms_icg(?:start|end)\.png",
            rf"{NUMBERED}/(?:left|right)/seq00/segmentation/icg(?:start|end)seg\.png",
        ),
        cameras=("left", "right"),
    ),
    "vtk": Format(
        "for ParaView",
        required_outputs=("trajectory",),
        file_patterns=_patterns_per_run(r"[0-9]{4,}\.vtu", r"surface\.pvd", r"picture\.png"),
    ),
    "gltf": Format(
        "for Blender and browsers", required_outputs=("trajectory",), file_patterns=_patterns_per_run(r"surface\.glb")
    ),
    "obj": Format(
        "for other programs with surfaces",
        required_outputs=("trajectory",),
        file_patterns=_patterns_per_run(r"[0-9]{4,}\.obj", r"surface\.mtl", r"picture\.png"),
    ),
    "csv": Format(
        "forces and tracks as tables",
        required_outputs=(),
        optional_outputs=("forces", "tracks"),
        file_patterns=(r"forces\.csv", r"tracks\.csv"),
        cameras=ANY_CAMERA,
        module="csv_tables",
    ),
}


class ExportSource(NamedTuple):
    """A run that is exported."""

    run: FinishedRun  # as the first camera that the format shows has seen it
    name: str  # its number among the runs; empty if it is the only one
    progress: Count  # of this run


# Writes the files of all runs into an empty folder. It is a generator: after each run it gives what the user should
# know about that run, and after the last it writes what is of all runs together.
FormatWriter = Callable[[Sequence[ExportSource], Path], Iterator[list[str]]]


def one_folder_per_run(write: Callable[[FinishedRun, Path, Count], list[str]]) -> FormatWriter:
    """Make a format of what writes one run into an empty folder."""

    @wraps(write)
    def write_all(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
        for source in sources:
            own = folder / source.name
            own.mkdir(exist_ok=True)
            yield write(source.run, own, source.progress)

    return write_all


def read_runs(directories: Sequence[str | Path]) -> tuple[list[FinishedRun], int]:
    """Read the records of runs in their folders and in those of sweeps; also counts the runs that are left out.

    Of a sweep these are all that are not complete.

    Raises:
        FilesError: as `read_run` does, and when no run is left.
    """
    runs, left_out = [], 0
    for directory in map(Path, directories):
        record = directory / SWEEP
        with reading(record):
            is_sweep = record.is_file() and not (directory / RECORD).is_file()
        if not is_sweep:
            runs.append(read_run(directory))
            continue
        with reading(record):
            names = list_files(directory, (rf"{RUNS}/{NUMBERED}/{RECORD}",), strict=False)
            folders = sorted(((directory / name).parent for name in names), key=lambda folder: int(folder.name))
            count = len(json.loads(read_regular(record, MAX_RECORD_BYTES))["values"])
        complete = [run for run in map(read_run, folders) if run.status == "complete"]
        left_out += count - len(complete)
        runs += complete
    if not runs:
        raise FilesError(f"{', '.join(map(str, directories))}: no run is complete; table.csv there tells why")
    return runs, left_out
