"""Taichi against Quadrants: whole runs, steps, pictures and labels, in turn."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from benchmarks import looks
from benchmarks.drawing import LIT
from benchmarks.process import call
from benchmarks.race import Progress
from benchmarks.stepping import PEERS
from benchmarks.whole_run import SCENE, command
from taichi_msm.system.compiler import COMPILERS

POINTS = (31, 101, 331, 1024)
PIXELS = (512, 1024)

OURS = "taichi_msm"

# Times by the work and by the name of the compiler [s].
Samples = dict[str, dict[str, list[float]]]


def works(folder: str) -> dict[str, Callable[[str], float]]:
    """Return the timed works: functions from the name of a compiler to seconds.

    Args:
        folder: for the results of runs and for compiled kernels.
    """

    def whole_run(compiler: str, cache: str) -> float:
        return command("run", SCENE, "--quiet", "--out", f"{folder}/out", cache=cache, compiler=compiler)[0]

    def cold(compiler: str) -> float:
        with tempfile.TemporaryDirectory() as cache:
            return whole_run(compiler, cache)

    def step(points: int, precision: str) -> Callable[[str], float]:
        return lambda compiler: call(
            "benchmarks.stepping.measure:clock", peer=PEERS[OURS + precision], points=points, compiler=compiler
        )

    def picture(pixels: int) -> Callable[[str], float]:
        arguments = {"peer": LIT[OURS], "pixels": pixels, "refine": looks.REFINE, "lit": True}
        return lambda compiler: call("benchmarks.drawing.measure:clock", **arguments, compiler=compiler)

    def labels(compiler: str) -> float:
        return call("benchmarks.looks:labels", pixels=PIXELS[0], compiler=compiler)

    return {
        "a run, cold": cold,
        "a run, warm": lambda compiler: whole_run(compiler, str(Path(folder) / compiler)),
        **{f"a step, {n} × {n}": step(n, "") for n in POINTS},
        **{f"a step, {n} × {n}, f64": step(n, ", f64") for n in POINTS},
        **{f"a picture, {n} × {n}": picture(n) for n in PIXELS},
        f"labels alone, {PIXELS[0]} × {PIXELS[0]}": labels,
    }


def measure(rounds: int, progress: Progress) -> Samples:
    """Time every work with each compiler in turn; nothing if only one is installed."""
    if not all(find_spec(name) for name in COMPILERS):
        return {}
    with tempfile.TemporaryDirectory() as folder:
        timed = works(folder)
        samples: Samples = {work: {name: [] for name in COMPILERS} for work in timed}
        # The first round compiles.
        for number in range(1 + rounds):
            for work, seconds in timed.items():
                for name in COMPILERS:
                    progress(f"{work}, {name}: round {number} of {rounds}")
                    samples[work][name].append(seconds(name))
    return {work: {name: times[1:] for name, times in by_name.items()} for work, by_name in samples.items()}
