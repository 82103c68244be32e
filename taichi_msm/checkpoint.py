"""What an unfinished run leaves for another process to go on with: its plan, its frames and its last state."""

from __future__ import annotations

import json
import math
import shutil
import time
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from taichi_msm.course import Course, Saved
from taichi_msm.dynamics import State
from taichi_msm.errors import DamagedError
from taichi_msm.publication import PLAN

POSITIONS, STATE = "positions", "state.npz"

# Saving the state may take this share of the time.
SHARE = 0.02


class Checkpoint:
    """A folder from which a run can go on, whenever its process is killed.

    Args:
        folder: where it is.
        points: rows, cols.
        precision: type of the positions.
        stores: whether positions are wanted at all.

    Attributes:
        frames: number of frames that were added.
    """

    def __init__(self, folder: Path, points: tuple[int, int], precision: DTypeLike, *, stores: bool = True) -> None:
        self.frames = 0
        self._folder = folder
        self._shape = (*points, 3)
        self._precision = np.dtype(precision)
        self._frame_bytes = stores * math.prod(self._shape) * self._precision.itemsize
        self._file: BinaryIO | None = None
        self._due = 0.0

    @property
    def due(self) -> bool:
        """Whether it is time to save again."""
        return time.perf_counter() >= self._due

    @property
    def positions(self) -> BinaryIO:
        """The positions of all frames, one after another."""
        assert self._file is not None, "begin or go_on comes first"
        return self._file

    def begin(self, plan: Mapping[str, Any]) -> None:
        """Begin without a frame, in the place of any other run; the plan is what a process must know, in JSON."""
        if self._folder.exists():
            shutil.rmtree(self._folder)
        self._folder.mkdir()
        # Without a buffer, so that what was written stays when the process is killed.
        self._file = (self._folder / POSITIONS).open("x+b", buffering=0)
        draft = self._folder / "draft"
        draft.write_text(json.dumps(plan), encoding="utf-8")
        draft.replace(self._folder / PLAN)

    def go_on(self) -> Saved | None:
        """Go on from what was saved last; None: from the beginning.

        Raises:
            DamagedError: when the files do not belong together.
            OSError: when they cannot be read.
        """
        try:
            self._file = (self._folder / POSITIONS).open("r+b", buffering=0)
        except FileNotFoundError:
            raise self._damaged(POSITIONS) from None
        saved = self.load()
        self.frames = 0 if saved is None else saved.course.frame + 1
        size = self.frames * self._frame_bytes
        if (self._folder / POSITIONS).stat().st_size < size:
            raise self._damaged(POSITIONS)
        self.positions.truncate(size)
        self.positions.seek(size)
        return saved

    def add(self, position: NDArray[Any]) -> None:
        """Add the positions of the next frame [m], shape (rows, cols, 3)."""
        if self._frame_bytes:
            rest = np.ascontiguousarray(position, self._precision).data.cast("B")
            while rest:
                rest = rest[self.positions.write(rest) :]
        self.frames += 1

    def position(self, frame: int) -> NDArray[Any]:
        """Read the positions of a frame [m], shape (rows, cols, 3)."""
        start, count = frame * self._frame_bytes, math.prod(self._shape)
        found = np.fromfile(self._folder / POSITIONS, self._precision, count, offset=start)
        return found.reshape(self._shape)

    def save(self, saved: Saved) -> Path:
        """Keep where the run is, in the place of what was saved before; its frames have been added.

        Returns:
            The file that has it, with the arrays of `State` and the numbers of `Course` by their names.
        """
        start = time.perf_counter()
        draft = self._folder / "draft"
        try:
            with draft.open("wb") as file:
                np.savez(file, **saved.state._asdict(), **asdict(saved.course))
            draft.replace(self._folder / STATE)
        except OSError:
            draft.unlink(missing_ok=True)
            raise
        now = time.perf_counter()
        self._due = now + (now - start) / SHARE
        return self._folder / STATE

    def load(self) -> Saved | None:
        """Read what was saved last; None: nothing was.

        Raises:
            DamagedError: when it cannot be read.
        """
        try:
            with (self._folder / STATE).open("rb") as file, np.load(file, allow_pickle=False) as found:
                state = State(int(found["steps"]), found["displacement"], found["difference"])
                course = Course(**{key: found[key].item() for key in asdict(Course())})
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error):
            raise self._damaged(STATE) from None
        if state.displacement.shape != self._shape or state.difference.shape != self._shape:
            raise self._damaged(STATE)
        return Saved(state, course)

    def close(self) -> None:
        """Close the positions."""
        if self._file is not None:
            self._file.close()

    def _damaged(self, name: str) -> DamagedError:
        return DamagedError(f"{self._folder / name} is damaged; run the scene again")
