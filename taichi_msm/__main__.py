"""Entry point of the commands `taichi-msm` and `python -m taichi_msm`."""

import gc
import io
import os
import sys
import warnings

from taichi_msm.system import process

# Commands and options that write no results by themselves.
NO_RESULTS = {"check", "schema", "view", "--dry-run", "--help", "--version"}


def main() -> int:
    """Run the command line, and return its exit code."""
    # Imports create half a million permanent objects. At the default threshold, their garbage collection takes 5 % of a
    # short run.
    gc.set_threshold(100_000)
    # PYTHONWARNINGS=error is for a user's own code; a warning in a library must not end a command or a child process.
    if any(option and "error".startswith(option.partition(":")[0]) for option in sys.warnoptions):
        warnings.simplefilter("ignore")
        os.environ.pop("PYTHONWARNINGS", None)
    # OpenBLAS starts a spinning thread per core, but the matrices here are too small for two threads. NumPy loads it
    # later, in this process and in the encoder.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    process.open_standard_streams()
    process.exit_on_signals("interrupted" if NO_RESULTS & set(sys.argv) else "interrupted; nothing was written")
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file name may contain bytes that are not text; stderr escapes them by default.
        sys.stdout.reconfigure(errors="backslashreplace")
    from taichi_msm.cli.main import main

    try:
        return main()
    finally:
        # Taichi writes its kernel cache only when it is stopped. Frozen objects save the interpreter a search for
        # cycles at exit, which takes 0.2 s.
        if runtime := sys.modules.get("taichi_msm.system.runtime"):
            runtime.stop()
        gc.freeze()


if __name__ == "__main__":
    sys.exit(main())
