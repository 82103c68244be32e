"""What it takes to launch a kernel that does the residual is next to 0, on every thread."""

from __future__ import annotations

from benchmarks.clock import seconds
from taichi_msm.system import runtime

# Iterations of a parallel loop, enough for every thread of a common machine to get some.
ITERATIONS = 1 << 16


def empty() -> float:
    """Time a launch [s]."""
    runtime.start("cpu")
    ti = runtime.ti
    total = ti.field(ti.i32, shape=())

    @ti.kernel
    def nothing():
        for i in range(ITERATIONS):
            if i < 0:
                total[None] += 1

    def launch(count: int) -> None:
        for _ in range(count):
            nothing()

    launch(1)
    return seconds(launch)
