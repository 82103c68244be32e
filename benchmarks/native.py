"""Builds the C++ files with what an expert would tell the compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

from benchmarks.process import CACHE, UnavailableError

OPTIONS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC")


def library(source: Path) -> ctypes.CDLL:
    """Compile a C++ file, once in a run of the benchmarks.

    Raises:
        UnavailableError: when there is no g++, or it fails.
    """
    built = CACHE / f"{source.stem}.so"
    if shutil.which("g++") is None:
        raise UnavailableError("g++ is not installed")
    if not built.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(
            ["g++", *OPTIONS, str(source), "-o", str(built)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise UnavailableError(f"g++ fails: {done.stderr.strip().splitlines()[0]}")
    return ctypes.CDLL(str(built))
