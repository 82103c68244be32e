"""NumPy reference of the model: forces, energy, tangent and time stepping.

Equation numbers are those of Yuan et al. 2009. `assembled` is a sheet to use in place of the scene's own; its numbers
may be complex, for derivatives by a complex step.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.loads import Schedule, average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Foundation
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import make_plan
from tests.reference.contact import Contact
from tests.reference.loads import Loads, step_loads
from tests.reference.sheet import Sheet, Springs, sheet
from tests.reference.surface import at_fractions, normal_at

Array = NDArray[np.float64]


def elastic_force(scene: Scene, displacement: Array, assembled: Sheet | None = None) -> Array:
    """Return the force of structural and shear springs [N], shape (rows, cols, 3).

    The sum of k (L - L0) (Q - P) / L over the neighbours Q of every point P (eq. 2), less its value at rest, where the
    forces of a sheet under tension cancel. Stiffening tissue has `lock` of the strain in place of the strain.

    Args:
        scene: scene with springs or tissue.
        displacement: u = x - X [m], shape (rows, cols, 3), real or complex.
        assembled: another sheet than the scene's.
    """
    every = (assembled or sheet(scene)).springs
    force = np.zeros(displacement.shape, np.result_type(displacement, *(springs.unstretched for springs in every)))
    for springs in every:
        tension = spring_pull(scene, springs, displacement)
        force[springs.start] += tension
        force[springs.end] -= tension
    return force


def spring_pull(scene: Scene, springs: Springs, displacement: Array) -> Array:
    """Return the pull of springs on the mass points at their starts, less that at rest [N], shape (..., 3)."""
    between, length = _ends_apart(springs, displacement)
    pull = (length - springs.unstretched) / np.where(length == 0, 1, length)
    tension = (springs.stiffness * pull)[..., None] * between
    at_rest = springs.stiffness * (springs.length - springs.unstretched) / springs.length
    tension -= at_rest[..., None] * springs.offset
    if scene.tissue is not None and scene.tissue.stiffening is not None:
        keys, strain = scene.tissue.stiffening, length / springs.length - 1
        more = springs.stiffness * springs.length * (lock(strain, keys.lock, keys.factor) - strain)
        tension += (more / length)[..., None] * between
    return np.asarray(tension)


def lock(e: Array, m: float, factor: float) -> Array:
    """Return the strain that the law of stiffening tissue has in place of e.

    e / (1 - e / m) where e > 0, and e where it is negative; beyond the strain at which the slope reaches `factor` the
    law goes on straight.

    Args:
        e: strain, of any shape.
        m: locking strain.
        factor: largest slope, that is the ratio of the largest stiffness to that at rest.
    """
    c = m * (1 - factor**-0.5)
    curved = np.where(e > 0, e / (1 - np.clip(e, 0, c) / m), e)
    return np.where(e > c, c / (1 - c / m) + (e - c) * factor, curved)


def lock_slope(e: Array, m: float, factor: float) -> Array:
    """Return the slope of `lock`: 1 where e <= 0, then (1 - e / m)^-2, at most the factor."""
    return np.where(e > m * (1 - factor**-0.5), factor, (1 - np.clip(e, 0, m * (1 - factor**-0.5)) / m) ** -2)


def lock_energy(e: Array, m: float, factor: float) -> Array:
    """Return the integral of lock(e) - e from 0."""
    c = m * (1 - factor**-0.5)
    inner, beyond = np.clip(e, 0, c), np.maximum(e - c, 0)
    curved = -m * inner - m * m * np.log1p(-inner / m) - inner**2 / 2
    return np.asarray(curved + beyond * (c / (1 - c / m) - c) + (factor - 1) * beyond**2 / 2)


def foundation_force(scene: Scene, displacement: Array, assembled: Sheet | None = None) -> Array:
    """Return the force of the virtual springs while they are active [N], shape (rows, cols, 3).

    -K u (eq. 4); where the foundation locks, with `lock` of the depth along the normal at rest, w = -u . N.

    Args:
        scene: scene with virtual springs or a foundation.
        displacement: u [m], shape (rows, cols, 3).
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    k, normal = assembled.virtual, assembled.normal
    force = -k[..., None] * displacement
    foundation = None if scene.tissue is None else scene.tissue.foundation
    if isinstance(foundation, Foundation) and foundation.lock is not None:
        depth = -(displacement * normal).sum(axis=-1)
        more = np.where(depth > 0, lock(depth, foundation.lock, foundation.factor) - depth, 0)
        force += (k * more)[..., None] * normal
    return force


def _ends_apart(springs: Springs, displacement: Array) -> tuple[Array, Array]:
    """Return the vectors from one end of each spring to the other, and their lengths [m]."""
    between = displacement[springs.end] - displacement[springs.start] + springs.offset
    return between, np.sqrt((between**2).sum(axis=-1))


def _laplacian(scene: Scene, u: Array) -> Array:
    """Return the five-point Laplacian at the points that have four neighbours [1/m]."""
    (dx, dy), inner = spacing(scene.sheet), u[1:-1, 1:-1]
    return (u[1:-1, 2:] - 2 * inner + u[1:-1, :-2]) / dx**2 + (u[2:, 1:-1] - 2 * inner + u[:-2, 1:-1]) / dy**2


def bending_force(scene: Scene, displacement: Array, assembled: Sheet | None = None) -> Array:
    """Return the force of plate bending [N], shape (rows, cols, 3).

    The negative gradient of D / 2 sum of dx dy |Laplacian of u|^2 over the points with four neighbours.

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3), real or complex.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    if assembled.is_curved:
        return np.zeros_like(displacement)
    (dx, dy), moment = spacing(scene.sheet), assembled.bending * _laplacian(scene, displacement)
    force = np.zeros(displacement.shape, moment.dtype)
    force[1:-1, 1:-1] += (2 / dx**2 + 2 / dy**2) * moment
    force[1:-1, 2:] -= moment / dx**2
    force[1:-1, :-2] -= moment / dx**2
    force[2:, 1:-1] -= moment / dy**2
    force[:-2, 1:-1] -= moment / dy**2
    return force


def shortest_spring(scene: Scene, displacement: Array) -> float:
    """Return the smallest ratio of a spring's length to that at rest, at most 1.

    Args:
        scene: scene whose springs are measured, except those without stiffness.
        displacement: u [m], shape (rows, cols, 3).
    """
    return min(1.0, *(float(strain.min(initial=1.0)) for strain in _strains(scene, displacement)))


def longest_spring(scene: Scene, displacement: Array) -> float:
    """Return the largest ratio of a spring's length to that at rest, at least 1.

    Args:
        scene: scene whose springs are measured, except those without stiffness.
        displacement: u [m], shape (rows, cols, 3).
    """
    return max(1.0, *(float(strain.max(initial=1.0)) for strain in _strains(scene, displacement)))


def _strains(scene: Scene, displacement: Array) -> Iterator[Array]:
    for springs in sheet(scene).springs:
        yield (_ends_apart(springs, displacement)[1] / springs.length)[springs.stiffness > 0]


def energy(scene: Scene, displacement: Array, assembled: Sheet | None = None) -> float:
    """Return the elastic energy of springs and bending above that at rest [J], without the virtual springs.

    The sum of k ((L - L0)^2 - (L_rest - L0)^2) / 2, less the part linear in u, and of D / 2 |Laplacian|^2 dx dy.

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        assembled: another sheet than the scene's.
    """
    assembled, total = assembled or sheet(scene), 0.0
    if not assembled.is_curved:
        total = float((assembled.bending * _laplacian(scene, displacement) ** 2).sum()) / 2
    for springs in assembled.springs:
        between, length = _ends_apart(springs, displacement)
        rest = springs.length - springs.unstretched
        # The part that is linear in the displacements cancels in the sum, as the sheet is in equilibrium at rest.
        linear = ((between - springs.offset) * springs.offset).sum(axis=-1) * rest / springs.length
        strained = (length - springs.unstretched) ** 2 / 2 - rest**2 / 2 - linear
        total += float((springs.stiffness * strained).sum())
        if scene.tissue is not None and scene.tissue.stiffening is not None:
            keys, strain = scene.tissue.stiffening, length / springs.length - 1
            total += float((springs.stiffness * springs.length**2 * lock_energy(strain, keys.lock, keys.factor)).sum())
    return total


def surgical_force(scene: Scene, loads: Schedule | Loads, n: int, assembled: Sheet | None = None) -> Array:
    """Return the sum of the forces of probes [N], shape (rows, cols, 3).

    Of each, (percent / 100) force exp(-falloff d - offset) (eq. 5), or its total shared by exp(-falloff d).

    Args:
        scene: scene with force-controlled tools.
        loads: schedule of loads and control points, a row for every step or time; for a surface `Loads`.
        n: row of the schedule.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    force = np.zeros_like(assembled.rest)
    if isinstance(loads, Loads):
        for number, percent, (across, down) in zip(loads.probes, loads.percent[n], loads.at[n], strict=True):
            force += percent / 100 * probe_force(scene.probes[number], assembled, across, down)
        return force
    for index, slot in enumerate(loads.slots):
        probe = scene.probes[slot.probe]
        distance = np.linalg.norm(assembled.rest[..., :2] - loads.point[n, index], axis=-1)
        decay = np.exp(-probe.falloff * np.maximum(distance - probe.radius, 0))
        if probe.total is None:
            decay *= np.exp(-probe.offset)
        else:
            decay *= assembled.share
        force += decay[..., None] * loads.strength[n, index]
    return force


def probe_force(probe: Probe, assembled: Sheet, across: float, down: float) -> Array:
    """Return the force of a probe at 100 % with its control point at fractions of the sheet [N], shape (rows, cols, 3).

    force w(d) exp(-offset), or total w(d) A / W on a mass point of area A at the distance d in space, with
    w = exp(-falloff max(d - R, 0)) and W its integral over a plane. A number acts along the normal.
    """
    distance = np.linalg.norm(assembled.rest - at_fractions(assembled.rest, across, down), axis=-1)
    decay = np.exp(-probe.falloff * np.maximum(distance - probe.radius, 0))
    if probe.total is None:
        vector: Any = probe.force
        decay *= np.exp(-probe.offset)
    else:
        vector, reach = probe.total, 1 / probe.falloff
        decay *= assembled.area / (np.pi * probe.radius**2 + 2 * np.pi * (probe.radius * reach + reach**2))
    if np.ndim(vector) == 0:
        vector = vector * normal_at(assembled.normal, across, down)
    return decay[..., None] * vector


def force(scene: Scene, displacement: Array, loads: Schedule | Loads, n: int, assembled: Sheet | None = None) -> Array:
    """Return the sum of all forces except damping (eq. 1) [N], shape (rows, cols, 3).

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3), real or complex.
        loads: schedule of loads and of the activity of virtual springs.
        n: row of the schedule.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    springs = elastic_force(scene, displacement, assembled) + bending_force(scene, displacement, assembled)
    # In this order small sheets stay within the roundings of their steps.
    return (
        springs
        + surgical_force(scene, loads, n, assembled)
        + loads.active[n] * foundation_force(scene, displacement, assembled)
    )


def internal_force(scene: Scene, displacement: Array, loads: Schedule | Loads, n: int, assembled: Sheet) -> Array:
    """Return the sum of the forces of springs, bending and foundation [N], shape (rows, cols, 3).

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        loads: schedule of the activity of virtual springs.
        n: row of the schedule.
        assembled: assembled sheet of the scene, or another one.
    """
    springs = elastic_force(scene, displacement, assembled) + bending_force(scene, displacement, assembled)
    return springs + loads.active[n] * foundation_force(scene, displacement, assembled)


class Relaxation:
    """Viscoelastic memory of tissue: a Prony series, integrated exactly for forces that are linear within a step.

    Args:
        scene: the scene; its tissue's `relaxation` has the branches' shares and times [s].
        h: time step [s].
    """

    def __init__(self, scene: Scene, h: float) -> None:
        branches = () if scene.tissue is None else scene.tissue.relaxation
        self._branches = [(branch.share, h / branch.time) for branch in branches]
        self._memory: list[Any] = [0.0 for _ in branches]

    def step(self, elastic: Array) -> Array:
        """Return the relaxed force [N], and add the elastic force [N] of this step to the memory."""
        total = (1 - sum(share for share, _ in self._branches)) * elastic
        for n, (share, x) in enumerate(self._branches):
            phi = (1 - np.exp(-x)) / x
            total = total + self._memory[n] + share * phi * elastic
            self._memory[n] = np.exp(-x) * self._memory[n] - share * phi * (1 - np.exp(-x)) * elastic
        return total

    def begin(self, elastic: Array) -> None:
        """Set the memory to the history of a load [N] applied at frame 0 of a quasi-static scene."""
        for n, (share, x) in enumerate(self._branches):
            self._memory[n] = share * (np.exp(-x) - (1 - np.exp(-x)) / x) * elastic


def tangent(
    scene: Scene, displacement: Array, change: Array, active: float = 1.0, assembled: Sheet | None = None
) -> Array:
    """Return the change of springs', bending and foundation forces with the displacements [N], shape (rows, cols, 3).

    Of a spring with the unit vector n, k ((1 - L0 / L) I + L0 / L n n^T) times the change of its vector. With a pull
    f(L) of stiffening tissue in addition, f / L (I - n n^T) + f' n n^T more.

    Args:
        scene: scene with springs or tissue.
        displacement: u [m], shape (rows, cols, 3).
        change: direction du [m], same shape.
        active: share of the virtual springs that are active, 0 to 1.
        assembled: another sheet than the scene's.
    """
    assembled = assembled or sheet(scene)
    total = bending_force(scene, change, assembled) - active * assembled.virtual[..., None] * change
    foundation = None if scene.tissue is None else scene.tissue.foundation
    if isinstance(foundation, Foundation) and foundation.lock is not None:
        depth, normal = -(displacement * assembled.normal).sum(axis=-1), assembled.normal
        more = assembled.virtual * (lock_slope(depth, foundation.lock, foundation.factor) - 1)
        total -= active * (more * (change * normal).sum(axis=-1))[..., None] * normal
    for springs in assembled.springs:
        between, length = _ends_apart(springs, displacement)
        apart, slack = change[springs.end] - change[springs.start], (springs.unstretched / length)[..., None]
        along = ((between * apart).sum(axis=-1) / length**2)[..., None] * between
        pull = springs.stiffness[..., None] * ((1 - slack) * apart + slack * along)
        if scene.tissue is not None and scene.tissue.stiffening is not None:
            keys, strain = scene.tissue.stiffening, length / springs.length - 1
            more = springs.stiffness * springs.length / length * (lock(strain, keys.lock, keys.factor) - strain)
            slope = springs.stiffness * (lock_slope(strain, keys.lock, keys.factor) - 1)
            pull += more[..., None] * (apart - along) + slope[..., None] * along
        total[springs.start] += pull
        total[springs.end] -= pull
    return total


def displacements(plan: Plan) -> Iterator[Array]:
    """Step a scene by Stoermer-Verlet (eq. 6 to 9) and yield u_0, u_1, ... [m], each of shape (rows, cols, 3)."""
    return (u for u, _ in steps(plan))


def steps(plan: Plan, assembled: Sheet | None = None) -> Iterator[tuple[Array, Contact]]:
    """Yield u_0, u_1, ... [m], shape (rows, cols, 3), each with the contact in the step before it.

    Stoermer-Verlet with central damping, (1 + g h / 2) u_{n+1} = 2 u_n - (1 - g h / 2) u_{n-1} + h^2 a_n, or with
    backward damping, u_{n+1} = 2 u_n - u_{n-1} + h^2 a_n - g h (u_n - u_{n-1}) (eq. 6 to 9); u_1 = h^2 a_0 / 2. Of
    order 2, and of order 1 with backward damping.

    Args:
        plan: plan of a scene, with its time step.
        assembled: another sheet than the scene's.
    """
    scene = plan.scene
    h, assembled = plan.grid.step, assembled or sheet(scene)
    # Points without sheet, which never move, have no mass.
    mass = np.where(assembled.mass == 0, 1, assembled.mass)
    m, g = mass[..., None], (assembled.drag / mass)[..., None]
    moves, contact = ~plan.fixed[..., None], Contact(plan, assembled)
    loads: Schedule | Loads = step_loads(plan) if assembled.is_curved else average_loads(plan, 0, plan.grid.steps)
    relaxation = Relaxation(scene, h)

    def acceleration(u: Array, n: int) -> Array:
        if scene.tissue is None or not scene.tissue.relaxation:
            return np.asarray(force(scene, u, loads, n, assembled) / m)
        elastic = internal_force(scene, u, loads, n, assembled)
        return np.asarray((relaxation.step(elastic) + surgical_force(scene, loads, n, assembled)) / m)

    previous = np.zeros((*scene.sheet.points, 3))
    yield previous, contact
    current = contact.resolve(0, previous, h**2 / 2 * acceleration(previous, 0) * moves)
    yield current, contact
    for n in range(1, len(loads.active)):
        a = acceleration(current, n)
        if scene.time.damping_difference == "central":
            following = (2 * current - (1 - g * h / 2) * previous + h**2 * a) / (1 + g * h / 2)
        else:
            following = 2 * current - previous + h**2 * a - g * h * (current - previous)
        previous, current = current, contact.resolve(n, current, following * moves)
        yield current, contact


def simulate(scene: Scene) -> Array:
    """Return the positions of every frame of a scene [m], shape (frames + 1, rows, cols, 3)."""
    plan = make_plan(scene)
    frames = [u for n, u in enumerate(displacements(plan)) if n % plan.grid.steps_per_frame == 0]
    return sheet(scene).rest + np.array(frames)
