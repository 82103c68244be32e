"""Errors for the user, checks of arguments of library calls, and types of progress callbacks.

Only the command line prints errors, or turns them into exit codes.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Path to a value of a scene, such as ("probes", 0, "load").
Key = tuple[str | int, ...]


@dataclass(frozen=True)
class Problem:
    """A fault of a scene."""

    path: Key  # to the faulty key; empty for the whole scene
    message: str  # value, fault and remedy, without the key
    is_unknown_key: bool = False  # whether the section has no such key

    @property
    def key(self) -> str:
        """The key in dotted form, such as probes.0.load."""
        return ".".join(str(part) for part in self.path)

    def __str__(self) -> str:
        return f"{self.key}: {self.message}" if self.path else self.message


class MsmError(Exception):
    """Base class of the errors of this package that a user can remedy."""


class SceneError(MsmError):
    """A scene is invalid or cannot be run.

    Attributes:
        lines: a line for each fault, with control characters escaped.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        # Two checks may report the same fault.
        self.lines = tuple(dict.fromkeys(printable(line) for line in lines))
        super().__init__("\n".join(self.lines))

    def __reduce__(self) -> tuple[type[SceneError], tuple[tuple[str, ...]]]:
        return type(self), (self.lines,)


class DeviceError(MsmError):
    """The requested arch, thread count, compiler or port is not available, or the device skipped part of its work."""


class NotInstalledError(MsmError):
    """A required package is not installed; the message contains the command to install it."""


class ExecutorError(MsmError):
    """The executor of a sweep cannot be reached, or is not suitable."""


class LostExecutorError(ExecutorError):
    """The executor of a sweep accepts no more runs."""


class ArgumentError(MsmError, ValueError):
    """An argument of a library call is invalid; the message contains its name, its value and the allowed values."""


class DivergedError(MsmError):
    """The simulation diverged. All arguments but the message are also attributes.

    Args:
        message: time, mass point, fault and remedy.
        step: number of completed steps.
        time: simulated time [s].
        point: row and column of the mass point with the largest displacement.
    """

    def __init__(self, message: str, step: int, time: float, point: tuple[int, int]) -> None:
        super().__init__(message)
        self.step, self.time, self.point = step, time, point

    def __reduce__(self) -> tuple[type[DivergedError], tuple[str, int, float, tuple[int, int]]]:
        return type(self), (str(self), self.step, self.time, self.point)


class FilesError(MsmError):
    """Reading or writing failed; the message contains the path and the remedy."""


class ForeignError(FilesError):
    """A file or folder at the path of a result was not written by this program, and is left unchanged."""

    @classmethod
    def at(cls, path: object, kind: str) -> ForeignError:
        """Build the error for a path; `kind` is a noun for the message, as from `directory.entry_kind`."""
        return cls(f"{path}: {kind} not written by this program; move it away or choose another folder")


class DamagedError(FilesError):
    """The files of an unfinished run are damaged, so it cannot be resumed."""


def printable(text: str) -> str:
    """Escape the line breaks, control characters and surrogates in a text."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


# Largest number of characters of a value in a message.
MAX_VALUE_LENGTH = 60


def truncate(text: str) -> str:
    """Truncate a text to `MAX_VALUE_LENGTH`, with an ellipsis."""
    return text if len(text) <= MAX_VALUE_LENGTH else text[:MAX_VALUE_LENGTH] + "..."


def closest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that is similar to an unknown one in any case; empty without a similar name."""
    # Imported here, as only a message needs it.
    from difflib import get_close_matches

    # Matching takes time in proportion to the length of the name; a single letter is similar to none.
    matches = get_close_matches(name[:60].lower(), [each for each in known if len(each) > 1], n=1)
    return matches[0] if matches and matches[0] != name else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name, such as "; did you mean 'top'?"; empty without a similar name."""
    closest = closest_name(name, known)
    return f"; did you mean '{closest}'?" if closest else ""


def windows_path_hint(path: str) -> str:
    r"""Return a hint for a missing path such as textures\a.png on a system with /; empty for other paths."""
    return "; write / in place of \\" if "\\" in path and os.sep == "/" else ""


@contextmanager
def writing(path: object, option: str = "--out") -> Iterator[None]:
    """Return a context that converts an OSError to a FilesError, whose remedy is another path for `option`."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        remedy = f"free some space or choose another {option}" if full else f"choose another {option}"
        raise FilesError(f"{path}: cannot write: {error.strerror or error}; {remedy}") from error


def out_of_memory(error: Exception) -> str:
    """Return the message of a failed allocation of memory, with the remedy; empty for other errors."""
    # Taichi puts a source line in brackets before its messages.
    reason = re.sub(r"^\[.*?\] ", "", " ".join(str(error).split())).rstrip(".")
    # Compilers and picture encoders raise a RuntimeError.
    if isinstance(error, MemoryError) or re.search(r"(?i)MemoryError|memory allocation|out of memory", reason):
        fault = f"out of memory: {reason}" if reason else "out of memory"
        return f"{fault}; reduce sheet.points or render.size, or raise the limit of memory (ulimit -v)"
    return ""


# Largest number of processes or threads, above the cores of any machine; Taichi starts all of its threads.
MAX_WORKERS = 1024


def as_array(values: Any, name: str) -> NDArray[Any]:
    """Convert an argument to an array, not copied if it is one; raise an ArgumentError where that is impossible."""
    # Imported here, so that the check of a scene does not import NumPy.
    import numpy as np

    try:
        return np.asarray(values)
    except ValueError as error:
        raise ArgumentError(f"{name}: {error}; take an array") from None


def is_real_array(array: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Return whether an array has an integer or floating dtype and a given shape, in which a 1 does not broadcast."""
    return array.dtype.kind in "fiu" and array.shape == shape


def require_type(value: Any, types: Any, name: str, expected: str) -> None:
    """Raise an ArgumentError unless an argument has one of some types; `expected` are its values, for the message."""
    if not isinstance(value, types):
        raise ArgumentError(f"{name}: {value!r}; take {expected}")


def require_frame_count(frames: int) -> None:
    """Raise an ArgumentError unless a number of frames is a whole number, 0 or more."""
    if isinstance(frames, bool) or not isinstance(frames, Integral) or frames < 0:
        raise ArgumentError(f"{frames!r} frames cannot be simulated; take a whole number, 0 or more")


def require_path(path: str | Path, name: str = "directory", remedy: str = "take a path") -> None:
    """Raise an ArgumentError unless an argument is a text or a Path without a null character."""
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise ArgumentError(f"{name}: {path!r}; {remedy}")


# Callbacks of long computations, which an exception from the callback stops.

# Called several times a second, so that the caller can interrupt.
Pause = Callable[[], None]

# Called with the completed and the total amount of work.
ProgressCallback = Callable[[int, int], None]

# Called with the stage, and the completed and the total amount of its work.
StageProgressCallback = Callable[[str, int, int], None]
