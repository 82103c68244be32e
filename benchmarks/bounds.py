"""What the machine allows: how fast the work could be done by its bytes, flops, roots and launches, all measured here.

The work of a stage is counted as the least that anyone must do, so a bound is a time that nobody is below, and how far
a stage is from it is no less than what is lost.
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

# A step reads u_n (12 bytes), reads and writes u_{n-1} or a difference (24) and reads the load's share (4). Several
# steps of a part of the sheet that fits in a cache, before the next part, would move less.
STEP_BYTES = 40
# What of these is kept between two steps: two vectors and the share.
STATE_BYTES = 28

# Each of the 4 springs that a point has to itself: the vector along it 3 and its rest 1.5 on the average, the square of
# its length 5, root 1, pull 2, force 3, added here 3 and there 3. Then virtual spring 6, load 6, Verlet 15.
STEP_FLOPS = 4 * 21.5 + 27
# A reciprocal root for each of these springs.
STEP_ROOTS = 4

# A picture is written and its texture read, once, in 8-bit colours.
COLOUR_BYTES = 3
# A pixel by the way that kernel 2 goes: the outline of its cell 20, the small quad 50, its corners and the triangle 70,
# the normal and the light 30, four texels filtered in three colours 30.
PIXEL_FLOPS = 200

# Points of the smallest sheet, whose step takes the residual is next to 0: what is left is the launch.
SMALLEST = 11

FLOATS = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")
REPEATS = 10_000


def bandwidth(footprint: int) -> float:
    """Measure the triad on arrays of so many bytes together [bytes/s]."""
    triad = _library().triad
    triad.argtypes = [FLOATS] * 3 + [ctypes.c_int64] * 2
    triad.restype = None
    n = footprint // 12
    a, b, c = (np.ones(n, np.float32) for _ in range(3))
    return 12 * n / seconds(lambda count: triad(a, b, c, n, count))


def rate(operation: str) -> float:
    """Measure how many flops or roots all threads do [1/s]."""
    function = getattr(_library(), operation)
    function.argtypes, function.restype = [ctypes.c_int64], ctypes.c_double
    done = function(REPEATS)
    return done / REPEATS / seconds(function)


def _library() -> ctypes.CDLL:
    return library(Path(__file__).with_name("bounds.cpp"))


def measure(sizes: tuple[int, ...], rounds: int, progress: Progress) -> dict[str, Any]:
    """Measure everything, each in a process of its own; what cannot be measured is left out, and said."""

    def best(choose: Callable[[list[float]], float], task: str, **arguments: Any) -> float:
        progress(f"{task} {arguments}")
        # What disturbs a measurement only ever makes the machine look slower.
        return choose([call(task, **arguments) for _ in range(rounds)])

    found: dict[str, Any] = {"said": "", "bandwidth": {}}
    try:
        for operation in ("flops", "roots"):
            found[operation] = best(max, "benchmarks.bounds:rate", operation=operation)
        for points in sizes:
            footprint = STATE_BYTES * points**2
            found["bandwidth"][str(points)] = best(max, "benchmarks.bounds:bandwidth", footprint=footprint)
        found["launch"] = best(min, "benchmarks.launch:empty")
        ours = {"peer": PEERS["taichi_msm"], "points": SMALLEST}
        found["one_step"] = best(min, "benchmarks.stepping.measure:launch", **ours)
    except (UnavailableError, FailedError) as error:
        found["said"] = str(error).split(":")[0]
    return found
