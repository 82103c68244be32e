"""The errors that the user is told of. Only the command line prints them or turns them into exit codes.

Checks of the arguments that a caller gives to the library.

Functions by which work reports its progress; an exception from one stops the work at that point.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The way to a value of a scene: ("probes", 0, "load").
Key = tuple[str | int, ...]

# So many letters of a name are compared with those that are known.
MAX_NAME = 60


@dataclass(frozen=True)
class Problem:
    """One fault of a scene."""

    path: Key  # of the key at fault
    message: str  # the value, what is wrong with it, and the remedy; without the key

    @property
    def key(self) -> str:
        """The key as the user writes it: probes.0.load."""
        return ".".join(str(part) for part in self.path)

    def __str__(self) -> str:
        return f"{self.key}: {self.message}" if self.path else self.message


class MsmError(Exception):
    """Any error of this package that is meant for the user."""


class SceneError(MsmError):
    """A scene cannot be run; `lines` holds one printable line for each fault, whatever characters the names have."""

    def __init__(self, lines: Sequence[str]) -> None:
        # Two checks may report the same fault of a value.
        self.lines = tuple(dict.fromkeys(printable(line) for line in lines))
        super().__init__("\n".join(self.lines))

    def __reduce__(self) -> tuple[type[SceneError], tuple[tuple[str, ...]]]:
        return type(self), (self.lines,)


class DeviceError(MsmError):
    """The requested arch, number of threads or compiler is not available, or the device left out part of its work."""


class NotInstalledError(MsmError):
    """A package that the request needs is not installed; the message says how to install it."""


class ExecutorError(MsmError):
    """What should take the runs of a sweep cannot be reached, or is not fit for them."""


class LostExecutorError(ExecutorError):
    """What takes the runs of a sweep takes no more."""


class ArgumentError(MsmError, ValueError):
    """An argument of a call is wrong; the message names it, its value, and which values are allowed."""


class DivergedError(MsmError):
    """The simulation diverged; the message names the time, the point and the remedy.

    Attributes:
        step: number of steps taken so far.
        time: simulated time so far [s].
        point: row and column of the point that is farthest from its rest position.
    """

    def __init__(self, message: str, step: int, time: float, point: tuple[int, int]) -> None:
        super().__init__(message)
        self.step, self.time, self.point = step, time, point

    def __reduce__(self) -> tuple[type[DivergedError], tuple[str, int, float, tuple[int, int]]]:
        return type(self), (str(self), self.step, self.time, self.point)


class FilesError(MsmError):
    """Reading or writing failed; the message names the path and the remedy."""


class ForeignError(FilesError):
    """Something that no run has put there is in the way; it was not touched."""

    @classmethod
    def at(cls, path: object, found: str) -> ForeignError:
        """Make the error for what was found at a path."""
        return cls(f"{path}: {found} that no run has put there; move it away or choose another folder")


class DamagedError(FilesError):
    """The files of an unfinished run cannot be used."""


def printable(text: str) -> str:
    """Escape line breaks, control characters for terminals, and what is not a character."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Ask whether the nearest of the known names was meant, in words that go after a message; empty if none is near."""
    # Imported here, as it is needed only for a message.
    from difflib import get_close_matches

    near = get_close_matches(name[:MAX_NAME].lower(), list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near and near[0] != name else ""


@contextmanager
def writing(place: object, option: str = "--out") -> Iterator[None]:
    """Raise a FilesError instead of an OSError: `place` cannot be written, and `option` chooses another."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        remedy = f"free some space or choose another {option}" if full else f"choose another {option}"
        raise FilesError(f"{place}: cannot write: {error.strerror or error}; {remedy}") from error


pass  # REMOVED


# More processes or threads than this are refused.
MAX_WORKERS = 1024


def as_array(values: Any, name: str) -> NDArray[Any]:
    """Turn an argument into an array; ArgumentError: it is impossible, such as for rows of different lengths."""
    # Imported here, so that a scene can be checked without importing NumPy.
    import numpy as np

    try:
        return np.asarray(values)
    except ValueError as error:
        raise ArgumentError(f"{name}: {error}; take an array") from None


def is_real_array(array: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Tell whether an array holds real numbers and has a shape."""
    return array.dtype.kind in "fiu" and array.shape == shape


def require_frame_count(frames: int) -> None:
    """Make sure that a number of frames is a whole number, 0 or more; ArgumentError: it is not."""
    if isinstance(frames, bool) or not isinstance(frames, Integral) or frames < 0:
        raise ArgumentError(f"{frames!r} frames cannot be simulated; take a whole number, 0 or more")


def require_path(path: str | Path, name: str = "directory", remedy: str = "take a path") -> None:
    """Check that an argument can be a path; ArgumentError: it cannot, with the remedy."""
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise ArgumentError(f"{name}: {path!r}; {remedy}")


# Called some times a second.
Pause = Callable[[], None]

# Called with how much is done and how much there is in all.
ProgressCallback = Callable[[int, int], None]

# Called with the stage of the work, then the same two.
StageProgressCallback = Callable[[str, int, int], None]
