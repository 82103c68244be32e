"""Lower bounds of times (roofline): bytes, flops, roots and launches of the work over the machine's measured rates.

The work of a stage is the least that any program must do, so the distance from the bound is an upper limit of the loss.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clock import seconds
from benchmarks.native import library
from benchmarks.process import FailedError, UnavailableError, call
from benchmarks.race import Progress
from benchmarks.stepping import PEERS

# A step reads u_n (12 bytes), reads and writes u_{n-1} or a difference (24) and reads the load's share (4). Blocking in
# time would move less.
STEP_BYTES = 40
# Stored between two steps: two vectors and the share.
STATE_BYTES = 28

# Each of the 4 springs per point: the vector along it 3, its rest vector 1.5 on average, the square of its length 5,
# root 1, pull 2, force 3, added at both ends 6. Then virtual spring 6, load 6, Verlet 15.
STEP_FLOPS = 4 * 21.5 + 27
# A reciprocal root for each of these springs.
STEP_ROOTS = 4

# A picture is written and its texture read, once, in 8-bit colours.
COLOUR_BYTES = 3
# A pixel in kernel 2: the outline of its cell 20, the quad 50, its corners and the triangle 70, normal and light 30,
# four texels filtered in three colours 30.
PIXEL_FLOPS = 200

# Points of the smallest sheet, whose step is almost only the launch.
SMALLEST = 11

FLOATS = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")
REPEATS = 10_000


def bandwidth(footprint: int) -> float:
    """Return the bandwidth of the triad on arrays of `footprint` bytes in total [bytes/s]."""
    triad = _library().triad
    triad.argtypes = [FLOATS] * 3 + [ctypes.c_int64] * 2
    triad.restype = None
    n = footprint // 12
    a, b, c = (np.ones(n, np.float32) for _ in range(3))
    return 12 * n / seconds(lambda count: triad(a, b, c, n, count))


def rate(operation: str) -> float:
    """Return the rate of an operation, "flops" or "roots", of all threads [1/s]."""
    function = getattr(_library(), operation)
    function.argtypes, function.restype = [ctypes.c_int64], ctypes.c_double
    done = function(REPEATS)
    return done / REPEATS / seconds(function)


def _library() -> ctypes.CDLL:
    return library(Path(__file__).with_name("bounds.cpp"))


def measure(sizes: tuple[int, ...], rounds: int, progress: Progress) -> dict[str, Any]:
    """Measure each rate in a separate process; `failure` is why the rest is missing, or empty."""

    def best(choose: Callable[[list[float]], float], task: str, **arguments: Any) -> float:
        progress(f"{task} {arguments}")
        # Disturbances only make the machine look slower.
        return choose([call(task, **arguments) for _ in range(rounds)])

    rates: dict[str, Any] = {"failure": "", "bandwidth": {}}
    try:
        for operation in ("flops", "roots"):
            rates[operation] = best(max, "benchmarks.bounds:rate", operation=operation)
        for points in sizes:
            footprint = STATE_BYTES * points**2
            rates["bandwidth"][str(points)] = best(max, "benchmarks.bounds:bandwidth", footprint=footprint)
        rates["launch"] = best(min, "benchmarks.launch:empty")
        ours = {"peer": PEERS["taichi_msm"], "points": SMALLEST}
        rates["one_step"] = best(min, "benchmarks.stepping.measure:launch", **ours)
    except (UnavailableError, FailedError) as error:
        rates["failure"] = str(error).split(":")[0]
    return rates
