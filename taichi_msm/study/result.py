"""The results of a study: plain data, and the settings it recommends."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from taichi_msm.scene import MAX_POINTS

# A picture is refined enough if no other one of the same supersampling has a PSNR higher by more than this [dB].
REFINED_ENOUGH = 0.1

# A stepping that takes up to this many times the time of the fastest one is as fast: so much the clock is off.
AS_FAST = 1.1


@dataclass(frozen=True)
class Timing:
    """Times of repeated, equal work.

    Attributes:
        median, fastest, slowest: of the times [s].
        runs: number of repetitions.
    """

    median: float
    fastest: float
    slowest: float
    runs: int

    @classmethod
    def of(cls, samples: Sequence[float]) -> Timing:
        """Summarise samples [s], at least one."""
        return cls(statistics.median(samples), min(samples), max(samples), len(samples))


@dataclass(frozen=True)
class Reference:
    """The solution that errors of the stepping refer to: central differences in f64, extrapolated.

    Attributes:
        steps_per_frame: of its finest run.
        error: its own error, estimated by halving the step, as a fraction of the largest displacement.
        largest: the largest displacement of any point at any frame [m].
    """

    steps_per_frame: int
    error: float
    largest: float


@dataclass(frozen=True)
class Stepping:
    """One way to step the scene.

    Attributes:
        precision: f32 or f64.
        damping_difference: central or backward.
        steps_per_frame: number of steps in a frame.
        step: the step h that follows from it [s].
        error: largest error of any point at any frame, as a fraction of the largest displacement; None: it diverged.
        rounding: the part of the error that comes from f32; None for f64.
        known: whether the reference is exact enough to know this error; if not, it is an approximate upper bound.
        seconds: time of stepping through the whole scene, compiled and warm.
    """

    precision: str
    damping_difference: str
    steps_per_frame: int
    step: float
    error: float | None
    rounding: float | None
    known: bool
    seconds: Timing

    @property
    def method(self) -> str:
        """Name the method, such as f32 central."""
        return f"{self.precision} {self.damping_difference}"


@dataclass(frozen=True)
class Peer:
    """SciPy's DOP853 on the same equations.

    Attributes:
        rtol: relative tolerance; the absolute one is rtol x the largest displacement / 10.
        error: as for `Stepping`.
        known: as for `Stepping`.
        evaluations: number of evaluations of the forces.
        seconds: time of the whole scene.
    """

    rtol: float
    error: float
    known: bool
    evaluations: int
    seconds: Timing


@dataclass(frozen=True)
class Drawn:
    """One way to draw the most deformed frame.

    Attributes:
        refine, supersample: the settings.
        psnr: against a picture of high refinement and supersampling [dB]; None: they are equal.
        largest_error: of any colour of any pixel, 0 to 255.
        seconds: time of one frame.
    """

    refine: int
    supersample: int
    psnr: float | None
    largest_error: int
    seconds: Timing


@dataclass(frozen=True)
class Points:
    """A sheet of tissue with more or fewer points, in f64.

    Attributes:
        rows, cols: numbers of points.
        steps_per_frame: of the automatic step with these points.
        error: that the number of points makes: the largest of any point at any frame, as a fraction of the largest
            displacement; None: it diverged.
        known: as for `Stepping`.
        estimate: of this error, by the pilot that `run` has beside it; None: not known.
        seconds: time of stepping through the whole scene, compiled and warm.
    """

    rows: int
    cols: int
    steps_per_frame: int
    error: float | None
    known: bool
    estimate: float | None
    seconds: Timing

    @property
    def name(self) -> str:
        """Give its name, such as 31 x 31."""
        return f"{self.rows} x {self.cols}"


@dataclass(frozen=True)
class Term:
    """The cost of a step without one term of the model.

    Attributes:
        without: key of the term that is left out; empty: none is.
        seconds: time of one step.
    """

    without: str
    seconds: Timing


@dataclass
class Study:
    """Speed against error of one scene on one machine.

    Attributes:
        scene: its name.
        settings: the scene with its defaults filled in.
        status: complete or interrupted.
        tolerance: largest allowed error, as a fraction of the largest displacement.
        machine: cpu, cores, arch, threads, bits of a vector and versions.
        reference: None if the study was interrupted before there was one.
        stepping: ordered by method and, within a method, by falling step.
        orders: of every method, by regression over the points where the step makes the error; None: too few of them.
        peers: DOP853 at several tolerances.
        drawing: ordered by supersample and refine; empty if the scene has no picture.
        points: with tissue, from few to many; empty if the scene has springs.
        terms: the first leaves nothing out.
        notes: what a reader must know, such as parts left out and why.
    """

    scene: str
    settings: dict[str, Any]
    status: str
    tolerance: float
    machine: dict[str, Any]
    reference: Reference | None = None
    stepping: list[Stepping] = field(default_factory=list)
    orders: dict[str, float | None] = field(default_factory=dict)
    peers: list[Peer] = field(default_factory=list)
    drawing: list[Drawn] = field(default_factory=list)
    points: list[Points] = field(default_factory=list)
    terms: list[Term] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def points_tolerance(self) -> float:
        """Largest allowed error due to the number of points, as a fraction of the largest displacement."""
        return float(self.settings["sheet"]["tolerance"] or self.tolerance)

    @property
    def own_points(self) -> Points | None:
        """Find the sheet with the scene's own points; None: it was not measured, or diverged."""
        own = list(self.settings["sheet"]["points"])
        return next((one for one in self.points if [one.rows, one.cols] == own and one.error is not None), None)

    @property
    def more_points(self) -> tuple[int, int] | None:
        """Tell how many points have an error within the tolerance, where the scene's own have not; None elsewhere.

        These are the fewest that were measured, or else an extrapolation: the error falls with the power of the cells'
        size that the two finest sheets show, at least the first and at most the second. They may be more than allowed.
        """
        own, allowed = self.own_points, self.points_tolerance
        if own is None or own.error is None or own.error <= allowed:
            return None
        errors = [(one.rows, one.cols, one.error) for one in self.points if one.error is not None]
        for rows, cols, error in errors:
            if error <= allowed:
                return rows, cols
        order = 1.0
        rows, cols, error = errors[-1]
        if len(errors) > 1:
            coarser_rows, _, coarser_error = errors[-2]
            shown = math.log(coarser_error / error) / math.log((rows - 1) / (coarser_rows - 1))
            order = min(2.0, max(1.0, shown))
        times = (error / allowed) ** (1 / order)
        return math.ceil((rows - 1) * times) + 1, math.ceil((cols - 1) * times) + 1

    @property
    def best_stepping(self) -> Stepping | None:
        """Find the fastest stepping within the tolerance, or one that is as fast and less wrong; None if there is none.

        None, too, where the scene needs other points, for which no step was measured. Of every method only
        its largest step counts, so that noise of the clock cannot prefer a smaller one.
        """
        if self.more_points is not None:
            return None
        good = [one for one in self.stepping if one.error is not None and one.error <= self.tolerance]
        largest = {one.method: one for one in sorted(good, key=lambda one: one.step)}
        fastest = min((one.seconds.median for one in largest.values()), default=0.0)
        alike = [one for one in largest.values() if one.seconds.median <= AS_FAST * fastest]
        return min(alike, key=lambda one: one.error or 0.0, default=None)

    @property
    def best_drawing(self) -> Drawn | None:
        """Find the fastest sufficient refinement at the scene's own supersampling."""
        own = self.settings["render"]["supersample"]
        same = [one for one in self.drawing if one.supersample == own]
        best = max((_decibels(one) for one in same), default=0.0)
        good = [one for one in same if _decibels(one) >= best - REFINED_ENOUGH]
        return min(good, key=lambda one: one.seconds.median, default=None)

    def recommendation(self) -> list[str]:
        """Write the recommended settings as lines of a scene file."""
        lines = []
        if (points := self.more_points) is not None and max(points) <= MAX_POINTS:
            # A run finds the step for these points.
            lines += [
                "sheet:",
                f"  points: {list(points)}",
                "time:",
                "  step: auto",
                f"  tolerance: {self.tolerance:g}",
            ]
        if (step := self.best_stepping) is not None:
            lines.append("time:")
            if self.settings["time"]["tolerance"] is not None:
                lines.append("  tolerance: null")
            lines += [
                # With all digits: rounded up, the largest stable step would exceed the limit.
                f"  step: {step.step!r}",
                f"  damping_difference: {step.damping_difference}",
                f"  precision: {step.precision}",
            ]
        if (drawn := self.best_drawing) is not None:
            lines += ["render:", f"  refine: {drawn.refine}", f"  supersample: {drawn.supersample}"]
        return lines


def _decibels(drawn: Drawn) -> float:
    return float("inf") if drawn.psnr is None else drawn.psnr
