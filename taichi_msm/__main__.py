"""`taichi-msm`, which `python -m taichi_msm` is too."""

import os
import signal
import sys
from types import FrameType


def _leave(_number: int, _frame: FrameType | None) -> None:
    # Raised in the middle of an import, KeyboardInterrupt gets lost or turns into another error.
    os.write(2, b"interrupted; nothing was written\n")
    os._exit(130)


def main() -> int:
    """Run the command line of the process; until there is something to keep, Ctrl-C ends it at once."""
    signal.signal(signal.SIGINT, _leave)
    from taichi_msm.cli import main

    return main()


if __name__ == "__main__":
    sys.exit(main())
