"""The files from which another process can continue an unfinished run: its manifest, its frames and its last state.

Every part has a checksum, which is verified before the part is used: a SHA-256 for the manifest, one for the positions
of every frame, and the CRC-32 of the archive for the arrays of the state.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, fields
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DamagedError
from taichi_msm.physics.run_progress import RunProgress, Saved
from taichi_msm.physics.state import State
from taichi_msm.results.folder import Folder, write_all
from taichi_msm.results.npz import read_array, write_array
from taichi_msm.results.publication import CHECKPOINT, CHECKPOINT_TREE, DRAFT, MANIFEST, POSITIONS, STATE
from taichi_msm.results.sealed import seal
from taichi_msm.timegrid import TimeGrid

# The share of the time that saving states may take.
SHARE = 0.02

DIGEST_BYTES = 32


class Checkpoint:
    """A folder from which a run can continue, no matter when its process is killed.

    Args:
        staging: the folder that contains it.
        grid: the steps of the run.
        points: rows and columns of the sheet.
        keeps_positions: whether the positions of the frames are kept.

    Attributes:
        frames: number of frames added so far.
        precision: type of the positions.
    """

    def __init__(self, staging: Folder, grid: TimeGrid, points: tuple[int, int], *, keeps_positions: bool) -> None:
        self.frames = 0
        self._staging = staging
        self._grid = grid
        self._shape = (*points, 3)
        self.precision = np.dtype(np.float32 if grid.precision == "f32" else np.float64)
        self._frame_bytes = math.prod(self._shape) * self.precision.itemsize
        self._record_bytes = (DIGEST_BYTES + self._frame_bytes) if keeps_positions else 0
        self._due = 0.0
        self._open = ExitStack()
        # The digest of the manifest, to which all parts of a checkpoint are tied.
        self._key = b""
        self._folder: Folder | None = None
        self._positions: BinaryIO | None = None

    @property
    def due(self) -> bool:
        """Whether it is time to save again."""
        return time.perf_counter() >= self._due

    def begin(self, manifest: Mapping[str, Any]) -> None:
        """Begin without frames, replacing the checkpoint of any other run.

        Args:
            manifest: what another process must know to continue the run, in JSON.
        """
        with self._staging.folder(CHECKPOINT, create=True) as folder:
            # Removed first: without a manifest, what is left of a checkpoint does not count as one.
            folder.remove(MANIFEST)
            folder.clear(CHECKPOINT_TREE)
        folder = self._enter()
        # Unbuffered, so that what was written is not lost when the process is killed.
        self._positions = self._open.enter_context(folder.create(POSITIONS, buffering=0))
        sealed = seal(manifest)
        self._key = _digest(sealed)
        folder.write(MANIFEST, sealed, DRAFT)

    def reopen(self) -> Saved | None:
        """Continue an earlier run; returns the state that it saved last, or None to continue from rest.

        Raises:
            DamagedError: when the files do not belong together.
            OSError: when they cannot be read.
        """
        folder = self._enter()
        try:
            with folder.open(MANIFEST) as file:
                self._key = _digest(file.read())
            self._positions = self._open.enter_context(folder.open(POSITIONS, write=True))
        except FileNotFoundError as error:
            raise self._damaged(str(error.filename)) from None
        saved = self.load()
        frames = 0 if saved is None else saved.progress.frame + 1
        if os.fstat(self._positions.fileno()).st_size < frames * self._record_bytes:
            raise self._damaged(POSITIONS)
        self.frames = frames
        return saved

    def add(self, position: NDArray[Any]) -> None:
        """Add the positions of the next frame [m], shape (rows, cols, 3)."""
        if self._record_bytes:
            assert self._positions is not None, "begin or reopen comes first"
            data = np.ascontiguousarray(position, self.precision).data.cast("B")
            self._positions.seek(self.frames * self._record_bytes)
            write_all(self._positions, self._digest(self.frames, data))
            write_all(self._positions, data)
        self.frames += 1

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a frame.

        Returns:
            Positions [m], shape (rows, cols, 3).

        Raises:
            DamagedError: when the positions are not as they were written.
        """
        assert self._positions is not None, "begin or reopen comes first"
        record = np.empty(self._record_bytes, np.uint8)
        self._positions.seek(frame * self._record_bytes)
        rest = record.data
        while rest and (count := self._positions.readinto(rest)):  # type: ignore[attr-defined]
            rest = rest[count:]
        data = record[DIGEST_BYTES:]
        found = data.view(self.precision).reshape(self._shape)
        # Not trusted: anybody may have written it.
        if rest or record[:DIGEST_BYTES].tobytes() != self._digest(frame, data.data) or not np.isfinite(found).all():
            raise self._damaged(POSITIONS)
        return found

    def positions(self, frames: int) -> Iterator[memoryview]:
        """Read the bytes of the positions of the first frames, frame by frame; raises what `position` does."""
        for frame in range(frames):
            yield self.position(frame).data.cast("B")

    def save(self, saved: Saved) -> str:
        """Save a state of the run, replacing the one saved before; the frames up to it must have been added.

        Returns:
            The path of the file, which has the arrays of `State` and the numbers of `RunProgress` by name.
        """
        start = time.perf_counter()
        folder = self._entered
        folder.remove(DRAFT)
        try:
            with folder.create(DRAFT) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
                for name, array in self._arrays(saved).items():
                    write_array(archive, name, array.dtype, array.shape, [np.ascontiguousarray(array).data.cast("B")])
            folder.replace(DRAFT, folder, STATE)
        except OSError:
            folder.remove(DRAFT)
            raise
        now = time.perf_counter()
        self._due = now + (now - start) / SHARE
        return str(folder.path / STATE)

    def load(self) -> Saved | None:
        """Read the state that was saved last; None: none was.

        Raises:
            DamagedError: when it cannot be a state of this run.
        """
        like = self._arrays(Saved(State(0, np.empty(0), np.empty(0)), RunProgress()))
        sheet = self.precision, self._shape
        kinds = {name: sheet if array.size == 0 else (array.dtype, array.shape) for name, array in like.items()}
        try:
            with self._entered.open(STATE) as file, zipfile.ZipFile(file) as archive:
                found = {name: read_array(archive, name, *kind) for name, kind in kinds.items()}
        except FileNotFoundError:
            return None
        # A forged archive can make zipfile raise almost anything.
        except Exception:
            raise self._damaged(STATE) from None
        progress = RunProgress(**{field.name: found[field.name].item() for field in fields(RunProgress)})
        saved = Saved(State(int(found["steps"]), found["displacement"], found["difference"]), progress)
        every = self._grid.steps_per_frame
        # Not trusted: anybody may have written it.
        if not (
            progress.frame <= self._grid.frames
            and progress.frame * every <= saved.state.steps <= (progress.frame + 1) * every
            and all(np.isfinite(array).all() for array in found.values())
            and all(value >= 0 for value in asdict(progress).values())
            and found["manifest"].tobytes() == self._key
        ):
            raise self._damaged(STATE)
        return saved

    def close(self) -> None:
        """Close its files."""
        self._open.close()

    @property
    def _entered(self) -> Folder:
        assert self._folder is not None, "begin or reopen comes first"
        return self._folder

    def _enter(self) -> Folder:
        self.close()
        self._folder = self._open.enter_context(self._staging.folder(CHECKPOINT))
        return self._folder

    def _arrays(self, saved: Saved) -> dict[str, NDArray[Any]]:
        """Give the arrays of a state, the numbers of its progress and the digest of the manifest, all by name."""
        named = {**saved.state._asdict(), **asdict(saved.progress), "manifest": np.frombuffer(self._key, np.uint8)}
        return {name: np.asarray(value) for name, value in named.items()}

    def _digest(self, frame: int, data: memoryview) -> bytes:
        """Compute a digest of the positions that also depends on the frame and the run."""
        return _digest(self._key, frame.to_bytes(8, "little"), data)

    def _damaged(self, name: str) -> DamagedError:
        return DamagedError(f"{self._staging.path / CHECKPOINT / name} is damaged; run the scene again")


def _digest(*parts: bytes | memoryview) -> bytes:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.digest()
