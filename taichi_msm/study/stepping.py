"""Work and precision of stepping: every precision and damping difference, from the largest stable step downwards."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.divergence import farthest_displacement
from taichi_msm.physics.error_control import longest
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import make_plan
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.timestep import stable_steps, with_time
from taichi_msm.progress import Count
from taichi_msm.study.result import Reference, Stepping, Timing
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


@dataclass
class _Trial:
    """One setting, and what is known about it so far."""

    precision: Precision
    difference: str
    steps: int
    error: float = math.inf
    rounding: float | None = None
    samples: list[float] = field(default_factory=list)


class SteppingStudy:
    """Measures the stepping of one scene.

    Args:
        scene: a checked scene.
        device: what `runtime.start` returned.
        longest_run: approximate time that a run may take [s].
        progress: called with the runs done and the runs in all; may raise KeyboardInterrupt: what is done is kept.

    Attributes:
        frames: displacements of the reference at every frame but the first [m], shape (F, rows, cols, 3).
        reference: the facts about it.
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
        self._trials: list[_Trial] = []
        self._done = 0
        self._to_do = 1
        with ExitStack() as opened:
            self._dynamics: dict[Precision, Dynamics] = {}
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
        self._to_do = self._done + (ROUNDS - 1) * len(self._trials)
        for _ in range(ROUNDS - 1):
            for trial in self._trials:
                self._run(trial.precision, trial.difference, trial.steps, trial.samples)

    def points(self) -> list[Stepping]:
        """Give the results so far, ordered by method and by falling step."""
        ordered = sorted(self._trials, key=lambda one: (one.precision, one.difference != "central", one.steps))
        return [self._point(trial) for trial in ordered if trial.samples]

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
        going = set(PRECISIONS)
        for steps in counts:
            exact: Frames | None = None
            for precision in PRECISIONS:
                if precision not in going:
                    continue
                trial = _Trial(precision, difference, steps)
                frames = self._run(precision, difference, steps, trial.samples)
                trial.error = self.relative(frames)
                if longest(frames) > farthest_displacement(self.plan, self.plan.scene.time.duration):
                    trial.error = math.inf
                self._trials.append(trial)
                if precision == "f64":
                    exact = frames
                elif exact is not None and self.reference.largest > 0:
                    trial.rounding = longest(frames - exact) / self.reference.largest
                dominated = trial.rounding is not None and trial.rounding > trial.error / 2
                if trial.error < math.inf and (dominated or not self.known(trial.error)):
                    going.discard(precision)

    def _run(self, precision: Precision, difference: str, steps: int, samples: list[float]) -> Frames:
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

    def _point(self, trial: _Trial) -> Stepping:
        finite = trial.error < math.inf
        return Stepping(
            precision=trial.precision,
            damping_difference=trial.difference,
            steps_per_frame=trial.steps,
            step=replace(self._grid, steps_per_frame=trial.steps).step,
            error=trial.error if finite else None,
            rounding=trial.rounding if finite else None,
            known=finite and self.known(trial.error),
            seconds=Timing.of(trial.samples),
        )


def observed_orders(points: list[Stepping]) -> dict[str, float | None]:
    """Fit the order of every method over the points where the error comes from the step, not from rounding."""
    orders: dict[str, float | None] = {}
    for method in dict.fromkeys(point.method for point in points):
        fit = [
            (math.log(point.step), math.log(point.error))
            for point in points
            if point.method == method and point.error and point.known and (point.rounding or 0) < point.error / 10
        ]
        steps, errors = np.array(fit).reshape(-1, 2).T
        orders[method] = float(np.polyfit(steps, errors, 1)[0]) if len(fit) > 2 else None
    return orders
