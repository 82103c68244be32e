"""Measurements of a study.

- Work-precision diagram of stepping: every precision and damping difference, from the largest stable step downwards.
- Work-precision diagram of the mesh: tissue with a quarter, half and twice the cells per side.
- Work-precision diagram of drawing: every refinement and supersampling, for the most deformed frame.

The results are added to a `Study`, which keeps the first ones after a KeyboardInterrupt from `progress`. `longest_run`
is the approximate time limit of a run [s].
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.accuracy.interpolation import difference, interpolate
from taichi_msm.accuracy.mesh import MIN_POINTS_PER_SIDE, with_points
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.errors import ProgressCallback
from taichi_msm.integrators import INTEGRATORS
from taichi_msm.load import cost
from taichi_msm.model.plan import Plan
from taichi_msm.model.time_grid import Precision
from taichi_msm.model.tools import min_steps_per_frame
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.sheet import Sheet
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import min_stable_steps, plan_variant, try_plan, with_time
from taichi_msm.study.result import DrawingMeasurement, MeshMeasurement, Reference, SteppingMeasurement, Study
from taichi_msm.system import process
from taichi_msm.system.runtime import Device

PRECISIONS: tuple[Precision, ...] = ("f64", "f32")

# Number of timings of every setting, in turns with the other settings of its kind.
ROUNDS = 5

# Smallest ratio of a measured error to the error of the reference; a smaller error is only a bound.
REFERENCE_MARGIN = 20

Array = NDArray[Any]


class SteppingStudy:
    """Work-precision diagram of stepping."""

    def __init__(
        self, plan: Plan, device: Device, longest_run: float, study: Study, progress: ProgressCallback
    ) -> None:
        self._plan, self._device, self._longest_run = plan, device, longest_run
        self._study, self._progress = study, progress
        self._plans = {
            difference: plan_variant(plan, with_time(plan.scene, damping_difference=difference, step="auto"))
            for difference in INTEGRATORS
        }
        self._dynamics: dict[str, Dynamics] = {}
        self._done, self._total = 0, 1

    def run(self) -> Array:
        """Compute the reference and the errors, then repeat every run to measure its time.

        Return the reference displacements at every frame but the first [m], shape (F, rows, cols, 3).
        """
        with ExitStack() as opened:
            for precision in PRECISIONS:
                self._progress(0, self._total)
                plan = self._plan.with_grid(precision=precision)
                dynamics = opened.enter_context(closing(Dynamics(plan, self._device)))
                dynamics.compile()
                self._dynamics[precision] = dynamics
            series = {difference: list(self._series(difference)) for difference in INTEGRATORS}
            finest = max(steps for counts in series.values() for steps in counts)
            self._total = 3 + ROUNDS * len(PRECISIONS) * sum(len(counts) for counts in series.values())
            frames = self._compute_reference(finest)
            for difference, counts in series.items():
                self._measure_errors(difference, counts, frames)
            self._total = self._done + (ROUNDS - 1) * len(self._study.stepping)
            for _ in range(ROUNDS - 1):
                for point in self._study.stepping:
                    self._run(point.precision, point.damping_difference, point.steps_per_frame, point.samples)
        return frames

    def _series(self, difference: str) -> Iterator[int]:
        """Yield the steps per frame: the smallest stable number, then doubled ones, up to the time limit of a run."""
        steps = min_steps_per_frame(self._plan.tools, self._plan.grid, min_stable_steps(self._plans[difference]))
        samples: list[float] = []
        self._run("f64", difference, steps, samples)
        yield steps
        for halving in range(1, 64):
            # The first two halvings of the step ignore the time limit.
            if halving > 2 and samples[0] * 2**halving > self._longest_run:
                return
            yield steps * 2**halving

    def _compute_reference(self, finest: int) -> Array:
        """Extrapolate central differences with one half and one quarter of the finest measured step."""
        # Richardson: u* = u_{h/2} + (u_{h/2} - u_h) / 3, whose error is roughly bounded by its distance from the same
        # formula at 2 h. With contact, of order 1, the finest run is the reference.
        coarse, middle, fine = (self._run("f64", "central", finest * 2**halving, []) for halving in range(3))
        before, frames = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
        if self._plan.tools:
            before, frames = middle, fine
        largest = max_norm(frames)
        self._study.reference = Reference(4 * finest, _relative_error(frames - before, largest), largest)
        return frames

    def _measure_errors(self, difference: str, counts: list[int], exact: Array) -> None:
        """Run every step once: in f32 until rounding dominates, in f64 until errors are only bounds."""
        assert self._study.reference is not None
        largest, reference_error = self._study.reference.largest, self._study.reference.error
        remaining, bound = set(PRECISIONS), displacement_bound(self._plan, self._plan.scene.time.duration)
        for steps in counts:
            frames_f64: Array | None = None
            for precision in (each for each in PRECISIONS if each in remaining):
                step = replace(self._plan.grid, steps_per_frame=steps).step
                point = SteppingMeasurement(precision, difference, steps, step)
                frames = self._run(precision, difference, steps, point.samples)
                error, rounding = _relative_error(frames - exact, largest), None
                if precision == "f64":
                    frames_f64 = frames
                elif frames_f64 is not None and largest > 0:
                    rounding = max_norm(frames - frames_f64) / largest
                self._study.stepping.append(point)
                if error < math.inf and max_norm(frames) <= bound:
                    point.error, point.rounding = error, rounding
                    point.known = error >= REFERENCE_MARGIN * reference_error
                    if not point.known or (rounding is not None and rounding > error / 2):
                        remaining.discard(precision)

    def _run(self, precision: str, difference: str, steps: int, samples: list[float]) -> Array:
        """Simulate the scene, append the time of stepping [s] to the samples, and return the frames."""
        dynamics = self._dynamics[precision]
        plan = self._plans[difference].with_grid(precision=precision, steps_per_frame=steps)
        frames = np.empty((plan.grid.frames, *plan.scene.sheet.points, 3), precision.replace("f", "float"))
        seconds = []
        for frame, duration in zip(frames, _simulate(dynamics, plan), strict=True):
            self._progress(self._done, self._total)
            seconds.append(duration)
            frame[:] = dynamics.displacement()
        samples.append(sum(seconds))
        self._done += 1
        return frames


def _simulate(dynamics: Dynamics, plan: Plan) -> Iterator[float]:
    """Simulate the scene of a plan; yield the time of the steps of every frame [s]."""
    dynamics.restart(plan)
    for _ in range(plan.grid.frames):
        start = time.perf_counter()
        dynamics.advance(plan.grid.steps_per_frame)
        yield time.perf_counter() - start


def _relative_error(error: Array, largest: float) -> float:
    """Return the largest error [m] as a fraction of the largest displacement [m]; 0 without motion."""
    return max_norm(error) / largest if largest > 0 else 0.0


# Cells per side of the finer mesh, relative to those of the scene.
FINE_CELL_RATIO = 2


class _MeshRun(NamedTuple):
    plan: Plan
    dynamics: Dynamics
    measurement: MeshMeasurement


class MeshStudy:
    """Work-precision diagram of the mesh of a sheet of tissue, in f64, from coarse to fine.

    Errors are measured with the same step for all meshes, so that time-step errors cancel, and times with the automatic
    step of each mesh, which is longer for a coarser one.

    The reference is extrapolated from a mesh finer than all measured ones if a run of it takes at most `ROUNDS` times
    `longest_run`, otherwise from the finest measured mesh, whose own error is then only a bound.
    """

    def __init__(
        self, plan: Plan, device: Device, longest_run: float, study: Study, progress: ProgressCallback
    ) -> None:
        scene = with_time(plan.scene, step="auto", tolerance=None, precision="f64")
        self._plan = plan_variant(plan, with_points(scene, scene.sheet.points))
        self._device, self._longest_run, self._study, self._progress = device, longest_run, study, progress
        self._sheets: list[_MeshRun] = []
        self._done = 0

    def run(self) -> None:
        """Compute the errors, then measure the times; do nothing for springs, whose stiffness depends on the mesh."""
        if self._plan.scene.tissue is None:
            return
        with ExitStack() as opened:
            seconds = 0.0
            for plan in mesh_plans(self._plan):
                seconds = self._measure_mesh(plan, opened)
            if not self._sheets:
                note = f"meshes were not compared: that takes at least {MIN_POINTS_PER_SIDE} points a side"
                self._study.notes.append(note)
                return
            finer = self._finer_plan(self._plan, seconds, self._longest_run)
            if finer is None:
                rows, cols = _scaled(self._plan, FINE_CELL_RATIO)
                self._study.notes.append(f"{rows} x {cols} points were not measured, for lack of time or memory")
            else:
                seconds = self._measure_mesh(finer, opened)
                finer = self._finer_plan(finer, seconds, ROUNDS * self._longest_run)
            if len(self._sheets) < 2:
                return
            self._measure_errors(finer)
            for _ in range(ROUNDS):
                for sheet in self._sheets:
                    sheet.measurement.samples.append(self._step_through(sheet))

    def _measure_mesh(self, plan: Plan, opened: ExitStack) -> float:
        """Add a mesh; return the time of a run with its automatic step [s]."""
        dynamics = opened.enter_context(closing(Dynamics(plan, self._device)))
        sheet = _MeshRun(plan, dynamics, MeshMeasurement(*plan.scene.sheet.points, plan.grid.steps_per_frame))
        self._sheets.append(sheet)
        self._study.points.append(sheet.measurement)
        self._tick()
        dynamics.compile()
        # The minimum of two runs is less sensitive to other load of the machine.
        return min(self._step_through(sheet) for _ in range(2))

    def _finer_plan(self, plan: Plan, seconds: float, longest_run: float) -> Plan | None:
        """Plan the mesh finer than one whose run took `seconds`; None beyond the limits of points, time and memory."""
        points = _scaled(plan, FINE_CELL_RATIO)
        if max(points) > MAX_POINTS:
            return None
        finer = plan_variant(plan, with_points(plan.scene, points))
        work = [math.prod(each.scene.sheet.points) * each.grid.steps_per_frame for each in (plan, finer)]
        return None if seconds * work[1] / work[0] > longest_run or any(cost.size_problems(finer)) else finer

    def _measure_errors(self, finer: Plan | None) -> None:
        """Step all meshes in lockstep, with the finer one unless None, and compare every frame."""
        finest = self._sheets[-1].plan if finer is None else finer
        grid = finest.grid
        with ExitStack() as opened:
            sheets = [sheet.dynamics for sheet in self._sheets]
            if finer is not None:
                sheets.append(opened.enter_context(closing(Dynamics(finer, self._device))))
                sheets[-1].compile()
            for sheet in sheets:
                sheet.restart(sheet.plan.with_grid(steps_per_frame=grid.steps_per_frame))
            errors, reference_error, largest = [0.0] * len(sheets), 0.0, 0.0
            meshes = [sheet.plan.scene.sheet for sheet in sheets]
            for _ in range(grid.frames):
                for sheet in sheets:
                    self._tick()
                    sheet.advance(grid.steps_per_frame)
                fields = [sheet.displacement() for sheet in sheets]
                with np.errstate(all="ignore"):
                    exact, bound = _reference(fields, meshes, extrapolate=not (finest.tools or meshes[-1].mask))
                    coarser = list(zip(fields[:-1], meshes[:-1], strict=True))
                    frame_errors = [max_norm(difference(exact, field, meshes[-1], mesh)) for field, mesh in coarser]
                    # The error of the finest mesh between its points is not measured. At order 1 or more, its distance
                    # from a mesh with half the cells per side is a bound.
                    frame_errors.append(max_norm(difference(fields[-1], fields[-2], meshes[-1], meshes[-2])))
                errors = [max(pair) for pair in zip(errors, frame_errors, strict=True)]
                reference_error, largest = max(reference_error, bound), max(largest, max_norm(exact))
            self._done += 1
        max_displacement = displacement_bound(finest, finest.scene.time.duration)
        if not largest <= max_displacement:
            return
        for (plan, _, measurement), error in zip(self._sheets, errors, strict=False):
            if plan is not finest:
                measurement.known = error >= 5 * reference_error
                error += 0.0 if measurement.known else reference_error
            share = error / largest if largest > 0 else 0.0
            measurement.error = share if share < math.inf else None

    def _step_through(self, sheet: _MeshRun) -> float:
        """Simulate the scene with the automatic step; return the time of the steps [s]."""
        seconds = 0.0
        for duration in _simulate(sheet.dynamics, sheet.plan):
            self._tick()
            seconds += duration
        self._done += 1
        return seconds

    def _tick(self) -> None:
        # A mesh has two first runs and `ROUNDS` timed ones; the comparison of all meshes counts as a run.
        self._progress(self._done, 1 + (2 + ROUNDS) * len(self._sheets))


def mesh_plans(plan: Plan) -> Iterator[Plan]:
    """Yield the plans of valid coarser meshes, from coarse to fine, and of the scene's own mesh."""
    for ratio in (1 / 4, 1 / 2):
        points = _scaled(plan, ratio)
        if min(points) >= MIN_POINTS_PER_SIDE:
            coarse, _ = try_plan(with_points(plan.scene, points), plan.maps)
            if coarse is not None:
                yield coarse
    if min(plan.scene.sheet.points) >= MIN_POINTS_PER_SIDE:
        yield plan


def _scaled(plan: Plan, ratio: float) -> tuple[int, int]:
    """Return the rows and columns of mass points of a mesh with `ratio` times the cells per side."""
    rows, cols = (round((count - 1) * ratio) + 1 for count in plan.scene.sheet.points)
    return rows, cols


def _reference(fields: list[Array], meshes: list[Sheet], *, extrapolate: bool) -> tuple[Array, float]:
    """Return Richardson's extrapolation of order 2 of the two finest fields, and a bound of its error [m]."""
    # u* = u + (u - u_r) / (r^2 - 1), where the cells of u_r are r times as long. The correction is computed at the mass
    # points of u_r and interpolated at those of u. The rough bound is the distance of u* from the extrapolation of the
    # next coarser pair, or from u without a third field. With contact or a mask, of order 1, u is the reference, and
    # its distance from u_r the rough bound.
    if not extrapolate:
        return fields[-1], max_norm(difference(fields[-2], fields[-1], meshes[-2], meshes[-1]))
    exact = fields[-1] + interpolate(_correction(fields[-1], fields[-2]), fields[-1])
    if len(fields) > 2:
        before = fields[-2] + interpolate(_correction(fields[-2], fields[-3]), fields[-2])
    else:
        before = interpolate(fields[-1], fields[-2])
    return exact, max_norm(interpolate(exact, before) - before)


def _correction(fine: Array, coarse: Array) -> Array:
    """Return Richardson's correction at the mass points of the coarse field."""
    ratio = min((n - 1) / (m - 1) for n, m in zip(fine.shape[:2], coarse.shape[:2], strict=True))
    correction: Array = (interpolate(fine, coarse) - coarse) / (ratio**2 - 1)
    return correction


REFINES = (0, 1, 2, 5, 10, 20)
SUPERSAMPLES = (1, 2, 3, 4)

# Settings of the reference picture, finer than all compared ones.
REFERENCE_RENDER = {"refine": 40, "supersample": 8}

Picture = NDArray[np.uint8]


def measure_pictures(
    scene: Scene, position: NDArray[Any], texture: Picture, quick: bool, study: Study, progress: ProgressCallback
) -> None:
    """Measure the errors and times of drawing with all `render_settings`.

    `position` are those of the mass points [m], shape (rows, cols, 3).
    """
    position = np.ascontiguousarray(position, np.float32)
    memory = process.available_memory() // 2
    finest = _with_render(scene, **REFERENCE_RENDER)
    if cost.drawing_bytes(finest) > memory:
        study.notes.append("drawing was not measured, for lack of memory for the reference picture")
        return
    reference = Rasterizer(finest, texture).draw(position)
    drawings, candidates = [], list(render_settings(scene, quick))
    for number, (refine, supersample) in enumerate(candidates):
        progress(number, len(candidates) * ROUNDS)
        changed = _with_render(scene, refine=refine, supersample=supersample)
        memory -= cost.drawing_bytes(changed)
        if memory < 0:
            note = f"drawing was not measured from refine {refine}, supersample {supersample} on, for lack of memory"
            study.notes.append(note)
            break
        drawing = Rasterizer(changed, texture)
        drawings.append(drawing)
        picture = drawing.draw(position)
        error = int(np.abs(picture.astype(np.int16) - reference).max())
        study.drawing.append(DrawingMeasurement(refine, supersample, psnr(picture, reference), error))
    for round_ in range(ROUNDS):
        for number, (drawing, measurement) in enumerate(zip(drawings, study.drawing, strict=True)):
            progress(round_ * len(drawings) + number, len(drawings) * ROUNDS)
            start = time.perf_counter()
            drawing.draw(position)
            measurement.samples.append(time.perf_counter() - start)


def render_settings(scene: Scene, quick: bool) -> Iterator[tuple[int, int]]:
    """Yield the pairs of refinement and supersampling to compare; if `quick`, those with one of the scene's two."""
    render = scene.render
    for supersample in sorted({*SUPERSAMPLES, render.supersample}):
        for refine in sorted({*REFINES, render.refine}):
            if not quick or refine == render.refine or supersample == render.supersample:
                yield refine, supersample


def psnr(picture: Picture, reference: Picture) -> float | None:
    """Return the peak signal-to-noise ratio [dB], 10 log10(255^2 / mean square error); None for equal pictures."""
    square = float(np.mean((picture.astype(np.float64) - reference) ** 2))
    return 10 * math.log10(255**2 / square) if square > 0 else None


def _with_render(scene: Scene, **changes: int) -> Scene:
    # No validation: the settings of the reference picture exceed the limits of a scene.
    return scene.model_copy(update={"render": BaseModel.model_copy(scene.render, update=changes)})
