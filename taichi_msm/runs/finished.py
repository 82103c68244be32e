"""Read the results of a run that has ended, for later use."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from taichi_msm.errors import FilesError, MsmError, SceneError, require_path
from taichi_msm.images import PictureError, file_sha256, read_rgb
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import camera_problems
from taichi_msm.runs.arrays import map_array
from taichi_msm.runs.directory import FILE, FOLDER, MAX_RECORD, kind
from taichi_msm.scene.outputs import OUTPUTS, RUN_RECORD, SWEEP_RECORD
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.files import read_regular

# The largest number of f32.
MOST = float(np.finfo(np.float32).max)

_DIGESTS, _OVERRIDES = TypeAdapter(dict[str, str]), TypeAdapter(list[str])

PUT_BACK = "put back the picture that it was run with, or run the scene again"


@dataclass(frozen=True)
class FinishedRun:
    """A run that has ended, complete or not.

    Its scene is that which was run: with the points, the step and the precision that were chosen, without a tolerance,
    and with paths of pictures that are relative to the current directory.
    """

    directory: Path  # where its results are
    status: str  # how it ended, as in `RunRecord`
    scene: Scene
    frames: int  # how many were simulated
    sha256: Mapping[str, str]  # of the files of its pictures, by the keys that name them
    overrides: list[str]  # that made the scene from its file
    _record: bytes = field(repr=False)
    camera: str = ""  # of which what is seen is read; "": the only one, without a name

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of every frame [s], shape (frames,)."""
        return np.arange(self.frames) / self.scene.time.frames_per_second

    def positions(self) -> NDArray[np.floating]:
        """Map the trajectory [m], shape (frames, rows, cols, 3), read-only, after reading it once to find damage.

        Raises:
            FilesError: when there is none, or it is damaged or belongs to another run.
        """
        path = self.result("trajectory")
        dtype = np.dtype(np.float32 if self.scene.time.precision == "f32" else np.float64)
        rest = rest_positions(self.scene.sheet)
        with reading(path):
            positions = map_array(path, "position", dtype, (self.frames, *rest.shape))
        # Every run in motion begins flat; this is checked, as anybody may have written the file. Kernels and other
        # programs take numbers in f32. Written so that NaN is found too.
        begins_right = self.scene.time.at_rest or np.array_equal(positions[0], rest.astype(dtype))
        if not begins_right or not all(np.abs(position).max() <= MOST for position in positions):
            raise damaged(path)
        return positions

    def picture(self, key: str, frame: int) -> NDArray[np.uint8]:
        """Read a picture that was written for an entry of `output`; colours, shape (height, width, 3).

        Raises a FilesError when it is missing or cannot be read, or has another size than the scene's.
        """
        path = self.result(key, frame)
        try:
            image = read_rgb(str(path), (0, 0, 0))
        except PictureError as error:
            raise FilesError(f"{error}, or run the scene again") from None
        if image.size != self.scene.render.size:
            raise damaged(path)
        return np.asarray(image)

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Raise a FilesError when another run publishes its results in the block; also instead of what that raises."""
        try:
            yield
        except MsmError:
            self._require_unchanged()
            raise
        self._require_unchanged()

    def _require_unchanged(self) -> None:
        # A run removes this file before it moves any other.
        data = b""
        with suppress(OSError):
            data = read_regular(self.directory / RUN_RECORD, MAX_RECORD)
        if data != self._record:
            raise FilesError(f"{self.directory}: another run replaced these results while they were read; try again")

    def require_pictures(self, *, drawn: bool) -> None:
        """Raise a FilesError if a map, or the picture if it is `drawn`, is not what was run, by its SHA-256."""
        for key, path in self.scene.pictures.items():
            if key == "image" and not drawn:
                continue
            fault = f"{path} is not the file that was run, as its SHA-256 tells"
            try:
                if file_sha256(path) == self.sha256.get(key):
                    continue
            except PictureError as error:
                fault = str(error).partition(";")[0]
            raise FilesError(f"{self.directory}: {key}: {fault}; {PUT_BACK}")

    def has(self, key: str) -> bool:
        """Tell whether the results have what an entry of `output` asks for."""
        path = self._folder(key) / OUTPUTS[key].result
        with reading(path):
            return path.exists()

    def cameras(self) -> list[str]:
        """Name the cameras; none: it has one, without a name."""
        return list(self.scene.render.cameras or ())

    def _folder(self, key: str) -> Path:
        """Give the folder of what was written for an entry of `output`."""
        return self.directory / self.camera if OUTPUTS[key].is_camera_output else self.directory

    def remedy(self, *keys: str) -> str:
        """Say how to get the results of further entries of a scene's `output`."""
        outputs = ",".join(dict.fromkeys([*self.scene.output, *keys]))
        if (self.directory / ".." / ".." / SWEEP_RECORD).is_file():
            return f"run the sweep into a new folder with `set: {{output: [{outputs}]}}` in its file"
        return f'run the scene again with --set "output=[{outputs}]"'

    def result(self, key: str, frame: int = 0) -> Path:
        """Find a file that was written for an entry of `output`, of a frame if there is one for each.

        Raises a FilesError when it is not there.
        """
        result, folder = OUTPUTS[key].result, self._folder(key)
        path = folder / OUTPUTS[key].path(frame)
        if not self.has(key):
            raise FilesError(f"{result}: not among the results of {folder}; {self.remedy(key)}")
        return self.own(path, key)

    def own(self, path: Path, key: str) -> Path:
        """Make sure that a file was written by the run.

        The results may come from anybody, and what is read may be given to others: no link leads out of the folder.

        Args:
            path: the file, below the run's folder.
            key: the entry of `output` that writes it.

        Returns:
            The path.

        Raises:
            FilesError: when it is not there, is no file, or it or a folder on the way to it is a link.
        """
        below = path.relative_to(self.directory)
        for inner in [*list(below.parents)[-2::-1], below]:
            place = self.directory / inner
            with reading(place):
                found = kind(place)
            if found not in (None, FILE if place == path else FOLDER):
                raise FilesError(f"{place}: {found}, which no run writes; {self.remedy(key)}")
            if found is None:
                raise FilesError(f"{place}: no such file; {self.remedy(key)}")
        return path


def read_run(directory: str | Path) -> FinishedRun:
    """Read the record of a run; its other results are read only when they are asked for.

    Raises:
        ArgumentError: when the directory cannot be a path.
        FilesError: when there is no record of a run, or one that no run has written.
    """
    require_path(directory)
    path = Path(directory) / RUN_RECORD
    with reading(path):
        if not path.is_file():
            raise FilesError(f"{path.parent}: no results of a run; name the folder that `run --out` wrote")
        if kind(path) != FILE:
            raise FilesError(f"{path}: {kind(path)}, which no run writes; name the folder that `run --out` wrote")
        data = read_regular(path, MAX_RECORD)
        record = json.loads(data)
        scene, frames = _as_run(record), record["frames"]
        sha256, overrides = _DIGESTS.validate_python(record["sha256"]), _OVERRIDES.validate_python(record["overrides"])
        chosen = scene.time.precision != "auto" and scene.sheet.tolerance is scene.time.tolerance is None
        if not isinstance(frames, int) or not 1 <= frames <= scene.time.frames + 1 or not chosen:
            raise damaged(path)
    return FinishedRun(path.parent, record["status"], scene, frames, sha256, overrides, data, scene.render.main)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error while a result is read into a FilesError; damaged archives and records raise nearly anything."""
    try:
        yield
    except FilesError:
        raise
    except Exception as error:
        # The numbers in a damaged file may lead to an impossible position.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
        raise damaged(path) from None


def damaged(path: Path) -> FilesError:
    """Make the error for a result that is not what the run has written."""
    return FilesError(f"{path}: damaged, or not of this run; run the scene again")


def _as_run(record: Mapping[str, Any]) -> Scene:
    """Make the scene of a record, whose pictures are found from the current directory."""
    scene, folder = Scene(**record["scene"]), Path(record["working_directory"])
    if folder != Path.cwd():
        scene = scene.with_pictures(lambda path: str(folder / path))
    problems = [*try_plan(scene)[1], *camera_problems(scene)]
    # A picture that is missing, or has changed, is reported by the code that needs it, and a step was good for the map
    # that was run.
    if any(problem.path[-1:] != ("image",) and problem.path[0] != "time" for problem in problems):
        raise SceneError([str(problem) for problem in problems])
    return scene
