"""Work and precision of stepping: every precision and damping difference, from the largest stable step downwards."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.divergence import farthest_displacement
from taichi_msm.physics.error_control import longest
from taichi_msm.physics.paths import fewest_steps
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import stable_steps, variant, with_time
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count
from taichi_msm.study.result import Reference, Stepping, Study
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
    """Measures the stepping of a checked scene, in runs of up to about `longest_run` seconds.

    `progress` may raise KeyboardInterrupt: the results in `study` stay.

    Attributes:
        frames: displacements of the reference at every frame but the first [m], shape (F, rows, cols, 3).
    """

    def __init__(self, plan: Plan, device: Device, longest_run: float, study: Study, progress: Count) -> None:
        self.plan = plan
        self._plans = {
            difference: variant(plan, with_time(plan.scene, damping_difference=difference, step="auto"))
            for difference in DIFFERENCES
        }
        self.frames: Frames | None = None
        self._longest_run, self.study, self._progress = longest_run, study, progress
        self._done, self._to_do = 0, 1
        self._dynamics: dict[str, Dynamics] = {
            one: Dynamics(plan.with_grid(precision=one), device) for one in PRECISIONS
        }

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
        self._to_do = self._done + (ROUNDS - 1) * len(self.study.stepping)
        for _ in range(ROUNDS - 1):
            for one in self.study.stepping:
                self._run(one.precision, one.damping_difference, one.steps_per_frame, one.samples)

    def relative(self, frames: Frames) -> float:
        """Give the largest error of frames relative to the reference, as a fraction of the largest displacement."""
        assert self.frames is not None
        largest = self._reference.largest
        return longest(frames - self.frames) / largest if largest > 0 else 0.0

    def known(self, error: float) -> bool:
        """Tell whether the reference is exact enough to know an error."""
        return error >= MARGIN * self._reference.error

    def close(self) -> None:
        """Free the memory."""
        for dynamics in self._dynamics.values():
            dynamics.close()

    @property
    def _reference(self) -> Reference:
        assert self.study.reference is not None
        return self.study.reference

    def _series(self, difference: str) -> Iterator[int]:
        """Give the steps per frame of a series: of the largest valid step, doubled until a run would take too long."""
        steps = fewest_steps(self.plan.tools, self.plan.grid, stable_steps(self._plans[difference]))
        samples: list[float] = []
        self._run("f64", difference, steps, samples)
        yield steps
        for halving in range(1, 64):
            if halving > LEAST_HALVINGS and samples[0] * 2**halving > self._longest_run:
                return
            yield steps * 2**halving

    def _make_reference(self, finest: int) -> None:
        """Extrapolate central differences from steps well below the finest that is measured.

        u* = u_{h/2} + (u_{h/2} - u_h) / 3. Its error is at most about its distance from the same with 2 h for h. With
        contact, which is of order 1 about, nothing is extrapolated.
        """
        coarse, middle, fine = (self._run("f64", "central", finest * 2**halving, []) for halving in range(3))
        before, self.frames = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
        if self.plan.tools:
            before, self.frames = middle, fine
        largest = longest(self.frames)
        error = longest(self.frames - before) / largest if largest > 0 else 0.0
        self.study.reference = Reference(4 * finest, error, largest)

    def _measure_errors(self, difference: str, counts: list[int]) -> None:
        """Run every step once: in f32 until rounding dominates, in f64 until the reference is not exact enough."""
        going, farthest = set(PRECISIONS), farthest_displacement(self.plan, self.plan.scene.time.duration)
        for steps in counts:
            exact: Frames | None = None
            for precision in (one for one in PRECISIONS if one in going):
                point = Stepping(precision, difference, steps, replace(self.plan.grid, steps_per_frame=steps).step)
                frames = self._run(precision, difference, steps, point.samples)
                error, rounding = self.relative(frames), None
                if precision == "f64":
                    exact = frames
                elif exact is not None and self._reference.largest > 0:
                    rounding = longest(frames - exact) / self._reference.largest
                self.study.stepping.append(point)
                if error < math.inf and longest(frames) <= farthest:
                    point.error, point.rounding, point.known = error, rounding, self.known(error)
                    if not point.known or (rounding is not None and rounding > error / 2):
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
