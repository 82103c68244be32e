"""Which pilots estimate the error of a run: the cheapest that tell it, decided from the scene alone.

A pilot with half as many steps costs half a run, one with twice as many costs two. So the first pilot is coarse, where
twice the step is stable, and a finer one follows only where the first one shows an error that matters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from taichi_msm.model.plan import Plan
from taichi_msm.solver.planning import affords_companions, stable_steps

# An error below this needs no finer pilot: nobody sees it, and twice as much or half of it would mean the same.
ENOUGH = 1e-3

# A coarse pilot takes at most this share of the run's steps; else it saves too little.
COARSEST = 0.6

# The largest refinement of a fine pilot; if it would have to be finer, the error is not known.
FINEST = 64

# Steps of the pilots for the points, for each step of what they are compared with, in steps of the whole sheet: half
# and a quarter of the cells a side, and of the steps; with contact 1 / sqrt(2) of the cells a side and half the steps.
POINTS, POINTS_IN_CONTACT = 1 / 4 / 2 + 1 / 16 / 4, 1 / 2 / 2


# Why there is no error of the step where the sheet is at rest.
AT_REST = "quasistatic"


class Pilots(NamedTuple):
    """The pilots of a run."""

    beside: int = 0  # steps per frame of the pilot that goes with the run; 0: there is none
    after: int = 0  # steps per frame of the one that follows if the first one shows too large an error; 0: none
    points: bool = False  # whether pilots with fewer points go with the run
    cost: float = 0.0  # of those that go with the run: for each of its steps theirs, in steps of the whole sheet
    reason: str = ""  # why there are none for the step

    @property
    def some(self) -> bool:
        """Whether there are any."""
        return self.points or not self.reason


def choose_pilots(plan: Plan, *, asked: bool = False) -> Pilots:
    """Choose the pilots of a run; asked: whatever they cost. At rest there are none for a step."""
    if plan.scene.time.at_rest:
        tells = plan.scene.tissue is not None and (asked or affords_companions(plan, POINTS))
        return Pilots(points=tells, cost=POINTS if tells else 0.0, reason=AT_REST)
    own, coarse, fine = plan.grid.steps_per_frame, coarse_steps(plan), fine_steps(plan)
    points = (POINTS_IN_CONTACT if plan.tools else POINTS) if plan.scene.tissue is not None else 0.0
    # Beside a run in f32 a fine pilot has another one with the run's own steps.
    fine_cost = fine / own + (plan.grid.precision == "f32")
    first = (1 + points) * coarse / own if coarse else fine_cost + points
    if coarse and plan.tools:
        first = coarse / own + points  # Those for the points are compared with the run, not with the coarse pilot.
    if not asked and not affords_companions(plan, first):
        return Pilots(reason="it would take more than two fifths of the run; to have it anyway, pass --estimate-error")
    if not coarse:
        return Pilots(fine, 0, points > 0, first)
    # Where no positions are kept, the run is repeated beside the pilot that follows.
    again = 0.0 if plan.scene.output else 1.0
    follows = asked or affords_companions(plan, first + fine_cost + again)
    return Pilots(coarse, fine if follows else 0, points > 0, first)


def coarse_steps(plan: Plan) -> int:
    """Count the steps per frame of the coarse pilot: half of the run's; 0: no such run is stable, or cheap enough."""
    own = plan.grid.steps_per_frame
    steps = max(math.ceil(own / 2), stable_steps(plan))
    return steps if steps <= COARSEST * own else 0


def fine_steps(plan: Plan) -> int:
    """Count the steps per frame of the fine pilot: twice the run's, or as many as resolve the damping; 0: too many.

    If g h / r > 1, with g = C / m, central differences make velocities change their sign at every step, and the
    difference between runs with steps h and h / r does not show all of it. A coarse pilot shows 2 to 4 times as much.
    """
    refinement = max(2, math.ceil(plan.material.drag * plan.grid.step))
    return refinement * plan.grid.steps_per_frame if refinement <= FINEST else 0
