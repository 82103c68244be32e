"""Choice of the companion runs that estimate the error of a run, before the run.

A companion run repeats the scene with another time step or another mesh, in parallel to the run. A coarse one, with
half the steps, costs half a run; a fine one, with twice the steps, costs two. Hence the first companion run is coarse
if twice the step is stable, and a fine one follows only after an error above NEGLIGIBLE_ERROR.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from taichi_msm.model.plan import Plan
from taichi_msm.solver.planning import affords_companions, min_stable_steps

# Beginnings of a run's warnings of the mesh, which sweeps report once.
MESH_DOUBT, MESH_REMEDY = "the mesh error may be larger", "for a smaller error of the mesh"

# A smaller error, as a fraction of the largest displacement, needs no fine companion run.
NEGLIGIBLE_ERROR = 1e-3

# Largest number of steps of a fine companion run, as a multiple of the run's. The error is unknown if the damping
# requires more.
MAX_STEP_RATIO = 64

# Cost of the companion runs on coarser meshes, in steps of the full mesh per step of the compared run. Without contact
# there are two, with 1/2 and 1/4 of the cells per side and of the steps; with contact there is one, with 1 / sqrt(2) of
# the cells per side and 1/2 of the steps.
MESH_COST, CONTACT_MESH_COST = 1 / 4 / 2 + 1 / 16 / 4, 1 / 2 / 2

# Cells per side of the second companion run on a coarser mesh with contact, relative to the run; its steps are as long
# relative to the stability limit, so that it does not become unstable before the run does.
SECOND_CELL_RATIO = 0.85
SECOND_MESH_COST = SECOND_CELL_RATIO**3

# Reason for a missing estimate in a quasi-static scene, which has no time step.
QUASISTATIC_REASON = "quasistatic"


class CompanionRuns(NamedTuple):
    """The choice of companion runs for a run, and their cost."""

    concurrent_steps: int = 0  # steps per frame of the companion run in parallel to the run; 0 without one
    # Steps per frame of the companion run that follows if the first one shows a large error; 0 without one.
    subsequent_steps: int = 0
    mesh: bool = False  # whether there are companion runs on coarser meshes
    cost: float = 0.0  # cost of the parallel companion runs, in steps of the full sheet per step of the run
    reason: str = ""  # reason for a missing estimate of the time-step error; empty if there is one
    second_mesh: bool = False  # whether a second run on a coarser mesh with contact may follow

    @property
    def planned(self) -> bool:
        """Whether any companion run is planned."""
        return self.mesh or not self.reason


def choose_companion_runs(plan: Plan, *, requested: bool = False) -> CompanionRuns:
    """Return the companion runs of a run and their cost, or the reason for a missing estimate.

    `requested` chooses an error estimate at any cost.
    """
    if plan.scene.time.at_rest:
        mesh = plan.scene.tissue is not None and (requested or affords_companions(plan, MESH_COST))
        second = mesh and plan.has_contact and (requested or affords_companions(plan, MESH_COST + SECOND_MESH_COST))
        return CompanionRuns(mesh=mesh, second_mesh=second, cost=MESH_COST if mesh else 0.0, reason=QUASISTATIC_REASON)
    steps, coarse, fine = plan.grid.steps_per_frame, coarse_steps(plan), fine_steps(plan)
    mesh_cost = (CONTACT_MESH_COST if plan.has_contact else MESH_COST) if plan.scene.tissue is not None else 0.0
    # For a run in f32, a fine companion run needs another one in f64 with the run's own steps.
    fine_cost = fine / steps + (plan.grid.precision == "f32")
    if not coarse:
        cost = fine_cost + mesh_cost
    elif plan.has_contact:
        cost = coarse / steps + mesh_cost
    else:
        # Coarser meshes are compared with the coarse companion run, whose steps are longer.
        cost = (1 + mesh_cost) * coarse / steps
    if not requested and not affords_companions(plan, cost):
        reason = "it would take more than two fifths of the run; to have it anyway, pass --estimate-error"
        return CompanionRuns(reason=reason)
    # Without stored positions, a subsequent companion run requires a repetition of the run.
    repetition = 0.0 if plan.scene.output else 1.0

    def affords(subsequent_cost: float) -> bool:
        return requested or affords_companions(plan, cost + subsequent_cost + repetition)

    second = mesh_cost > 0 and plan.has_contact and affords(SECOND_MESH_COST)
    first, subsequent = (coarse, fine if affords(fine_cost) else 0) if coarse else (fine, 0)
    return CompanionRuns(first, subsequent, mesh_cost > 0, cost, second_mesh=second)


def coarse_steps(plan: Plan) -> int:
    """Return the steps per frame of the coarse companion run, half of the run's; 0 if unstable or too expensive."""
    run_steps = plan.grid.steps_per_frame
    steps = max(math.ceil(run_steps / 2), min_stable_steps(plan))
    # A companion run with more than 0.6 of the run's steps saves too little.
    return steps if steps <= 0.6 * run_steps else 0


def fine_steps(plan: Plan) -> int:
    """Return the steps per frame of the fine companion run, r times the run's; 0 if r > `MAX_STEP_RATIO` is required.

    r is 2, or with strong damping at least g h, with g = C / m. With a smaller r, central differences would reverse the
    velocities at every step, and the two runs would differ by less than the error.
    """
    refinement = max(2, math.ceil(plan.material.drag * plan.grid.step))
    return refinement * plan.grid.steps_per_frame if refinement <= MAX_STEP_RATIO else 0
