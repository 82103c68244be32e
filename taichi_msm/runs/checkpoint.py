"""Checkpoint of an unfinished run, from which another process can continue it.

A checkpoint is a folder with two files:

- `state.npz`: the manifest, with all inputs that determine the results, the even grid of a surface, and the last saved
  state of the solver;
- `frames`: positions and forces of every frame.

Readers verify the CRC-32 of each part, and validate its contents, because the folder may be untrusted.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from taichi_msm.accuracy.mesh import MeshEstimate
from taichi_msm.accuracy.time_step import TimeStepEstimate
from taichi_msm.errors import DamagedError, FilesError, ForeignError, SceneError, writing
from taichi_msm.images import PictureError, file_sha256, use_folder
from taichi_msm.model.plan import Plan
from taichi_msm.model.time_grid import DTYPES
from taichi_msm.render.camera import camera_problems
from taichi_msm.runs.arrays import read_array, read_rows, write_arrays
from taichi_msm.runs.directory import FILE, FOLDER, STAGING_FOLDER, create_file, require_kind
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.surface import KeptGrid
from taichi_msm.solver.planning import try_plan
from taichi_msm.solver.state import PeakForce, ProbeForces, RunProgress, Snapshot, State, TipForce
from taichi_msm.system.compiler import result_versions
from taichi_msm.system.runtime import ARCHS
from taichi_msm.terms import memory_names

# A folder without the state file is not a checkpoint.
CHECKPOINT_FOLDER, STATE_FILE, FRAMES_FILE = "checkpoint", "state.npz", "frames"
CHECKPOINT_PATTERNS = (
    r"(?:state\.npz|state\.new|frames)",
    r"(?:manifest\.json|positions|forces)",  # of earlier versions
)

# Numbers per `TipForce` (tip, force) and per `PeakForce` (time, force).
FORCE_COLUMNS, PEAK_FORCE_COLUMNS = 6, 4


@dataclass(frozen=True)
class Manifest:
    """All inputs that determine the bits of the results of a run."""

    given: Scene  # as loaded
    scene: Scene  # with resolved mesh, step and precision
    overrides: tuple[str, ...]  # of the scene file
    estimate: TimeStepEstimate | None  # time-step error by trial runs; None without `time.tolerance`
    mesh: MeshEstimate | None  # mesh error by trial runs; None without `sheet.tolerance`
    asks_estimate: bool | None  # whether to estimate the error during the run; None: only if cheap
    folder: str  # working directory of `run`, to which picture paths are relative
    arch: str  # cpu, cuda or vulkan
    sha256: Mapping[str, str]  # of picture, map and camera files, by scene key
    versions: Mapping[str, str]  # of all software that affects the results

    def as_json(self) -> dict[str, Any]:
        """Convert the manifest to data for JSON."""
        return cast(dict[str, Any], _MANIFEST_ADAPTER.dump_python(self, mode="json"))

    def require_same_inputs(self, sha256: Mapping[str, str], versions: Mapping[str, str]) -> None:
        """Raise a FilesError if a file or a version has changed, so that a resumed run could yield other bits."""
        for key, path in self.scene.pictures.items():
            _require_same_file(path, sha256.get(key), self.sha256.get(key))
        original, current = result_versions(self.versions, self.arch), result_versions(versions, self.arch)
        if original != current:
            # Without another difference, the compiler differs; it is missing in `original` if it is a tested one.
            changed = any(version != current.get(name) for name, version in original.items())
            listed = original if changed else self.versions
            differing = [f"{name} {version}" for name, version in listed.items() if version != versions.get(name)]
            raise FilesError(f"the run began with {', '.join(differing)}; use these versions, or run the scene again")

    def has_same_bits_as(self, manifest: Manifest) -> bool:
        """Return whether another manifest yields the same bits, so that either run can continue the other."""
        return self._result_inputs() == manifest._result_inputs()

    def _result_inputs(self) -> tuple[Any, ...]:
        # Pictures are compared by digest, not by path.
        scene = self.scene.with_pictures(lambda path: "any")
        # The order of the cameras matters, because the light is at the first one; dictionaries compare without order.
        cameras = list(scene.render.all_cameras)
        return scene, cameras, self.arch, self.sha256, result_versions(self.versions, self.arch)


_MANIFEST_ADAPTER = TypeAdapter(Manifest)


def _require_same_file(path: str, sha256: str | None, original: str | None) -> None:
    if sha256 != original:
        raise FilesError(f"{path} has changed since the run began; put it back, or run the scene again")


def read_manifest(directory: Path) -> tuple[Manifest, Plan]:
    """Read the manifest of the unfinished run in a directory, and plan its scene.

    A damaged manifest or an invalid scene is a DamagedError; the absence of a run, or one of an earlier version, a
    FilesError; a map that cannot be read, a SceneError.
    """
    path = directory / STAGING_FOLDER / CHECKPOINT_FOLDER / STATE_FILE
    try:
        file = _open_state(directory)
    except (FileNotFoundError, NotADirectoryError):
        raise FilesError(f"{directory}: there is no unfinished run to resume") from None
    except OSError as error:
        raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    try:
        with file, zipfile.ZipFile(file) as archive:
            data = json.loads(_manifest_bytes(archive))
            # The current directory may differ from that of the original process.
            with use_folder(data["folder"]):
                manifest = _MANIFEST_ADAPTER.validate_python(data)
            scene = manifest.scene.with_pictures(partial(os.path.join, manifest.folder))
            manifest = replace(manifest, scene=scene.model_copy(update={"sheet": _frozen_sheet(scene.sheet, archive)}))
    except Exception:  # a forged archive may raise any type
        if path.with_name("manifest.json").exists():
            problem = "is of an earlier version of the program"
            raise FilesError(f"{path} {problem}; run the scene again, or continue with that version") from None
        raise _damaged(path) from None
    for key, name in manifest.scene.sheet.files.items():
        with suppress(PictureError):
            _require_same_file(name, file_sha256(name), manifest.sha256.get(key))
    plan, problems = try_plan(manifest.scene)
    if unreadable := [
        str(problem) for problem in problems if problem.path[-1:] == ("image",) or {"surface", "mask"} & {*problem.path}
    ]:
        raise SceneError(unreadable)
    numbers = () if manifest.estimate is None else asdict(manifest.estimate).values()
    is_valid = manifest.arch in ARCHS and all(number >= 0 for number in numbers)
    if plan is None or problems or not is_valid or list(camera_problems(manifest.scene)):
        raise DamagedError(f"{path} is damaged: its scene is invalid; run the scene again")
    return manifest, plan


def _frozen_sheet(sheet: Sheet, archive: zipfile.ZipFile) -> Sheet:
    """Return the sheet with the even grid of a checkpoint, if it has one."""
    grid = None
    if sheet.surface and sheet.surface.is_even:
        grid = read_array(archive, "grid", np.dtype(np.float64), (*sheet.points, 2))
        if not np.isfinite(grid).all():
            raise ValueError("grid")
    return sheet.with_frozen_surface(None, None if grid is None else KeptGrid.of(grid))


def is_unfinished(directory: Path) -> bool:
    """Return whether a directory has an unfinished run that can be continued."""
    try:
        _open_state(directory).close()
    except (OSError, FilesError):
        return False
    return True


def input_digests(plan: Plan) -> dict[str, str]:
    """Compute the SHA-256 of picture, map, surface, mask and camera files, by scene key.

    An unreadable picture is omitted. All digests but that of the picture come from the plan, which read the files.
    """
    scene = plan.scene
    sha256 = {**plan.sha256} | {f"{scene.kind}.{name}.image": image.sha256 for name, image in plan.maps.items()}
    if scene.sheet.surface and (file := scene.sheet.surface.file):
        sha256[".".join(("sheet", "surface", *scene.sheet.surface.file_key))] = file.sha256
    if scene.sheet.mask:
        sha256["sheet.mask.image"] = scene.sheet.mask.pixels.sha256
    if scene.image is not None:
        with suppress(PictureError):
            sha256["image"] = file_sha256(scene.image)
    return sha256


def _open_state(directory: Path) -> BinaryIO:
    """Open the state of the unfinished run in a directory; raise an OSError or a ForeignError without one."""
    checkpoint = require_kind(require_kind(directory / STAGING_FOLDER, FOLDER) / CHECKPOINT_FOLDER, FOLDER)
    return require_kind(checkpoint / STATE_FILE, FILE).open("rb")


def _manifest_bytes(archive: zipfile.ZipFile) -> bytes:
    # 64 MiB are above the size of any manifest: it has the scene twice, from a file of at most 1 MiB.
    if archive.getinfo("manifest.npy").file_size > 1 << 26:
        raise ValueError("too large")
    return read_rows(archive, "manifest", np.uint8, ()).tobytes()


def _damaged(path: Path) -> DamagedError:
    return DamagedError(f"{path} is damaged; run the scene again")


class Checkpoint:
    """Checkpoint folder of a run, valid whenever the process is killed; a damaged part is a DamagedError."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        scene = plan.scene
        self.frames = 0  # number of frames stored so far
        self.precision = DTYPES[plan.grid.precision]  # of the positions
        self._plan, self._state_path, self._frames_path = plan, folder / STATE_FILE, folder / FRAMES_FILE
        self._next_save, self._manifest = 0.0, b""
        grid = scene.sheet.surface.frame.grid if scene.sheet.surface and scene.sheet.surface.frame else None
        self._grid = {} if grid is None else {"grid": grid.fractions}
        self._directory = folder.parent.parent  # of the results, for messages
        self._file: BinaryIO | None = None  # None without outputs: the frames are not needed
        position = "position", self.precision, (*scene.sheet.points, 3)
        forces = "forces", np.float64, (len(scene.probes), FORCE_COLUMNS)
        self._frame_dtype = np.dtype([("checksum", np.int64), position, forces])

    @property
    def is_save_due(self) -> bool:
        """Whether the state should be saved, and all of its frames are stored."""
        return self.frames > 0 and time.perf_counter() >= self._next_save

    def begin(self, manifest: Mapping[str, Any]) -> None:
        """Begin the checkpoint of a new run in place of an earlier one."""
        self.close()
        self.invalidate()
        folder = self._state_path.parent
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
        self._manifest = json.dumps(manifest).encode()
        if self._plan.scene.output:
            # Unbuffered, so that stored frames survive when the process is killed.
            self._file = self._frames_path.open("x+b", buffering=0)
        self._write_state({})

    def invalidate(self) -> None:
        """Delete the state file, without which the folder is not a checkpoint."""
        self._state_path.unlink(missing_ok=True)

    def reopen(self) -> Snapshot | None:
        """Open the checkpoint of an earlier run; return its last saved state, or None for the initial state."""
        saved = self.load()
        self.frames = 0 if saved is None else saved.progress.frame + 1
        if self._plan.scene.output:
            try:
                self._file = self._frames_path.open("r+b", buffering=0)
            except FileNotFoundError:
                raise _damaged(self._frames_path) from None
            status = os.fstat(self._file.fileno())
            if status.st_nlink > 1:
                raise ForeignError.at(self._frames_path, "a hard-linked file")
            if status.st_size < self.frames * self._frame_dtype.itemsize:
                raise _damaged(self._frames_path)
        return saved

    def add(self, position: NDArray[Any], forces: Sequence[TipForce]) -> None:
        """Store the positions of the next frame [m], shape (rows, cols, 3), and the force of every probe."""
        if self._file:
            parts = np.ascontiguousarray(position, self.precision), _tip_force_array(forces)
            self._file.seek(self.frames * self._frame_dtype.itemsize)
            for part in (np.array(self._checksum(self.frames, *parts)), *parts):
                remaining = part.reshape(-1).view(np.uint8).data
                while remaining:  # a write to an unbuffered file may be partial
                    remaining = remaining[self._file.write(remaining) :]
        self.frames += 1

    def read_positions(self, frame: int) -> NDArray[Any]:
        """Read the positions of the mass points in a frame [m], shape (rows, cols, 3)."""
        return self._read(frame)[0]

    def read_forces(self, frame: int) -> tuple[TipForce, ...]:
        """Read the force of every probe in a frame."""
        return _tip_forces(self._read(frame)[1])

    def save(self, saved: Snapshot) -> str:
        """Save a state, whose frames must be stored, in place of the previous one; return the path of its archive.

        The archive has the fields of `State` and `RunProgress` by name.
        """
        start = time.perf_counter()
        with writing(self._directory):
            self._write_state(_to_arrays(saved))
        now = time.perf_counter()
        # Saving takes at most 2 % of the run's time.
        self._next_save = now + (now - start) / 0.02
        return str(self._state_path)

    def load(self) -> Snapshot | None:
        """Read the last saved state; None if there is none."""
        expected = _to_arrays(self._empty_snapshot())
        try:
            with self._state_path.open("rb") as file, zipfile.ZipFile(file) as archive:
                self._manifest = _manifest_bytes(archive)
                if len(archive.namelist()) == 1 + len(self._grid):  # without a state
                    return None
                arrays = {name: read_array(archive, name, array.dtype, array.shape) for name, array in expected.items()}
        except FileNotFoundError:
            return None
        except Exception:  # a forged archive may raise any type
            raise _damaged(self._state_path) from None
        saved, grid = _from_arrays(arrays), self._plan.grid
        if not (
            saved.progress.frame <= grid.frames
            and 0 <= saved.state.steps - saved.progress.frame * grid.steps_per_frame <= grid.steps_per_frame
            and all(np.isfinite(array).all() for array in arrays.values())
            and all(value >= 0 for value in asdict(saved.progress).values())
        ):
            raise _damaged(self._state_path)
        return saved

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def _empty_snapshot(self) -> Snapshot:
        """Return a snapshot with the dtypes and shapes of all arrays."""
        scene, zero = self._plan.scene, (0.0, 0.0, 0.0)
        position = np.empty((*scene.sheet.points, 3), self.precision)
        memory = np.empty((len(memory_names(self._plan)), *scene.sheet.points), self.precision)
        felt = ProbeForces((TipForce(0, zero, zero),) * len(scene.probes), (PeakForce(0, zero),) * len(scene.probes))
        return Snapshot(State(0, position, position, memory), RunProgress(), felt)

    def _write_state(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Replace the state file by the manifest and the arrays of a state."""
        draft = self._state_path.with_suffix(".new")
        draft.unlink(missing_ok=True)
        with create_file(draft) as file:
            write_arrays(file, {"manifest": np.frombuffer(self._manifest, np.uint8), **self._grid, **arrays})
        draft.replace(self._state_path)

    def _read(self, frame: int) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Read positions and forces of a frame; raise a DamagedError for non-finite values or a wrong checksum."""
        assert self._file
        with writing(self._directory):
            self._file.seek(frame * self._frame_dtype.itemsize)
            records = np.fromfile(self._file, self._frame_dtype, 1)
        if len(records) == 1:
            position, forces = records["position"][0], records["forces"][0]
            is_sound = records["checksum"][0] == self._checksum(frame, position, forces)
            if is_sound and np.isfinite(position).all() and np.isfinite(forces).all():
                return position, forces
        raise _damaged(self._frames_path)

    def _checksum(self, frame: int, *parts: NDArray[Any]) -> int:
        """Compute the CRC-32 of the manifest, the index and the parts of a frame."""
        # The manifest and the index detect frames of another run or at another index.
        checksum = zlib.crc32(frame.to_bytes(8, "little"), zlib.crc32(self._manifest))
        for part in parts:
            checksum = zlib.crc32(part.data, checksum)
        return checksum


def _to_arrays(saved: Snapshot) -> dict[str, NDArray[Any]]:
    """Convert a snapshot, without its probes, to arrays by the names of its fields."""
    forces, greatest = saved.probe_forces
    peaks = np.array([(peak.time, *peak.force) for peak in greatest]).reshape(-1, PEAK_FORCE_COLUMNS)
    named = {**saved.state._asdict(), **asdict(saved.progress), "forces": _tip_force_array(forces), "greatest": peaks}
    return {name: np.asarray(value) for name, value in named.items()}


def _from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Snapshot:
    progress = RunProgress(**{field.name: arrays[field.name].item() for field in fields(RunProgress)})
    state = State(int(arrays["steps"]), arrays["displacement"], arrays["difference"], arrays["memory"])
    greatest = tuple(PeakForce(time, (x, y, z)) for time, x, y, z in arrays["greatest"].tolist())
    return Snapshot(state, progress, ProbeForces(_tip_forces(arrays["forces"]), greatest))


def _tip_force_array(forces: Sequence[TipForce]) -> NDArray[np.float64]:
    return np.array([(*force.tip, *force.force) for force in forces], float).reshape(-1, FORCE_COLUMNS)


def _tip_forces(numbers: NDArray[np.float64]) -> tuple[TipForce, ...]:
    return tuple(TipForce(n, (x, y, z), (a, b, c)) for n, (x, y, z, a, b, c) in enumerate(numbers.tolist()))
