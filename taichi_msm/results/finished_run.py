"""The results of a run that has ended, read again for what is made of them afterwards."""

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
        record: what is in run.json.
        scene: as it was run: with the points, the step and the precision that were chosen, no tolerance, and pictures
            as they are found from the current directory.
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
        """Map the trajectory, after it was read once to find damage.

        Returns:
            Positions [m], shape (frames, rows, cols, 3), read-only.

        Raises:
            FilesError: when there is none, or it is damaged or of another run.
        """
        path = self.result(TRAJECTORY, "trajectory")
        dtype = np.dtype(np.float32 if self.scene.time.precision == "f32" else np.float64)
        rest = rest_positions(self.scene.sheet)
        with reading(path):
            found = map_array(path, "position", dtype, (self.frames, *rest.shape))
        # Every run begins at rest, and anybody may have written the file.
        if not np.array_equal(found[0], rest.astype(dtype)) or not all(np.isfinite(frame).all() for frame in found):
            raise damaged(path)
        return found

    def has(self, output: str) -> bool:
        """Tell whether a file or folder is among the results."""
        return (self.directory / output).exists()

    def result(self, name: str, key: str) -> Path:
        """Find a file of the results.

        Args:
            name: of the file, with its folder.
            key: what a scene's `output` must hold for it.

        Raises:
            FilesError: when it is not there.
        """
        output, path = name.partition("/")[0], self.directory / name
        if not self.has(output):
            raise FilesError(
                f"{output}: not among the results of {self.directory}; run the scene again with '{key}' in output"
            )
        if not path.is_file():
            raise FilesError(f"{path}: no such file; run the scene again")
        return path


def read_run(directory: str | Path) -> FinishedRun:
    """Read the record of a run; its other results are read when they are asked for.

    Args:
        directory: where the results are.

    Raises:
        ArgumentError: when that cannot be a path.
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
    """Turn whatever is raised while a result is read into one line with its remedy.

    Raises:
        FilesError: in the place of any error; damaged archives and records raise nearly anything.
    """
    try:
        yield
    except FilesError:
        raise
    except Exception as error:
        # What the file says of itself may lead to a place that is none.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
        raise damaged(path) from None


def damaged(path: Path) -> FilesError:
    """Make the error of a result that is not as a run has written it."""
    return FilesError(f"{path}: damaged, or not of this run; run the scene again")


def _as_run(record: Mapping[str, Any]) -> Scene:
    """Make the scene of a record with what was chosen for it.

    Raises:
        Exception: when it is none that can be run, or the record lacks something.
    """
    given, folder = Scene(**record["scene"]), Path(record["working_directory"])
    sheet = {"points": record["points"], "tolerance": None}
    time = {"step": record["step"], "precision": record["precision"], "tolerance": None}
    scene = given.model_copy(
        update={
            "sheet": given.sheet.model_copy(update=sheet),
            "time": given.time.model_copy(update=time),
            "image": None if given.image is None else str(folder / given.image),
        }
    )
    if scene.stiffness_map is not None:
        scene = scene.with_map_image(str(folder / scene.stiffness_map.image))
    found = [problem for check in (material.problems, camera.problems) for problem in check(scene)]
    # A picture that is gone, or is another now, is told of by whoever needs it.
    if any(problem.path[-1:] != ("image",) for problem in found):
        raise SceneError([str(problem) for problem in found])
    return scene
