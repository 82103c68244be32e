"""Registry of the export formats: each is a row of `FORMATS`, and a module of its name with a function `write`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from taichi_msm.errors import FilesError, ProgressCallback
from taichi_msm.runs.directory import MAX_RECORD_BYTES, list_files
from taichi_msm.runs.finished import FinishedRun, read_run, reading
from taichi_msm.scene.outputs import NUMBER_PATTERN, RUN_RECORD, RUNS_FOLDER, SWEEP_RECORD, zero_padded
from taichi_msm.system.files import read_regular

# Value of `Format.cameras` for the camera of the user's choice, or the only one.
ANY_CAMERA = ("",)


class Format(NamedTuple):
    """Export format."""

    description: str  # for the help text
    file_patterns: tuple[str, ...]  # regular expressions, for `list_files`
    required_outputs: tuple[str, ...] = ("trajectory",)  # entries of a scene's `output`
    optional_outputs: tuple[str, ...] = ()  # further exported entries of `output`
    numbers_pairs: bool = False  # whether files are numbered by pair of frames, and not by run
    cameras: tuple[str, ...] = ANY_CAMERA  # names of the exported cameras; empty for a format without camera
    checks_camera: bool = False  # whether the module has `check_camera(run)`, for cameras that it cannot describe
    module: str = ""  # name of the module; empty for the name of the format


def _patterns_per_run(*patterns: str) -> tuple[str, ...]:
    """Return the patterns of files per run: in a numbered folder, or without a folder for a single run."""
    return (*patterns, *(f"{NUMBER_PATTERN}/{pattern}" for pattern in patterns))


FORMATS = {
    "kitti": Format(
        "optical flow",
        (
            rf"training/image_2/{NUMBER_PATTERN}_1[01]\.png",
            rf"training/flow_occ/{NUMBER_PATTERN}_10\.png",
            rf"training/flow_noc/{NUMBER_PATTERN}_10\.png",
        ),
        required_outputs=("flow",),
        optional_outputs=("occlusion", "png"),
        numbers_pairs=True,
    ),
    "tapvid": Format("tracks of points", (r"tapvid\.pkl",), required_outputs=("tracks", "png")),
    "tapvid3d": Format(
        "tracks of points in space",
        (rf"{NUMBER_PATTERN}\.npz",),
        required_outputs=("tracks", "png"),
        checks_camera=True,
    ),
    "stir": Format(
        "tracks of points in stereo",
        (
            rf"{NUMBER_PATTERN}/calib\.json",
            rf"{NUMBER_PATTERN}/(?:left|right)/seq00/frames/0ms-[0-9]+ms-visible\.mp4",
            rf"{NUMBER_PATTERN}/(?:left|right)/seq00/[0-9]+ms_icg(?:start|end)\.png",
            rf"{NUMBER_PATTERN}/(?:left|right)/seq00/segmentation/icg(?:start|end)seg\.png",
        ),
        required_outputs=("tracks", "png"),
        cameras=("left", "right"),
        checks_camera=True,
    ),
    "endonerf": Format(
        "neural reconstruction of tissue",
        _patterns_per_run(rf"(?:images|depth|masks)/{NUMBER_PATTERN}\.png", r"poses_bounds\.npy"),
        required_outputs=("depth", "instrument", "png"),
        checks_camera=True,
    ),
    "rerun": Format(
        "for the viewer of rerun.io",
        (rf"{NUMBER_PATTERN}\.rrd",),
        optional_outputs=("png", "depth", "flow", "tracks"),
        cameras=(),
    ),
    "vtk": Format("for ParaView", _patterns_per_run(r"[0-9]{4,}\.vtu", r"surface\.pvd", r"picture\.png"), cameras=()),
    "gltf": Format("for Blender and browsers", _patterns_per_run(r"surface\.glb"), cameras=()),
    "obj": Format(
        "for other programs with surfaces",
        _patterns_per_run(r"[0-9]{4,}\.obj", r"surface\.mtl", r"picture\.png"),
        cameras=(),
    ),
    "csv": Format(
        "forces and tracks as tables",
        (r"forces\.csv", r"tracks\.csv"),
        required_outputs=(),
        optional_outputs=("forces", "tracks"),
        module="csv_tables",
    ),
}


class ExportSource(NamedTuple):
    """Run to export."""

    run: FinishedRun  # with the first of the format's cameras selected
    name: str  # number of the run as text; empty for a single run
    progress: ProgressCallback  # called with the finished and total frames of this run


class FormatWriter(Protocol):
    """Function `write` of a format."""

    def __call__(self, sources: Sequence[ExportSource], folder: Path, /) -> Iterator[list[str]]:
        """Write all runs.

        Args:
            sources: runs to export.
            folder: existing, empty folder of the export.

        Yields:
            Warnings about each run in turn. Files that combine runs are written after the last one.

        Raises:
            FilesError: when results are missing or damaged or do not suit the format.
            SceneError: when a picture has changed since the run.
            ArgumentError: when the format cannot describe the camera.
            NotInstalledError: when a package is missing.
        """


class RunWriter(Protocol):
    """Function that writes the files of a single run."""

    def __call__(self, run: FinishedRun, path: Path, progress: ProgressCallback, /) -> list[str]:
        """Write a run and return warnings.

        Args:
            run: run to export, with the first of the format's cameras selected.
            path: existing folder of the run's files, or the file or folder to create.
            progress: called with the finished and the total number of frames.

        Raises:
            FilesError, SceneError, ArgumentError, NotInstalledError: as for `FormatWriter`.
        """


def one_folder_per_run(write: RunWriter) -> FormatWriter:
    """Return the writer of a format with a folder per run, or with the files of a single run directly in the export."""

    def write_all(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
        for run, name, progress in sources:
            (folder / name).mkdir(exist_ok=True)
            yield write(run, folder / name, progress)

    return write_all


def one_path_per_run(write: RunWriter, suffix: str = "") -> FormatWriter:
    """Return the writer of a format with a file or folder per run, named by the number of the run and `suffix`."""

    def write_all(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
        for run, name, progress in sources:
            yield write(run, folder / f"{name or zero_padded(0)}{suffix}", progress)

    return write_all


def read_runs(directories: Sequence[str | Path]) -> tuple[list[FinishedRun], int]:
    """Read the records of runs, given as folders of runs or of sweeps; raise a FilesError if no run is complete.

    Return the runs, without the incomplete runs of sweeps; and the number of these.
    """
    runs, incomplete = [], 0
    for directory in map(Path, directories):
        record = directory / SWEEP_RECORD
        with reading(record):
            is_sweep = record.is_file() and not (directory / RUN_RECORD).is_file()
        if not is_sweep:
            runs.append(read_run(directory))
            continue
        with reading(record):
            names = list_files(directory, (rf"{RUNS_FOLDER}/{NUMBER_PATTERN}/{RUN_RECORD}",), strict=False)
            folders = sorted(((directory / name).parent for name in names), key=lambda folder: int(folder.name))
            count = len(json.loads(read_regular(record, MAX_RECORD_BYTES))["values"])
        complete = [run for run in map(read_run, folders) if run.status == "complete"]
        incomplete += count - len(complete)
        runs += complete
    if not runs:
        raise FilesError(f"{', '.join(map(str, directories))}: no run is complete; table.csv has the reasons")
    return runs, incomplete
