"""Ctrl-C and SIGTERM as a request to stop, granted only where the work can stop.

By default Python raises KeyboardInterrupt between any two bytecodes; raised in an import, a destructor or a callback of
a library, it is lost or turned into another error.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)

# A descriptor of stderr that works even while libraries are kept from writing there.
_outlet = 2


class Interruption:
    """Remembers a request to stop; a second request ends the process at once.

    Attributes:
        code: exit code of a program that was stopped: 128 plus the number of the signal.
    """

    def __init__(self) -> None:
        self.code = 128 + signal.SIGINT
        self._requested = False

    def listen(self) -> None:
        """Treat the signals as requests from now on."""
        for number in SIGNALS:
            signal.signal(number, self._request)

    def grant(self) -> None:
        """Raise KeyboardInterrupt if a signal came since `listen`."""
        if self._requested:
            raise KeyboardInterrupt

    def _request(self, number: int, _frame: FrameType | None) -> None:
        self.code = 128 + number
        if self._requested:
            _end(self.code, b"interrupted twice; ended at once\n")
        self._requested = True


def leave_at_once() -> None:
    """From now on let a signal end the process at once; for use while there are no results to keep."""
    global _outlet
    _outlet = os.dup(2)
    for number in SIGNALS:
        signal.signal(number, _leave)


def _leave(number: int, _frame: FrameType | None) -> None:
    _end(128 + number, b"interrupted; nothing was written\n")


def _end(code: int, message: bytes) -> None:
    with suppress(OSError):  # nobody can read it
        os.write(_outlet, message)
    os._exit(code)
