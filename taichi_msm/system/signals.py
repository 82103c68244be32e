"""Ctrl-C and SIGTERM as a request, granted where the work can stop.

Python raises KeyboardInterrupt between any two bytecodes: inside an import, a destructor or a callback of a library it
gets lost or turns into another error.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)

# Where stderr is, also while libraries are kept from writing there.
_outlet = 2


class Interruption:
    """Remembers that the program was asked to stop; asked twice, it ends the process at once.

    Attributes:
        code: the exit code of a program that stops, 128 and the number of the signal.
    """

    def __init__(self) -> None:
        self.code = _code(signal.SIGINT)
        self._requested = False

    def listen(self) -> None:
        """Take the signals as a request from now on."""
        for number in SIGNALS:
            signal.signal(number, self._request)

    def grant(self) -> None:
        """Stop here if it was asked for.

        Raises:
            KeyboardInterrupt: when a signal came since `listen`.
        """
        if self._requested:
            raise KeyboardInterrupt

    def _request(self, number: int, _frame: FrameType | None) -> None:
        self.code = _code(number)
        if self._requested:
            _end(self.code, b"interrupted twice; ended at once\n")
        self._requested = True


def leave_at_once() -> None:
    """End the process at a signal, as long as there is nothing to keep."""
    global _outlet
    _outlet = os.dup(2)
    for number in SIGNALS:
        signal.signal(number, _leave)


def _leave(number: int, _frame: FrameType | None) -> None:
    _end(_code(number), b"interrupted; nothing was written\n")


def _end(code: int, message: bytes) -> None:
    with suppress(OSError):  # nobody can read it
        os.write(_outlet, message)
    os._exit(code)


def _code(number: int) -> int:
    return 128 + number
