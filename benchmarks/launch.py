"""Time of launching a kernel that does almost nothing, on every thread."""

from __future__ import annotations

from benchmarks.clock import seconds
from taichi_msm.system import runtime


def empty() -> float:
    """Return the time of a launch [s]."""
    runtime.start("cpu")
    ti = runtime.ti
    total = ti.field(ti.i32, shape=())

    @ti.kernel
    def nothing():
        for i in range(1 << 16):  # enough iterations for every thread
            if i < 0:
                total[None] += 1

    def launch(count: int) -> None:
        for _ in range(count):
            nothing()

    launch(1)
    return seconds(launch)
