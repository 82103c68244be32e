"""Convert the folder of a run to a folder with another program's files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taichi_msm.errors import FilesError, SceneError, writing
from taichi_msm.export.formats import EXPORT, FORMATS, RECORD
from taichi_msm.progress import Count
from taichi_msm.results.finished_run import PUT_BACK, read_run
from taichi_msm.results.publication import RESULTS, Publication


class Exported(NamedTuple):
    """What was written.

    Attributes:
        files: names in the folder, with slashes.
        notes: what the user should know about them.
    """

    files: list[str]
    notes: list[str]


def convert(run: Path, name: str, directory: Path, progress: Count = lambda done, total: None) -> Exported:
    """Convert the results of a run; the files replace those of an earlier export.

    Args:
        run: the folder of the run's results.
        name: of the format, one of `FORMATS`.
        directory: where the files go; made if it does not exist.
        progress: called with the frames done and the frames in all; what it raises stops the work, and no file changes.

    Raises:
        FilesError: when a file that is needed is missing or damaged, or the directory cannot be written.
        NotInstalledError: when a package that writes the format is not installed.
    """
    finished, wanted = read_run(run), FORMATS[name]
    progress(0, finished.frames)
    try:
        with writing(directory), Publication(directory, kind=EXPORT) as publication:
            with finished.unchanged(), np.errstate(over="raise", divide="raise", invalid="raise"):
                if missing := [key for key in wanted.needs if not finished.has(RESULTS.get(key, key))]:
                    remedy = finished.remedy(*wanted.needs, *wanted.uses)
                    raise FilesError(f"{run}: {name} needs {' and '.join(missing)}; {remedy}")
                notes = wanted.write(finished, publication.staged, progress)
            files = sorted(publication.staged.files(EXPORT.files))
            publication.staged.add(RECORD, (json.dumps({"files": files}, indent=1) + "\n").encode())
            publication.publish([*files, RECORD])
    except SceneError as error:
        # The fault names what the scene is to change; here the picture itself must be put back.
        fault = error.lines[0].partition(";")[0]
        raise FilesError(f"{run}: {fault}; {PUT_BACK}") from None
    except FloatingPointError:
        raise FilesError(f"{run}: its numbers are too large for {name}; run the scene again") from None
    return Exported(files, notes)
