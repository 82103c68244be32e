"""Errors for the user, checks of the arguments of library calls, and the types of progress callbacks.

Only the command line prints errors or turns them into exit codes.
"""

from __future__ import annotations

import errno
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
    """A fault of a scene.

    Attributes:
        path: path to the key at fault; empty for the whole scene.
        message: the value, its fault and the remedy, without the key.
    """

    path: Key
    message: str

    @property
    def key(self) -> str:
        """The key in dotted form, as users write it: probes.0.load."""
        return ".".join(str(part) for part in self.path)

    def __str__(self) -> str:
        return f"{self.key}: {self.message}" if self.path else self.message


class MsmError(Exception):
    """Base class of all errors of this package that are meant for the user."""


class SceneError(MsmError):
    """A scene is invalid or cannot be run.

    Attributes:
        lines: one line for each fault, with control characters escaped.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        # Two checks may report the same fault of a value.
        self.lines = tuple(dict.fromkeys(printable(line) for line in lines))
        super().__init__("\n".join(self.lines))

    def __reduce__(self) -> tuple[type[SceneError], tuple[tuple[str, ...]]]:
        return type(self), (self.lines,)


class DeviceError(MsmError):
    """The requested arch, thread count or compiler is not available, or the device skipped part of its work."""


class NotInstalledError(MsmError):
    """A required package is not installed; the message contains the command to install it."""


class ExecutorError(MsmError):
    """The executor of the runs of a sweep cannot be reached, or is not suitable."""


class LostExecutorError(ExecutorError):
    """The executor of the runs of a sweep stopped accepting runs."""


class ArgumentError(MsmError, ValueError):
    """An argument of a call is invalid; the message contains its name, its value and the allowed values."""


class DivergedError(MsmError):
    """The simulation diverged. `step`, `time` and `point` are also attributes.

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
    """A foreign file or folder, not written by this program, is at the path of a result. It is unchanged."""

    @classmethod
    def at(cls, path: object, kind: str) -> ForeignError:
        """Build the error for a foreign entry at the path of a result.

        Args:
            path: foreign entry.
            kind: noun for the message, such as "a file"; see `directory.entry_kind`.

        Returns:
            The error, for a `raise` statement.
        """
        return cls(f"{path}: {kind} not written by this program; move it away or choose another folder")


class DamagedError(FilesError):
    """The files of an unfinished run are damaged, so it cannot be resumed."""


def printable(text: str) -> str:
    """Escape line breaks, control characters and surrogates of a text."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


# Largest number of characters of a value in a message.
MAX_VALUE_LENGTH = 60


def truncate(text: str) -> str:
    """Truncate a text to the length of a value in a message."""
    return text if len(text) <= MAX_VALUE_LENGTH else text[:MAX_VALUE_LENGTH] + "..."


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a hint for a message about an unknown name, such as "; did you mean 'top'?".

    Args:
        name: the unknown name; case is ignored.
        known: valid names, of which the most similar is proposed; without a similar one, the hint is empty.
    """
    # Imported here, as it is needed only for a message.
    from difflib import get_close_matches

    # Matching takes time in proportion to the length of the name.
    matches = get_close_matches(name[:60].lower(), list(known), n=1)
    return f"; did you mean '{matches[0]}'?" if matches and matches[0] != name else ""


@contextmanager
def writing(path: object, option: str = "--out") -> Iterator[None]:
    """Return a context that converts an OSError to a FilesError.

    Args:
        path: file or folder that the block writes to, for the message.
        option: command-line option of the path, for the remedy.

    Raises:
        FilesError: in place of the OSError; contains its reason and the remedy.
    """
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        remedy = f"free some space or choose another {option}" if full else f"choose another {option}"
        raise FilesError(f"{path}: cannot write: {error.strerror or error}; {remedy}") from error


def out_of_memory(error: Exception) -> str:
    """Return a message with the remedy for a failed allocation of memory; empty for other errors."""
    # Taichi prefixes its messages with a line of its source, in brackets.
    reason = re.sub(r"^\[.*?\] ", "", " ".join(str(error).split())).rstrip(".")
    # The compilers and the encoder of pictures raise a RuntimeError.
    if isinstance(error, MemoryError) or re.search(
        r"MemoryError|memory allocation|out of memory", reason, re.IGNORECASE
    ):
        fault = f"out of memory: {reason}" if reason else "out of memory"
        return f"{fault}; reduce sheet.points or render.size, or raise the limit of memory (ulimit -v)"
    return ""


# Limit of the numbers of processes and threads.
MAX_WORKERS = 1024


def as_array(values: Any, name: str) -> NDArray[Any]:
    """Convert an argument of a library call to an array.

    Args:
        values: array or nested sequences.
        name: name of the argument, for the message.

    Returns:
        An array of any shape and dtype; not copied if `values` is one.

    Raises:
        ArgumentError: when conversion fails, such as for rows of different lengths.
    """
    # Imported here, so that a scene can be checked without importing NumPy.
    import numpy as np

    try:
        return np.asarray(values)
    except ValueError as error:
        raise ArgumentError(f"{name}: {error}; take an array") from None


def is_real_array(array: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Return whether an array has a real dtype and a given shape.

    Args:
        array: array of any dtype.
        shape: expected shape, compared exactly.
    """
    return array.dtype.kind in "fiu" and array.shape == shape


def require_frame_count(frames: int) -> None:
    """Require a number of frames to be a whole number, 0 or more; raise an ArgumentError otherwise."""
    if isinstance(frames, bool) or not isinstance(frames, Integral) or frames < 0:
        raise ArgumentError(f"{frames!r} frames cannot be simulated; take a whole number, 0 or more")


def require_path(path: str | Path, name: str = "directory", remedy: str = "take a path") -> None:
    """Require that an argument of a library call is a path.

    Args:
        path: argument of any type.
        name: its name in the message.
        remedy: advice at the end of the message.

    Raises:
        ArgumentError: when it is neither a text nor a Path, or contains null characters.
    """
    if not isinstance(path, (str, Path)) or "\0" in str(path):
        raise ArgumentError(f"{name}: {path!r}; {remedy}")


# Callbacks of long computations. An exception that a callback raises stops the computation.

# Called several times a second, to let the caller interrupt.
Pause = Callable[[], None]

# Called with the completed and the total amount of work.
ProgressCallback = Callable[[int, int], None]

# Called with the name of the stage, and the completed and the total amount of its work.
StageProgressCallback = Callable[[str, int, int], None]
