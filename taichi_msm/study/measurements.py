"""Measurements of a study.

- Work-precision diagram of stepping: every precision and damping difference, from the largest stable step downwards.
- Work-precision diagram of the mesh: tissue with a quarter, half and twice the cells per side.
- Work-precision diagram of drawing: every refinement and supersampling, for the most deformed frame.
- Ablation of the terms of the model: the time of a step without each of them.
- Solution of the same equations by SciPy's DOP853, for comparison.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.accuracy.mesh import (
    MIN_POINTS_PER_SIDE,
    CubicInterpolation,
    MeshCompanion,
    mesh_companion_plan,
    with_points,
)
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.errors import ProgressCallback
from taichi_msm.load import cost
from taichi_msm.model.loads import Schedule, evaluate_loads, keyframe_times
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import area_shares, axes, spacing
from taichi_msm.model.time_grid import Precision
from taichi_msm.model.tool_force import probe_force
from taichi_msm.model.tools import min_steps_per_frame
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant, stable_steps, try_plan, with_time
from taichi_msm.study.result import (
    DrawingMeasurement,
    MeshMeasurement,
    Reference,
    SteppingMeasurement,
    Study,
    TermMeasurement,
)
from taichi_msm.system import process
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import elastic_force, spring_families
from taichi_msm.terms.foundation import foundation_force

PRECISIONS: tuple[Precision, ...] = ("f64", "f32")
DIFFERENCES = ("central", "backward")

# Number of timings of every setting; all settings are timed in turns.
STEPPING_ROUNDS = 5

# Smallest ratio of a known error to the error of the reference.
REFERENCE_MARGIN = 20

Frames = NDArray[Any]


class SteppingStudy:
    """Work-precision diagram of stepping.

    Args:
        plan: of the scene.
        device: runs the simulations.
        longest_run: approximate time limit of a run [s].
        study: receives the results, also those before a KeyboardInterrupt from `progress`.
        progress: called with the number of finished runs and their total.

    Attributes:
        frames: reference displacements at every frame but the first [m], shape (F, rows, cols, 3).
    """

    def __init__(
        self, plan: Plan, device: Device, longest_run: float, study: Study, progress: ProgressCallback
    ) -> None:
        self.plan = plan
        self._plans = {
            difference: plan_variant(plan, with_time(plan.scene, damping_difference=difference, step="auto"))
            for difference in DIFFERENCES
        }
        self.frames: Frames | None = None
        self._longest_run, self.study, self._progress = longest_run, study, progress
        self._done, self._total = 0, 1
        self._dynamics: dict[str, Dynamics] = {
            precision: Dynamics(plan.with_grid(precision=precision), device) for precision in PRECISIONS
        }

    def run(self) -> None:
        """Compute the reference and the errors, then repeat all runs for their times."""
        for dynamics in self._dynamics.values():
            self._progress(0, self._total)
            dynamics.compile()
        series = {difference: list(self._series(difference)) for difference in DIFFERENCES}
        finest = max(steps for counts in series.values() for steps in counts)
        self._total = 3 + STEPPING_ROUNDS * len(PRECISIONS) * sum(len(counts) for counts in series.values())
        self._compute_reference(finest)
        for difference, counts in series.items():
            self._measure_errors(difference, counts)
        self._total = self._done + (STEPPING_ROUNDS - 1) * len(self.study.stepping)
        for _ in range(STEPPING_ROUNDS - 1):
            for point in self.study.stepping:
                self._run(point.precision, point.damping_difference, point.steps_per_frame, point.samples)

    def relative_error(self, frames: Frames) -> float:
        """Return the largest error against the reference, as a fraction of the largest displacement."""
        assert self.frames is not None
        largest = self._reference.largest
        return max_norm(frames - self.frames) / largest if largest > 0 else 0.0

    def determines(self, error: float) -> bool:
        """Return whether the reference is accurate enough to determine an error."""
        return error >= REFERENCE_MARGIN * self._reference.error

    def close(self) -> None:
        """Free the memory."""
        for dynamics in self._dynamics.values():
            dynamics.close()

    @property
    def _reference(self) -> Reference:
        assert self.study.reference is not None
        return self.study.reference

    def _series(self, difference: str) -> Iterator[int]:
        """Yield the steps per frame, from that of the largest valid step, doubled until a run would take too long."""
        steps = min_steps_per_frame(self.plan.tools, self.plan.grid, stable_steps(self._plans[difference]))
        samples: list[float] = []
        self._run("f64", difference, steps, samples)
        yield steps
        for halving in range(1, 64):
            # Two halvings are measured regardless of the time limit.
            if halving > 2 and samples[0] * 2**halving > self._longest_run:
                return
            yield steps * 2**halving

    def _compute_reference(self, finest: int) -> None:
        """Extrapolate central differences with one half and one quarter of the finest measured step."""
        # u* = u_{h/2} + (u_{h/2} - u_h) / 3. Its error is at most about its distance from the same formula with 2 h for
        # h. With contact, of order 1, the finest run is the reference.
        coarse, middle, fine = (self._run("f64", "central", finest * 2**halving, []) for halving in range(3))
        before, self.frames = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
        if self.plan.tools:
            before, self.frames = middle, fine
        largest = max_norm(self.frames)
        error = max_norm(self.frames - before) / largest if largest > 0 else 0.0
        self.study.reference = Reference(4 * finest, error, largest)

    def _measure_errors(self, difference: str, counts: list[int]) -> None:
        """Run every step once: in f32 until rounding dominates, in f64 until the reference is too inaccurate."""
        remaining, bound = set(PRECISIONS), displacement_bound(self.plan, self.plan.scene.time.duration)
        for steps in counts:
            exact: Frames | None = None
            for precision in (each for each in PRECISIONS if each in remaining):
                step = replace(self.plan.grid, steps_per_frame=steps).step
                point = SteppingMeasurement(precision, difference, steps, step)
                frames = self._run(precision, difference, steps, point.samples)
                error, rounding = self.relative_error(frames), None
                if precision == "f64":
                    exact = frames
                elif exact is not None and self._reference.largest > 0:
                    rounding = max_norm(frames - exact) / self._reference.largest
                self.study.stepping.append(point)
                if error < math.inf and max_norm(frames) <= bound:
                    point.error, point.rounding, point.known = error, rounding, self.determines(error)
                    if not point.known or (rounding is not None and rounding > error / 2):
                        remaining.discard(precision)

    def _run(self, precision: str, difference: str, steps: int, samples: list[float]) -> Frames:
        """Simulate the scene, append the time without that of the copies [s] to the samples, and return the frames."""
        dynamics = self._dynamics[precision]
        plan = self._plans[difference].with_grid(precision=precision, steps_per_frame=steps)
        dynamics.restart(plan)
        frames = np.empty((plan.grid.frames, *plan.scene.sheet.points, 3), precision.replace("f", "float"))
        seconds = 0.0
        for frame in frames:
            self._progress(self._done, self._total)
            start = time.perf_counter()
            dynamics.advance(steps)
            seconds += time.perf_counter() - start
            frame[:] = dynamics.displacement()
        samples.append(seconds)
        self._done += 1
        return frames


# Cells per side of the finer mesh, relative to those of the scene.
FINE_CELL_RATIO = 2

# Number of timings of every mesh; all meshes are timed in turns.
MESH_ROUNDS = 5

Field = NDArray[Any]


class _MeshRun(NamedTuple):
    plan: Plan
    dynamics: Dynamics
    measurement: MeshMeasurement


class MeshStudy:
    """Work-precision diagram of the mesh of a sheet of tissue, in f64.

    Errors are measured with the same step for all meshes, so that the time-step errors cancel. Times are measured with
    the automatic step of each mesh, which is longer for coarser ones.

    The reference is a mesh finer than all measured ones if there is time for it: a single run, which may take as long
    as all timed runs of another mesh. Otherwise it is the finest measured mesh, for whose own error only a bound is
    known.

    Args:
        plan: of the scene.
        device: runs the simulations.
        longest_run: approximate time limit of a run [s].
        study: receives the results, from coarse to fine, also those before a KeyboardInterrupt from `progress`.
        progress: called with the number of finished runs and their total.
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
        """Compute the estimates and the errors, then measure the times.

        Sheets of springs are skipped, as their stiffness depends on the mesh.
        """
        if self._plan.scene.tissue is None:
            return
        with ExitStack() as opened:
            seconds = 0.0
            for plan in mesh_plans(self._plan):
                seconds = self._measure_mesh(plan, opened)
            if not self._sheets:
                note = f"points were not measured: with fewer than {MIN_POINTS_PER_SIDE} a side they cannot be compared"
                self._study.notes.append(note)
                return
            finer = self._finer_plan(self._plan, seconds, self._longest_run)
            if finer is None:
                rows, cols = _scaled(self._plan, FINE_CELL_RATIO)
                self._study.notes.append(f"{rows} x {cols} points were not measured: time or memory")
            else:
                seconds = self._measure_mesh(finer, opened)
                finer = self._finer_plan(finer, seconds, MESH_ROUNDS * self._longest_run)
            if len(self._sheets) < 2:
                return
            self._measure_errors(finer)
            for _ in range(MESH_ROUNDS):
                for sheet in self._sheets:
                    sheet.measurement.samples.append(self._step_through(sheet))

    def _measure_mesh(self, plan: Plan, opened: ExitStack) -> float:
        """Simulate a mesh with its automatic step and companion runs; return the time of its steps [s]."""
        dynamics = opened.enter_context(closing(Dynamics(plan, self._device)))
        sheet = _MeshRun(plan, dynamics, MeshMeasurement(*plan.scene.sheet.points, plan.grid.steps_per_frame))
        coarse = mesh_companion_plan(plan)
        assert coarse is not None
        self._sheets.append(sheet)
        self._study.points.append(sheet.measurement)
        self._tick()
        dynamics.compile()
        companion = MeshCompanion(plan, coarse, self._device)
        companion.compile()
        first = self._step_through(sheet, companion)
        # The minimum of two runs is less sensitive to other load on the machine.
        seconds = min(first, self._step_through(sheet, companion.build_second_run(plan, self._device)))
        estimate = companion.estimate.error
        sheet.measurement.estimate = estimate if estimate < math.inf else None
        return seconds

    def _finer_plan(self, plan: Plan, seconds: float, longest_run: float) -> Plan | None:
        """Plan the next finer mesh than one that took `seconds`; return None beyond the limits of time or memory."""
        points = _scaled(plan, FINE_CELL_RATIO)
        if max(points) > MAX_POINTS:
            return None
        finer = plan_variant(plan, with_points(plan.scene, points))
        work = [math.prod(each.scene.sheet.points) * each.grid.steps_per_frame for each in (plan, finer)]
        return None if seconds * work[1] / work[0] > longest_run or any(cost.size_problems(finer)) else finer

    def _measure_errors(self, finer: Plan | None) -> None:
        """Step all meshes, and the finer one if given, in lockstep, and compare every frame."""
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
            for _ in range(grid.frames):
                for sheet in sheets:
                    self._tick()
                    sheet.advance(grid.steps_per_frame)
                fields = [sheet.displacement() for sheet in sheets]
                with np.errstate(all="ignore"):
                    exact, bound = _reference(fields, extrapolate=not finest.tools)
                    frame_errors = [max_norm(_sampled(field, exact) - exact) for field in fields[:-1]]
                    # The error of the finest mesh is unknown between its mass points. But at an order of at least 1,
                    # it is at most the distance from a mesh with half the cells per side.
                    frame_errors.append(max_norm(_sampled(fields[-2], fields[-1]) - fields[-1]))
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

    def _step_through(self, sheet: _MeshRun, companion: MeshCompanion | None = None) -> float:
        """Simulate the scene with the automatic step; return the time of the steps alone [s]."""
        plan, dynamics, _ = sheet
        dynamics.restart(plan)
        seconds = 0.0
        for _ in range(plan.grid.frames):
            self._tick()
            start = time.perf_counter()
            dynamics.advance(plan.grid.steps_per_frame)
            seconds += time.perf_counter() - start
            displacement = dynamics.displacement()
            if companion is not None:
                companion.compare_frame(displacement, self._tick)
        self._done += 1
        return seconds

    def _tick(self) -> None:
        # Two runs of every mesh with its companions and the timed runs; the comparison of all meshes counts as one.
        self._progress(self._done, 1 + (2 + MESH_ROUNDS) * len(self._sheets))


def mesh_plans(plan: Plan) -> Iterator[Plan]:
    """Yield the plans of the meshes that the scene allows, from coarse to its own."""
    for ratio in (1 / 4, 1 / 2):
        points = _scaled(plan, ratio)
        coarse, _ = (
            try_plan(with_points(plan.scene, points), plan.maps) if min(points) >= MIN_POINTS_PER_SIDE else (None, [])
        )
        if coarse is not None:
            yield coarse
    if min(plan.scene.sheet.points) >= MIN_POINTS_PER_SIDE:
        yield plan


def _scaled(plan: Plan, ratio: float) -> tuple[int, int]:
    """Return the rows and columns of mass points for `ratio` times the cells per side."""
    rows, cols = (round((count - 1) * ratio) + 1 for count in plan.scene.sheet.points)
    return rows, cols


def _reference(fields: list[Field], *, extrapolate: bool) -> tuple[Field, float]:
    """Apply Richardson's extrapolation of order 2 to the two finest fields; return it and a bound of its error [m]."""
    # u* = u + (u - u_r) / (r^2 - 1), where u_r has cells r times as long. The correction is computed at the mass points
    # of u_r and interpolated at those of u. The error of u* is at most about its distance from the extrapolation of the
    # next coarser pair, or from u if there are only two fields. With contact, of order 1, u is not extrapolated; its
    # error is at most about its distance from u_r.
    if not extrapolate:
        return fields[-1], max_norm(_sampled(fields[-1], fields[-2]) - fields[-2])
    exact = fields[-1] + _sampled(_correction(fields[-1], fields[-2]), fields[-1])
    if len(fields) > 2:
        before = fields[-2] + _sampled(_correction(fields[-2], fields[-3]), fields[-2])
    else:
        before = _sampled(fields[-1], fields[-2])
    return exact, max_norm(_sampled(exact, before) - before)


def _correction(fine: Field, coarse: Field) -> Field:
    """Return Richardson's correction at the mass points of the coarse field."""
    ratio = min(
        (fine_count - 1) / (coarse_count - 1)
        for fine_count, coarse_count in zip(fine.shape[:2], coarse.shape[:2], strict=True)
    )
    correction: Field = (_sampled(fine, coarse) - coarse) / (ratio**2 - 1)
    return correction


def _sampled(values: Field, target: Field) -> Field:
    """Interpolate a field at the mass points of another one."""
    (rows, cols), (target_rows, target_cols) = values.shape[:2], target.shape[:2]
    return CubicInterpolation((rows, cols), (target_rows, target_cols)).evaluate(values)


REFINES = (0, 1, 2, 5, 10, 20)
SUPERSAMPLES = (1, 2, 3, 4)

# Settings of the reference picture, finer than all others.
REFERENCE_RENDER = {"refine": 40, "supersample": 8}

PICTURE_ROUNDS = 5

Picture = NDArray[np.uint8]


def measure_pictures(
    scene: Scene, position: NDArray[Any], texture: Picture, quick: bool, study: Study, progress: ProgressCallback
) -> None:
    """Measure the error and the time of drawing with every setting.

    Args:
        scene: the scene.
        position: of the mass points [m], shape (rows, cols, 3).
        texture: picture on the sheet, 8-bit RGB, shape (height, width, 3).
        quick: as for `render_settings`.
        study: receives the results.
        progress: called with the number of finished pictures and their total.
    """
    position = np.ascontiguousarray(position, np.float32)
    memory = process.available_memory() // 2
    finest = _with_render(scene, **REFERENCE_RENDER)
    if cost.drawing_bytes(finest) > memory:
        study.notes.append("drawing was not measured: there is no memory for a picture fine enough to compare with")
        return
    reference = Rasterizer(finest, texture).draw(position)
    drawings, candidates = [], list(render_settings(scene, quick))
    for number, (refine, supersample) in enumerate(candidates):
        progress(number, len(candidates) * PICTURE_ROUNDS)
        changed = _with_render(scene, refine=refine, supersample=supersample)
        memory -= cost.drawing_bytes(changed)
        if memory < 0:
            study.notes.append(f"drawing was not measured from refine {refine}, supersample {supersample} on: memory")
            break
        drawing = Rasterizer(changed, texture)
        drawings.append(drawing)
        picture = drawing.draw(position)
        error = int(np.abs(picture.astype(np.int16) - reference).max())
        study.drawing.append(DrawingMeasurement(refine, supersample, psnr(picture, reference), error))
    for round_ in range(PICTURE_ROUNDS):
        for number, (drawing, measurement) in enumerate(zip(drawings, study.drawing, strict=True)):
            progress(round_ * len(drawings) + number, len(drawings) * PICTURE_ROUNDS)
            start = time.perf_counter()
            drawing.draw(position)
            measurement.samples.append(time.perf_counter() - start)


def render_settings(scene: Scene, quick: bool) -> Iterator[tuple[int, int]]:
    """Yield the pairs of refinement and supersampling to compare.

    Args:
        scene: has its own settings.
        quick: whether to vary one of both at a time.
    """
    render = scene.render
    for supersample in sorted({*SUPERSAMPLES, render.supersample}):
        for refine in sorted({*REFINES, render.refine}):
            if not quick or refine == render.refine or supersample == render.supersample:
                yield refine, supersample


def psnr(picture: Picture, reference: Picture) -> float | None:
    """Compute the peak signal-to-noise ratio [dB], 10 log10(255^2 / mean square error).

    Args:
        picture: 8-bit RGB, shape (height, width, 3).
        reference: of the same shape.

    Returns:
        The ratio [dB]; None if both pictures are equal.
    """
    square = float(np.mean((picture.astype(np.float64) - reference) ** 2))
    return 10 * math.log10(255**2 / square) if square > 0 else None


def _with_render(scene: Scene, **changes: int) -> Scene:
    # Not validated, as the settings of the reference picture exceed the limits of a scene.
    return scene.model_copy(update={"render": BaseModel.model_copy(scene.render, update=changes)})


TERM_ROUNDS = 9

# Keys of the terms that can be disabled, with the values that do so.
SPRING_TERMS: dict[str, float | None] = {"structural": 0.0, "shear": 0.0, "virtual": 0.0, "map": None}
TISSUE_TERMS: dict[str, float | None] = {
    **dict.fromkeys(("foundation", "damping", "pretension", "bending"), 0.0),
    **dict.fromkeys(("map", "foundation_map")),
}


def measure_terms(plan: Plan, device: Device, sample: float, study: Study, progress: ProgressCallback) -> None:
    """Measure the time of a step without each term in turn.

    Args:
        plan: of the scene.
        device: runs the simulations.
        sample: approximate time of a measurement [s].
        study: receives the results.
        progress: called with the number of finished measurements and their total.
    """
    # All variants have the step of the full scene, because the automatic step depends on the springs.
    grid = {"steps_per_frame": plan.grid.steps_per_frame, "precision": plan.grid.precision}
    plans = {without: plan_variant(plan, scene).with_grid(**grid) for without, scene in scene_variants(plan.scene)}
    study.terms += map(TermMeasurement, plans)
    with ExitStack() as opened:
        sheets: list[Dynamics] = []
        for without in plans.values():
            progress(0, len(plans))
            sheets.append(opened.enter_context(closing(Dynamics(without, device))))
            sheets[-1].compile()
        frames = round(sample / (_step_seconds(sheets[0], 1) * plan.grid.steps_per_frame))
        frames = max(1, min(plan.grid.frames, frames))
        for round_ in range(TERM_ROUNDS):
            for number, (term, sheet) in enumerate(zip(study.terms, sheets, strict=True)):
                progress(round_ * len(sheets) + number, TERM_ROUNDS * len(sheets))
                # All variants step through the same part of the scene.
                sheet.restart(sheet.plan)
                term.samples.append(_step_seconds(sheet, frames))


def scene_variants(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield the full scene with an empty key, then the scene without each of its terms, with the key of the term."""
    yield "", scene
    terms, sheet = (SPRING_TERMS, scene.springs) if scene.tissue is None else (TISSUE_TERMS, scene.tissue)
    assert sheet is not None
    for name, absent in terms.items():
        if getattr(sheet, name) not in (0, None):
            without = sheet.model_copy(update={name: absent})
            yield f"{scene.kind}.{name}", scene.model_copy(update={scene.kind: without})
    if scene.damping > 0:
        yield "damping", scene.model_copy(update={"damping": 0.0})
    for index in range(len(scene.probes)):
        remaining = scene.probes[:index] + scene.probes[index + 1 :]
        yield f"probes.{index}", scene.model_copy(update={"probes": remaining})


def _step_seconds(dynamics: Dynamics, frames: int) -> float:
    """Measure the time of one step [s]."""
    steps = frames * dynamics.plan.grid.steps_per_frame
    start = time.perf_counter()
    dynamics.advance(steps)
    return (time.perf_counter() - start) / steps


# Loads may jump at keyframes: they are evaluated at this distance from them, as a fraction of the interval.
KEY_MARGIN = 1e-9

Array = NDArray[np.float64]


class TimeLimitError(Exception):
    """The time limit is exceeded."""


class IntegrationError(Exception):
    """The step size of the solver has underflowed; the message contains the time."""


def solve_with_dop853(
    plan: Plan, rtol: float, atol: float, deadline: float, tick: Callable[[], None]
) -> tuple[Array, int]:
    """Integrate the scene with SciPy's DOP853, in intervals between keyframes, where loads are smooth.

    Args:
        plan: of the scene.
        rtol: relative tolerance.
        atol: absolute tolerance of displacements [m] and velocities [m/s].
        deadline: time limit, on the clock of `time.perf_counter` [s].
        tick: called several times a second.

    Returns:
        Displacements at every frame but the first [m], shape (F, rows, cols, 3), and the number of evaluations.

    Raises:
        TimeLimitError: when the deadline has passed.
        IntegrationError: when SciPy fails.
    """
    from scipy.integrate import solve_ivp

    scene = plan.scene
    shape = (*scene.sheet.points, 3)
    accelerate, free = acceleration_function(plan), ~plan.fixed[..., None]
    state = np.zeros(2 * int(np.prod(shape)))
    evaluations = 0
    displacements = []
    for start, end, frames in _smooth_intervals(scene):
        margin = KEY_MARGIN * (end - start)
        end_loads = evaluate_loads(plan, np.array([start + margin, end - margin]))

        def motion(t: float, y: Array, start: float = start, end: float = end, ends: Schedule = end_loads) -> Array:
            if time.perf_counter() > deadline:
                raise TimeLimitError
            tick()
            share = (t - start) / (end - start)
            between = (each[:1] + share * (each[1:] - each[:1]) for each in ends[1:])
            loads = Schedule(ends.slots, *between)
            u, v = y.reshape(2, *shape)
            return np.concatenate([v.ravel(), (accelerate(u, v, loads) * free).ravel()])

        times = np.union1d(frames, end)
        solution = solve_ivp(motion, (start, end), state, "DOP853", t_eval=times, rtol=rtol, atol=atol)
        if not solution.success:
            raise IntegrationError(f"after {solution.t[-1] if solution.t.size else start:.3g} s")
        state = solution.y[:, -1]
        evaluations += solution.nfev
        displacements += [column[: state.size // 2].reshape(shape) for column in solution.y.T[: len(frames)]]
    return np.array(displacements), evaluations


def acceleration_function(plan: Plan) -> Callable[[Array, Array, Schedule], Array]:
    """Build the right-hand side of eq. 1, divided by the mass.

    Returns:
        Function of displacements [m] and velocities [m/s], shape (rows, cols, 3), and of a schedule of one step, that
        returns accelerations [m/s2].
    """
    scene, material, families = plan.scene, plan.material, tuple(spring_families(plan))
    (dx, dy), (x, y) = spacing(scene.sheet), axes(scene.sheet)
    shares = area_shares(scene.sheet)
    area = shares if material.by_area else np.ones_like(shares)
    foundation = area if material.virtual_factors is None else area * material.virtual_factors
    probes = [probe_force(probe, scene.sheet) for probe in scene.probes]

    def laplacian(u: Array) -> Array:
        inner = u[1:-1, 1:-1]
        return (u[1:-1, 2:] - 2 * inner + u[1:-1, :-2]) / dx**2 + (u[2:, 1:-1] - 2 * inner + u[:-2, 1:-1]) / dy**2

    def accelerate(u: Array, v: Array, loads: Schedule) -> Array:
        force = elastic_force(families, u)
        force += foundation_force(material, loads.active[0] * material.virtual * foundation, u)
        for slot, strength, (at_x, at_y) in zip(loads.slots, loads.strength[0], loads.point[0], strict=True):
            probe = probes[slot.probe]
            decay = probe.decay(np.hypot(x - at_x, y - at_y)) * (shares if probe.by_area else 1)
            force += decay[..., None] * strength
        if material.bending:
            # The bending moment needs four neighbours; the border is fixed.
            moment = np.zeros_like(u)
            moment[1:-1, 1:-1] = material.bending * laplacian(u)
            force[1:-1, 1:-1] -= laplacian(moment)
        return np.asarray(force / (material.mass * area)[..., None] - material.drag * v)

    return accelerate


def _smooth_intervals(scene: Scene) -> Iterator[tuple[float, float, Array]]:
    """Split the time at the keyframes; yield start, end, and the times t of frames with start < t <= end."""
    frames = np.arange(1, scene.time.frames + 1) / scene.time.frames_per_second
    bounds = [0.0, *keyframe_times(scene), float(frames[-1])]
    for start, end in pairwise(bounds):
        # The margin absorbs rounding where a keyframe is at a frame.
        inside = frames[(frames > start * (1 + KEY_MARGIN)) & (frames <= end * (1 + KEY_MARGIN))]
        yield start, end, np.minimum(inside, end)
