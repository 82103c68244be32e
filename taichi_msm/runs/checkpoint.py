"""Checkpoint of an unfinished run, from which another process can continue it.

A checkpoint is a folder with the manifest of the run, the positions and, if requested, the forces of every frame, and
the last saved state of the solver. Each part has a checksum, which is verified before the part is used: SHA-256 for the
manifest and for each frame, CRC-32 for the state. Contents are also validated, because the folder may be untrusted.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DamagedError, FilesError, ForeignError
from taichi_msm.model.plan import Plan
from taichi_msm.runs.arrays import read_array, write_arrays
from taichi_msm.runs.directory import (
    DRAFT_FILE,
    FILE,
    FOLDER,
    HIDDEN_FOLDER_PATTERN,
    LOCK_FILE,
    STAGING_FOLDER,
    clear_folder,
    create_file,
    replacing,
    require_kind,
)
from taichi_msm.solver.state import PeakForce, ProbeForces, RunProgress, Snapshot, State, TipForce
from taichi_msm.terms import memory_names

# A folder without the manifest is not a checkpoint.
CHECKPOINT_FOLDER, MANIFEST_FILE, POSITIONS_FILE, FORCES_FILE, STATE_FILE = (
    "checkpoint",
    "manifest.json",
    "positions",
    "forces",
    "state.npz",
)
CHECKPOINT_PATTERNS = (
    *(re.escape(name) for name in (MANIFEST_FILE, POSITIONS_FILE, FORCES_FILE, STATE_FILE)),
    *(f"{HIDDEN_FOLDER_PATTERN}/{name}" for name in (LOCK_FILE, DRAFT_FILE)),
)

# Upper bound of the time spent on saving states, as a fraction of the run's time.
MAX_SAVE_TIME_FRACTION = 0.02

# Numbers of a `TipForce`, tip and force, and of a `PeakForce`, time and force.
FORCE_COLUMNS, PEAK_FORCE_COLUMNS = 6, 4


class Checkpoint:
    """Checkpoint folder of a run. It stays valid whenever the process is killed.

    Args:
        folder: the folder; `begin` creates it.
        plan: the plan of the run.

    Raises:
        DamagedError: from the methods that read, when a part is damaged; the message names the part.

    Attributes:
        frames: number of frames stored so far.
        precision: dtype of the positions.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        scene, grid = plan.scene, plan.grid
        self.frames = 0
        self._folder = folder
        self._grid = grid
        self._shape, self._probes = (*scene.sheet.points, 3), len(scene.probes)
        self._memory_shape = (len(memory_names(plan)), *scene.sheet.points)
        self.precision = np.dtype(np.float32 if grid.precision == "f32" else np.float64)
        self._next_save = 0.0
        # Checksums of all parts include this digest, so that parts of different runs do not mix.
        self._manifest_digest = b""
        self._positions = ArrayFile(folder / POSITIONS_FILE, self._shape, self.precision)
        self._forces = ArrayFile(folder / FORCES_FILE, (self._probes, FORCE_COLUMNS), np.float64)
        self._array_files = [self._positions] if scene.output else []
        self._array_files += [self._forces] if scene.asks_for("forces") else []

    @property
    def is_save_due(self) -> bool:
        """Whether the state should be saved again."""
        return time.perf_counter() >= self._next_save

    def begin(self, manifest: Mapping[str, Any]) -> None:
        """Begin the checkpoint of a new run in place of an earlier one."""
        self.close()
        self._folder.mkdir(exist_ok=True)
        self.invalidate()
        clear_folder(self._folder, CHECKPOINT_PATTERNS)
        data = dump_with_checksum(manifest)
        self._manifest_digest = sha256_digest(data)
        for array_file in self._array_files:
            array_file.begin(self._manifest_digest)
        with replacing(self._folder / MANIFEST_FILE) as file:
            file.write(data)

    def invalidate(self) -> None:
        """Delete the manifest, so that the remaining files no longer count as a checkpoint."""
        (self._folder / MANIFEST_FILE).unlink(missing_ok=True)

    def reopen(self) -> Snapshot | None:
        """Open the checkpoint of an earlier run to continue it.

        Returns:
            The last saved state; None when the run continues from its first frame.
        """
        self.close()
        try:
            self._manifest_digest = sha256_digest((self._folder / MANIFEST_FILE).read_bytes())
            for array_file in self._array_files:
                array_file.reopen(self._manifest_digest)
        except FileNotFoundError as error:
            raise damaged_checkpoint(self._folder / Path(error.filename).name) from None
        saved = self.load()
        frames = 0 if saved is None else saved.progress.frame + 1
        for array_file in self._array_files:
            array_file.require_length(frames)
        self.frames = frames
        return saved

    def add(self, position: NDArray[Any], forces: Sequence[TipForce]) -> None:
        """Store the next frame.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            forces: the force of every probe.
        """
        for array_file, values in ((self._positions, position), (self._forces, _tip_force_array(forces))):
            if array_file in self._array_files:
                array_file.write(self.frames, values)
        self.frames += 1

    def read_positions(self, frame: int) -> NDArray[Any]:
        """Read the positions of the mass points in a frame [m], shape (rows, cols, 3)."""
        return self._positions.read(frame)

    def read_forces(self, frame: int) -> tuple[TipForce, ...]:
        """Read the force of every probe in a frame; only for scenes that output forces."""
        return _tip_forces(self._forces.read(frame))

    def save(self, saved: Snapshot) -> str:
        """Save a state in place of the previous one; all frames up to it must be stored.

        Returns:
            Path of the archive, which contains the fields of `State` and `RunProgress` by name.
        """
        start = time.perf_counter()
        path = self._folder / STATE_FILE
        with replacing(path) as file:
            write_arrays(file, self._arrays(saved))
        now = time.perf_counter()
        self._next_save = now + (now - start) / MAX_SAVE_TIME_FRACTION
        return str(path)

    def load(self) -> Snapshot | None:
        """Read the last saved state; None if there is none."""
        empty = self._arrays(Snapshot(State(0, np.empty(0), np.empty(0)), RunProgress(), ProbeForces((), ())))
        types = {name: (array.dtype, array.shape) for name, array in empty.items()}
        types["forces"] = types["forces"][0], (self._probes, FORCE_COLUMNS)
        types["greatest"] = types["greatest"][0], (self._probes, PEAK_FORCE_COLUMNS)
        types |= dict.fromkeys(("displacement", "difference"), (self.precision, self._shape))
        types["memory"] = self.precision, self._memory_shape
        try:
            with (self._folder / STATE_FILE).open("rb") as file, zipfile.ZipFile(file) as archive:
                arrays = {name: read_array(archive, name, *expected) for name, expected in types.items()}
        except FileNotFoundError:
            return None
        except Exception:  # zipfile raises almost any type for a forged archive
            raise damaged_checkpoint(self._folder / STATE_FILE) from None
        progress = RunProgress(**{field.name: arrays[field.name].item() for field in fields(RunProgress)})
        state = State(int(arrays["steps"]), arrays["displacement"], arrays["difference"], arrays["memory"])
        greatest = tuple(PeakForce(time, (x, y, z)) for time, x, y, z in arrays["greatest"].tolist())
        saved = Snapshot(state, progress, ProbeForces(_tip_forces(arrays["forces"]), greatest))
        steps_per_frame = self._grid.steps_per_frame
        if not (
            progress.frame <= self._grid.frames
            and progress.frame * steps_per_frame <= saved.state.steps <= (progress.frame + 1) * steps_per_frame
            and all(np.isfinite(array).all() for array in arrays.values())
            and all(value >= 0 for value in asdict(progress).values())
            and arrays["manifest"].tobytes() == self._manifest_digest
        ):
            raise damaged_checkpoint(self._folder / STATE_FILE)
        return saved

    def close(self) -> None:
        """Close the files."""
        for array_file in self._array_files:
            array_file.close()

    def _arrays(self, saved: Snapshot) -> dict[str, NDArray[Any]]:
        """Convert a state, its progress and the manifest's digest to arrays by name."""
        greatest = np.array([(peak.time, *peak.force) for peak in saved.felt.greatest]).reshape(-1, PEAK_FORCE_COLUMNS)
        forces = {"forces": _tip_force_array(saved.felt.forces), "greatest": greatest}
        named = {**saved.state._asdict(), **asdict(saved.progress), **forces}
        named["manifest"] = np.frombuffer(self._manifest_digest, np.uint8)
        return {name: np.asarray(value) for name, value in named.items()}


def open_manifest(directory: Path) -> BinaryIO:
    """Open the manifest of the unfinished run in a directory; raise an OSError or a ForeignError without one."""
    checkpoint = require_kind(require_kind(directory / STAGING_FOLDER, FOLDER) / CHECKPOINT_FOLDER, FOLDER)
    return require_kind(checkpoint / MANIFEST_FILE, FILE).open("rb")


def is_unfinished(directory: Path) -> bool:
    """Return whether a directory has an unfinished run that can be continued."""
    try:
        open_manifest(directory).close()
    except (OSError, FilesError):
        return False
    return True


def dump_with_checksum(content: Any) -> bytes:
    """Serialise a value as JSON with its SHA-256."""
    return json.dumps({"sha256": sha256_digest(json.dumps(content).encode()).hex(), "content": content}).encode()


def load_with_checksum(data: bytes) -> Any:
    """Parse the output of `dump_with_checksum`; raise a ValueError when any byte of it has changed."""
    try:
        content = json.loads(data)["content"]
        if dump_with_checksum(content) == data:
            return content
    except (KeyError, TypeError, RecursionError):
        pass
    raise ValueError("damaged")


def _tip_force_array(forces: Sequence[TipForce]) -> NDArray[np.float64]:
    return np.array([(*force.tip, *force.force) for force in forces], float).reshape(-1, FORCE_COLUMNS)


def _tip_forces(numbers: NDArray[np.float64]) -> tuple[TipForce, ...]:
    return tuple(TipForce(n, (x, y, z), (a, b, c)) for n, (x, y, z, a, b, c) in enumerate(numbers.tolist()))


DIGEST_BYTES = 32


class ArrayFile:
    """Growing file of arrays of equal shape and dtype, one per frame.

    Each array has a SHA-256 that also covers its index and the digest of the run's manifest.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: Any) -> None:
        self._path, self._shape, self._dtype = path, shape, np.dtype(dtype)
        self._size = DIGEST_BYTES + math.prod(shape) * self._dtype.itemsize
        self._manifest_digest = b""
        self._file: BinaryIO
        self._open = ExitStack()

    def begin(self, manifest_digest: bytes) -> None:
        """Create the file for a new run."""
        # Unbuffered, so that stored frames survive when the process is killed.
        self._manifest_digest, self._file = (
            manifest_digest,
            self._open.enter_context(create_file(self._path, buffering=0)),
        )

    def reopen(self, manifest_digest: bytes) -> None:
        """Open the file of an earlier run; raise a FileNotFoundError when it is missing."""
        self._manifest_digest, self._file = (
            manifest_digest,
            self._open.enter_context(self._path.open("r+b", buffering=0)),
        )
        if os.fstat(self._file.fileno()).st_nlink > 1:
            raise ForeignError.at(self._path, "a file that has other names")

    def require_length(self, count: int) -> None:
        """Raise a DamagedError if the file has fewer than `count` arrays."""
        if os.fstat(self._file.fileno()).st_size < count * self._size:
            raise damaged_checkpoint(self._path)

    def write(self, index: int, values: NDArray[Any]) -> None:
        """Write an array at an index, in place of an earlier one."""
        data = np.ascontiguousarray(values, self._dtype).reshape(-1).view(np.uint8).data
        self._file.seek(index * self._size)
        for remaining in (memoryview(self._digest(index, data)), data):
            while remaining:  # A write to an unbuffered file may be partial.
                remaining = remaining[self._file.write(remaining) :]

    def read(self, index: int) -> NDArray[Any]:
        """Read the array at an index; raise a DamagedError if its checksum differs or it is not finite."""
        record = np.empty(self._size, np.uint8)
        self._file.seek(index * self._size)
        remaining = record.data
        while remaining and (count := self._file.readinto(remaining)):  # type: ignore[attr-defined]
            remaining = remaining[count:]
        data = record[DIGEST_BYTES:]
        values = data.view(self._dtype).reshape(self._shape)
        if (
            remaining
            or record[:DIGEST_BYTES].tobytes() != self._digest(index, data.data)
            or not np.isfinite(values).all()
        ):
            raise damaged_checkpoint(self._path)
        return values

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def _digest(self, index: int, data: memoryview) -> bytes:
        return sha256_digest(self._manifest_digest, index.to_bytes(8, "little"), data)


def damaged_checkpoint(path: Path) -> DamagedError:
    """Build the error for a damaged part of a checkpoint."""
    return DamagedError(f"{path} is damaged; run the scene again")


def sha256_digest(*parts: bytes | memoryview) -> bytes:
    """Compute the SHA-256 of concatenated bytes."""
    sha256 = hashlib.sha256()
    for part in parts:
        sha256.update(part)
    return sha256.digest()
