"""Time one step against the sheet's size, the number of threads, and Taichi's fast_math.

    python benchmarks/stepping.py

Every cell is a process of its own, as a process has one device; the columns take turns, and medians are shown.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

SIZES = (31, 101, 331, 1024)
COLUMNS = {"1 thread": (1, 0), "2 threads": (2, 0), "1 thread, fast_math": (1, 1)}
ROUNDS = 5

# Enough steps for some 0.2 s a sample.
POINT_STEPS = 80_000_000


def measure(size: int, threads: int, fast_math: bool) -> float:
    """Give the median time of a step [us], with all families of springs and a fixed border, in f32."""
    from taichi_msm import runtime
    from taichi_msm.dynamics import Dynamics
    from taichi_msm.scene import Scene

    if fast_math:
        initialise = runtime.ti.init
        runtime.ti.init = lambda **options: initialise(**{**options, "fast_math": True})
    scene = Scene.model_validate(
        {
            "sheet": {"points": [size, size], "size": [0.33, 0.33], "mass": 1e-3},
            "springs": {"structural": 20, "shear": 20, "virtual": 0.5},
            "damping": 0.01,
            "probes": [{"force": [0, 0, -1000], "falloff": 60}],
            "time": {"duration": 1},
            "output": [],
        }
    )
    dynamics = Dynamics(scene, runtime.start("cpu", threads))
    dynamics.advance(2)
    steps = max(2, POINT_STEPS // size**2)
    samples = []
    for _ in range(5):
        start = time.perf_counter()
        dynamics.advance(steps)
        samples.append((time.perf_counter() - start) / steps * 1e6)
    return statistics.median(samples)


def main() -> None:
    """Print the table."""
    print("| points | " + " | ".join(f"{name} [us]" for name in COLUMNS) + " |")
    print("|---|" + "---:|" * len(COLUMNS))
    for size in SIZES:
        times: dict[str, list[float]] = {name: [] for name in COLUMNS}
        for _ in range(ROUNDS):
            for name, (threads, fast_math) in COLUMNS.items():
                command = [sys.executable, __file__, str(size), str(threads), str(fast_math)]
                done = subprocess.run(command, check=True, capture_output=True, text=True)
                times[name].append(float(done.stdout))
        cells = (f"{statistics.median(values):.3g}" for values in times.values())
        print(f"| {size} x {size} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(measure(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "1"))
    else:
        main()
