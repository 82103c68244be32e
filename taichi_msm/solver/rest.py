"""The sheet at rest: every frame is the equilibrium under its loads and tools, found from the frame before.

A frame is done when the largest force that is left on a point is at most ENOUGH of the largest force of a spring, a
load or the foundation. FIRE (`kernel_rest`) follows the forces down from the frame before, with masses of its own, so
that a sheet that has buckled goes on as it has begun. Tools that are moved come by at most half a radius between
shapes, of which those between two frames are found less closely.

A balance need not be stable: a flat sheet that is pressed together in its plane stays flat as long as nothing disturbs
it. So every frame is disturbed once, when only the share DISTURBED of the forces is left: each point is moved at
random, by no more than these forces would move it. Where the balance is stable this dies out with the rest of the
motion. Where it is not, the forces do not vanish, and FIRE goes on to where the sheet buckles. Only a sheet with
springs that are pressed together, or on a rod, can give way; there the search goes on to the share SURE, for up to four
times the evaluations. So a weak instability may go unnoticed: 1 % above a critical load, but not 3 %
(tests/solver/test_rest.py).

Where nothing holds the sheet or is in its way any more, it is flat: without tension it has no stiffness out of its
plane, so that the forces would never tell the way back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError, Pause
from taichi_msm.model.loads import frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import GRASP, Tool, grip_frames
from taichi_msm.scene.section import MIN_MAGNITUDE
from taichi_msm.solver.arrays import SheetLayout, Start
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.kernel_rest import Relaxation
from taichi_msm.solver.state import Reading, State, farthest
from taichi_msm.system.runtime import Device
from taichi_msm.terms import inertia
from taichi_msm.terms.contact import AFTER, COLUMNS, HELD, PUSHES, SINCE, TAKEN, TOOL_COLUMNS, ContactTerm

# A frame is done when the forces left are this share of the largest; it is disturbed when they are that share. Where
# the balance may not be stable, the search goes on to a smaller share.
ENOUGH, DISTURBED, SURE = 1e-7, 1e-3, 1e-9

# Where no force is larger, there is none [N].
NOTHING = 1e-30

# Springs may be this much shorter than without any force before they count as pushing.
SLACK = 1e-9

# A shape takes at most so many evaluations for each point of the longer side; one that buckles takes up to 200.
MOST_EVALUATIONS = 2000

# A launch evaluates the forces at most so many times, and of so many points in all, about 0.1 s of a core.
PER_LAUNCH, POINTS_PER_LAUNCH = 64, 40_000_000

Array = NDArray[np.float64]


class Rest(Dynamics):
    """The sheet at rest, in the place of the sheet in motion: a frame is a step.

    Attributes:
        evaluations: how often the forces were evaluated for the last frame.
        residual: of the last frame: the largest force left, as a share of the largest force.
    """

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Begin again, as `Dynamics` does; without a state the first frame is yet to be found."""
        self.evaluations, self.residual = 0, 0.0
        self._settled = state
        super().restart(plan, state)

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Find the shape of the first frame, if that is yet to be done, and of so many more, with pauses.

        After an exception from a pause another call begins anew from the last frame that was found.

        Raises:
            DivergedError: when no shape was found in which the forces balance.
        """
        self._require_whole()
        end = self.steps_done + steps
        while self._settled is None or self.steps_done < end:
            frame = self.steps_done + (self._settled is not None)
            self._settle(frame, pause)
            self.steps_done = frame
            displacement = self._copy(differences=False)[0]
            self._settled = State(frame, displacement, np.zeros_like(displacement), self._contact())

    def compile(self) -> None:
        """Compile everything without moving anything."""
        row = self._columns(frame_loads(self.plan, 0), 0)
        self._relaxation.relax(0, 0.0, row)
        self._relaxation.scale(row)
        self.displacement()

    def state(self) -> State:
        """Read everything that the next frames depend on: the last frame that was found."""
        return self._before

    def read(self) -> Reading:
        """Read the displacements and measure the sheet; its energy is that of springs and bending."""
        reading = super().read()
        return reading._replace(residual=self.residual, evaluations=self.evaluations)

    def tool_forces(self) -> Array:
        """Give the force of each tool that is moved on the sheet [N], shape (tools, 3).

        It is minus the sum of all other forces on the points that the tool touches or holds.
        """
        # Not -0.
        return 0.0 - np.einsum("tij,ijk->tk", self._touched().astype(float), self._copy(differences=True)[0])

    def _touched(self) -> NDArray[np.bool_]:
        """Tell which points each tool touches or holds, shape (tools, rows, cols)."""
        tools, contact = len(self.plan.tools), self._contact()
        normals = contact[: PUSHES * tools].reshape(tools, PUSHES, self.structure.rows, self.structure.cols)
        touched = (normals != 0).any(axis=1)
        if len(contact) > PUSHES * tools:
            touched |= contact[PUSHES * tools + HELD] == np.arange(1, tools + 1)[:, None, None]
        return np.asarray(touched)

    def _started(self, start: Start) -> Any:
        self._astray = False
        # A point without any stiffness has no place to rest either.
        self._masses = np.maximum(inertia(self.plan), MIN_MAGNITUDE)
        return Relaxation(self.structure, start, self._masses)

    @property
    def _relaxation(self) -> Relaxation:
        assert isinstance(self._sheet, Relaxation), "it is closed"
        return self._sheet

    @property
    def _before(self) -> State:
        """The last frame that was found; before the first one, the flat sheet."""
        if self._settled is not None:
            return self._settled
        shape, contact = (self.structure.rows, self.structure.cols), self.structure.code.get(ContactTerm)
        none = np.zeros((0 if contact is None else contact.field_count, *shape))
        return State(0, np.zeros((*shape, 3)), np.zeros((*shape, 3)), none)

    def _tabulate(self, count: int) -> None:
        """Leave it: the loads of a frame are found when it is its turn."""

    def _of_motion(self, _sums: NDArray[Any]) -> float:
        return 0.0

    def _settle(self, frame: int, pause: Pause) -> None:
        """Find the shape of a frame."""
        self.evaluations = 0
        relaxation, before, loads = self._relaxation, self._before, frame_loads(self.plan, frame)
        contact = self._gripping(frame, before)
        held = PUSHES * len(self.plan.tools) + HELD
        held_before, holds = (len(fields) > held and bool(fields[held].any()) for fields in (before.contact, contact))
        if len(contact):
            relaxation.arrays.set_fields(self.structure.code.first_field(ContactTerm), contact)
        if self._astray:
            relaxation.place(before.displacement)
        self._astray, left = True, 0.0
        *ways, end = self._times(frame)
        for time in (*ways, end):
            row = self._at(time, frame, self._columns(loads, frame))
            # What is let go falls, whatever tool is in its way.
            free = not loads.strength.any() and not holds and (held_before or not self._meets_tool(time))
            if free and self._falls_flat(row):
                left = 0.0
            else:
                left = self._relax(frame, row, ENOUGH if time == end else DISTURBED, pause)
        self._astray, self.residual = False, left

    def _meets_tool(self, time: float) -> bool:
        """Tell whether a tool at that time is in the way of the sheet as it is."""
        place = rest_positions(self.plan.scene.sheet) + self._copy(differences=False)[0]
        return any(tool.touches(place[~self.plan.fixed], time) for tool in self.plan.tools)

    def _falls_flat(self, row: NDArray[Any]) -> bool:
        """Lay the sheet flat, if it stays so."""
        relaxation, shape = self._relaxation, self._copy(differences=False)[0]
        relaxation.place(np.zeros_like(shape))
        done, left = relaxation.relax(1, 0.0, row)
        self.evaluations += done
        if left > 0:
            relaxation.place(shape)
        return left == 0

    def _times(self, frame: int) -> list[float]:
        """List the times of the shapes on the way to a frame, and that of the frame itself."""
        rate = self.plan.grid.frames_per_second
        begin, end = max(0, frame - 1) / rate, frame / rate
        return sorted({end, *(float(time) for tool in self.plan.tools for time in tool.strides(begin, end))})

    def _at(self, time: float, frame: int, row: NDArray[Any]) -> NDArray[Any]:
        """Put the tools in a row of the table of loads where they are at a time on the way to a frame."""
        for n, tool in enumerate(self.plan.tools):
            own = self.structure.code.first_column(ContactTerm) + COLUMNS + TOOL_COLUMNS * n
            middle = tool.middle(np.array([time]))[0]
            row[0, own + AFTER : own + AFTER + 3] = middle
            for taken in self._held(tool, frame):
                row[0, own + SINCE : own + SINCE + 3] = middle - self._taken_at(tool, taken)
        return row

    def _held(self, tool: Tool, frame: int) -> Iterator[int]:
        """Give the grip of a tool at a frame, if any: the frame when it began."""
        for grip in tool.grips:
            frames = grip_frames(grip, self.plan.grid.frames_per_second)
            if frame in frames:
                yield frames.start

    def _taken_at(self, tool: Tool, frame: int) -> Array:
        """Tell where a tool was when it took hold at a frame: with the points as they were the frame before."""
        return tool.middle(np.array([max(0, frame - 1) / self.plan.grid.frames_per_second]))[0]

    def _gripping(self, frame: int, before: State) -> NDArray[Any]:
        """Give the fields of contact at the start of a frame: grips that end let go, and others take hold."""
        tools, contact = self.plan.tools, before.contact.copy()
        if len(contact) == PUSHES * len(tools):
            return contact
        held, taken = contact[PUSHES * len(tools) + HELD], contact[PUSHES * len(tools) + TAKEN :]
        place = rest_positions(self.plan.scene.sheet) + before.displacement
        begun = [frame in self._held(tool, frame) for tool in tools]
        for n, tool in enumerate(tools):
            if begun[n] or not list(self._held(tool, frame)):
                held[held == n + 1] = 0
        for n, tool in enumerate(tools):
            if begun[n]:
                near = np.linalg.norm(place - self._taken_at(tool, frame), axis=-1) <= GRASP * tool.radius
                takes = near & ~self.plan.fixed & (held == 0)
                held[takes] = n + 1
                taken[:, takes] = before.displacement[takes].T
        return contact

    def _relax(self, frame: int, row: NDArray[Any], wanted: float, pause: Pause) -> float:
        """Let the points go to where at most a share of the forces is left; returns that share."""
        relaxation, longer = self._relaxation, max(self.structure.rows, self.structure.cols)
        relaxation.stop()
        per_launch = max(1, min(PER_LAUNCH, POINTS_PER_LAUNCH // (self.structure.rows * self.structure.cols)))
        most, evaluations, disturbed = MOST_EVALUATIONS * longer, 0, wanted >= DISTURBED
        scale, last = max(NOTHING, relaxation.scale(row)), math.inf
        while True:
            # The first evaluation tells whether there is anything to do.
            first = evaluations == 0
            enough = (wanted if first or disturbed else DISTURBED) * scale
            done, left = relaxation.relax(1 if first else min(per_launch, most - evaluations), enough, row)
            evaluations += done
            scale = max(NOTHING, relaxation.scale(row))
            if left <= min(enough, wanted * scale):
                if wanted == ENOUGH and not first and evaluations < last and self._may_give():
                    # A balance that is not stable shows while these evaluations last.
                    wanted, last = SURE, 4 * evaluations
                    continue
                self.evaluations += evaluations
                return left / scale
            if wanted == SURE and (left > 10 * ENOUGH * scale or evaluations >= last):
                wanted = ENOUGH
            if not (left < np.inf and scale < np.inf) or evaluations >= most:
                raise self._diverged(frame, left / scale, evaluations)
            if left <= enough and not disturbed:
                self._disturb(left)
                disturbed = True
            pause()

    def _may_give(self) -> bool:
        """Tell whether a spring is pressed together, or a point rests on a rod; else every balance is stable."""
        material = self.plan.material
        stiffest = 1.0 if material.factors is None else float(material.factors.max())
        pressed = super().read().shortest_spring < 1 - material.tension / stiffest - SLACK
        return pressed or bool(self._touched().any())

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
        remedy = (
            "the sheet may hang slack, fold or wrinkle; give it a foundation, pretension or bending, or take less load"
        )
        if not (plan.fixed.any() or plan.material.virtual > 0):
            remedy = "nothing holds the sheet; fix a side, or give it a foundation"
        elif (self._touched().sum(axis=0) > 1).any():
            remedy = "two tools press on one point; keep them apart"
        said = (
            f"diverged at {time:.6g} s, frame {frame}: no shape was found in which the forces balance: after "
            f"{evaluations} evaluations, {left:.2g} of the largest force is left at point ({row}, {column}), and "
            f"{ENOUGH:g} was wanted; {remedy}"
        )
        return DivergedError(said, frame, time, (row, column))


def sheet_of(plan: Plan, device: Device, layout: SheetLayout | None = None, cores: int | None = None) -> Dynamics:
    """Make the sheet of a plan, in motion or at rest; arguments as for `Dynamics`."""
    return (Rest if plan.scene.time.at_rest else Dynamics)(plan, device, layout, cores)
