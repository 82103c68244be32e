"""Results of a study, and the settings that it recommends."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_msm.scene.section import MAX_POINTS


@dataclass(frozen=True)
class Timing:
    """Statistics of the times of repeated runs [s], and number of the runs."""

    median: float
    fastest: float
    slowest: float
    runs: int

    @classmethod
    def of(cls, samples: Sequence[float]) -> Timing:
        """Compute the statistics of one or more samples [s]."""
        return cls(statistics.median(samples), min(samples), max(samples), len(samples))


@dataclass(frozen=True)
class Reference:
    """Reference for the errors of stepping: central differences in f64, extrapolated without contact."""

    steps_per_frame: int  # in the finest run
    error: float  # estimated error of the reference, as a fraction of `largest`
    largest: float  # largest displacement of any mass point at any frame [m]


@dataclass
class Measurement:
    """Measurement of one setting."""

    samples: list[float] = field(default_factory=list, kw_only=True)  # times of repeated runs [s]

    @property
    def seconds(self) -> Timing:
        """Statistics of the samples; needs at least one."""
        return Timing.of(self.samples)


@dataclass
class SteppingMeasurement(Measurement):
    """Measurement of stepping through the scene with a method and a step, without compilation."""

    precision: str  # f32 or f64
    damping_difference: str  # central or backward
    steps_per_frame: int
    step: float  # time step h [s]
    # Largest error of any mass point at any frame, as a fraction of the largest displacement; None if it diverged.
    error: float | None = None
    rounding: float | None = None  # difference from f64 with the same step, as such a fraction; None if not measured
    known: bool = False  # False if `error` is only a rough upper bound, because the reference is too inaccurate

    @property
    def method(self) -> str:
        """Name of the method, such as f32 central."""
        return f"{self.precision} {self.damping_difference}"


@dataclass
class DrawingMeasurement(Measurement):
    """Measurement of drawing the most deformed frame."""

    refine: int
    supersample: int
    psnr: float | None  # against a picture of high refinement and supersampling [dB]; None if both are equal
    largest_error: int  # of any colour channel of any pixel, 0 to 255


@dataclass
class MeshMeasurement(Measurement):
    """Measurement of stepping through the scene with a mesh, in f64."""

    rows: int
    cols: int
    steps_per_frame: int  # of the automatic step on this mesh
    # Discretisation error at and between mass points, as a fraction of the largest displacement; None if it diverged.
    error: float | None = None
    known: bool = False  # as in `SteppingMeasurement`

    @property
    def name(self) -> str:
        """Name of the mesh, such as 31 x 31."""
        return f"{self.rows} x {self.cols}"


@dataclass
class Study:
    """Results of a study: speed against error of a scene's settings on a machine."""

    scene: str  # name of the scene
    settings: dict[str, Any]  # the scene with its defaults filled in
    status: str  # complete or interrupted
    tolerance: float  # largest allowed error, as a fraction of the largest displacement
    machine: dict[str, Any]  # CPU, cores, arch, threads, bits of a vector, and versions
    reference: Reference | None = None  # None if the study was interrupted before it
    stepping: list[SteppingMeasurement] = field(default_factory=list)  # by method, with decreasing steps
    orders: dict[str, float | None] = field(default_factory=dict)  # order of convergence by method
    drawing: list[DrawingMeasurement] = field(default_factory=list)  # by supersampling and refinement
    points: list[MeshMeasurement] = field(default_factory=list)  # from coarse to fine; empty for springs
    notes: list[str] = field(default_factory=list)  # remarks, such as the reason of an omitted part

    def finish(self) -> None:
        """Remove measurements without samples, sort those of stepping, and fit the orders of convergence."""
        self.stepping = sorted(
            (point for point in self.stepping if point.samples),
            key=lambda point: (point.precision, point.damping_difference != "central", point.steps_per_frame),
        )
        self.orders = observed_orders(self.stepping)
        self.drawing = [drawing for drawing in self.drawing if drawing.samples]
        self.points = [mesh for mesh in self.points if mesh.samples]

    @property
    def has_contact(self) -> bool:
        """Whether the scene has position-controlled tools."""
        return any(probe.get("path") for probe in self.settings["probes"])

    @property
    def mesh_tolerance(self) -> float:
        """Largest allowed discretisation error of the mesh, as a fraction of the largest displacement."""
        return float(self.settings["sheet"]["tolerance"] or self.tolerance)

    @property
    def scene_mesh(self) -> MeshMeasurement | None:
        """Measurement of the scene's own mesh; None if not measured, or diverged."""
        points = list(self.settings["sheet"]["points"])
        return next((mesh for mesh in self.points if [mesh.rows, mesh.cols] == points and mesh.error is not None), None)

    @property
    def recommended_points(self) -> tuple[int, int] | None:
        """Rows and columns of a mesh within the tolerance; None if the scene's mesh is, or was not measured.

        It is the coarsest measured mesh within the tolerance. Without one, it is extrapolated by the observed order of
        convergence, limited to 1 to 2, and may be finer than a scene allows.
        """
        scene_mesh, allowed = self.scene_mesh, self.mesh_tolerance
        if scene_mesh is None or scene_mesh.error is None or scene_mesh.error <= allowed:
            return None
        errors = [(mesh.rows, mesh.cols, mesh.error) for mesh in self.points if mesh.error is not None]
        for rows, cols, error in errors:
            if error <= allowed:
                return rows, cols
        order = 1.0
        rows, cols, error = errors[-1]
        if len(errors) > 1:
            coarser_rows, _, coarser_error = errors[-2]
            observed = math.log(coarser_error / error) / math.log((rows - 1) / (coarser_rows - 1))
            order = min(2.0, max(1.0, observed))
        refinement = (error / allowed) ** (1 / order)
        return math.ceil((rows - 1) * refinement) + 1, math.ceil((cols - 1) * refinement) + 1

    @property
    def best_stepping(self) -> SteppingMeasurement | None:
        """Most accurate stepping within the tolerance, of those at most 10 % slower than the fastest of them.

        None if no stepping is within the tolerance, or if the scene needs another mesh, whose steps are not measured.
        Of each method only the largest step is a candidate, as noise in the times could favour a smaller one.
        """
        if self.recommended_points is not None:
            return None
        sufficient = [point for point in self.stepping if point.error is not None and point.error <= self.tolerance]
        largest = {point.method: point for point in sorted(sufficient, key=lambda point: point.step)}
        fastest = min((point.seconds.median for point in largest.values()), default=0.0)
        fast = [point for point in largest.values() if point.seconds.median <= 1.1 * fastest]
        return min(fast, key=lambda point: point.error or 0.0, default=None)

    @property
    def best_drawing(self) -> DrawingMeasurement | None:
        """Fastest sufficient refinement with the scene's supersampling; None if not measured."""
        return self.best_refinement(self.settings["render"]["supersample"])

    def best_refinement(self, supersample: int) -> DrawingMeasurement | None:
        """Return the fastest refinement within 0.1 dB of the best with a supersampling; None if not measured."""
        drawings = [drawing for drawing in self.drawing if drawing.supersample == supersample]
        qualities = [math.inf if drawing.psnr is None else drawing.psnr for drawing in drawings]
        sufficient = [each for each, psnr in zip(drawings, qualities, strict=True) if psnr >= max(qualities) - 0.1]
        return min(sufficient, key=lambda drawing: drawing.seconds.median, default=None)

    def recommendation(self) -> list[str]:
        """Format the recommended settings as lines of a scene file."""
        lines = []
        if (points := self.recommended_points) is not None and max(points) <= MAX_POINTS:
            # With a tolerance, a run finds the step for this mesh.
            lines += ["sheet:", f"  points: {list(points)}"]
            lines += ["time:", "  step: auto", f"  tolerance: {self.tolerance:g}"]
        if (step := self.best_stepping) is not None:
            lines.append("time:")
            if self.settings["time"]["tolerance"] is not None:
                lines.append("  tolerance: null")
            # All digits: a rounded step could exceed the stability limit.
            lines += [f"  step: {step.step!r}", f"  damping_difference: {step.damping_difference}"]
            lines.append(f"  precision: {step.precision}")
        if (drawn := self.best_drawing) is not None:
            lines += ["render:", f"  refine: {drawn.refine}", f"  supersample: {drawn.supersample}"]
        return lines


def observed_orders(points: list[SteppingMeasurement]) -> dict[str, float | None]:
    """Fit the order of convergence of every method to its errors, except bounds and those with significant rounding.

    It is None with fewer than three such errors.
    """
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
