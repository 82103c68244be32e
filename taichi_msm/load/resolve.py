"""Choose what a scene leaves open: the points and the step for its tolerances, and the precision."""

from __future__ import annotations

from typing import NamedTuple

from taichi_msm.accuracy.mesh import MeshEstimate, choose_points
from taichi_msm.accuracy.time_step import TimeStepEstimate, choose_step
from taichi_msm.errors import Count
from taichi_msm.load.check import checked
from taichi_msm.model.plan import Plan
from taichi_msm.solver import planning
from taichi_msm.solver.planning import with_chosen_grid
from taichi_msm.system.runtime import Device


class Resolved(NamedTuple):
    """A plan in which nothing is left open: its scene has the points, the step and the precision that were chosen."""

    plan: Plan
    estimate: TimeStepEstimate | None  # of the error, if a tolerance of the time required it
    mesh: MeshEstimate | None  # the error of the points, if a tolerance of the sheet required it


def resolve(plan: Plan, device: Device, progress: Count = lambda done, total: None) -> Resolved:
    """Choose what a checked scene leaves open, by pilot runs where it has tolerances; SceneError: none meet them."""
    estimate = mesh = None
    plan = planning.on(plan, device.arch)
    if plan.scene.sheet.tolerance is not None:
        plan, mesh = choose_points(plan, device, checked, progress)
    if plan.scene.time.tolerance is not None:
        plan, estimate = choose_step(plan, device, progress)
    return Resolved(with_chosen_grid(plan), estimate, mesh)
