"""The results of a study: plain data, and the settings it recommends."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_msm.scene.section import MAX_POINTS

# A picture is refined enough if no other one of the same supersampling has a PSNR higher by more than this [dB].
PSNR_TOLERANCE_DB = 0.1

# Timings within 10 % count as equal.
TIMING_TOLERANCE = 1.1


@dataclass(frozen=True)
class Timing:
    """Times of repeated, equal work [s], and the number of repetitions."""

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
    """The solution that errors of the stepping refer to: central differences in f64, extrapolated."""

    steps_per_frame: int  # of its finest run
    error: float  # its own, estimated by halving the step, as a fraction of the largest displacement
    largest: float  # displacement of any point at any frame [m]


@dataclass
class Measurement:
    """What is known of one setting so far."""

    samples: list[float] = field(default_factory=list, kw_only=True)  # times of repeated, equal work [s]

    @property
    def seconds(self) -> Timing:
        """Summarise the times, of which there is at least one."""
        return Timing.of(self.samples)


@dataclass
class SteppingMeasurement(Measurement):
    """One way to step the scene; timed is stepping through the whole of it, compiled and warm.

    Attributes:
        error: largest of any point at any frame, as a fraction of the largest displacement; None: it diverged.
        rounding: the part of the error that comes from f32; None for f64.
        known: whether the reference is exact enough to know this error; if not, it is an approximate upper bound.
    """

    precision: str
    damping_difference: str
    steps_per_frame: int
    step: float  # h [s]
    error: float | None = None
    rounding: float | None = None
    known: bool = False

    @property
    def method(self) -> str:
        """Name the method, such as f32 central."""
        return f"{self.precision} {self.damping_difference}"


@dataclass
class PeerMeasurement(Measurement):
    """SciPy's DOP853 on the same equations, timed for the whole scene; error and known as for `SteppingMeasurement`."""

    rtol: float  # relative tolerance; the absolute one is rtol x the largest displacement / 10
    error: float
    known: bool
    evaluations: int  # of the forces


@dataclass
class DrawingMeasurement(Measurement):
    """One way to draw the most deformed frame, timed for one frame."""

    refine: int
    supersample: int
    psnr: float | None  # against a picture of high refinement and supersampling [dB]; None: they are equal
    largest_error: int  # of any colour of any pixel, 0 to 255


@dataclass
class MeshMeasurement(Measurement):
    """A sheet of tissue with more or fewer points, in f64, timed like `SteppingMeasurement`; error and known are as there.

    The error is that which the number of points makes, at the points and between them.
    """

    rows: int
    cols: int
    steps_per_frame: int  # of the automatic step with these points
    error: float | None = None
    known: bool = False
    estimate: float | None = None  # of this error, by the pilot that `run` has beside it; None: not known

    @property
    def name(self) -> str:
        """Give its name, such as 31 x 31."""
        return f"{self.rows} x {self.cols}"


@dataclass
class TermMeasurement(Measurement):
    """The cost of a step without one term of the model, timed for one step."""

    without: str  # key of the term that is left out; empty: none is


@dataclass
class Study:
    """Speed against error of one scene on one machine."""

    scene: str  # its name
    settings: dict[str, Any]  # the scene with its defaults filled in
    status: str  # complete or interrupted
    tolerance: float  # largest allowed error, as a fraction of the largest displacement
    machine: dict[str, Any]  # cpu, cores, arch, threads, bits of a vector and versions
    reference: Reference | None = None  # None: interrupted before there was one
    stepping: list[SteppingMeasurement] = field(default_factory=list)  # by method and, within a method, by falling step
    orders: dict[str, float | None] = field(default_factory=dict)  # `observed_orders`
    peers: list[PeerMeasurement] = field(default_factory=list)
    drawing: list[DrawingMeasurement] = field(
        default_factory=list
    )  # by supersample and refine; empty without a picture
    points: list[MeshMeasurement] = field(default_factory=list)  # from few to many; empty with springs
    terms: list[TermMeasurement] = field(default_factory=list)  # the first leaves nothing out
    notes: list[str] = field(default_factory=list)  # what a reader must know, such as parts left out and why

    def finish(self) -> None:
        """Leave out what was not timed, order the steppings and fit their orders."""
        self.stepping = sorted(
            (one for one in self.stepping if one.samples),
            key=lambda one: (one.precision, one.damping_difference != "central", one.steps_per_frame),
        )
        self.orders = observed_orders(self.stepping)
        self.drawing = [one for one in self.drawing if one.samples]
        self.points = [one for one in self.points if one.samples]
        self.terms = [one for one in self.terms if one.samples]

    @property
    def has_contact(self) -> bool:
        """Whether tools that are moved touch the sheet."""
        return any(probe.get("path") for probe in self.settings["probes"])

    @property
    def mesh_tolerance(self) -> float:
        """Largest allowed error due to the number of points, as a fraction of the largest displacement."""
        return float(self.settings["sheet"]["tolerance"] or self.tolerance)

    @property
    def scene_mesh(self) -> MeshMeasurement | None:
        """Find the sheet with the scene's own points; None: it was not measured, or diverged."""
        own = list(self.settings["sheet"]["points"])
        return next((one for one in self.points if [one.rows, one.cols] == own and one.error is not None), None)

    @property
    def recommended_points(self) -> tuple[int, int] | None:
        """Tell how many points have an error within the tolerance, where the scene's own have not; None elsewhere.

        These are the fewest that were measured, or else an extrapolation: the error falls with the power of the cells'
        size that the two finest sheets show, at least the first and at most the second. They may be more than allowed.
        """
        own, allowed = self.scene_mesh, self.mesh_tolerance
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
    def best_stepping(self) -> SteppingMeasurement | None:
        """Find the fastest stepping within the tolerance, or one that is as fast and less wrong.

        None where there is none, or the scene needs other points, for which no step was measured. Of every method only
        its largest step counts, so that noise of the clock cannot prefer a smaller one.
        """
        if self.recommended_points is not None:
            return None
        good = [one for one in self.stepping if one.error is not None and one.error <= self.tolerance]
        largest = {one.method: one for one in sorted(good, key=lambda one: one.step)}
        fastest = min((one.seconds.median for one in largest.values()), default=0.0)
        alike = [one for one in largest.values() if one.seconds.median <= TIMING_TOLERANCE * fastest]
        return min(alike, key=lambda one: one.error or 0.0, default=None)

    @property
    def best_drawing(self) -> DrawingMeasurement | None:
        """Find the fastest sufficient refinement at the scene's own supersampling."""
        own = self.settings["render"]["supersample"]
        decibels = [(math.inf if one.psnr is None else one.psnr, one) for one in self.drawing if one.supersample == own]
        enough = max((psnr for psnr, _ in decibels), default=0.0) - PSNR_TOLERANCE_DB
        good = [one for psnr, one in decibels if psnr >= enough]
        return min(good, key=lambda one: one.seconds.median, default=None)

    def recommendation(self) -> list[str]:
        """Write the recommended settings as lines of a scene file."""
        lines = []
        if (points := self.recommended_points) is not None and max(points) <= MAX_POINTS:
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


def observed_orders(points: list[SteppingMeasurement]) -> dict[str, float | None]:
    """Fit the order of every method over the points where the error comes from the step; None: too few of them."""
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
