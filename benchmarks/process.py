"""Separate processes for measurements: Taichi has one device per process, and thread pools spin."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from taichi_msm.system import runtime
from taichi_msm.system.compiler import COMPILER_VARIABLE, COMPILERS, active_compiler

ROOT = Path(__file__).parent.parent

# Results, ignored by git; compiled kernels and reference answers are cached for one run only.
OUTPUT = ROOT / "output" / "benchmarks"
CACHE = OUTPUT / "cache"

# Longest duration of a measurement [s].
MAX_MEASUREMENT_S = 900.0

# Environment variable with the width of vectors for peers, that of the processor by default.
NARROW = "BENCHMARK_VECTOR_BITS"

# A processor with AVX2 and FMA and without AVX-512, as GCC and LLVM call it.
AVX2 = "x86-64-v3"


class UnavailableError(Exception):
    """A peer cannot run on this machine; the message is the reason."""


class FailedError(Exception):
    """A measurement ended with an error; the message is its last line."""


def call(task: str, **arguments: Any) -> Any:
    """Call a function in a separate process; return its value.

    Args:
        task: "module:function"; its arguments and its value are JSON.
        arguments: of the function; `threads` also sizes thread pools by the environment. Not passed on are `bits`, the
            width of vectors for peers, and `compiler`, the name of the compiler of this program's kernels.

    Raises:
        UnavailableError: when a requirement is not installed.
        FailedError: when it ends with another error or takes too long.
    """
    bits, compiler = arguments.pop("bits", None), arguments.pop("compiler", None)
    command = [sys.executable, "-m", "benchmarks.child", task, json.dumps(arguments)]
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env=_environment(arguments.get("threads"), bits, compiler or active_compiler().name),
            capture_output=True,
            text=True,
            check=False,
            timeout=MAX_MEASUREMENT_S,
        )
    except subprocess.TimeoutExpired:
        raise FailedError(f"takes more than {MAX_MEASUREMENT_S:g} s") from None
    if done.returncode < 0:
        raise FailedError(f"signal {-done.returncode}")
    if done.returncode:
        raise FailedError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    answer = json.loads(done.stdout.splitlines()[-1])
    if "unavailable" in answer:
        raise UnavailableError(answer["unavailable"])
    return answer["returned"]


def vector_bits() -> int:
    """Return the width of vectors for peers in this process [bits]."""
    return int(os.environ.get(NARROW) or runtime.vector_bits())


def _environment(threads: int | None, bits: int | None, compiler: str) -> dict[str, str]:
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "NUMBA_CACHE_DIR": str(CACHE / "numba"),
        COMPILER_VARIABLE: compiler,
        COMPILERS[compiler].folder_variable: str(CACHE / compiler),
    }
    if threads is not None:
        pools = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")
        environment |= dict.fromkeys(pools, str(threads))
    if bits is not None and bits < runtime.vector_bits():
        environment |= {
            NARROW: str(bits),
            "NUMBA_CPU_NAME": AVX2,
            "NUMBA_CPU_FEATURES": "+avx2,+fma",
            "NUMBA_CACHE_DIR": str(CACHE / "numba-256"),
        }
    return environment
