"""The files from which another process can continue an unfinished run: its manifest, its frames and its last state.

Every part has a checksum, which is verified before the part is used: a SHA-256 for the manifest, one for the positions
of every frame, and the CRC-32 of the archive for the arrays of the state. What they say is not trusted, as anybody may
have written them.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import time
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DamagedError, FilesError, ForeignError
from taichi_msm.outputs.npz import read_array, write_arrays
from taichi_msm.physics.state import RunProgress, Saved, State
from taichi_msm.physics.terms.contact import contact_fields
from taichi_msm.results.entries import FILE, FOLDER, clear, require
from taichi_msm.results.publication import STAGING
from taichi_msm.results.whole import DRAFT, create, replacing
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid

# A folder is a checkpoint if it has a run's manifest. Beside it are the positions of the frames and the last state.
CHECKPOINT, MANIFEST, POSITIONS, STATE = "checkpoint", "manifest.json", "positions", "state.npz"
PATTERNS = tuple(re.escape(name) for name in (MANIFEST, POSITIONS, STATE, DRAFT))

# The share of the time that saving states may take.
SHARE = 0.02

DIGEST_BYTES = 32


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
        self._shape = (*scene.sheet.points, 3)
        self._contact_shape = (contact_fields(scene.probes), *scene.sheet.points)
        self.precision = np.dtype(np.float32 if grid.precision == "f32" else np.float64)
        self._frame_bytes = math.prod(self._shape) * self.precision.itemsize
        self._record_bytes = (DIGEST_BYTES + self._frame_bytes) if scene.output else 0
        self._due = 0.0
        self._open = ExitStack()
        # The digest of the manifest, to which all parts of a checkpoint are tied.
        self._key = b""
        self._positions: BinaryIO | None = None

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
        # Unbuffered, so that what was written is not lost when the process is killed.
        self._positions = self._open.enter_context(create(self._folder / POSITIONS, buffering=0))
        sealed = seal(manifest)
        self._key = _digest(sealed)
        with replacing(self._folder / MANIFEST) as file:
            file.write(sealed)

    def forget(self) -> None:
        """Remove the manifest: without it, what is left, even if it is only half removed, is no checkpoint."""
        (self._folder / MANIFEST).unlink(missing_ok=True)

    def reopen(self) -> Saved | None:
        """Continue an earlier run; returns the state that it saved last, or None to continue from rest."""
        self.close()
        path = self._folder / POSITIONS
        try:
            self._key = _digest((self._folder / MANIFEST).read_bytes())
            self._positions = self._open.enter_context(path.open("r+b", buffering=0))
        except FileNotFoundError as error:
            raise self._damaged(Path(error.filename).name) from None
        status = os.fstat(self._positions.fileno())
        if status.st_nlink > 1:
            raise ForeignError.at(path, "a file that has other names")
        saved = self.load()
        frames = 0 if saved is None else saved.progress.frame + 1
        if status.st_size < frames * self._record_bytes:
            raise self._damaged(POSITIONS)
        self.frames = frames
        return saved

    def add(self, position: NDArray[Any]) -> None:
        """Add the positions of the next frame [m], shape (rows, cols, 3)."""
        if self._record_bytes:
            assert self._positions is not None, "begin or reopen comes first"
            data = np.ascontiguousarray(position, self.precision).data.cast("B")
            self._positions.seek(self.frames * self._record_bytes)
            for rest in (memoryview(self._digest(self.frames, data)), data):
                while rest:  # A write to an unbuffered file may take only some of the bytes.
                    rest = rest[self._positions.write(rest) :]
        self.frames += 1

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a frame [m], shape (rows, cols, 3)."""
        assert self._positions is not None, "begin or reopen comes first"
        record = np.empty(self._record_bytes, np.uint8)
        self._positions.seek(frame * self._record_bytes)
        rest = record.data
        while rest and (count := self._positions.readinto(rest)):  # type: ignore[attr-defined]
            rest = rest[count:]
        data = record[DIGEST_BYTES:]
        position = data.view(self.precision).reshape(self._shape)
        if rest or record[:DIGEST_BYTES].tobytes() != self._digest(frame, data.data) or not np.isfinite(position).all():
            raise self._damaged(POSITIONS)
        return position

    def save(self, saved: Saved) -> str:
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

    def load(self) -> Saved | None:
        """Read the state that was saved last; None: none was."""
        like = self._arrays(Saved(State(0, np.empty(0), np.empty(0)), RunProgress()))
        kinds = {name: (array.dtype, array.shape) for name, array in like.items()}
        kinds |= dict.fromkeys(("displacement", "difference"), (self.precision, self._shape))
        kinds["contact"] = self.precision, self._contact_shape
        try:
            with (self._folder / STATE).open("rb") as file, zipfile.ZipFile(file) as archive:
                arrays = {name: read_array(archive, name, *kind) for name, kind in kinds.items()}
        except FileNotFoundError:
            return None
        # A forged archive can make zipfile raise almost anything.
        except Exception:
            raise self._damaged(STATE) from None
        progress = RunProgress(**{field.name: arrays[field.name].item() for field in fields(RunProgress)})
        saved = Saved(
            State(int(arrays["steps"]), arrays["displacement"], arrays["difference"], arrays["contact"]), progress
        )
        every = self._grid.steps_per_frame
        if not (
            progress.frame <= self._grid.frames
            and progress.frame * every <= saved.state.steps <= (progress.frame + 1) * every
            and all(np.isfinite(array).all() for array in arrays.values())
            and all(value >= 0 for value in asdict(progress).values())
            and arrays["manifest"].tobytes() == self._key
        ):
            raise self._damaged(STATE)
        return saved

    def close(self) -> None:
        """Close its files."""
        self._open.close()

    def _arrays(self, saved: Saved) -> dict[str, NDArray[Any]]:
        """Give the arrays of a state, the numbers of its progress and the digest of the manifest, all by name."""
        named = {**saved.state._asdict(), **asdict(saved.progress), "manifest": np.frombuffer(self._key, np.uint8)}
        return {name: np.asarray(value) for name, value in named.items()}

    def _digest(self, frame: int, data: memoryview) -> bytes:
        """Compute a digest of the positions that also depends on the frame and the run."""
        return _digest(self._key, frame.to_bytes(8, "little"), data)

    def _damaged(self, name: str) -> DamagedError:
        return DamagedError(f"{self._folder / name} is damaged; run the scene again")


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
    return json.dumps({"sha256": _digest(json.dumps(content).encode()).hex(), "content": content}).encode()


def unseal(data: bytes) -> Any:
    """Read what `seal` wrote; raises ValueError when any bit of it, even of white space, is not as it was written."""
    try:
        content = json.loads(data)["content"]
        if seal(content) == data:
            return content
    except (KeyError, TypeError, RecursionError):
        pass
    raise ValueError("damaged")


def _digest(*parts: bytes | memoryview) -> bytes:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.digest()
