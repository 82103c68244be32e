"""The reference for derivatives: the steps once more, for complex numbers too, and their adjoint, by the book.

A step is d' = keep d + gain F(u) and u' = u + d'. With a bar for the derivative of the loss, and backward in time,

    d'_bar += u'_bar,    F_bar = gain d'_bar,    u_bar = u'_bar + F'(u) F_bar,    d_bar = keep d'_bar

where F' is the tangent, which is symmetric, as forces have an energy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions, spacing
from taichi_msm.scene.scene import Scene
from tests.reference.sheet import Sheet, Springs

# Of complex numbers where the derivative is by a complex step.
Array = NDArray[Any]


class Bars(NamedTuple):
    """Derivatives of a loss."""

    stiffness: list[Array]  # by k of every spring, as in `Sheet.springs`, at the same unstretched length
    unstretched: list[Array]  # by the unstretched lengths
    virtual: Array  # by K of every point
    bending: Array  # by D dx dy
    keep: Array  # by keep of every point
    gain: Array  # by gain of every point, after step 0
    first_gain: Array  # by that of step 0
    strength: Array  # by the forces at the control points, as in `Schedule`
    point: Array  # by the control points


def coefficients(plan: Plan, made: Sheet) -> tuple[Array, Array, Array]:
    """Give keep, gain, and the gain of step 0, of every point; shape (rows, cols, 1)."""
    h, g, m = plan.grid.step, (made.drag / made.mass)[..., None], made.mass[..., None]
    moves = ~plan.fixed[..., None]
    if plan.scene.time.damping_difference == "central":
        return (1 - g * h / 2) / (1 + g * h / 2), moves * h**2 / m / (1 + g * h / 2), moves * h**2 / m / 2
    return 1 - g * h, moves * h**2 / m, moves * h**2 / m / 2


def displacements(plan: Plan, made: Sheet, loads: Schedule) -> list[Array]:
    """Step a sheet and give u_0, u_1, ... [m]."""
    keep, gain, first_gain = coefficients(plan, made)
    u = d = np.zeros((*plan.scene.sheet.points, 3))
    every = [u]
    for n in range(len(loads.active)):
        d = keep * d + (gain if n else first_gain) * force(plan.scene, made, loads, n, u)
        u = u + d
        every.append(u)
    return every


def force(scene: Scene, made: Sheet, loads: Schedule, n: int, u: Array) -> Array:
    """Add up all forces but the damping at a step [N]."""
    total = -loads.active[n] * made.virtual[..., None] * u + _bent(scene, made.bending, u)
    for springs in made.springs:
        between, length = _ends_apart(springs, u)
        pull = springs.stiffness * (1 - springs.unstretched / length)
        at_rest = springs.stiffness * (1 - springs.unstretched / springs.length)
        _spread(total := total + 0j if np.iscomplexobj(pull) else total, springs, pull[..., None] * between)
        _spread(total, springs, -at_rest[..., None] * springs.offset)
    for share, _, strength in _shares(scene, loads, n):
        total = total + share[..., None] * strength
    return total


def tangent(scene: Scene, made: Sheet, active: float, u: Array, v: Array) -> Array:
    """Apply F'(u) to v: the change of the forces as the displacements u change by v."""
    total = -active * made.virtual[..., None] * v + _bent(scene, made.bending, v)
    for springs in made.springs:
        between, length = _ends_apart(springs, u)
        apart = v[springs.there] - v[springs.here]
        along = (between * apart).sum(axis=-1) / length
        change = (1 - springs.unstretched / length)[..., None] * apart
        change += (springs.unstretched / length**2 * along)[..., None] * between
        _spread(total, springs, springs.stiffness[..., None] * change)
    return total


def backward(plan: Plan, made: Sheet, loads: Schedule, every: list[Array], slopes: dict[int, Array]) -> Bars:
    """Give the derivatives of a loss; every: u_0, u_1, ...; slopes: its derivative by u_n, for some n."""
    scene, steps = plan.scene, len(loads.active)
    keep, gain, first_gain = coefficients(plan, made)
    zero = np.zeros_like(every[0])
    stiffness, unstretched = ([np.zeros_like(one.stiffness) for one in made.springs] for _ in range(2))
    virtual, bending = np.zeros_like(made.virtual), np.zeros(())
    keep_bar, gain_bar, first_bar = (np.zeros(made.mass.shape) for _ in range(3))
    strength, point = np.zeros_like(loads.strength), np.zeros_like(loads.point)
    u_bar, d_bar = slopes.get(steps, zero), zero
    for n in reversed(range(steps)):
        u, d_bar = every[n], d_bar + u_bar
        force_bar = (gain if n else first_gain) * d_bar
        for index, springs in enumerate(made.springs):
            between, length = _ends_apart(springs, u)
            apart = force_bar[springs.here] - force_bar[springs.there]
            along, at_rest = (between * apart).sum(axis=-1) / length, apart @ springs.offset / springs.length
            stiffness[index] += (length - springs.unstretched) * along
            stiffness[index] -= (springs.length - springs.unstretched) * at_rest
            unstretched[index] -= springs.stiffness * (along - at_rest)
        virtual -= loads.active[n] * (u * force_bar).sum(axis=-1)
        bending = bending + (_bent(scene, 1.0, u) * force_bar).sum()
        (gain_bar if n else first_bar)[...] += (force(scene, made, loads, n, u) * d_bar).sum(axis=-1)
        if n:
            keep_bar += ((u - every[n - 1]) * d_bar).sum(axis=-1)
        for slot, (share, slope, full) in enumerate(_shares(scene, loads, n)):
            strength[n, slot] = (share[..., None] * force_bar).sum(axis=(0, 1))
            point[n, slot] = (slope * (force_bar @ full)[..., None]).sum(axis=(0, 1))
        u_bar = u_bar + tangent(scene, made, loads.active[n], u, force_bar) + slopes.get(n, zero)
        d_bar = keep * d_bar
    return Bars(stiffness, unstretched, virtual, bending, keep_bar, gain_bar, first_bar, strength, point)


def _ends_apart(springs: Springs, u: Array) -> tuple[Array, Array]:
    """Give the vectors from one end of each spring to the other, and their lengths [m]."""
    between = u[springs.there] - u[springs.here] + springs.offset
    return between, np.sqrt((between**2).sum(axis=-1))


def _spread(total: Array, springs: Springs, pull: Array) -> None:
    """Add the forces of springs to both of their ends."""
    total[springs.here] += pull
    total[springs.there] -= pull


def _bent(scene: Scene, stiffness: Any, u: Array) -> Array:
    """Give the forces of bending, which are linear."""
    (dx, dy), total = spacing(scene.sheet), np.zeros(u.shape, np.result_type(u, stiffness))
    inner = u[1:-1, 1:-1]
    moment = (u[1:-1, 2:] - 2 * inner + u[1:-1, :-2]) / dx**2 + (u[2:, 1:-1] - 2 * inner + u[:-2, 1:-1]) / dy**2
    moment = stiffness * moment
    total[1:-1, 1:-1] += (2 / dx**2 + 2 / dy**2) * moment
    total[1:-1, 2:] -= moment / dx**2
    total[1:-1, :-2] -= moment / dx**2
    total[2:, 1:-1] -= moment / dy**2
    total[:-2, 1:-1] -= moment / dy**2
    return total


def _shares(scene: Scene, loads: Schedule, n: int) -> Iterator[tuple[Array, Array, Array]]:
    """Give for every slot the points' shares of its force, their derivatives by the control point, and the force."""
    rest = rest_positions(scene.sheet)[..., :2]
    for index, slot in enumerate(loads.slots):
        probe, off = scene.probes[slot.probe], rest - loads.point[n, index]
        distance = np.sqrt((off**2).sum(axis=-1))
        beyond = distance.real > probe.radius
        share = np.exp(-probe.falloff * np.where(beyond, distance - probe.radius, 0))
        if probe.total is None:
            share = share * np.exp(-probe.offset)
        else:
            share[[0, -1]] /= 2
            share[:, [0, -1]] /= 2
        slope = (share * probe.falloff * beyond / np.where(distance == 0, 1, distance))[..., None] * off
        yield share, slope, loads.strength[n, index]
