"""Convert the folder of a run to a folder with another program's files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.errors import FilesError, SceneError, writing
from taichi_msm.exports.formats import FORMATS
from taichi_msm.progress import Count
from taichi_msm.results.entries import files
from taichi_msm.results.finished_run import PUT_BACK, read_run
from taichi_msm.results.publication import Contents, Listed, Publication
from taichi_msm.results.whole import add

# The file that lists the others.
RECORD = "export.json"


def _listed(record: Mapping[str, Any]) -> Listed:
    return {RECORD, *record["files"]}.__contains__


# The files of all formats: any of them may have been exported to a folder before, or been about to be. A folder with
# anything else in it is refused, as nobody would find it again among so many files.
PATTERNS = (r"export\.json", *dict.fromkeys(pattern for row in FORMATS.values() for pattern in row.files))
EXPORT = Contents("export", RECORD, PATTERNS, _listed, alone=True)


class Exported(NamedTuple):
    """What was written."""

    files: list[str]  # names in the folder, with slashes
    notes: list[str]  # what the user should know about them


def convert(run: Path, name: str, directory: Path, progress: Count = lambda done, total: None) -> Exported:
    """Convert the results of a run to the format of this name; the files replace those of an earlier export.

    `progress` is called with the frames done and the frames in all; what it raises stops the work, and no file changes.

    Raises:
        FilesError: when a file that is needed is missing or damaged, or the directory cannot be written.
        NotInstalledError: when a package that writes the format is not installed.
    """
    finished, wanted = read_run(run), FORMATS[name]
    # Writes the files of a run into an empty folder, and returns what the user should know about them.
    write = import_module(f"taichi_msm.exports.{name}").write
    progress(0, finished.frames)
    try:
        with writing(directory), Publication(directory, EXPORT) as publication:
            with finished.unchanged(), np.errstate(over="raise", divide="raise", invalid="raise"):
                if missing := [key for key in wanted.needs if not finished.has(key)]:
                    remedy = finished.remedy(*wanted.needs, *wanted.uses)
                    raise FilesError(f"{run}: {name} needs {' and '.join(missing)}; {remedy}")
                notes = write(finished, publication.staged, progress)
            written = sorted(files(publication.staged, PATTERNS, strict=True))
            add(publication.staged / RECORD, (json.dumps({"files": written}, indent=1) + "\n").encode())
            publication.publish([*written, RECORD])
    except SceneError as error:
        # The fault names what the scene is to change; here the picture itself must be put back.
        fault = error.lines[0].partition(";")[0]
        raise FilesError(f"{run}: {fault}; {PUT_BACK}") from None
    except FloatingPointError:
        raise FilesError(f"{run}: its numbers are too large for {name}; run the scene again") from None
    return Exported(written, notes)
