"""Reader of the results of a finished run. Files are validated, because they may be untrusted."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from taichi_msm.errors import FilesError, SceneError, require_path
from taichi_msm.images import PictureError, file_sha256, read_rgb, use_folder
from taichi_msm.model.geometry import Rest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import camera_problems
from taichi_msm.runs.arrays import map_array
from taichi_msm.runs.directory import FILE, FOLDER, MAX_RECORD_BYTES, entry_kind
from taichi_msm.scene.framing import is_framed
from taichi_msm.scene.outputs import OUTPUTS, REST_FILE, RUN_RECORD, SWEEP_RECORD
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.surface import KeptGrid
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.files import read_regular

_DIGESTS, _OVERRIDES = TypeAdapter(dict[str, str]), TypeAdapter(list[str])

RESTORE_PICTURE = "restore the original file, or run the scene again"


@dataclass(frozen=True)
class FinishedRun:
    """Results of a run that has ended, complete or not."""

    directory: Path  # folder of the results
    status: str  # as in `RunRecord`
    scene: Scene  # with resolved mesh, step and precision, and picture paths relative to the current directory
    frames: int  # number of simulated frames
    largest_frame: int  # index of the frame with the largest displacement; the last frame if unrecorded
    sha256: Mapping[str, str]  # of picture, map and camera files, by scene key
    overrides: list[str]  # of the scene file
    _record: bytes = field(repr=False)  # content of run.json
    camera: str = ""  # camera whose pictures, labels and tracks are read; empty for an unnamed camera

    @property
    def time(self) -> NDArray[np.float64]:
        """Time of every frame [s], shape (frames,)."""
        return np.arange(self.frames) / self.scene.time.frames_per_second

    def positions(self) -> NDArray[np.floating]:
        """Map the positions of the mass points [m], shape (frames, rows, cols, 3), into memory, read-only."""
        path = self.result_path("trajectory")
        dtype = np.dtype(np.float32 if self.scene.time.precision == "f32" else np.float64)
        rest = rest_positions(self.scene.sheet)
        with reading(path):
            positions = map_array(path, "position", dtype, (self.frames, *rest.shape))
        # A dynamic run begins with the flat sheet.
        if not (self.scene.time.at_rest or np.array_equal(positions[0], rest.astype(dtype))):
            raise damaged_result(path)
        # Kernels and export formats need values in the range of f32; NaN compares as false.
        largest = float(np.finfo(np.float32).max)
        if not all(np.abs(position).max() <= largest for position in positions):
            raise damaged_result(path)
        return positions

    def read_picture(self, key: str, frame: int) -> NDArray[np.uint8]:
        """Read the picture of a frame, shape (height, width, 3), of an entry of `output` such as "png"."""
        path = self.result_path(key, frame)
        try:
            image = read_rgb(str(path), (0, 0, 0))
        except PictureError as error:
            raise FilesError(f"{error}, or run the scene again") from None
        if image.size != self.scene.render.size:
            raise damaged_result(path)
        return np.asarray(image)

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Return a context that raises a FilesError if another run replaces the results inside the block."""
        try:
            yield
        finally:
            # A new publication moves run.json away before other files.
            data = b""
            with suppress(OSError):
                data = read_regular(self.directory / RUN_RECORD, MAX_RECORD_BYTES)
            if data != self._record:
                fault = "another run replaced these results while they were read"
                raise FilesError(f"{self.directory}: {fault}; try again")

    def require_same_pictures(self, *, drawn: bool) -> None:
        """Raise a FilesError unless the maps, and if `drawn` the picture, have the SHA-256 of the run."""
        self._require_same({key: path for key, path in self.scene.pictures.items() if drawn or key != "image"})

    def _require_same(self, files: Mapping[str, str]) -> None:
        for key, path in files.items():
            _require_digest(path, self.sha256.get(key), f"{self.directory}: {key}")

    def _frozen_sheet(self) -> Sheet:
        """Return the sheet with the even grid in rest.npz, if it has one."""
        sheet, path = self.scene.sheet, self.directory / REST_FILE
        if not (sheet.surface and sheet.surface.is_even):
            return sheet.with_frozen_surface(None, None)
        with reading(path):
            if entry_kind(path) != FILE:
                fault = entry_kind(path) or "no such file"
                raise FilesError(f"{path}: {fault}; restore it, or run the scene again")
            grid = np.array(map_array(path, "grid", np.float64, (*sheet.points, 2)))
        if not np.isfinite(grid).all():
            raise damaged_result(path)
        return sheet.with_frozen_surface(None, KeptGrid.of(grid))

    def rest(self) -> Rest | None:
        """Return the sheet at rest with its mask and its picture by a camera, None without both.

        Raise a FilesError unless its files have the SHA-256 of the run.
        """
        if self.scene.sheet.mask is None and self.scene.calibrated_size is None:
            return None
        self._require_same(self.scene.sheet.files)
        return rest_of(self.scene.sheet)

    def has_output(self, key: str) -> bool:
        """Return whether the results contain the files of an entry of `output`."""
        path = self._output_folder(key) / OUTPUTS[key].result
        with reading(path):
            return path.exists()

    def camera_names(self) -> list[str]:
        """Return the names of the cameras; empty for a single unnamed camera."""
        return list(self.scene.render.cameras or ())

    def _output_folder(self, key: str) -> Path:
        return self.directory / self.camera if OUTPUTS[key].is_camera_output else self.directory

    def remedy(self, *keys: str) -> str:
        """Return the remedy for missing entries of `output`, for messages."""
        outputs = ",".join(dict.fromkeys([*self.scene.output, *keys]))
        if (self.directory / ".." / ".." / SWEEP_RECORD).is_file():
            return f"run the sweep into a new folder with `set: {{output: [{outputs}]}}` in its file"
        return f'run the scene again with --set "output=[{outputs}]"'

    def result_path(self, key: str, frame: int = 0) -> Path:
        """Return the path of a file of an entry of `output`, for a series that of a frame; a FilesError without it."""
        result, folder = OUTPUTS[key].result, self._output_folder(key)
        path = folder / OUTPUTS[key].path(frame)
        if not self.has_output(key):
            raise FilesError(f"{result}: not among the results of {folder}; {self.remedy(key)}")
        return self.require_regular_file(path, key)

    def require_regular_file(self, path: Path, key: str) -> Path:
        """Return a path below the run's folder; raise a FilesError unless it is a regular file.

        Links on the path, which could expose other files, are not allowed. `key` is the entry of `output`, for the
        remedy.
        """
        relative = path.relative_to(self.directory)
        for inner in [*reversed(relative.parents), relative][1:]:  # without the run's folder itself
            entry = self.directory / inner
            with reading(entry):
                kind = entry_kind(entry)
            if kind is None:
                raise FilesError(f"{entry}: no such file; {self.remedy(key)}")
            if kind != (FILE if inner == relative else FOLDER):
                raise FilesError(f"{entry}: {kind}, which no run writes; {self.remedy(key)}")
        return path


def read_run(directory: str | Path) -> FinishedRun:
    """Read the record of a finished run, run.json; other results are read on demand."""
    require_path(directory)
    path = Path(directory) / RUN_RECORD
    with reading(path):
        if not path.is_file():
            raise FilesError(f"{path.parent}: no results of a run; name the folder that `run --out` wrote")
        if entry_kind(path) != FILE:
            raise FilesError(f"{path}: {entry_kind(path)}, which no run writes; name the folder that `run --out` wrote")
        data = read_regular(path, MAX_RECORD_BYTES)
        record = json.loads(data)
        sha256, overrides = _DIGESTS.validate_python(record["sha256"]), _OVERRIDES.validate_python(record["overrides"])
        if is_framed(record["scene"]):  # The size of the image is that of the cameras.
            with use_folder(Path(record["working_directory"])):
                _require_digest(record["scene"]["image"], sha256.get("image"), f"{path.parent}: image")
        scene, frames = _read_scene(record), record["frames"]
        is_resolved = scene.time.precision != "auto" and scene.sheet.tolerance is scene.time.tolerance is None
        if not isinstance(frames, int) or not 1 <= frames <= scene.time.frames + 1 or not is_resolved:
            raise damaged_result(path)
        largest_frame = min(record.get("max_displacement_frame", frames), frames - 1)
        run = FinishedRun(
            path.parent, record["status"], scene, frames, largest_frame, sha256, overrides, data, scene.render.main
        )
        run._require_same(scene.sheet.files)  # without which there is no sheet
        run = replace(run, scene=scene.model_copy(update={"sheet": run._frozen_sheet()}))
        problems = [*try_plan(run.scene)[1], *camera_problems(run.scene)]
        # Other problems are ignored: later methods check the pictures, and the step was valid with the original map.
        if any(problem.path[-1:] != ("image",) and problem.path[0] != "time" for problem in problems):
            raise SceneError([str(problem) for problem in problems])
    return run


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Return a context that converts exceptions to FilesErrors; damaged archives and records raise many types."""
    try:
        yield
    except (FilesError, ImportError):
        raise
    except Exception as error:
        # Invalid offsets in a damaged file raise EINVAL.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
        raise damaged_result(path) from None


def damaged_result(path: Path) -> FilesError:
    """Build the error for a damaged result."""
    return FilesError(f"{path}: damaged, or not of this run; run the scene again")


def _read_scene(record: Mapping[str, Any]) -> Scene:
    """Build the scene of a record, with picture paths relative to the current directory."""
    folder = Path(record["working_directory"])
    with use_folder(folder):
        scene = Scene(**record["scene"])
    if folder != Path.cwd():
        scene = scene.with_pictures(lambda path: str(folder / path))
    return scene


def _require_digest(path: str, sha256: str | None, name: str) -> None:
    """Raise a FilesError unless the file has the SHA-256; `name` has the folder of the run and the scene key."""
    fault = f"{path} differs from the file of the run (SHA-256)"
    try:
        if file_sha256(path) == sha256:
            return
    except PictureError as error:
        fault = error.fault
    raise FilesError(f"{name}: {fault}; {RESTORE_PICTURE}")
