"""Error of the time step, estimated by a companion run, and the largest step within a tolerance.

The error of a displacement u_h is its distance from Richardson's extrapolation of runs with steps h and h / r in f64:

    u* = u_{h/r} + (u_{h/r} - u_h) / (r^p - 1)        p: order of the method, r: 2 or more (fine), or about 1/2 (coarse)

It includes the rounding of the run's precision. An error is the largest of any mass point at any frame, relative to the
largest displacement of any mass point at any frame.

Mass points come into contact with position-controlled tools from one step to the next, so the order is about 1, and the
error falls irregularly with the step. The estimate is then a bound that is rarely exceeded, reported as "at most about"
(docs/decisions/0027).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.companions import fine_steps
from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.errors import Pause, ProgressCallback, SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import overlap
from taichi_msm.scene.section import MAX_TOLERANCE
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.system.runtime import Device

# The search ends at an error between this fraction of the tolerance and the tolerance; the step is then at least about
# 90 % of the largest possible one.
MIN_TOLERANCE_FRACTION = 0.75

# Safety factor of an error estimated by a coarse companion run, because kinks of a load have other positions in its
# steps (docs/decisions/0021).
COARSE_MARGIN = 1.25

# With contact, an error estimated by a fine companion run has the additional safety factor CONTACT_MARGIN. The estimate
# of the coarse companion run changes it by at most the factor 1 +- COARSE_INFLUENCE (docs/decisions/0027).
CONTACT_MARGIN, COARSE_INFLUENCE = 1.5, 1 / 3

# Largest refinement of the step from one trial run of a search to the next.
MAX_STEP_REFINEMENT = 8.0


@dataclass(frozen=True)
class TimeStepEstimate:
    """Estimated error of the time step and of rounding, as fractions of the largest displacement."""

    steps_per_frame: int  # steps per frame of the run
    # Largest error; infinite if unknown because a companion run diverged or the step does not resolve the damping.
    error: float
    rounding: float  # part of the error that comes from f32, including positions in the trajectory; 0 in f64
    in_f64: float  # error of the same step in f64
    order: int  # of the method in this scene
    # Whether `rounding` and `in_f64` are separate; else, after a coarse companion of a run in f32, both equal `error`.
    separate: bool = True
    # Whether the error may be larger, because a fine companion run is missing; with contact, because tools overlap, the
    # error does not decrease with the step, or it is above the largest tolerance.
    at_least: bool = False
    at_most: bool = False  # whether the error may be much smaller, because of contact


def choose_step(
    plan: Plan, device: Device, progress: ProgressCallback = lambda done, total: None
) -> tuple[Plan, TimeStepEstimate]:
    """Return a plan with the largest stable step whose error is within the scene's tolerance, and the estimated error.

    The search begins with the steps per frame of the plan. Raise a SceneError, with a precision or a tolerance as
    remedy, when no step meets the tolerance.
    """
    tolerance, steps, trials = plan.scene.time.tolerance, plan.grid.steps_per_frame, TimeStepTrials(plan, device)
    assert tolerance is not None
    too_few, best, failures = steps - 1, None, []
    for _ in range(12):
        trial = trials.estimate(steps, progress)
        if trial.error <= tolerance:
            best = trial
        else:
            too_few = steps
            failures.append(trial)
            if trial.rounding > MIN_TOLERANCE_FRACTION * tolerance or _stagnates(failures):
                break
        if best and (best.error >= MIN_TOLERANCE_FRACTION * tolerance or best.steps_per_frame - too_few <= 1):
            break
        steps = max(_next_steps(trial, tolerance), too_few + 1)
        if best and steps >= best.steps_per_frame:
            break
    if not best:
        raise SceneError([_out_of_reach(tolerance, failures)])
    return plan.with_grid(steps_per_frame=best.steps_per_frame), best


class TimeStepCompanion:
    """Companion run in f64 with another time step, compared with a run frame by frame.

    For a run in f32, a fine companion includes a second run in f64 with the run's own steps, which separates the
    rounding. A coarse companion has none. The difference of the two runs then contains the rounding, plus r^-p - 1
    times the error of the step. It is the estimate, scaled up if r^-p - 1 is smaller than `COARSE_MARGIN`.

    With 0 steps per frame the error cannot be estimated. The kernels of a run with the same number of cores are reused.
    A device without f64 raises a DeviceError.
    """

    def __init__(self, plan: Plan, steps: int, device: Device, cores: int | None = None) -> None:
        self._order, in_f64 = plan.convergence_order, plan.with_grid(precision="f64")
        coarse = 0 < steps < plan.grid.steps_per_frame
        self._separate = plan.grid.precision == "f64" or not coarse
        self._dynamics = Dynamics(in_f64, device, cores=cores)
        # A run in f64 serves as the second run.
        needs_same_step = plan.grid.precision != "f64" and not coarse
        self._same_step = Dynamics(in_f64, device, cores=cores) if needs_same_step else None
        if coarse:
            factor = (plan.grid.steps_per_frame / steps) ** self._order - 1
            self._margin = COARSE_MARGIN if self._separate else max(1.0, COARSE_MARGIN / factor)
        else:
            self._margin = COARSE_MARGIN * CONTACT_MARGIN if plan.has_contact else 1.0
        self._overlap = overlap(plan.tools, plan.scene.time.duration) is not None
        self.restart(plan, steps)

    def restart(self, plan: Plan, steps: int) -> None:
        """Restart for another run of the same scene; a fine companion run must stay fine."""
        self._plan, self._steps = plan, steps
        in_f64 = plan.with_grid(precision="f64")
        if steps:
            self._dynamics.restart(in_f64.with_grid(steps_per_frame=steps))
            if self._same_step:
                self._same_step.restart(in_f64)
        self._error = self._rounding = self._in_f64 = self._largest = 0.0

    def compile(self) -> None:
        """Compile the kernels before the first frame."""
        self._dynamics.compile()

    def compare_frame(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Step to the next frame and compare it with the displacements of the run [m], shape (rows, cols, 3).

        After an exception from `pause`, the companion run cannot continue.
        """
        if not self._steps:
            return
        self._dynamics.advance(self._steps, pause)
        if self._same_step:
            self._same_step.advance(self._plan.grid.steps_per_frame, pause)
        companion = self.displacement = self._dynamics.displacement()
        same_step = self._same_step.displacement() if self._same_step else displacement
        with np.errstate(all="ignore"):
            ratio = self._steps / self._plan.grid.steps_per_frame
            extrapolated = (
                companion + (companion - same_step) / (ratio**self._order - 1) if self._separate else companion
            )
            self._error = max(self._error, max_norm(displacement - extrapolated))
            # With contact the extrapolated displacement may be far too large.
            best = extrapolated if not self._plan.has_contact else companion if ratio > 1 else displacement
            self._largest = max(self._largest, max_norm(best))
            if self._same_step:
                self._in_f64 = max(self._in_f64, max_norm(same_step - extrapolated))
                self._rounding = max(self._rounding, max_norm(displacement - same_step))

    def force_error(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Estimate the error of the mean tool forces since the previous frame [N], shape (tools, 3), with order 1."""
        ratio = self._steps / self._plan.grid.steps_per_frame
        return np.asarray(self._margin * abs(ratio / (ratio - 1)) * np.abs(forces - self._dynamics.tool_forces()))

    @property
    def estimate(self) -> TimeStepEstimate:
        """Estimate from the frames so far."""
        if not self._steps:
            return TimeStepEstimate(self._plan.grid.steps_per_frame, math.inf, 0.0, math.inf, self._order)
        bound = displacement_bound(self._plan, self._plan.scene.time.duration)

        def relative(distance: float) -> float:
            # A sheet at rest has no error; a non-finite error is unknown.
            fraction = self._margin * distance / self._largest if self._largest > 0 else 0.0
            return fraction if fraction < math.inf and self._largest <= bound else math.inf

        error, rounding, in_f64 = (relative(each) for each in (self._error, self._rounding, self._in_f64))
        if not self._same_step:
            rounding, in_f64 = 0.0 if self._separate else error, error
        steps, contact = self._plan.grid.steps_per_frame, self._plan.has_contact
        at_least = contact and (self._overlap or error > MAX_TOLERANCE)
        return TimeStepEstimate(steps, error, rounding, in_f64, self._order, self._separate, at_least, contact)


def combine_estimates(coarse: TimeStepEstimate, fine: TimeStepEstimate) -> TimeStepEstimate:
    """Return the fine estimate; with contact, scaled toward the coarse one by at most 1 +- `COARSE_INFLUENCE`."""
    if not fine.at_most or fine.error in (0, math.inf):
        return fine
    factor = min(max(coarse.error / fine.error, 1 - COARSE_INFLUENCE), 1 + COARSE_INFLUENCE)
    # Without margins and extrapolation, the fine companion run differs more from the run than the coarse one does.
    grows = fine.error > 2 * CONTACT_MARGIN * coarse.error
    return replace(fine, error=factor * fine.error, in_f64=factor * fine.in_f64, at_least=fine.at_least or grows)


class TimeStepTrials:
    """Trial runs of a scene with different steps, each with a companion run."""

    def __init__(self, plan: Plan, device: Device) -> None:
        self._plan = plan
        self._companion = TimeStepCompanion(plan, fine_steps(plan), device)
        self._dynamics = Dynamics(plan, device)

    def estimate(self, steps: int, progress: ProgressCallback = lambda done, total: None) -> TimeStepEstimate:
        """Return the error with a number of steps per frame, estimated by a run."""
        plan = self._plan.with_grid(steps_per_frame=steps)
        fine, frames = fine_steps(plan), plan.grid.frames
        self._companion.restart(plan, fine)
        self._dynamics.restart(plan)
        for frame in range(frames if fine else 0):
            pause = partial(progress, frame, frames)
            pause()
            self._dynamics.advance(steps, pause)
            self._companion.compare_frame(self._as_stored(self._dynamics.displacement()), pause)
        return self._companion.estimate

    def _as_stored(self, displacement: NDArray[Any]) -> NDArray[Any]:
        """Round displacements like the positions of a trajectory in f32, which lose digits to the size of the sheet."""
        if "trajectory" not in self._plan.scene.output or self._plan.grid.precision == "f64":
            return displacement
        rest = rest_positions(self._plan.scene.sheet)
        return (rest + displacement).astype(np.float32) - rest


def max_norm(vectors: NDArray[Any]) -> float:
    """Return the largest Euclidean norm of vectors of shape (..., 3), infinite if any is not finite."""
    with np.errstate(all="ignore"):
        length = math.sqrt(np.einsum("...k,...k->...", vectors, vectors, dtype=np.float64).max())
    return length if length < math.inf else math.inf


def _rounded_up(error: float) -> float:
    """Round up to one digit, with a margin of 20 %."""
    digit = 10.0 ** math.floor(math.log10(error))
    return float(f"{math.ceil(1.2 * error / digit) * digit:.3g}")


def _next_steps(trial: TimeStepEstimate, tolerance: float) -> int:
    """Extrapolate the number of steps per frame that meets the tolerance, by the order of the method."""
    if trial.error == math.inf:
        refinement = MAX_STEP_REFINEMENT
    else:
        # Allowed and estimated error of the step, both without the rounding.
        allowed = max((1 + MIN_TOLERANCE_FRACTION) / 2 * tolerance - trial.rounding, tolerance / 16)
        error = max(trial.error - trial.rounding, 0.0)
        refinement = min((error / allowed) ** (1 / trial.order), MAX_STEP_REFINEMENT)
    return max(1, math.ceil(trial.steps_per_frame * refinement))


def _stagnates(failures: list[TimeStepEstimate]) -> bool:
    """Return whether three refinements in succession have hardly reduced the error."""
    if len(failures) < 4:
        return False
    return all(
        after.error >= before.error / math.sqrt(after.steps_per_frame / before.steps_per_frame)
        for before, after in pairwise(failures[-4:])
    )


def _out_of_reach(tolerance: float, failures: list[TimeStepEstimate]) -> str:
    best = min(failures, key=lambda failure: failure.error)
    last = failures[-1]
    if best.error == math.inf:
        return (
            f"time.tolerance: {tolerance:g} is out of reach: with {last.steps_per_frame} steps a frame the error is "
            "not known, as runs diverge or steps do not resolve the damping; take a weaker load or less damping"
        )
    if last.rounding > MIN_TOLERANCE_FRACTION * tolerance:
        return (
            f"time.tolerance: {tolerance:g} is out of reach of f32, whose rounding alone causes an error of "
            f"{last.rounding:.2g} here; take time.precision: f64, or a tolerance of {_rounded_up(4 * last.rounding):g}"
        )
    weaker = "move the tools less deep, or take" if last.at_most else "take a weaker load or"
    remedy = f"{weaker} a shorter time"
    if best.error < MAX_TOLERANCE / 2:
        remedy += f", or a tolerance of {_rounded_up(best.error):g}"
    return (
        f"time.tolerance: {tolerance:g} is out of reach: with {last.steps_per_frame} steps a frame the error is still "
        f"{last.error:.2g}, and finer steps hardly reduce it; {remedy}"
    )
