"""Every measurement is a process of its own: Taichi has one device a process, and pools of threads spin."""

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

# What a run makes; ignored by git. Compiled kernels and the answers to compare with are kept for one run only.
OUTPUT = ROOT / "output" / "benchmarks"
CACHE = OUTPUT / "cache"

# A measurement that takes longer is given up [s].
PATIENCE = 900.0

# Where a measurement is told the width of vectors that peers may take; without it, they take the processor's.
NARROW = "BENCHMARK_VECTOR_BITS"

# A processor with AVX2 and FMA and without AVX-512, as GCC and LLVM call it.
AVX2 = "x86-64-v3"


class UnavailableError(Exception):
    """A peer cannot run here; the message says why, in a few words."""


class FailedError(Exception):
    """A measurement ended with an error; the message is its last line."""


def call(task: str, **arguments: Any) -> Any:
    """Call a function in a process of its own.

    Args:
        task: "module:function"; what it takes and gives is JSON.
        arguments: of the function; `threads` also sizes the pools that look into the environment. Not passed on are
            `bits`, the width of vectors that peers may take (None: the processor's), and `compiler`, the name of the
            compiler of this program's kernels (None: that of this process).

    Raises:
        UnavailableError: when what it needs is not installed.
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
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired:
        raise FailedError(f"takes more than {PATIENCE:g} s") from None
    if done.returncode < 0:
        raise FailedError(f"signal {-done.returncode}")
    if done.returncode:
        raise FailedError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    answer = json.loads(done.stdout.splitlines()[-1])
    if "unavailable" in answer:
        raise UnavailableError(answer["unavailable"])
    return answer["returned"]


def vector_bits() -> int:
    """Tell how wide vectors may be in this process."""
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
            "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX512_COMMON,AVX512_ICL",
        }
    return environment
