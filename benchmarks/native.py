"""Compilation of the C++ files with an expert's options."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

from benchmarks.process import AVX2, CACHE, UnavailableError, vector_bits

# By preference: for 1 / sqrt(x) with AVX-512 g++ 12 has two estimates, of the root and of its reciprocal, and a step
# takes half as long again.
COMPILERS = ("clang++", "g++")


def compiler() -> str:
    """Return the name of the compiler, empty if there is none."""
    return next((name for name in COMPILERS if shutil.which(name)), "")


def options() -> list[str]:
    """Return the compiler's options."""
    wide = ["-march=native", "-mprefer-vector-width=512"] if vector_bits() > 256 else [f"-march={AVX2}"]
    return ["-O3", *wide, "-ffast-math", "-fopenmp"]


def library(source: Path) -> ctypes.CDLL:
    """Compile a C++ file, once per run of the benchmarks, and load it.

    Raises:
        UnavailableError: without a compiler, or when it fails.
    """
    built = CACHE / f"{source.stem}-{vector_bits()}.so"
    if not compiler():
        raise UnavailableError(f"neither {' nor '.join(COMPILERS)} is installed")
    if not built.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        command = [compiler(), *options(), "-shared", "-fPIC", str(source), "-o", str(built)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UnavailableError(f"{compiler()} fails: {done.stderr.strip().splitlines()[0]}")
    return ctypes.CDLL(str(built))
