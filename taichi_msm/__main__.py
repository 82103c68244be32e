"""`taichi-msm`, which `python -m taichi_msm` is too."""

import io
import sys

from taichi_msm.system import signals, streams


def main() -> int:
    """Run the command line of the process."""
    streams.open_missing()
    signals.leave_at_once()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file name need not be text; errors, on stderr, are printed this way already.
        sys.stdout.reconfigure(errors="backslashreplace")
    from taichi_msm.cli import main

    return main()


if __name__ == "__main__":
    sys.exit(main())
