"""Convert the folders of runs to a folder with another program's files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.errors import ArgumentError, Count, FilesError, SceneError, did_you_mean, require_path, writing
from taichi_msm.exports.formats import ANY_CAMERA, FORMATS, ExportSource, FormatWriter, read_runs
from taichi_msm.runs.directory import (
    IsListed,
    Publication,
    PublicationSpec,
    create_file,
    list_files,
    require_no_link,
    write_new_file,
)
from taichi_msm.runs.finished import RESTORE_PICTURE, FinishedRun
from taichi_msm.scene.outputs import OUTPUTS, numbered

# The file that lists the others, and that which leads from numbers to runs.
EXPORT_RECORD, INDEX_FILE = "export.json", "index.csv"


def _export_file_test(record: Mapping[str, Any]) -> IsListed:
    return {EXPORT_RECORD, *record["files"]}.__contains__


# The files of all formats: any of them may have been exported to a folder before, or been about to be. A folder with
# anything else in it is refused, as nobody would find it again among so many files.
EXPORT_PATTERNS = (
    r"export\.json",
    r"index\.csv",
    *dict.fromkeys(pattern for row in FORMATS.values() for pattern in row.file_patterns),
)
EXPORT_PUBLICATION = PublicationSpec("export", EXPORT_RECORD, EXPORT_PATTERNS, _export_file_test, exclusive=True)


class Exported(NamedTuple):
    """What was written."""

    directory: Path
    files: list[str]  # names in the directory, with slashes
    notes: list[str]  # what the user should know about them


def export(
    runs: str | Path | Sequence[str | Path],
    format: str,  # noqa: A002
    out: str | Path | None = None,
    progress: Count = lambda done, total: None,
    camera: str | None = None,
) -> Exported:
    """Convert the results of runs for another program, whole or not at all.

    Runs are numbered in their order; index.csv leads from the numbers to the runs. The files replace those of an
    earlier export.

    Args:
        runs: the folder of a run, or that of a sweep, of which all complete runs are taken; or several of them.
        format: kitti, tapvid, tapvid3d, stir, vtk, gltf, obj or csv.
        out: where the files go; None: into export-FORMAT, in the folder if it is one, in output if they are several.
        progress: called often, with the frames done and the frames in all; what it raises stops the export, and no file
            changes.
        camera: of runs with several cameras, the name of the one whose pictures, labels and tracks are taken.

    Returns:
        The `directory` where the files are; the names of the `files` in it; and `notes`, a line each, on what is left
        out or only near.

    Raises:
        ArgumentError: when an argument is not what it must be.
        FilesError: when a file that is needed is missing or damaged, or the files cannot be written.
        NotInstalledError: when a package that writes the format is not installed.

    Example:
        >>> from taichi_msm import export
        >>> done = export("output/press", "obj")
        >>> done.directory.name, len(done.files), done.files[-1], done.notes
        ('export-obj', 34, 'surface.mtl', [])
    """
    directories = list(runs) if isinstance(runs, Sequence) and not isinstance(runs, str) else [runs]
    for path in [*directories, *([] if out is None else [out])]:
        require_path(path)
    if not directories:
        raise ArgumentError("runs: []; take the folder of a run or of a sweep, or several")
    if format not in list(FORMATS):
        raise ArgumentError(f"format: {format!r}; take one of {', '.join(FORMATS)}{did_you_mean(str(format), FORMATS)}")
    if camera is not None and FORMATS[format].cameras != ANY_CAMERA:
        raise ArgumentError(f"camera: {camera!r}; {format} has no choice of a camera; leave it out")
    directory = _default_folder(directories, format) if out is None else Path(out)
    finished, left_out = read_runs(directories)
    if camera is not None and not any(run.camera_names() for run in finished):
        raise ArgumentError(f"camera: {camera!r}; {finished[0].directory} has one camera, without a name; leave it out")
    views = [_camera_views(run, format, camera) for run in finished]
    exported = _write_export(views, format, directory, progress)
    if left_out:
        of_all = f"{left_out} of {left_out + len(finished)} runs"
        exported.notes.insert(0, f"left out, as not complete: {of_all}; table.csv of the sweep tells why")
    return exported


def _default_folder(directories: Sequence[str | Path], name: str) -> Path:
    folder = Path(directories[0]) if len(directories) == 1 else require_no_link(Path("output"), "--out")
    return require_no_link(folder / f"export-{name}", "--out")


def _camera_views(run: FinishedRun, name: str, camera: str | None) -> list[FinishedRun]:
    """Find the results of each camera that a format shows; of the run alone if it shows none, or one without a name."""
    wanted, known = FORMATS[name], run.camera_names()
    shown = wanted.cameras
    if shown == ANY_CAMERA and camera is not None and camera in known:
        return [replace(run, camera=camera)]
    seen = [
        key
        for key in (*wanted.required_outputs, *wanted.optional_outputs)
        if OUTPUTS[key].is_seen and key in run.scene.output
    ]
    if not shown or (shown == ANY_CAMERA and not (known and seen)):
        return [run]
    said = f"its cameras are {', '.join(known)}" if known else "it has one camera, without a name"
    if shown == ANY_CAMERA:
        given, near = ("none is chosen", "") if camera is None else (repr(camera), did_you_mean(camera, known))
        raise ArgumentError(f"camera: {given}; take one of those of {run.directory}: {', '.join(known)}{near}")
    if set(shown) <= set(known):
        return [replace(run, camera=each) for each in shown]
    said = f"{name} needs the cameras {' and '.join(shown)}; {said}; run the scene with `cameras` of these names"
    raise FilesError(f"{run.directory}: {said}")


def _write_export(views: Sequence[Sequence[FinishedRun]], name: str, directory: Path, progress: Count) -> Exported:
    """Convert runs, one or more, as the cameras have seen them that the format shows."""
    runs = [run for run, *_ in views]
    wanted, total, done = FORMATS[name], sum(run.frames for run in runs), 0
    write: FormatWriter = import_module(f"taichi_msm.exports.{wanted.module or name}").write
    sources = []
    for number, run in enumerate(runs):
        own = partial(_report_progress, progress, done, run.frames, total)
        sources.append(ExportSource(run, numbered(number) if len(runs) > 1 else "", own))
        done += run.frames
    progress(0, total)
    notes: dict[str, list[Path]] = {}
    with writing(directory), Publication(directory, EXPORT_PUBLICATION) as publication:
        for run in chain.from_iterable(views):
            with run.unchanged():
                if missing := [key for key in wanted.required_outputs if not run.has_output(key)]:
                    remedy = run.remedy(*wanted.required_outputs, *wanted.optional_outputs)
                    raise FilesError(f"{run.directory / run.camera}: {name} needs {' and '.join(missing)}; {remedy}")
        writer = write(sources, publication.new_folder)
        for run in runs:
            with _name_run_in_errors(run, name), run.unchanged():
                for note in next(writer):
                    notes.setdefault(note, []).append(run.directory)
        next(writer, None)
        _write_index(runs, wanted.numbers_pairs, publication.new_folder / INDEX_FILE)
        written = sorted(list_files(publication.new_folder, EXPORT_PATTERNS, strict=True))
        write_new_file(
            publication.new_folder / EXPORT_RECORD, (json.dumps({"files": written}, indent=1) + "\n").encode()
        )
        publication.publish([*written, EXPORT_RECORD])
    return Exported(
        directory, written, [*(_name_runs(note, of) if len(runs) > 1 else note for note, of in notes.items())]
    )


def _report_progress(progress: Count, before: int, frames: int, total: int, done: int, parts: int) -> None:
    """Report the progress of a run as that of all runs."""
    progress(before + frames * done // parts, total)


@contextmanager
def _name_run_in_errors(run: FinishedRun, name: str) -> Iterator[None]:
    """Say of which run a fault is that its scene or its numbers have."""
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            yield
    except SceneError as error:
        # The fault names what the scene is to change; here the picture itself must be put back.
        fault = error.lines[0].partition(";")[0]
        raise FilesError(f"{run.directory}: {fault}; {RESTORE_PICTURE}") from None
    except FloatingPointError:
        said = f"its numbers are too large for {name}; run the scene again"
        raise FilesError(f"{run.directory}: {said}") from None


def _name_runs(note: str, runs: Sequence[Path]) -> str:
    """Say of which runs a note is."""
    return f"{runs[0]}{f' and {len(runs) - 1} more' if len(runs) > 1 else ''}: {note}"


def _write_index(runs: Sequence[FinishedRun], pairs: bool, path: Path) -> None:
    """Write which run, or which pair of frames of it, has which number."""
    rows: list[tuple[str | int, ...]] = []
    for run in runs:
        name = run.directory.as_posix()
        rows += [(name, frame) for frame in range(run.frames - 1)] if pairs else [(name,)]
    with io.TextIOWrapper(create_file(path), "utf-8", "surrogateescape", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["number", "run", *(["frame"] if pairs else [])])
        writer.writerows([numbered(number), *row] for number, row in enumerate(rows))
