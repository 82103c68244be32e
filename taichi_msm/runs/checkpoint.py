"""The files from which another process can continue an unfinished run: its manifest, its frames and its last state.

Every part has a checksum, which is verified before the part is used: a SHA-256 for the manifest, one each for the
positions and the forces of every frame, and the CRC-32 of the archive for the arrays of the state. What they say is not
trusted, as anybody may have written them.

A file of arrays of one shape, one for each frame, that grows while a run does, and survives its death.
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
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.runs.arrays import read_array, write_arrays
from taichi_msm.runs.directory import DRAFT, FILE, FOLDER, HIDDEN, LOCK, STAGING, clear, create, replacing, require
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import PeakForce, ProbeForces, RunProgress, Snapshot, State, TipForce
from taichi_msm.terms.contact import contact_fields

pass  # REMOVED

# A folder is a checkpoint if it has a run's manifest. Beside it are the positions of the frames, the forces if they are
# asked for, and the last state.
CHECKPOINT, MANIFEST, POSITIONS, FORCES, STATE = "checkpoint", "manifest.json", "positions", "forces", "state.npz"
PATTERNS = (
    *(re.escape(name) for name in (MANIFEST, POSITIONS, FORCES, STATE)),
    *(f"{HIDDEN}/{name}" for name in (LOCK, DRAFT)),
)

# The share of the time that saving states may take.
SHARE = 0.02

# Numbers of a `TipForce`, and of a `PeakForce`.
FORCE_NUMBERS, PEAK_NUMBERS = 6, 4


class Checkpoint:
    """A folder, made by `begin`, from which a run can continue, no matter when its process is killed.

    A FilesError, of the methods that read, says which part is damaged.

    Attributes:
        frames: number of frames added so far.
        precision: type of the positions.
    """

    def __init__(self, folder: Path, scene: Scene, grid: TimeGrid) -> None:
        self.frames = 0
        self._folder = folder
        self._grid = grid
        self._shape, self._probes = (*scene.sheet.points, 3), len(scene.probes)
        self._contact_shape = (contact_fields(scene.probes), *scene.sheet.points)
        self.precision = np.dtype(np.float32 if grid.precision == "f32" else np.float64)
        self._due = 0.0
        # The digest of the manifest, to which all parts of a checkpoint are tied.
        self._key = b""
        self._positions = Records(folder / POSITIONS, self._shape, self.precision)
        self._forces = Records(folder / FORCES, (self._probes, FORCE_NUMBERS), np.float64)
        # What is kept of every frame.
        self._kept = [self._positions] if scene.output else []
        self._kept += [self._forces] if scene.asks_for("forces") else []

    @property
    def due(self) -> bool:
        """Whether it is time to save again."""
        return time.perf_counter() >= self._due

    def begin(self, manifest: Mapping[str, Any]) -> None:
        """Begin a run with this manifest, without frames, replacing the checkpoint of any other run."""
        self.close()
        self._folder.mkdir(exist_ok=True)
        self.forget()
        clear(self._folder, PATTERNS)
        sealed = seal(manifest)
        self._key = digest(sealed)
        for records in self._kept:
            records.begin(self._key)
        with replacing(self._folder / MANIFEST) as file:
            file.write(sealed)

    def forget(self) -> None:
        """Remove the manifest: without it, what is left, even if it is only half removed, is no checkpoint."""
        (self._folder / MANIFEST).unlink(missing_ok=True)

    def reopen(self) -> Snapshot | None:
        """Continue an earlier run; returns the state that it saved last, or None to continue from rest."""
        self.close()
        try:
            self._key = digest((self._folder / MANIFEST).read_bytes())
            for records in self._kept:
                records.reopen(self._key)
        except FileNotFoundError as error:
            raise damaged(self._folder / Path(error.filename).name) from None
        saved = self.load()
        frames = 0 if saved is None else saved.progress.frame + 1
        for records in self._kept:
            records.require(frames)
        self.frames = frames
        return saved

    def add(self, position: NDArray[Any], forces: Sequence[TipForce]) -> None:
        """Add the positions of the next frame [m], shape (rows, cols, 3), and the forces of every probe."""
        for records, values in ((self._positions, position), (self._forces, _tips(forces))):
            if records in self._kept:
                records.add(self.frames, values)
        self.frames += 1

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a frame [m], shape (rows, cols, 3)."""
        return self._positions.read(frame)

    def forces(self, frame: int) -> tuple[TipForce, ...]:
        """Read the forces of a frame, where they were asked for."""
        return _as_forces(self._forces.read(frame))

    def save(self, saved: Snapshot) -> str:
        """Save a state of the run, replacing the one saved before; the frames up to it must have been added.

        Gives the path of the file, which has the arrays of `State` and the numbers of `RunProgress` by name.
        """
        start = time.perf_counter()
        path = self._folder / STATE
        with replacing(path) as file:
            write_arrays(file, self._arrays(saved))
        now = time.perf_counter()
        self._due = now + (now - start) / SHARE
        return str(path)

    def load(self) -> Snapshot | None:
        """Read the state that was saved last; None: none was."""
        like = self._arrays(Snapshot(State(0, np.empty(0), np.empty(0)), RunProgress(), ProbeForces((), ())))
        kinds = {name: (array.dtype, array.shape) for name, array in like.items()}
        kinds["forces"] = kinds["forces"][0], (self._probes, FORCE_NUMBERS)
        kinds["greatest"] = kinds["greatest"][0], (self._probes, PEAK_NUMBERS)
        kinds |= dict.fromkeys(("displacement", "difference"), (self.precision, self._shape))
        kinds["contact"] = self.precision, self._contact_shape
        try:
            with (self._folder / STATE).open("rb") as file, zipfile.ZipFile(file) as archive:
                arrays = {name: read_array(archive, name, *kind) for name, kind in kinds.items()}
        except FileNotFoundError:
            return None
        # A forged archive can make zipfile raise almost anything.
        except Exception:
            raise damaged(self._folder / STATE) from None
        progress = RunProgress(**{field.name: arrays[field.name].item() for field in fields(RunProgress)})
        state = State(int(arrays["steps"]), arrays["displacement"], arrays["difference"], arrays["contact"])
        greatest = tuple(PeakForce(time, (x, y, z)) for time, x, y, z in arrays["greatest"].tolist())
        saved = Snapshot(state, progress, ProbeForces(_as_forces(arrays["forces"]), greatest))
        every = self._grid.steps_per_frame
        if not (
            progress.frame <= self._grid.frames
            and progress.frame * every <= saved.state.steps <= (progress.frame + 1) * every
            and all(np.isfinite(array).all() for array in arrays.values())
            and all(value >= 0 for value in asdict(progress).values())
            and arrays["manifest"].tobytes() == self._key
        ):
            raise damaged(self._folder / STATE)
        return saved

    def close(self) -> None:
        """Close its files."""
        for records in self._kept:
            records.close()

    def _arrays(self, saved: Snapshot) -> dict[str, NDArray[Any]]:
        """Give the arrays of a state, the numbers of its progress and the digest of the manifest, all by name."""
        greatest = np.array([(peak.time, *peak.force) for peak in saved.felt.greatest]).reshape(-1, PEAK_NUMBERS)
        forces = {"forces": _tips(saved.felt.forces), "greatest": greatest}
        named = {**saved.state._asdict(), **asdict(saved.progress), **forces}
        named["manifest"] = np.frombuffer(self._key, np.uint8)
        return {name: np.asarray(value) for name, value in named.items()}


def open_manifest(directory: Path) -> BinaryIO:
    """Open the manifest of the unfinished run in a directory; raises OSError or ForeignError when there is none."""
    checkpoint = require(require(directory / STAGING, FOLDER) / CHECKPOINT, FOLDER)
    return require(checkpoint / MANIFEST, FILE).open("rb")


def is_unfinished(directory: Path) -> bool:
    """Tell whether a directory has an unfinished run that can be continued."""
    try:
        open_manifest(directory).close()
    except (OSError, FilesError):
        return False
    return True


def seal(content: Any) -> bytes:
    """Write a value as JSON together with its SHA-256."""
    return json.dumps({"sha256": digest(json.dumps(content).encode()).hex(), "content": content}).encode()


def unseal(data: bytes) -> Any:
    """Read what `seal` wrote; raises ValueError when any bit of it, even of white space, is not as it was written."""
    try:
        content = json.loads(data)["content"]
        if seal(content) == data:
            return content
    except (KeyError, TypeError, RecursionError):
        pass
    raise ValueError("damaged")


def _tips(forces: Sequence[TipForce]) -> NDArray[np.float64]:
    return np.array([(*one.tip, *one.force) for one in forces], float).reshape(-1, FORCE_NUMBERS)


def _as_forces(numbers: NDArray[np.float64]) -> tuple[TipForce, ...]:
    return tuple(TipForce(n, (x, y, z), (a, b, c)) for n, (x, y, z, a, b, c) in enumerate(numbers.tolist()))


DIGEST_BYTES = 32


class Records:
    """The arrays, each with a SHA-256 that also depends on its number and on the run.

    Args:
        path: of the file.
        shape: of an array.
        dtype: of its numbers.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: Any) -> None:
        self._path, self._shape, self._dtype = path, shape, np.dtype(dtype)
        self._size = DIGEST_BYTES + math.prod(shape) * self._dtype.itemsize
        # The digest of the run's manifest, to which all parts of a checkpoint are tied.
        self._key = b""
        self._file: BinaryIO
        self._open = ExitStack()

    def begin(self, key: bytes) -> None:
        """Make the file of a new run."""
        # Unbuffered, so that what was written is not lost when the process is killed.
        self._key, self._file = key, self._open.enter_context(create(self._path, buffering=0))

    def reopen(self, key: bytes) -> None:
        """Open the file of an earlier run; FileNotFoundError: there is none."""
        self._key, self._file = key, self._open.enter_context(self._path.open("r+b", buffering=0))
        if os.fstat(self._file.fileno()).st_nlink > 1:
            raise ForeignError.at(self._path, "a file that has other names")

    def require(self, count: int) -> None:
        """Raise a DamagedError if the file has fewer arrays."""
        if os.fstat(self._file.fileno()).st_size < count * self._size:
            raise damaged(self._path)

    def add(self, number: int, values: NDArray[Any]) -> None:
        """Write the array of a number, over any that is there."""
        data = np.ascontiguousarray(values, self._dtype).reshape(-1).view(np.uint8).data
        self._file.seek(number * self._size)
        for rest in (memoryview(self._digest(number, data)), data):
            while rest:  # A write to an unbuffered file may take only some of the bytes.
                rest = rest[self._file.write(rest) :]

    def read(self, number: int) -> NDArray[Any]:
        """Read the array of a number; DamagedError: it is not what was written, or not finite."""
        record = np.empty(self._size, np.uint8)
        self._file.seek(number * self._size)
        rest = record.data
        while rest and (count := self._file.readinto(rest)):  # type: ignore[attr-defined]
            rest = rest[count:]
        data = record[DIGEST_BYTES:]
        values = data.view(self._dtype).reshape(self._shape)
        if rest or record[:DIGEST_BYTES].tobytes() != self._digest(number, data.data) or not np.isfinite(values).all():
            raise damaged(self._path)
        return values

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def _digest(self, number: int, data: memoryview) -> bytes:
        return digest(self._key, number.to_bytes(8, "little"), data)


def damaged(path: Path) -> DamagedError:
    """Make the error for a part of a checkpoint that is not what the run has written."""
    return DamagedError(f"{path} is damaged; run the scene again")


def digest(*parts: bytes | memoryview) -> bytes:
    """Compute the SHA-256 of some bytes."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part)
    return found.digest()
