"""`taichi-msm`, which `python -m taichi_msm` is too."""

import gc
import io
import os
import sys
import warnings

from taichi_msm.system import process

# New objects after which Python searches for unreachable cycles. Its own 700, or 2000, are few where imports make half
# a million objects that stay: the searches took a twentieth of a short run.
BETWEEN_SEARCHES = 100_000


def main() -> int:
    """Run the command line of the process."""
    gc.set_threshold(BETWEEN_SEARCHES)
    # PYTHONWARNINGS=error is for a user's own code; a warning in a library ends no command, here or in a child process.
    if any(option and "error".startswith(option.partition(":")[0]) for option in sys.warnoptions):
        warnings.simplefilter("ignore")
        os.environ.pop("PYTHONWARNINGS", None)
    # OpenBLAS starts a thread for every core, each of which spins for a while; what we multiply is too small for two.
    # NumPy loads it later, here and in the encoder's process.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    process.open_standard_streams()
    process.exit_on_signals()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file name need not be text; errors, on stderr, are printed this way already.
        sys.stdout.reconfigure(errors="backslashreplace")
    from taichi_msm.cli.main import main

    try:
        return main()
    finally:
        # Taichi writes its cache of kernels when its program is destroyed, which is here, or else when the interpreter
        # ends: it searches all objects but frozen ones for cycles then, several times, 0.2 s in all.
        if runtime := sys.modules.get("taichi_msm.system.runtime"):
            runtime.stop()
        gc.freeze()


if __name__ == "__main__":
    sys.exit(main())
