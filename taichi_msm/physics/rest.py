"""The sheet at rest: every frame is the equilibrium under its loads, found from the frame before.

A frame is done when the largest force that is left on a point is at most ENOUGH of the largest force of a spring, a
load or the foundation. FIRE (`kernel_rest`) follows the forces down from the frame before, with masses of its own, so
that a sheet that has buckled goes on as it has begun.

A balance need not be stable: a flat sheet that is pressed together in its plane stays flat as long as nothing disturbs
it. So every frame is disturbed once, when only the share DISTURBED of the forces is left: each point is moved at
random, by no more than these forces would move it. Where the balance is stable this dies out with the rest of the
motion. Where it is not it grows, about as fast as a mode dies out that is as stiff, and FIRE goes on to where the sheet
buckles. So an instability that is much weaker than the softest mode of the sheet may go unnoticed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError
from taichi_msm.faults import SMALLEST
from taichi_msm.physics.divergence import farthest
from taichi_msm.physics.kernel import SheetLayout, Start
from taichi_msm.physics.kernel_rest import Relaxation
from taichi_msm.physics.loads import frame_loads
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.state import Reading, State
from taichi_msm.physics.terms import inertia
from taichi_msm.progress import Pause
from taichi_msm.system.runtime import Device

# A frame is done when the forces left are this share of the largest; it is disturbed when they are that share.
ENOUGH, DISTURBED = 1e-7, 1e-3

# A frame takes at most so many evaluations for each point of the longer side; one that buckles takes up to 200.
MOST_EVALUATIONS = 2000

# A launch evaluates the forces at most so many times, and of so many points in all, about 0.1 s of a core.
PER_LAUNCH, POINTS_PER_LAUNCH = 64, 40_000_000


class Rest(Dynamics):
    """The sheet at rest, in the place of the sheet in motion: a frame is a step.

    Attributes:
        evaluations: of the forces so far.
        residual: of the last frame: the largest force left, as a share of the largest force.
    """

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Begin again, as `Dynamics` does; without a state the first frame is yet to be found."""
        self.evaluations, self.residual = 0, 0.0
        self._settled = None if state is None else state.displacement
        super().restart(plan, state)

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Find the shape of the first frame, if that is yet to be done, and of so many more, with pauses.

        After an exception from a pause another call begins anew from the last frame that was found.

        Raises:
            DivergedError: when there is no shape in which the forces balance, or it was not found.
        """
        self._require_whole()
        end = self.steps_done + steps
        while self._settled is None or self.steps_done < end:
            frame = self.steps_done + (self._settled is not None)
            self._settle(frame, pause)
            self.steps_done = frame

    def compile(self) -> None:
        """Compile everything without moving anything."""
        row = self._columns(frame_loads(self.plan, 0))
        self._relaxation.relax(0, 0.0, row)
        self._relaxation.scale(row)
        self.displacement()

    def state(self) -> State:
        """Read everything that the next frames depend on."""
        displacement = self._copy(differences=False)[0] if self._settled is None else self._settled
        return State(self.steps_done, displacement, np.zeros_like(displacement))

    def read(self) -> Reading:
        """Read the displacements and measure the sheet; its energy is that of springs and bending."""
        reading = super().read()
        return reading._replace(residual=self.residual, evaluations=self.evaluations)

    def _started(self, start: Start) -> Any:
        self._astray = self._settled is None
        # A point without any stiffness has no place to rest either.
        self._masses = np.maximum(inertia(self.plan), SMALLEST)
        return Relaxation(self.structure, start, self._masses)

    @property
    def _relaxation(self) -> Relaxation:
        assert isinstance(self._sheet, Relaxation), "it is closed"
        return self._sheet

    def _tabulate(self, count: int) -> None:
        """Leave it: the loads of a frame are found when it is its turn."""

    def _of_motion(self, _sums: NDArray[Any]) -> float:
        return 0.0

    def _settle(self, frame: int, pause: Pause) -> None:
        """Find the shape of a frame, and keep it."""
        relaxation, loads = self._relaxation, frame_loads(self.plan, frame)
        row, points = self._columns(loads), self.structure.rows * self.structure.cols
        # Where nothing presses, the sheet comes back; without tension a flat sheet has no stiffness that would say how.
        if self._settled is None or not loads.strength.any():
            relaxation.place(np.zeros((self.structure.rows, self.structure.cols, 3)))
        elif self._astray:
            relaxation.place(self._settled)
        relaxation.stop()
        self._astray = True
        per_launch = max(1, min(PER_LAUNCH, POINTS_PER_LAUNCH // points))
        most = MOST_EVALUATIONS * max(self.structure.rows, self.structure.cols)
        evaluations, disturbed, scale = 0, False, relaxation.scale(row)
        while True:
            # The first evaluation tells whether there is anything to do.
            first = evaluations == 0
            enough = (ENOUGH if first or disturbed else DISTURBED) * scale
            done, left = relaxation.relax(1 if first else min(per_launch, most - evaluations), enough, row)
            evaluations += done
            scale = relaxation.scale(row)
            if left <= min(enough, ENOUGH * scale):
                break
            if not (left < np.inf and scale < np.inf) or evaluations >= most:
                raise self._diverged(frame, left / scale, evaluations)
            if left <= enough and not disturbed:
                self._disturb(left)
                disturbed = True
            pause()
        self._astray = False
        self._settled = self._copy(differences=False)[0]
        self.evaluations += evaluations
        self.residual = left / scale if scale > 0 else 0.0

    def _disturb(self, force: float) -> None:
        """Move every point at random, by at most what a force [N] moves it; always in the same way."""
        rows, cols = self.structure.rows, self.structure.cols
        # This generator gives the same numbers with every version of NumPy.
        noise = 2 * np.random.RandomState(0).random_sample((rows, cols, 3)) - 1
        moves = (~self.plan.fixed / self._masses)[..., None]
        self._relaxation.place(self._copy(differences=False)[0] + force * noise * moves)

    def _diverged(self, frame: int, left: float, evaluations: int) -> DivergedError:
        """Say that no shape was found, how far the forces were from balance, and what may help."""
        plan, time = self.plan, frame / self.plan.grid.frames_per_second
        row, column, *_ = farthest(self._copy(differences=True)[0])
        held = plan.fixed.any() or plan.material.virtual > 0
        remedy = (
            "the sheet may fold or wrinkle without end; take a weaker load, tissue.bending or pretension, or "
            "time.motion: dynamic"
            if held
            else "nothing holds the sheet; fix a side, or give it a foundation"
        )
        said = (
            f"diverged at {time:.6g} s, frame {frame}: no shape was found in which the forces balance: after "
            f"{evaluations} evaluations, {left:.2g} of the largest force is left at point ({row}, {column}), and "
            f"{ENOUGH:g} was wanted; {remedy}"
        )
        return DivergedError(said, frame, time, (row, column))


def sheet_of(plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> Dynamics:
    """Make the sheet of a plan, in motion or at rest; arguments as for `Dynamics`."""
    return (Rest if plan.scene.time.at_rest else Dynamics)(plan, device, layout, cores)
