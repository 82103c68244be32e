"""What shows that a simulation has gone wrong: no number, too far away, or more energy than the load can have given."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.lattice import axes, spacing
from taichi_msm.physics.loads import Envelope, ProbeSlot, decay, probe_slots
from taichi_msm.physics.material import material
from taichi_msm.physics.probe_force import probe_force
from taichi_msm.physics.run_progress import RunProgress
from taichi_msm.physics.state import Reading
from taichi_msm.physics.timestep import stable_step
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid

# Farther from rest than this many sheet sizes is no deformation any more; a sheet that nothing holds may fly besides.
MOST_SHEET_SIZES = 10.0

# The energy of Verlet's method swings by 1 / (1 - (h / h_stable)^2) about the true one, and somewhat more where springs
# are pressed to a point; it may be this many times what the load explains.
SWING = 4.0

# What rounding may make of the largest energy there was.
ROUNDING = 1e-9


def _is_held(scene: Scene) -> bool:
    """Tell whether springs lead from every point to one that is fixed; those of shear may leave every other one out."""
    made = material(scene)
    return scene.sheet.fixed not in ("none", ()) and min(made.across, made.down) > 0


def _free_acceleration(scene: Scene) -> float:
    """Bound the acceleration that the probes give a point that nothing holds [m/s^2]."""
    forces = (
        probe_force(probe, scene.sheet).size * max(abs(percent) for _, percent in probe.load) / 100
        for probe in scene.probes
    )
    return sum(forces) / material(scene).mass


def farthest_displacement(scene: Scene, time: float, acceleration: float | None = None) -> float:
    """Bound how far a point may be from rest [m]; farther, the simulation has gone wrong.

    Args:
        scene: what is run.
        time: since the beginning [s].
        acceleration: most that the probes have given a point that nothing holds [m/s^2]; None: what the scene's give.
    """
    most = MOST_SHEET_SIZES * max(scene.sheet.size)
    if _is_held(scene):
        return most
    made = material(scene)
    if made.virtual > 0 and not made.always:
        # They may pull a point from afar and let it go when it is fast.
        return math.inf
    return most + (_free_acceleration(scene) if acceleration is None else acceleration) * time * time / 2


class Watch:
    """Judges the frames of a run.

    With E the energy of motion and springs, and F the forces of the probes, damping takes energy and the probes give
    dE/dt <= |F| |v|, |v| <= (2 E / m)^(1/2), where |F| and |v| are over all points; so from time a to b

        E(b)^(1/2) <= E(a)^(1/2) + (2 m)^(-1/2) integral of |F| from a to b

    The virtual springs hold K / 2 |u|^2 more. Where they begin to act, that is added, as they pull from where the
    points are.

    Args:
        scene: what is run.
        grid: its steps.
        progress: of the frame where the watch begins.

    Attributes:
        progress: of the last frame that was fine.
    """

    def __init__(self, scene: Scene, grid: TimeGrid, progress: RunProgress | None = None) -> None:
        self.progress = progress or RunProgress()
        self._scene, self._grid, self._material = scene, grid, material(scene)
        self._loads = Envelope(scene, grid.step)
        self._acceleration = _free_acceleration(scene)
        slots = probe_slots(scene.probes, scene.sheet, grid.step)
        self._shares = np.array([_share(slot, scene) for slot in slots])
        limit = stable_step(scene)
        self._swing = SWING / max(1e-9, 1 - (grid.step / limit) ** 2)
        self._least = _underflow(scene, grid)

    def steer(self, scene: Scene) -> None:
        """Expect other loads from here on; their control points move if they did."""
        self._scene = scene
        self._loads = Envelope(scene, self._grid.step)
        self._acceleration = max(self._acceleration, _free_acceleration(scene))

    def follow(self, reading: Reading) -> str:
        """Judge a frame that was reached, as `judge` does, and take note of it if it is fine."""
        where, progress = farthest(reading.displacement), self.progress
        wrong = self._fault(reading, where)
        if not wrong:
            self.progress = RunProgress(
                frame=progress.frame + 1,
                max_displacement=max(progress.max_displacement, where.distance),
                shortest_spring=min(progress.shortest_spring, reading.shortest_spring),
                longest_spring=max(progress.longest_spring, reading.longest_spring),
                energy=reading.energy,
                reach=where.reach,
                peak=max(progress.peak, reading.energy),
            )
        return wrong

    def judge(self, reading: Reading) -> str:
        """Say what is wrong at a step after the last frame that was taken note of; nothing if it is fine."""
        return self._fault(reading, farthest(reading.displacement))

    def _fault(self, reading: Reading, where: Farthest) -> str:
        begin, end = self.progress.frame / self._grid.frames_per_second, self._grid.time(reading.steps)
        point, distance, energy = f"point ({where.row}, {where.column})", where.distance, reading.energy
        # Written so that NaN is found as well: it is not below anything.
        if not distance <= farthest_displacement(self._scene, end, self._acceleration):
            size = max(self._scene.sheet.size)
            return f"{point} is {distance:g} m from its rest position, and the sheet is {size:g} m long"
        most = self._most_energy(begin, end)
        if not energy < math.inf or energy > most:
            return (
                f"motion and springs hold {energy:.3g} J, and the load explains {most:.3g} J at most; "
                f"{point} is farthest from its rest position, {distance:g} m"
            )
        return ""

    def _most_energy(self, begin: float, end: float) -> float:
        """Bound the energy at the end of a time by what it was at its beginning, a frame that was taken note of [J]."""
        progress, mass, virtual = self.progress, self._material.mass, self._material.virtual / 2
        forces, active, activations = self._loads.between(begin, end)
        push = float((forces * self._shares).sum())
        # Products and no powers, which raise where a product is infinite.
        root = math.sqrt(progress.energy + active * virtual * progress.reach * progress.reach)
        root += push * (end - begin) / math.sqrt(2 * mass)
        reach = progress.reach + (end - begin) * root * math.sqrt(2 / mass)
        for _ in range(activations):
            root = math.sqrt(root * root + virtual * reach * reach)
            reach += (end - begin) * root * math.sqrt(2 / mass)
        return self._swing * root * root + ROUNDING * progress.peak + self._least


class Farthest(NamedTuple):
    """The point that is farthest from rest, or not finite.

    Attributes:
        row, column: which it is.
        distance: from its rest position [m].
        reach: root of the sum of all points' squared displacements [m].
    """

    row: int
    column: int
    distance: float
    reach: float


def farthest(displacement: NDArray[np.floating]) -> Farthest:
    """Find the point that is farthest from rest; displacement [m] of shape (rows, cols, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        square = np.einsum("ijk,ijk->ij", displacement, displacement, dtype=np.float64)
        # argmax points at NaN.
        row, column = (int(index) for index in np.unravel_index(square.argmax(), square.shape))
        return Farthest(
            row, column, float(np.linalg.norm(displacement[row, column].astype(float))), math.sqrt(square.sum())
        )


def _underflow(scene: Scene, grid: TimeGrid) -> float:
    """Tell the energy below which the squares that it is summed from have no digits [J]."""
    tiny = float(np.finfo(np.float32 if grid.precision == "f32" else np.float64).tiny)
    dx, dy = spacing(scene.sheet)
    made = material(scene)
    stiffness = max(made.across, made.down) + made.shear
    return math.prod(scene.sheet.points) * tiny * (made.mass / grid.step**2 + stiffness * (dx**2 + dy**2))


def _share(slot: ProbeSlot, scene: Scene) -> float:
    """Bound |F| over all points for a force of 1 N at the control point."""
    if not slot.moves:
        return float(np.linalg.norm(decay(scene.probes[slot.probe], scene.sheet)))
    # From anywhere the points are no nearer than from one of them, but for half a cell; and around one there are no
    # more than in four sheets that meet there.
    x, y = axes(scene.sheet)
    nearest = np.maximum(np.hypot(x - x[0], y - y[0]) - math.hypot(*spacing(scene.sheet)) / 2, 0)
    return 2 * float(np.linalg.norm(probe_force(scene.probes[slot.probe], scene.sheet).decay(nearest)))
