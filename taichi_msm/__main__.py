"""`taichi-msm`, which `python -m taichi_msm` is too."""

import gc
import io
import os
import sys

from taichi_msm.system import signals, streams

# Objects between two searches for unreachable cycles. Python's 700 are few where imports make half a million objects
# that all stay: these searches took a twentieth of a short run.
BETWEEN_SEARCHES = 100_000


def main() -> int:
    """Run the command line of the process."""
    gc.set_threshold(BETWEEN_SEARCHES)
    # NumPy starts a thread of OpenBLAS for every core; they spin although nothing here gives them work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    streams.open_missing()
    signals.leave_at_once()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file name need not be text; errors, on stderr, are printed this way already.
        sys.stdout.reconfigure(errors="backslashreplace")
    from taichi_msm.cli import main

    try:
        return main()
    finally:
        # Before it ends, the interpreter searches all objects but frozen ones for cycles, several times, 0.2 s in all.
        # It would find Taichi's program among them, which writes its cache when it is destroyed.
        if started := sys.modules.get("taichi_msm.system.runtime"):
            started.stop()
        gc.freeze()


if __name__ == "__main__":
    sys.exit(main())
