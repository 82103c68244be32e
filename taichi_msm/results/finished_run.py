"""Read the results of a run that has ended, for later use."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arguments import require_path
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.physics import material
from taichi_msm.physics.lattice import rest_positions
from taichi_msm.render import camera
from taichi_msm.results.npz import map_array
from taichi_msm.results.publication import MAX_RECORD, RECORD, TRAJECTORY
from taichi_msm.scene import Scene


@dataclass(frozen=True)
class FinishedRun:
    """A run that has ended, complete or not.

    Attributes:
        directory: where its results are.
        record: the content of run.json.
        scene: the scene as it was run: with the points, the step and the precision that were chosen, without a
            tolerance, and with paths of pictures that are relative to the current directory.
        frames: how many were simulated.
    """

    directory: Path
    record: Mapping[str, Any]
    scene: Scene
    frames: int

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of every frame [s], shape (frames,)."""
        return np.arange(self.frames) / self.scene.time.frames_per_second

    def positions(self) -> NDArray[np.floating]:
        """Map the trajectory into memory, after reading it once to find damage.

        Returns:
            Positions [m], shape (frames, rows, cols, 3), read-only.

        Raises:
            FilesError: when there is none, or it is damaged or belongs to another run.
        """
        path = self.result(TRAJECTORY, "trajectory")
        dtype = np.dtype(np.float32 if self.scene.time.precision == "f32" else np.float64)
        rest = rest_positions(self.scene.sheet)
        with reading(path):
            found = map_array(path, "position", dtype, (self.frames, *rest.shape))
        # Every run begins at rest; this is checked, as anybody may have written the file.
        if not np.array_equal(found[0], rest.astype(dtype)) or not all(np.isfinite(frame).all() for frame in found):
            raise damaged(path)
        return found

    def has(self, output: str) -> bool:
        """Tell whether a file or folder is among the results."""
        return (self.directory / output).exists()

    def remedy(self, *keys: str) -> str:
        """Say how to get the results of further entries of a scene's `output`."""
        outputs = ",".join(dict.fromkeys([*self.scene.output, *keys]))
        return f'run the scene again with --set "output=[{outputs}]"'

    def result(self, name: str, key: str) -> Path:
        """Find a file of the results.

        Args:
            name: of the file, with its folder.
            key: the entry of a scene's `output` that makes a run write it.

        Raises:
            FilesError: when it is not there.
        """
        output, path = name.partition("/")[0], self.directory / name
        if not self.has(output):
            raise FilesError(f"{output}: not among the results of {self.directory}; {self.remedy(key)}")
        if not path.is_file():
            raise FilesError(f"{path}: no such file; {self.remedy(key)}")
        return path


def read_run(directory: str | Path) -> FinishedRun:
    """Read the record of a run; its other results are read only when they are asked for.

    Args:
        directory: where the results are.

    Raises:
        ArgumentError: when the directory cannot be a path.
        FilesError: when there is no record of a run, or one that no run has written.
    """
    require_path(directory)
    path = Path(directory) / RECORD
    with reading(path):
        if not path.is_file():
            raise FilesError(f"{path.parent}: no results of a run; name the folder that `run --out` wrote")
        with path.open("rb") as file:
            record = json.loads(file.read(MAX_RECORD))
        scene, frames = _as_run(record), record["frames"]
        if not isinstance(frames, int) or not 1 <= frames <= scene.time.frames + 1 or scene.time.precision == "auto":
            raise damaged(path)
    return FinishedRun(path.parent, record, scene, frames)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error that is raised while a result is read into one line with its remedy.

    Raises:
        FilesError: instead of any other error; damaged archives and records raise nearly anything.
    """
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
    """Make the scene of a record.

    Raises:
        Exception: when the scene cannot be run, or the record lacks something.
    """
    given, folder = Scene(**record["scene"]), Path(record["working_directory"])
    scene = given.model_copy(update={"image": None if given.image is None else str(folder / given.image)})
    if scene.stiffness_map is not None:
        scene = scene.with_map_image(str(folder / scene.stiffness_map.image))
    found = [problem for check in (material.problems, camera.problems) for problem in check(scene)]
    # A picture that is missing, or has changed, is reported by the code that needs it.
    if any(problem.path[-1:] != ("image",) for problem in found):
        raise SceneError([str(problem) for problem in found])
    return scene
