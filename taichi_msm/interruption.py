"""Ctrl-C as a request, granted where the work can stop.

Python raises KeyboardInterrupt between any two bytecodes: inside an import, a destructor or a callback of a library it
gets lost or turns into another error.
"""

from __future__ import annotations

import os
import signal
from types import FrameType

INTERRUPTED = 130


class Interruption:
    """Remembers that Ctrl-C was pressed; pressed twice, it ends the process at once."""

    def __init__(self) -> None:
        self._requested = False

    def listen(self) -> None:
        """Take Ctrl-C as a request from now on."""
        signal.signal(signal.SIGINT, self._request)

    def grant(self) -> None:
        """Stop here if it was asked for.

        Raises:
            KeyboardInterrupt: when Ctrl-C was pressed since `listen`.
        """
        if self._requested:
            raise KeyboardInterrupt

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        if self._requested:
            os._exit(INTERRUPTED)
        self._requested = True


def leave_at_once() -> None:
    """End the process at Ctrl-C, as long as there is nothing to keep."""
    signal.signal(signal.SIGINT, _leave)


def _leave(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"interrupted; nothing was written\n")
    os._exit(INTERRUPTED)
