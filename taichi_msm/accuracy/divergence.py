"""Signs that a simulation has diverged: NaN, a point too far away, or more energy than the load can have supplied."""

from __future__ import annotations

import math

import numpy as np

from taichi_msm.accuracy.contact_warnings import piercing
from taichi_msm.accuracy.energy_growth import EnergyGrowth
from taichi_msm.model.loads import LoadBounds
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import spacing
from taichi_msm.solver.state import LargestDisplacement, Reading, RunProgress, largest_displacement
from taichi_msm.terms import TERMS
from taichi_msm.terms.foundation import FoundationTerm
from taichi_msm.terms.loads import force_norm, max_free_acceleration

# No deformation displaces a point by more than this many sheet sizes; a sheet that nothing holds may also fly away.
MOST_SHEET_SIZES = 10.0

# The energy of Verlet's method oscillates by 1 / (1 - (h / h_stable)^2) about the true one, and by somewhat more where
# springs are compressed to a point. It may be this many times larger than the load explains.
SWING = 4.0

# Energy that rounding may add, relative to the largest energy so far.
ROUNDING = 1e-9


def farthest_displacement(
    plan: Plan, time: float, acceleration: float | None = None, moved: float | None = None
) -> float:
    """Bound the displacement of a point at a time [m]; if one is larger, the simulation has diverged.

    acceleration, moved: most that the probes have given to a free point so far [m/s^2], and tools that are moved to all
        points [J]; None: most that the scene's can.
    """
    # A tool takes along what it holds.
    most = MOST_SHEET_SIZES * max(plan.scene.sheet.size) + sum(tool.path_length + tool.radius for tool in plan.tools)
    # Springs then connect every point to a fixed one; shear springs alone may skip every other point.
    if plan.scene.sheet.fixed not in ("none", ()) and min(plan.material.across, plan.material.down) > 0:
        return most
    if plan.material.virtual > 0 and not plan.material.always_active:
        # The virtual springs may accelerate a point from far away, and let go of it when it is fast.
        return math.inf
    if plan.tools:
        # No point is faster than if it had its share of all energy that the tools may have given.
        given = _most_moved(plan) if moved is None else moved
        most += math.sqrt(2 * given / plan.fixed.size / plan.material.mass) * time
    return most + (max_free_acceleration(plan) if acceleration is None else acceleration) * time * time / 2


class Watch:
    """Judges the frames of a run.

    Let E be the energy of motion and springs, F the forces of the probes, and |F| and |v| the norms over all points.
    Damping only takes energy, and the probes add dE/dt <= |F| |v|, with |v| <= (2 E / m)^(1/2). So from time a to b

        E(b)^(1/2) <= E(a)^(1/2) + (2 m)^(-1/2) integral of |F| from a to b

    Tools that are moved add at most the energy E_T that it takes to displace every point as far as they come and are
    wide, at their speed; where much is displaced already it takes more, so E_T^(1/2) is added to the right side.
    The virtual springs hold at most another K / 2 |u|^2, with K of the stiffest; when they begin to act, it is added
    for the displacements then.

    Attributes:
        progress: of the last frame that was found sound; at first, of the frame where the watch begins.
    """

    def __init__(self, plan: Plan, progress: RunProgress | None = None) -> None:
        self.progress = progress or RunProgress()
        self._plan, self._grid = plan, plan.grid
        self._loads = LoadBounds(plan)
        self._acceleration = max_free_acceleration(plan)
        self._moved = _most_moved(plan)
        self._shares = np.array([force_norm(slot, plan.scene) for slot in plan.slots])
        self._swing = SWING / max(1e-9, 1 - (plan.grid.step / plan.stable_step) ** 2)
        self._least, self._growth = _underflow(plan), EnergyGrowth(plan)

    def steer(self, plan: Plan) -> None:
        """Expect other loads from now on; control points move if they did before."""
        self._plan, self._growth = plan, EnergyGrowth(plan)
        self._loads = LoadBounds(plan)
        self._acceleration = max(self._acceleration, max_free_acceleration(plan))
        self._moved = max(self._moved, _most_moved(plan))

    def follow(self, reading: Reading) -> str:
        """Judge the next frame, as `judge` does, and record its progress if it is sound."""
        where, progress = largest_displacement(reading.displacement), self.progress
        frame, wrong = reading.steps // self._grid.steps_per_frame, self._fault(reading, where)
        if not wrong:
            least, growth = self._growth.follow(progress, reading, frame)
            pierced_by, pierced_frame = progress.pierced_by, progress.pierced_frame
            if not pierced_by:
                pierced_by = piercing(self._plan, reading.displacement, frame)
                pierced_frame = frame if pierced_by else 0
            self.progress = RunProgress(
                frame=frame,
                max_displacement=max(progress.max_displacement, where.distance),
                shortest_spring=min(progress.shortest_spring, reading.shortest_spring),
                longest_spring=max(progress.longest_spring, reading.longest_spring),
                energy=reading.energy,
                reach=where.reach,
                deepest=max(progress.deepest, -float(reading.displacement[..., 2].min())),
                peak=max(progress.peak, reading.energy),
                residual=max(progress.residual, reading.residual),
                evaluations=progress.evaluations + reading.evaluations,
                least_energy=least,
                energy_growth=growth,
                pierced_by=pierced_by,
                pierced_frame=pierced_frame,
            )
        return wrong

    def judge(self, reading: Reading) -> str:
        """Say what is wrong at a step since the last recorded frame; an empty text if it is sound."""
        return self._fault(reading, largest_displacement(reading.displacement))

    def _fault(self, reading: Reading, where: LargestDisplacement) -> str:
        if self._plan.scene.time.at_rest:
            return ""  # Where the forces balance, nothing has grown without bound.
        begin, end = self.progress.frame / self._grid.frames_per_second, self._grid.time(reading.steps)
        point, distance, energy = f"point ({where.row}, {where.column})", where.distance, reading.energy
        # Written so that NaN is found too: no comparison with it is true.
        if not distance <= farthest_displacement(self._plan, end, self._acceleration, self._moved):
            size = max(self._plan.scene.sheet.size)
            return f"{point} is {distance:g} m from its rest position, and the sheet is {size:g} m long"
        most = self._most_energy(begin, end)
        if not energy < math.inf or energy > most:
            return (
                f"motion and springs hold {energy:.3g} J, and the load explains {most:.3g} J at most; "
                f"{point} is farthest from its rest position, {distance:g} m"
            )
        return ""

    def _most_energy(self, begin: float, end: float) -> float:
        """Bound the energy at the end of an interval that begins at the last recorded frame [J]."""
        progress, material = self.progress, self._plan.material
        mass, virtual = material.mass, FoundationTerm.stiffness_bound(material, self._plan.scene.sheet) / 2
        forces, active, activations = self._loads.between(begin, end)
        push = float((forces * self._shares).sum())
        # Products instead of powers: these raise OverflowError where a product is infinite.
        root = math.sqrt(progress.energy + active * virtual * progress.reach * progress.reach)
        root += push * (end - begin) / math.sqrt(2 * mass) + math.sqrt(self._moved)
        reach = progress.reach + (end - begin) * root * math.sqrt(2 / mass)
        for _ in range(activations):
            root = math.sqrt(root * root + virtual * reach * reach)
            reach += (end - begin) * root * math.sqrt(2 / mass)
        return self._swing * root * root + ROUNDING * progress.peak + self._least


def message(time: float, step: int, wrong: str, *, exact: bool) -> str:
    """Say at what time and step a run diverged, and what `Watch` says; exact: the step before was still sound."""
    return f"diverged {'at' if exact else 'before'} {time:.6g} s, step {step}: {wrong}"


def _most_moved(plan: Plan) -> float:
    """Bound the energy that the tools which are moved can have given to the points [J]."""
    material, step, most = plan.material, plan.grid.step, 0.0
    stiffness = sum(term.stiffness_bound(material, plan.scene.sheet) for term in TERMS)
    for tool in plan.tools:
        far, speed = tool.path_length + tool.radius, tool.max_stride(step)[0] / step
        most += (stiffness * far * far + material.mass * speed * speed) / 2
    return plan.fixed.size * most


def _underflow(plan: Plan) -> float:
    """Give the energy below which the squares that it is summed from underflow [J]."""
    tiny = float(np.finfo(np.float32 if plan.grid.precision == "f32" else np.float64).tiny)
    (dx, dy), material = spacing(plan.scene.sheet), plan.material
    inertia = material.mass / plan.grid.step**2
    # Squares are summed, and squares times a stiffness.
    springs = max(1.0, sum(term.stiffness_bound(material, plan.scene.sheet) for term in TERMS)) * (dx**2 + dy**2)
    return math.prod(plan.scene.sheet.points) * tiny * (inertia + springs)
