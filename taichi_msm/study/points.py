"""Work and precision of the number of points: tissue with a quarter, half and twice the cells a side."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.divergence import farthest_displacement
from taichi_msm.physics.error_control import longest
from taichi_msm.physics.mesh_error import FEWEST, CubicSampling, MeshPilot, companion, with_points
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import try_plan, variant, with_time
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count
from taichi_msm.scene import MAX_POINTS
from taichi_msm.scenefile import budget
from taichi_msm.study.result import Points, Study
from taichi_msm.system.runtime import Device

# Cells a side, relative to those of the scene.
COARSER = (1 / 4, 1 / 2)
FINER = 2

# How many times every sheet is timed; all sheets take turns.
ROUNDS = 5

# An error counts as known if it is at least this many times the bound of the reference's own error.
MARGIN = 5

Field = NDArray[Any]
Lattice = tuple[int, int]


class _Sheet(NamedTuple):
    """A sheet with some number of points, and what is known about it so far."""

    plan: Plan
    dynamics: Dynamics
    measured: Points


class PointStudy:
    """Measures the error and the speed of a sheet of tissue with more or fewer points, in f64.

    Errors are measured with the same steps for all sheets, so that the errors of the step cancel. Times are measured
    with the automatic step of each sheet, which is longer for fewer points.

    The reference is a sheet with more points than all those listed, if there is time for it. Otherwise it is the finest
    of those listed, whose own error is then known only as a bound.

    A run takes up to about `longest_run` seconds; the reference, which is run only once, as long as all the runs
    together by which another sheet is timed. The results in `study` come with the fewest points first; `progress` may
    raise KeyboardInterrupt: they stay.
    """

    def __init__(self, plan: Plan, device: Device, longest_run: float, study: Study, progress: Count) -> None:
        scene = with_time(plan.scene, step="auto", tolerance=None, precision="f64")
        self._plan = variant(plan, with_points(scene, scene.sheet.points))
        self._device, self._longest_run, self._study, self._progress = device, longest_run, study, progress
        self._sheets: list[_Sheet] = []
        self._done = 0

    def run(self) -> None:
        """Compute the estimates, then the errors, then measure the times; with springs nothing.

        Other points would make another sheet of springs.
        """
        if self._plan.scene.tissue is None:
            return
        with ExitStack() as opened:
            seconds = 0.0
            for plan in lattices(self._plan):
                seconds = self._try(plan, opened)
            if not self._sheets:
                said = f"points were not measured: with fewer than {FEWEST} a side they cannot be compared"
                self._study.notes.append(said)
                return
            finer = self._finer(self._plan, seconds, self._longest_run)
            if finer is None:
                rows, cols = _scaled(self._plan, FINER)
                self._study.notes.append(f"{rows} x {cols} points were not measured: time or memory")
            else:
                seconds = self._try(finer, opened)
                finer = self._finer(finer, seconds, ROUNDS * self._longest_run)
            if len(self._sheets) < 2:
                return
            self._measure_errors(finer)
            for _ in range(ROUNDS):
                for sheet in self._sheets:
                    sheet.measured.samples.append(self._step_through(sheet))

    def _try(self, plan: Plan, opened: ExitStack) -> float:
        """Run a sheet with its own step beside the pilot that `run` would have; returns the time of stepping [s]."""
        dynamics = opened.enter_context(closing(Dynamics(plan, self._device)))
        sheet = _Sheet(plan, dynamics, Points(*plan.scene.sheet.points, plan.grid.steps_per_frame))
        coarse = companion(plan)
        assert coarse is not None
        self._sheets.append(sheet)
        self._study.points.append(sheet.measured)
        self._tick()
        dynamics.compile()
        pilot = MeshPilot(plan, coarse, self._device)
        pilot.compile()
        first = self._step_through(sheet, pilot)
        # The faster of two runs: what disturbs one may not disturb the other.
        seconds = min(first, self._step_through(sheet, pilot.nearer(plan, self._device)))
        estimate = pilot.estimate.error
        sheet.measured.estimate = estimate if estimate < math.inf else None
        return seconds

    def _finer(self, plan: Plan, seconds: float, longest_run: float) -> Plan | None:
        """Plan more points than a plan has, through which it took `seconds` to step.

        Returns:
            The plan; None if stepping through it would take longer than `longest_run` [s], or too much memory.
        """
        points = _scaled(plan, FINER)
        if max(points) > MAX_POINTS:
            return None
        finer = variant(plan, with_points(plan.scene, points))
        work = [math.prod(one.scene.sheet.points) * one.grid.steps_per_frame for one in (plan, finer)]
        return None if seconds * work[1] / work[0] > longest_run or any(budget.size_problems(finer)) else finer

    def _measure_errors(self, finer: Plan | None) -> None:
        """Step through the scene with all sheets side by side, and with a finer one if any; compare every frame."""
        finest = self._sheets[-1].plan if finer is None else finer
        grid = finest.grid
        with ExitStack() as opened:
            sheets = [sheet.dynamics for sheet in self._sheets]
            if finer is not None:
                sheets.append(opened.enter_context(closing(Dynamics(finer, self._device))))
                sheets[-1].compile()
            for sheet in sheets:
                sheet.restart(sheet.plan.with_grid(steps_per_frame=grid.steps_per_frame))
            errors, own_error, largest = [0.0] * len(sheets), 0.0, 0.0
            for _ in range(grid.frames):
                for sheet in sheets:
                    self._tick()
                    sheet.advance(grid.steps_per_frame)
                fields = [sheet.displacement() for sheet in sheets]
                with np.errstate(all="ignore"):
                    exact, bound = _reference(fields, extrapolate=not finest.tools)
                    apart = [longest(_sampled(one, exact) - exact) for one in fields[:-1]]
                    # Between the points of the finest sheet, its error is not known. But if its order is 1 or more, it
                    # is at most its distance from a sheet that is twice as coarse.
                    apart.append(longest(_sampled(fields[-2], fields[-1]) - fields[-1]))
                errors = [max(pair) for pair in zip(errors, apart, strict=True)]
                own_error, largest = max(own_error, bound), max(largest, longest(exact))
            self._done += 1
        farthest = farthest_displacement(finest, finest.scene.time.duration)
        if not largest <= farthest:
            return
        for (plan, _, measured), error in zip(self._sheets, errors, strict=False):
            if plan is not finest:
                measured.known = error >= MARGIN * own_error
                error += 0.0 if measured.known else own_error
            share = error / largest if largest > 0 else 0.0
            measured.error = share if share < math.inf else None

    def _step_through(self, sheet: _Sheet, pilot: MeshPilot | None = None) -> float:
        """Step through the scene with the sheet's own step; returns the time of stepping alone [s]."""
        plan, dynamics, _ = sheet
        dynamics.restart(plan)
        seconds = 0.0
        for _ in range(plan.grid.frames):
            self._tick()
            start = time.perf_counter()
            dynamics.advance(plan.grid.steps_per_frame)
            seconds += time.perf_counter() - start
            displacement = dynamics.displacement()
            if pilot is not None:
                pilot.follow(displacement, self._tick)
        self._done += 1
        return seconds

    def _tick(self) -> None:
        # For each sheet the estimate, another run and the rounds; for all of them together the errors.
        self._progress(self._done, 1 + (2 + ROUNDS) * len(self._sheets))


def lattices(plan: Plan) -> Iterator[Plan]:
    """Plan the numbers of points to compare, as far as the scene allows them; its own come last."""
    for share in COARSER:
        points = _scaled(plan, share)
        coarse, _ = try_plan(with_points(plan.scene, points), plan.maps) if min(points) >= FEWEST else (None, [])
        if coarse is not None:
            yield coarse
    if min(plan.scene.sheet.points) >= FEWEST:
        yield plan


def _scaled(plan: Plan, factor: float) -> Lattice:
    """Give the rows and columns of points for `factor` times the cells a side."""
    rows, cols = (round((count - 1) * factor) + 1 for count in plan.scene.sheet.points)
    return rows, cols


def _reference(fields: list[Field], *, extrapolate: bool) -> tuple[Field, float]:
    """Extrapolate the two finest fields by Richardson, for an error of order 2 in the length of cells.

    u* = u + (u - u_r) / (r^2 - 1), where u_r has cells r times as long. The correction is computed at the points of u_r
    and interpolated at those of u. The error of u* is at most about its distance from the extrapolation of the next two
    fields, or of u from u_r if there are only two.

    Args:
        fields: two or more of displacements [m], the fewest points first, each of shape (rows, cols, 3).
        extrapolate: whether to; else, as with contact, which has a lower order, u* is the finest one.

    Returns:
        u* at the points of the finest field [m], and an approximate bound of its error [m].
    """
    if not extrapolate:
        return fields[-1], longest(_sampled(fields[-1], fields[-2]) - fields[-2])
    exact = fields[-1] + _sampled(_correction(fields[-1], fields[-2]), fields[-1])
    if len(fields) > 2:
        before = fields[-2] + _sampled(_correction(fields[-2], fields[-3]), fields[-2])
    else:
        before = _sampled(fields[-1], fields[-2])
    return exact, longest(_sampled(exact, before) - before)


def _correction(fine: Field, coarse: Field) -> Field:
    """Compute the correction of Richardson's extrapolation at the points of the coarse field."""
    ratio = min((of - 1) / (to - 1) for of, to in zip(fine.shape[:2], coarse.shape[:2], strict=True))
    correction: Field = (_sampled(fine, coarse) - coarse) / (ratio**2 - 1)
    return correction


def _sampled(values: Field, like: Field) -> Field:
    """Interpolate a field at the points of another one."""
    (rows, cols), (to_rows, to_cols) = values.shape[:2], like.shape[:2]
    return CubicSampling((rows, cols), (to_rows, to_cols)).at(values)
