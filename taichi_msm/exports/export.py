"""Export of the results of runs to files of other programs and data sets."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taichi_msm.errors import (
    ArgumentError,
    FilesError,
    ProgressCallback,
    SceneError,
    did_you_mean,
    require_path,
    require_type,
    writing,
)
from taichi_msm.exports.formats import ANY_CAMERA, FORMATS, ExportSource, FormatWriter, read_runs
from taichi_msm.images import PictureError
from taichi_msm.runs.directory import (
    Publication,
    PublicationSpec,
    create_file,
    list_files,
    require_no_link,
    write_new_file,
)
from taichi_msm.runs.finished import RESTORE_PICTURE, FinishedRun
from taichi_msm.scene.outputs import OUTPUTS, is_formula, zero_padded

RECORD = "export.json"

# Files of all formats, because the export that is replaced may have another format. Other files are errors.
PATTERNS = (
    r"export\.json",
    r"index\.csv",
    *dict.fromkeys(pattern for export_format in FORMATS.values() for pattern in export_format.file_patterns),
)

PUBLICATION = PublicationSpec(
    "export", RECORD, PATTERNS, lambda record: {RECORD, *record["files"]}.__contains__, exclusive=True
)


class Exported(NamedTuple):
    """Result of an export."""

    directory: Path
    files: list[str]  # relative paths with slashes
    notes: list[str]  # warnings


def export(
    runs: str | Path | Sequence[str | Path],
    format: str,  # noqa: A002
    out: str | Path | None = None,
    progress: ProgressCallback = lambda done, total: None,
    camera: str | None = None,
) -> Exported:
    """Export the results of runs to the format of another program, atomically.

    Runs are numbered in order; index.csv maps the numbers to the runs. The files replace those of an earlier export.

    Args:
        runs: folder of a run, or of a sweep, whose complete runs are exported; or a sequence of folders.
        format: kitti, tapvid, tapvid3d, stir, endonerf, rerun, vtk, gltf, obj or csv.
        out: destination; None for a folder export-FORMAT, in that of a single run or sweep, or in output/ for several.
        progress: called with the finished and the total number of frames; an exception in it cancels the export and
            leaves all files unchanged.
        camera: for runs with several cameras, the name of the camera whose pictures, labels and tracks are exported.

    Returns:
        The `directory`; the relative paths of the `files` in it; and `notes`, which list omissions and approximations.

    Raises:
        ArgumentError: when an argument is invalid.
        FilesError: when a required file is missing or damaged, or the files cannot be written.
        NotInstalledError: when a package for the format is not installed.

    Example:
        >>> from taichi_msm import export
        >>> done = export("output/press", "obj")
        >>> done.directory.name, len(done.files), done.files[-1], done.notes
        ('export-obj', 34, 'surface.mtl', [])
    """
    directories = list(runs) if isinstance(runs, Sequence) and not isinstance(runs, str) else [runs]
    for path in [*directories, *([] if out is None else [out])]:
        require_path(path)
    require_type(progress, Callable, "progress", "a function")
    if not directories:
        raise ArgumentError("runs: []; take the folder of a run or of a sweep, or several")
    if format not in list(FORMATS):
        raise ArgumentError(f"format: {format!r}; take one of {', '.join(FORMATS)}{did_you_mean(str(format), FORMATS)}")
    if camera is not None and FORMATS[format].cameras != ANY_CAMERA:
        raise ArgumentError(f"camera: {camera!r}; {format} does not select a camera; remove camera")
    if out is None:
        folder = Path(directories[0]) if len(directories) == 1 else require_no_link(Path("output"), "--out")
        directory = require_no_link(folder / f"export-{format}", "--out")
    else:
        directory = Path(out)
    finished, incomplete = read_runs(directories)
    if camera is not None and not any(run.camera_names() for run in finished):
        raise ArgumentError(f"camera: {camera!r}; {finished[0].directory} has one unnamed camera; remove camera")
    camera_runs = [_select_cameras(run, format, camera) for run in finished]
    exported = _write_export(camera_runs, format, directory, progress)
    if incomplete:
        count = f"{incomplete} of {incomplete + len(finished)} runs"
        exported.notes.insert(0, f"incomplete runs are left out, {count}; the sweep's table.csv has the reasons")
    return exported


def _select_cameras(run: FinishedRun, name: str, camera: str | None) -> list[FinishedRun]:
    """Return a copy of a run for every camera that a format exports, with this camera selected."""
    export_format, known = FORMATS[name], run.camera_names()
    if export_format.cameras != ANY_CAMERA:
        if set(export_format.cameras) <= set(known):
            return [replace(run, camera=camera) for camera in export_format.cameras] or [run]
        cameras = f"its cameras are {', '.join(known)}" if known else "it has one camera, without a name"
        fault = f"{name} needs the cameras {' and '.join(export_format.cameras)}; {cameras}"
        raise FilesError(f"{run.directory}: {fault}; run the scene with `cameras` of these names")
    if camera is not None and camera in known:
        return [replace(run, camera=camera)]
    outputs = (*export_format.required_outputs, *export_format.optional_outputs)
    if not known or not any(OUTPUTS[key].is_camera_output and key in run.scene.output for key in outputs):
        return [run]
    choice, hint = ("none is chosen", "") if camera is None else (repr(camera), did_you_mean(camera, known))
    raise ArgumentError(f"camera: {choice}; take one of those of {run.directory}: {', '.join(known)}{hint}")


def _write_export(
    camera_runs: Sequence[Sequence[FinishedRun]], name: str, directory: Path, progress: ProgressCallback
) -> Exported:
    """Write an export atomically. `camera_runs` has the copies of every run by `_select_cameras`."""
    runs = [run for run, *_ in camera_runs]
    export_format, total, done = FORMATS[name], sum(run.frames for run in runs), 0
    module = import_module(f"taichi_msm.exports.{export_format.module or name}")
    write: FormatWriter = module.write
    sources, is_numbered = [], len(runs) > 1
    for number, run in enumerate(runs):
        run_progress = partial(_report_progress, progress, done, run.frames, total)
        sources.append(ExportSource(run, zero_padded(number) if is_numbered else "", run_progress))
        done += run.frames
    progress(0, total)
    notes: dict[str, list[Path]] = {}
    with writing(directory), Publication(directory, PUBLICATION) as publication:
        for run in chain.from_iterable(camera_runs):
            with run.unchanged():
                if missing := [key for key in export_format.required_outputs if not run.has_output(key)]:
                    if export_format.checks_camera:
                        # No outputs help a camera that the format cannot describe.
                        with _name_run_in_errors(run, name):
                            module.check_camera(run)
                    remedy = run.remedy(*export_format.required_outputs, *export_format.optional_outputs)
                    raise FilesError(f"{run.directory / run.camera}: {name} needs {' and '.join(missing)}; {remedy}")
        writer = write(sources, publication.new_folder)
        for run in runs:
            with _name_run_in_errors(run, name), run.unchanged():
                for note in next(writer):
                    notes.setdefault(note, []).append(run.directory)
        next(writer, None)  # writes the files that combine runs
        _write_index(runs, export_format.numbers_pairs, publication.new_folder / "index.csv")
        written = sorted(list_files(publication.new_folder, PATTERNS, strict=True))
        write_new_file(publication.new_folder / RECORD, (json.dumps({"files": written}, indent=1) + "\n").encode())
        publication.publish([*written, RECORD])
    named = [_name_runs(note, directories) if is_numbered else note for note, directories in notes.items()]
    return Exported(directory, written, named)


def _report_progress(progress: ProgressCallback, before: int, frames: int, total: int, done: int, parts: int) -> None:
    """Report the progress within a run as progress within all runs."""
    progress(before + frames * done // parts, total)


@contextmanager
def _name_run_in_errors(run: FinishedRun, name: str) -> Iterator[None]:
    """Convert scene and floating-point errors of a run to a FilesError that names the run."""
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            yield
    except SceneError as error:
        # The remedy of a picture, to change the scene, does not apply to a finished run.
        cause = error.__cause__
        fault = f"image: {cause.fault}" if isinstance(cause, PictureError) else error.lines[0]
        raise FilesError(f"{run.directory}: {fault}; {RESTORE_PICTURE}") from None
    except FloatingPointError:
        raise FilesError(f"{run.directory}: its numbers are too large for {name}; run the scene again") from None


def _name_runs(note: str, directories: Sequence[Path]) -> str:
    more = f" and {len(directories) - 1} more" if len(directories) > 1 else ""
    return f"{directories[0]}{more}: {note}"


def _write_index(runs: Sequence[FinishedRun], pairs: bool, path: Path) -> None:
    rows: list[tuple[str | int, ...]] = []
    for run in runs:
        name = run.directory.as_posix()
        name = f"./{name}" if is_formula(name) else name
        rows += [(name, frame) for frame in range(run.frames - 1)] if pairs else [(name,)]
    with io.TextIOWrapper(create_file(path), "utf-8", "surrogateescape", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["number", "run", *(["frame"] if pairs else [])])
        writer.writerows([zero_padded(number), *row] for number, row in enumerate(rows))
