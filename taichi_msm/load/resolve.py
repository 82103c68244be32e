"""Choice of the open settings of a scene: mass points, time step and precision.

Unlike validation (check.py), this starts the compiler.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from taichi_msm.accuracy.mesh import MeshEstimate, choose_points
from taichi_msm.accuracy.time_step import TimeStepEstimate, choose_step
from taichi_msm.errors import ProgressCallback, SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import freeze_surface
from taichi_msm.solver import planning
from taichi_msm.solver.planning import freeze_grid
from taichi_msm.system.runtime import Device


class ResolvedPlan(NamedTuple):
    """Plan with all settings chosen."""

    plan: Plan  # its scene contains the chosen numbers of mass points, time step and precision
    estimate: TimeStepEstimate | None  # of the time-step error; None without `time.tolerance`
    mesh: MeshEstimate | None  # of the discretisation error; None without `sheet.tolerance`


def resolve(plan: Plan, device: Device, progress: ProgressCallback = lambda done, total: None) -> ResolvedPlan:
    """Choose the open settings of a scene; for a scene with tolerances, by trial runs."""
    estimate = mesh = None
    plan = planning.choose_precision(plan, device.arch)
    # The plan was checked for a CPU, where `auto` may choose another precision.
    if problems := [str(problem) for problem in planning.precision_problems(plan)]:
        raise SceneError(problems)
    if plan.scene.sheet.tolerance is not None:
        plan, mesh = choose_points(plan, device, check_scene, progress)
    if plan.scene.time.tolerance is not None:
        plan, estimate = choose_step(plan, device, progress)
    plan = freeze_grid(plan)
    sheet = freeze_surface(plan.scene.sheet)
    return ResolvedPlan(replace(plan, scene=plan.scene.model_copy(update={"sheet": sheet})), estimate, mesh)
