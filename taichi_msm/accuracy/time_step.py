"""The error of a run, estimated by a pilot beside it, and the largest step within a tolerance.

The error of a displacement u_h is its distance from Richardson's extrapolation of runs with steps h and h / r in f64:

    u* = u_{h/r} + (u_{h/r} - u_h) / (r^p - 1)        p: order of the method, r: 2 or more (fine), or about 1/2 (coarse)

So it includes the rounding of the run's own precision. Errors are the largest of any point at any frame, relative to
the largest displacement of any point at any frame.

Where tools are moved, a point touches from one step to the next, so that the order is about 1 and errors fall in leaps.
What is told is then what is hardly exceeded: "at most about" (docs/decisions/0027).
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
from taichi_msm.accuracy.divergence import farthest_displacement
from taichi_msm.errors import Pause, ProgressCallback, SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import overlap
from taichi_msm.scene.section import MAX_TOLERANCE
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.system.runtime import Device

# The search ends when the error is at least this share of the tolerance: the step is then within about 10 % of the
# largest possible one.
CLOSE = 0.75

# The error of the step that a coarse pilot tells is so many times what its difference from the run shows: the kinks of
# a load meet its steps otherwise than those of the run (docs/decisions/0021).
MARGIN = 1.25

# With contact, a fine pilot alone tells so many times the error that it shows by order 1, and with a coarse one up to
# this share more or less (docs/decisions/0027).
ALONE, SHARE = 1.5, 1 / 3

# The largest number of pilot runs in a search, and the largest factor by which steps get finer from one to the next.
MOST_PILOTS = 12
LARGEST_CUT = 8.0


@dataclass(frozen=True)
class Estimate:
    """What is known about the error of a step."""

    steps_per_frame: int  # of the step
    # The largest error, as a fraction of the largest displacement; infinite if it is not known because a pilot diverged
    # or the step does not resolve the damping.
    error: float
    rounding: float  # the part of the error that comes from f32, also of positions in the trajectory; 0 in f64
    in_f64: float  # the error of the same step in f64
    order: int  # of the method in this scene
    # Whether the two parts are known; else, by a coarse pilot beside a run in f32, neither is larger than the error.
    parted: bool = True
    # Whether the error may be larger: a coarse pilot shows one that only a fine one would tell, or with contact smaller
    # steps do not come closer to each other, or the error is so large that nothing is known.
    at_least: bool = False
    at_most: bool = False  # whether the error may be much smaller, because of contact


def order(plan: Plan) -> int:
    """Give the order of the method: 1 with a damping by backward differences or with contact, else 2."""
    backward = plan.scene.time.damping_difference == "backward" and plan.material.drag > 0
    return 1 if backward or plan.tools else 2


def estimate_error(plan: Plan, device: Device, progress: ProgressCallback = lambda done, total: None) -> Estimate:
    """Estimate the error of a run; progress counts frames."""
    return Trials(plan, device).estimate(plan.grid.steps_per_frame, progress)


def choose_step(
    plan: Plan, device: Device, progress: ProgressCallback = lambda done, total: None
) -> tuple[Plan, Estimate]:
    """Find the largest stable step whose estimated error is within the scene's tolerance, and this error.

    No fewer steps than the plan's are tried; progress counts the frames of each pilot run.

    Raises:
        SceneError: when no step meets the tolerance; names a precision or a tolerance that would do.
    """
    tolerance, steps, trials = plan.scene.time.tolerance, plan.grid.steps_per_frame, Trials(plan, device)
    assert tolerance is not None
    too_few, enough, failures = steps - 1, None, []
    for _ in range(MOST_PILOTS):
        tried = trials.estimate(steps, progress)
        if tried.error <= tolerance:
            enough = tried
        else:
            too_few = steps
            failures.append(tried)
            if tried.rounding > CLOSE * tolerance or _stuck(failures):
                break
        if enough and (enough.error >= CLOSE * tolerance or enough.steps_per_frame - too_few <= 1):
            break
        steps = max(_next(tried, tolerance), too_few + 1)
        if enough and steps >= enough.steps_per_frame:
            break
    if not enough:
        raise SceneError([_out_of_reach(tolerance, failures)])
    return plan.with_grid(steps_per_frame=enough.steps_per_frame), enough


class Pilot:
    """A run in f64 beside another run, with other steps, which gives its error frame by frame.

    Beside a run in f32 a fine pilot has a second one with the run's own steps, which tells the part of rounding. A
    coarse one is alone, to be cheap, and the error told is the difference of the two runs: rounding as it is, and
    r^-p - 1 times the error of the step; where that is less than MARGIN times, the difference is enlarged accordingly.

    Args:
        steps: per frame of the pilot, as in `Pilots`; 0: the error is not known.
        cores: number of cores that stepping may use; None: all. With as many as the run has, its kernels are reused.

    Attributes:
        displacement: of the pilot at the last frame [m], shape (rows, cols, 3).

    Raises:
        DeviceError: when the device cannot run it in f64.
    """

    def __init__(self, plan: Plan, steps: int, device: Device, cores: int | None = None) -> None:
        self._order, exact = order(plan), plan.with_grid(precision="f64")
        coarse = 0 < steps < plan.grid.steps_per_frame
        self._parted = plan.grid.precision == "f64" or not coarse
        self._other = Dynamics(exact, device, cores=cores)
        # A run in f64 is itself the one with its own steps.
        own = plan.grid.precision == "f64" or coarse
        self._same = None if own else Dynamics(exact, device, cores=cores)
        self._margin = MARGIN * ALONE if plan.tools else 1.0
        self._overlap = overlap(plan.tools, plan.scene.time.duration) is not None
        if coarse:
            shown = (plan.grid.steps_per_frame / steps) ** self._order - 1
            self._margin = MARGIN if self._parted else max(1.0, MARGIN / shown)
        self.restart(plan, steps)

    def restart(self, plan: Plan, steps: int) -> None:
        """Begin again beside another run of the same scene, with its steps and the pilot's; fine ones stay fine."""
        self._plan, self._steps = plan, steps
        exact = plan.with_grid(precision="f64")
        if steps:
            self._other.restart(exact.with_grid(steps_per_frame=steps))
            if self._same:
                self._same.restart(exact)
        self._error = self._rounding = self._in_f64 = self._largest = 0.0

    def compile(self) -> None:
        """Compile now what the first frame would compile."""
        self._other.compile()

    def follow(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Step to the next frame, and compare.

        Args:
            displacement: of the run at that frame [m], shape (rows, cols, 3).
            pause: called several times a second; after an exception from it the pilot cannot continue.
        """
        if not self._steps:
            return
        self._other.advance(self._steps, pause)
        if self._same:
            self._same.advance(self._plan.grid.steps_per_frame, pause)
        other = self.displacement = self._other.displacement()
        same = self._same.displacement() if self._same else displacement
        with np.errstate(all="ignore"):
            ratio = self._steps / self._plan.grid.steps_per_frame
            exact = other + (other - same) / (ratio**self._order - 1) if self._parted else other
            self._error = max(self._error, longest(displacement - exact))
            # Where errors fall in leaps, what is extrapolated may be larger by far.
            best = exact if not self._plan.tools else other if ratio > 1 else displacement
            self._largest = max(self._largest, longest(best))
            if self._same:
                self._in_f64 = max(self._in_f64, longest(same - exact))
                self._rounding = max(self._rounding, longest(displacement - same))

    def force_error(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Estimate the error of the mean forces since the frame before [N], shape (tools, 3), by order 1."""
        ratio = self._steps / self._plan.grid.steps_per_frame
        return np.asarray(self._margin * abs(ratio / (ratio - 1)) * np.abs(forces - self._other.tool_forces()))

    @property
    def estimate(self) -> Estimate:
        """What the frames so far show."""
        if not self._steps:
            return Estimate(self._plan.grid.steps_per_frame, math.inf, 0.0, math.inf, self._order)
        farthest = farthest_displacement(self._plan, self._plan.scene.time.duration)

        def share(part: float) -> float:
            # If nothing moves, there is no error; an error that is not finite is not known.
            relative = self._margin * part / self._largest if self._largest > 0 else 0.0
            return relative if relative < math.inf and self._largest <= farthest else math.inf

        error, rounding, in_f64 = (share(part) for part in (self._error, self._rounding, self._in_f64))
        if not self._same:
            rounding, in_f64 = 0.0 if self._parted else error, error
        steps, contact = self._plan.grid.steps_per_frame, bool(self._plan.tools)
        at_least = contact and (self._overlap or error > MAX_TOLERANCE)
        return Estimate(steps, error, rounding, in_f64, self._order, self._parted, at_least, contact)


def reconcile(coarse: Estimate, fine: Estimate) -> Estimate:
    """Give what both pilots of a run tell: the finer one, but with contact the coarse one within its doubt."""
    if not fine.at_most or fine.error in (0, math.inf):
        return fine
    share = min(max(coarse.error / fine.error, 1 - SHARE), 1 + SHARE)
    # But for the factors of both, the difference of the finer one from the run is larger than that of the coarse one.
    grows = fine.error > 2 * ALONE * coarse.error
    return replace(fine, error=share * fine.error, in_f64=share * fine.in_f64, at_least=fine.at_least or grows)


class Trials:
    """Runs of a scene with different steps, one after the other, each with a pilot beside it."""

    def __init__(self, plan: Plan, device: Device) -> None:
        self._plan = plan
        self._pilot = Pilot(plan, fine_steps(plan), device)
        self._own = Dynamics(plan, device)

    def estimate(self, steps: int, progress: ProgressCallback) -> Estimate:
        """Run the scene with so many steps per frame, and estimate its error; progress counts frames."""
        plan = self._plan.with_grid(steps_per_frame=steps)
        fine, frames = fine_steps(plan), plan.grid.frames
        self._pilot.restart(plan, fine)
        self._own.restart(plan)
        for frame in range(frames if fine else 0):
            pause = partial(progress, frame, frames)
            pause()
            self._own.advance(steps, pause)
            self._pilot.follow(self._as_written(self._own.displacement()), pause)
        return self._pilot.estimate

    def _as_written(self, displacement: NDArray[Any]) -> NDArray[Any]:
        """Round as positions in the trajectory are rounded: in f32, relative to the size of the sheet."""
        if "trajectory" not in self._plan.scene.output or self._plan.grid.precision == "f64":
            return displacement
        rest = rest_positions(self._plan.scene.sheet)
        return (rest + displacement).astype(np.float32) - rest


def longest(vectors: NDArray[Any]) -> float:
    """Give the length of the longest vector, shape (..., 3); infinite if one is not finite."""
    with np.errstate(all="ignore"):
        length = math.sqrt(np.einsum("...k,...k->...", vectors, vectors, dtype=np.float64).max())
    return length if length < math.inf else math.inf


def _above(error: float) -> float:
    """Round up to one digit, with a margin of 20 %."""
    digit = 10.0 ** math.floor(math.log10(error))
    return float(f"{math.ceil(1.2 * error / digit) * digit:.3g}")


def _next(tried: Estimate, tolerance: float) -> int:
    """Extrapolate the fewest steps per frame that are enough: the error falls with the order of the method."""
    if tried.error == math.inf:
        cut = LARGEST_CUT
    else:
        # The error that the step may make, apart from rounding, and the error that it makes.
        allowed = max((1 + CLOSE) / 2 * tolerance - tried.rounding, tolerance / 16)
        error = max(tried.error - tried.rounding, 0.0)
        cut = min((error / allowed) ** (1 / tried.order), LARGEST_CUT)
    return max(1, math.ceil(tried.steps_per_frame * cut))


def _stuck(failures: list[Estimate]) -> bool:
    """Tell whether much smaller steps hardly reduced the error, three times in a row."""
    if len(failures) < 4:
        return False
    return all(
        after.error >= before.error / math.sqrt(after.steps_per_frame / before.steps_per_frame)
        for before, after in pairwise(failures[-4:])
    )


def _out_of_reach(tolerance: float, failures: list[Estimate]) -> str:
    best = min(failures, key=lambda one: one.error)
    last = failures[-1]
    if best.error == math.inf:
        return (
            f"time.tolerance: {tolerance:g} is out of reach: with {last.steps_per_frame} steps a frame the error is "
            "not known, as runs diverge or steps do not resolve the damping; take a weaker load or less damping"
        )
    if last.rounding > CLOSE * tolerance:
        return (
            f"time.tolerance: {tolerance:g} is out of reach of f32, whose rounding alone makes an error of "
            f"{last.rounding:.2g} here; take time.precision: f64, or a tolerance of {_above(4 * last.rounding):g}"
        )
    weaker = "move the tools less deep, or take" if last.at_most else "take a weaker load or"
    remedy = f"{weaker} a shorter time"
    if best.error < MAX_TOLERANCE / 2:
        remedy += f", or a tolerance of {_above(best.error):g}"
    return (
        f"time.tolerance: {tolerance:g} is out of reach: with {last.steps_per_frame} steps a frame the error is still "
        f"{last.error:.2g}, and finer steps hardly reduce it; {remedy}"
    )
