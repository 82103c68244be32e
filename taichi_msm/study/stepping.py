"""Work and precision of stepping: every precision and damping difference, from the largest stable step downwards."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.divergence import farthest_displacement
from taichi_msm.physics.error_control import longest
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import make_plan, stable_steps, with_time
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count
from taichi_msm.study.result import Reference, Stepping
from taichi_msm.system.runtime import Device
from taichi_msm.timegrid import Precision

PRECISIONS: tuple[Precision, ...] = ("f64", "f32")
DIFFERENCES = ("central", "backward")

# How many times every setting is timed; all settings take turns.
ROUNDS = 5

# An error counts as known if it is at least this many times that of the reference.
MARGIN = 20

# How many times the largest stable step is halved at least, whatever it costs.
LEAST_HALVINGS = 2

Frames = NDArray[Any]


class SteppingStudy:
    """Measures the stepping of one scene.

    Args:
        plan: of the scene.
        device: what `runtime.start` returned.
        longest_run: approximate time that a run may take [s].
        progress: called with the runs done and the runs in all; may raise KeyboardInterrupt: what is done is kept.

    Attributes:
        frames: displacements of the reference at every frame but the first [m], shape (F, rows, cols, 3).
        reference: the facts about it.
        results: a setting each, as far as they are measured.
    """

    def __init__(self, plan: Plan, device: Device, longest_run: float, progress: Count) -> None:
        self.plan = plan
        self._grid = plan.grid
        self._plans = {
            difference: make_plan(with_time(plan.scene, damping_difference=difference, step="auto"), plan.image)
            for difference in DIFFERENCES
        }
        self.frames: Frames | None = None
        self.reference: Reference | None = None
        self._longest_run = longest_run
        self._progress = progress
        self.results: list[Stepping] = []
        self._done = 0
        self._to_do = 1
        with ExitStack() as opened:
            self._dynamics: dict[str, Dynamics] = {}
            for precision in PRECISIONS:
                dynamics = self._dynamics[precision] = Dynamics(plan.with_grid(precision=precision), device)
                opened.callback(dynamics.close)
            self._open = opened.pop_all()

    def run(self) -> None:
        """Compute the reference, then the errors, then measure the times."""
        for dynamics in self._dynamics.values():
            self._progress(0, self._to_do)
            dynamics.compile()
        series = {difference: list(self._series(difference)) for difference in DIFFERENCES}
        finest = max(steps for counts in series.values() for steps in counts)
        self._to_do = 3 + ROUNDS * len(PRECISIONS) * sum(len(counts) for counts in series.values())
        self._make_reference(finest)
        for difference, counts in series.items():
            self._measure_errors(difference, counts)
        self._to_do = self._done + (ROUNDS - 1) * len(self.results)
        for _ in range(ROUNDS - 1):
            for one in self.results:
                self._run(one.precision, one.damping_difference, one.steps_per_frame, one.samples)

    def relative(self, frames: Frames) -> float:
        """Give the largest error of frames relative to the reference, as a fraction of the largest displacement."""
        assert self.frames is not None
        assert self.reference is not None
        return longest(frames - self.frames) / self.reference.largest if self.reference.largest > 0 else 0.0

    def known(self, error: float) -> bool:
        """Tell whether the reference is exact enough to know an error."""
        assert self.reference is not None
        return error >= MARGIN * self.reference.error

    def close(self) -> None:
        """Free the memory."""
        self._open.close()

    def _series(self, difference: str) -> Iterator[int]:
        """Give the steps per frame of a series: of the largest stable step, doubled until a run would take too long."""
        steps = stable_steps(self._plans[difference])
        samples: list[float] = []
        self._run("f64", difference, steps, samples)
        yield steps
        for halving in range(1, 64):
            if halving > LEAST_HALVINGS and samples[0] * 2**halving > self._longest_run:
                return
            yield steps * 2**halving

    def _make_reference(self, finest: int) -> None:
        """Extrapolate central differences from steps well below the finest that is measured.

        u* = u_{h/2} + (u_{h/2} - u_h) / 3. Its error is at most about its distance from the same with 2 h for h.
        """
        coarse, middle, fine = (self._run("f64", "central", finest * 2**halving, []) for halving in range(3))
        before = middle + (middle - coarse) / 3
        self.frames = fine + (fine - middle) / 3
        largest = longest(self.frames)
        error = longest(self.frames - before) / largest if largest > 0 else 0.0
        self.reference = Reference(4 * finest, error, largest)

    def _measure_errors(self, difference: str, counts: list[int]) -> None:
        """Run every step once: in f32 until rounding dominates, in f64 until the reference is not exact enough."""
        assert self.reference is not None
        going, farthest = set(PRECISIONS), farthest_displacement(self.plan, self.plan.scene.time.duration)
        for steps in counts:
            exact: Frames | None = None
            for precision in PRECISIONS:
                if precision not in going:
                    continue
                step = replace(self._grid, steps_per_frame=steps).step
                samples: list[float] = []
                frames = self._run(precision, difference, steps, samples)
                error, rounding = self.relative(frames), None
                diverged = not error < math.inf or longest(frames) > farthest
                if precision == "f64":
                    exact = frames
                elif exact is not None and self.reference.largest > 0:
                    rounding = longest(frames - exact) / self.reference.largest
                one = Stepping(precision, difference, steps, step, samples=samples)
                self.results.append(one)
                if not diverged:
                    one.error, one.rounding, one.known = error, rounding, self.known(error)
                    if not one.known or (rounding is not None and rounding > error / 2):
                        going.discard(precision)

    def _run(self, precision: str, difference: str, steps: int, samples: list[float]) -> Frames:
        """Step through the scene, and append the time of stepping alone [s] to the samples."""
        dynamics = self._dynamics[precision]
        plan = self._plans[difference].with_grid(precision=precision, steps_per_frame=steps)
        dynamics.restart(plan)
        frames = np.empty((plan.grid.frames, *plan.scene.sheet.points, 3), precision.replace("f", "float"))
        seconds = 0.0
        for frame in frames:
            self._progress(self._done, self._to_do)
            start = time.perf_counter()
            dynamics.advance(steps)
            seconds += time.perf_counter() - start
            frame[:] = dynamics.displacement()
        samples.append(seconds)
        self._done += 1
        return frames
