"""The reference for the model: its forces and its steps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.loads import Schedule, average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Foundation
from taichi_msm.solver.planning import make_plan
from tests.reference.contact import Contact
from tests.reference.sheet import Sheet, Springs, sheet

Array = NDArray[np.float64]


def elastic_force(scene: Scene, displacement: Array, made: Sheet | None = None) -> Array:
    """Sum k (L - L0) (Q - P) / L over the neighbours Q of every point P (eq. 2), without the part that cancels at rest.

    Of displacements x - X [m], shape (rows, cols, 3), and of another sheet than the scene's, numbers may be complex.
    """
    every = (made or sheet(scene)).springs
    force = np.zeros(displacement.shape, np.result_type(displacement, *(springs.unstretched for springs in every)))
    for springs in every:
        between, length = _ends_apart(springs, displacement)
        pull = (length - springs.unstretched) / np.where(length == 0, 1, length)
        found = (springs.stiffness * pull)[..., None] * between
        at_rest = springs.stiffness * (springs.length - springs.unstretched) / springs.length
        found -= at_rest[..., None] * springs.offset
        if scene.tissue is not None and scene.tissue.stiffening is not None:
            keys, strain = scene.tissue.stiffening, length / springs.length - 1
            more = springs.stiffness * springs.length * (lock(strain, keys.lock, keys.factor) - strain)
            found += (more / length)[..., None] * between
        force[springs.here] += found
        force[springs.there] -= found
    return force


def lock(e: Array, m: float, factor: float) -> Array:
    """Return the law of tissue that locks: e / (1 - e / m) where e > 0, straight where its slope reaches the factor."""
    c = m * (1 - factor**-0.5)
    curved = np.where(e > 0, e / (1 - np.clip(e, 0, c) / m), e)
    return np.where(e > c, c / (1 - c / m) + (e - c) * factor, curved)


def _integral(e: Array, m: float, factor: float) -> Array:
    """Return the integral of lock(e) - e from 0."""
    c = m * (1 - factor**-0.5)
    inner, beyond = np.clip(e, 0, c), np.maximum(e - c, 0)
    curved = -m * inner - m * m * np.log1p(-inner / m) - inner**2 / 2
    return np.asarray(curved + beyond * (c / (1 - c / m) - c) + (factor - 1) * beyond**2 / 2)


def foundation_force(scene: Scene, displacement: Array, made: Sheet | None = None) -> Array:
    """Return the force of the virtual springs while they are active [N], shape (rows, cols, 3)."""
    k = (made or sheet(scene)).virtual
    force = -k[..., None] * displacement
    foundation = None if scene.tissue is None else scene.tissue.foundation
    if isinstance(foundation, Foundation) and foundation.lock is not None:
        depth = -displacement[..., 2]
        force[..., 2] = k * np.where(depth > 0, lock(depth, foundation.lock, foundation.factor), depth)
    return force


def _ends_apart(springs: Springs, displacement: Array) -> tuple[Array, Array]:
    """Give the vectors from one end of each spring to the other, and their lengths [m]."""
    between = displacement[springs.there] - displacement[springs.here] + springs.offset
    return between, np.sqrt((between**2).sum(axis=-1))


def _laplacian(scene: Scene, u: Array) -> Array:
    """Give the five-point Laplacian at the points that have four neighbours [1/m]."""
    (dx, dy), inner = spacing(scene.sheet), u[1:-1, 1:-1]
    return (u[1:-1, 2:] - 2 * inner + u[1:-1, :-2]) / dx**2 + (u[2:, 1:-1] - 2 * inner + u[:-2, 1:-1]) / dy**2


def bending_force(scene: Scene, displacement: Array, made: Sheet | None = None) -> Array:
    """Differentiate D / 2 sum of dx dy |Laplacian of u|^2 over the points with four neighbours; as `elastic_force`."""
    (dx, dy), moment = spacing(scene.sheet), (made or sheet(scene)).bending * _laplacian(scene, displacement)
    force = np.zeros(displacement.shape, moment.dtype)
    force[1:-1, 1:-1] += (2 / dx**2 + 2 / dy**2) * moment
    force[1:-1, 2:] -= moment / dx**2
    force[1:-1, :-2] -= moment / dx**2
    force[2:, 1:-1] -= moment / dy**2
    force[:-2, 1:-1] -= moment / dy**2
    return force


def shortest_spring(scene: Scene, displacement: Array) -> float:
    """Find the smallest ratio of a spring's length to that at rest; 1 if there are no springs."""
    return min(1.0, *(float(strain.min(initial=1.0)) for strain in _strains(scene, displacement)))


def longest_spring(scene: Scene, displacement: Array) -> float:
    """Find how far the springs are stretched, as `shortest_spring` does."""
    return max(1.0, *(float(strain.max(initial=1.0)) for strain in _strains(scene, displacement)))


def _strains(scene: Scene, displacement: Array) -> Iterator[Array]:
    for springs in sheet(scene).springs:
        yield (_ends_apart(springs, displacement)[1] / springs.length)[springs.stiffness > 0]


def energy(scene: Scene, displacement: Array) -> float:
    """Give the elastic energy of springs and bending above that at rest [J], without the virtual springs."""
    made = sheet(scene)
    held = made.bending / 2 * float((_laplacian(scene, displacement) ** 2).sum())
    for springs in made.springs:
        between, length = _ends_apart(springs, displacement)
        rest = springs.length - springs.unstretched
        # The part that is linear in the displacements cancels in the sum, as the sheet is in equilibrium at rest.
        linear = (between - springs.offset) @ springs.offset * rest / springs.length
        strained = (length - springs.unstretched) ** 2 / 2 - rest**2 / 2 - linear
        held += float((springs.stiffness * strained).sum())
        if scene.tissue is not None and scene.tissue.stiffening is not None:
            keys, strain = scene.tissue.stiffening, length / springs.length - 1
            held += float((springs.stiffness * springs.length**2 * _integral(strain, keys.lock, keys.factor)).sum())
    return held


def surgical_force(scene: Scene, loads: Schedule, n: int) -> Array:
    """Sum the forces of probes in row n of a schedule [N], shape (rows, cols, 3).

    They are (percent / 100) force exp(-falloff d - offset) (eq. 5), or shares of their totals.
    """
    rest = rest_positions(scene.sheet)
    force = np.zeros_like(rest)
    for index, slot in enumerate(loads.slots):
        probe = scene.probes[slot.probe]
        distance = np.linalg.norm(rest[..., :2] - loads.point[n, index], axis=-1)
        decay = np.exp(-probe.falloff * np.maximum(distance - probe.radius, 0))
        if probe.total is None:
            decay *= np.exp(-probe.offset)
        else:
            decay[[0, -1]] /= 2
            decay[:, [0, -1]] /= 2
        force += decay[..., None] * loads.strength[n, index]
    return force


def force(scene: Scene, displacement: Array, loads: Schedule, n: int, made: Sheet | None = None) -> Array:
    """Add up all forces except the damping at one step (eq. 1), row n of the schedule; as `elastic_force`."""
    made = made or sheet(scene)
    springs = elastic_force(scene, displacement, made) + bending_force(scene, displacement, made)
    # In this order small sheets stay within the roundings of their steps.
    return springs + surgical_force(scene, loads, n) + loads.active[n] * foundation_force(scene, displacement, made)


def internal_force(scene: Scene, displacement: Array, loads: Schedule, n: int, made: Sheet) -> Array:
    """Add up the forces of springs, bending and foundation [N], shape (rows, cols, 3)."""
    springs = elastic_force(scene, displacement, made) + bending_force(scene, displacement, made)
    return springs + loads.active[n] * foundation_force(scene, displacement, made)


class Relaxation:
    """The memory of tissue that relaxes, h [s] apart."""

    def __init__(self, scene: Scene, h: float) -> None:
        branches = () if scene.tissue is None else scene.tissue.relaxation
        self._branches = [(branch.share, h / branch.time) for branch in branches]
        self._memory: list[Any] = [0.0 for _ in branches]

    def step(self, elastic: Array) -> Array:
        """Return the force that acts in place of the elastic force, which becomes part of the memory."""
        total = (1 - sum(share for share, _ in self._branches)) * elastic
        for n, (share, x) in enumerate(self._branches):
            phi = (1 - np.exp(-x)) / x
            total = total + self._memory[n] + share * phi * elastic
            self._memory[n] = np.exp(-x) * self._memory[n] - share * phi * (1 - np.exp(-x)) * elastic
        return total

    def begin(self, elastic: Array) -> None:
        """Remember a load that was put on at frame 0 of a scene at rest."""
        for n, (share, x) in enumerate(self._branches):
            self._memory[n] = share * (np.exp(-x) - (1 - np.exp(-x)) / x) * elastic


def tangent(scene: Scene, displacement: Array, change: Array, active: float = 1.0, made: Sheet | None = None) -> Array:
    """Give the change of all forces but those of the probes with a small change of the displacements [N].

    Of the virtual springs a share is active; `made` is the scene's sheet, where it is known.
    """
    made = made or sheet(scene)
    total = bending_force(scene, change, made) - active * made.virtual[..., None] * change
    for springs in made.springs:
        between, length = _ends_apart(springs, displacement)
        apart, slack = change[springs.there] - change[springs.here], (springs.unstretched / length)[..., None]
        turned = ((between * apart).sum(axis=-1) / length**2)[..., None] * between
        pull = springs.stiffness[..., None] * ((1 - slack) * apart + slack * turned)
        total[springs.here] += pull
        total[springs.there] -= pull
    return total


def displacements(plan: Plan) -> Iterator[Array]:
    """Step a scene by Stoermer-Verlet (eq. 6 to 9) and yield u_0, u_1, ... [m], each of shape (rows, cols, 3)."""
    return (u for u, _ in steps(plan))


def steps(plan: Plan, made: Sheet | None = None) -> Iterator[tuple[Array, Contact]]:
    """Yield u_0, u_1, ... [m], shape (rows, cols, 3), each with the contact in the step before it.

    made: another sheet than the scene's, as for `elastic_force`.
    """
    scene = plan.scene
    h, made = plan.grid.step, made or sheet(scene)
    m, g = made.mass[..., None], (made.drag / made.mass)[..., None]
    moves, contact = ~plan.fixed[..., None], Contact(plan)
    loads, relaxation = average_loads(plan, 0, plan.grid.steps), Relaxation(scene, h)

    def acceleration(u: Array, n: int) -> Array:
        if scene.tissue is None or not scene.tissue.relaxation:
            return np.asarray(force(scene, u, loads, n, made) / m)
        elastic = internal_force(scene, u, loads, n, made)
        return np.asarray((relaxation.step(elastic) + surgical_force(scene, loads, n)) / m)

    previous = np.zeros((*scene.sheet.points, 3))
    yield previous, contact
    current = contact.after(0, previous, h**2 / 2 * acceleration(previous, 0) * moves)
    yield current, contact
    for n in range(1, len(loads.active)):
        a = acceleration(current, n)
        if scene.time.damping_difference == "central":
            following = (2 * current - (1 - g * h / 2) * previous + h**2 * a) / (1 + g * h / 2)
        else:
            following = 2 * current - previous + h**2 * a - g * h * (current - previous)
        previous, current = current, contact.after(n, current, following * moves)
        yield current, contact


def simulate(scene: Scene) -> Array:
    """Run the whole scene and give the positions of every frame [m], shape (F + 1, rows, cols, 3)."""
    plan = make_plan(scene)
    frames = [u for n, u in enumerate(displacements(plan)) if n % plan.grid.steps_per_frame == 0]
    return rest_positions(scene.sheet) + np.array(frames)
