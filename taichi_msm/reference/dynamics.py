"""The model once more: forces and steps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.lattice import fixed_points, rest_positions, springs
from taichi_msm.physics.loads import Schedule, probe_slots, schedule
from taichi_msm.physics.timestep import step, steps_per_frame
from taichi_msm.scene import Scene

Array = NDArray[np.float64]


def elastic_force(scene: Scene, displacement: Array) -> Array:
    """Sum k (L - L0) (Q - P) / L over the neighbours Q of every point P (eq. 2).

    Args:
        scene: the scene.
        displacement: x - X [m], shape (rows, cols, 3).

    Returns:
        Force [N], shape (rows, cols, 3).
    """
    force = np.zeros_like(displacement)
    for spring in springs(scene):
        here, there = spring.ends(scene.sheet.points)
        between = displacement[there] - displacement[here] + np.array([*spring.offset, 0.0])
        length = np.linalg.norm(between, axis=-1, keepdims=True)
        pull = np.divide(length - spring.length, length, out=np.zeros_like(length), where=length > 0)
        force[here] += spring.stiffness * pull * between
    return force


def shortest_spring(scene: Scene, displacement: Array) -> float:
    """Find how far the springs are compressed.

    Args:
        scene: the scene.
        displacement: x - X [m], shape (rows, cols, 3).

    Returns:
        The smallest L / L0 of all springs; 1 where there are none.
    """
    smallest = 1.0
    for spring in springs(scene):
        if (spring.down, spring.right) < (0, 0):
            continue
        here, there = spring.ends(scene.sheet.points)
        between = displacement[there] - displacement[here]
        between[..., 0] += spring.offset[0]
        between[..., 1] += spring.offset[1]
        square = np.einsum("ijk,ijk->ij", between, between).min(initial=math.inf)
        smallest = min(smallest, math.sqrt(square) / spring.length)
    return smallest


def surgical_force(scene: Scene, loads: Schedule, n: int) -> Array:
    """Sum (percent / 100) force exp(-falloff d - offset) over the probes (eq. 5).

    Args:
        scene: the scene.
        loads: its schedule.
        n: row of the schedule.

    Returns:
        Force [N], shape (rows, cols, 3).
    """
    rest = rest_positions(scene.sheet)
    force = np.zeros_like(rest)
    for index, slot in enumerate(probe_slots(scene)):
        probe = scene.probes[slot.probe]
        distance = np.linalg.norm(rest[..., :2] - loads.point[n, index], axis=-1)
        force += np.exp(-probe.falloff * distance - probe.offset)[..., None] * loads.strength[n, index]
    return force


def force(scene: Scene, displacement: Array, loads: Schedule, n: int) -> Array:
    """Add up all forces but the damping at one step (eq. 1).

    Args:
        scene: the scene.
        displacement: x - X [m], shape (rows, cols, 3).
        loads: its schedule.
        n: row of the schedule.

    Returns:
        Force [N], shape (rows, cols, 3).
    """
    return (
        elastic_force(scene, displacement)
        + surgical_force(scene, loads, n)
        - loads.active[n] * scene.springs.virtual * displacement
    )


def displacements(scene: Scene) -> Iterator[Array]:
    """Step the scene by Stoermer-Verlet (eq. 6 to 9) and yield u_0, u_1, ... [m], each of shape (rows, cols, 3)."""
    h, m, damping = step(scene), scene.sheet.mass, scene.damping
    moves = ~fixed_points(scene.sheet)[..., None]
    g = damping / m
    loads = schedule(scene, 0, scene.time.frames * steps_per_frame(scene))

    previous = np.zeros((*scene.sheet.points, 3))
    yield previous
    current = h**2 / 2 * force(scene, previous, loads, 0) / m * moves
    yield current
    for n in range(1, len(loads.active)):
        a = force(scene, current, loads, n) / m
        if scene.time.damping_difference == "central":
            following = (2 * current - (1 - g * h / 2) * previous + h**2 * a) / (1 + g * h / 2)
        else:
            following = 2 * current - previous + h**2 * a - g * h * (current - previous)
        previous, current = current, following * moves
        yield current


def simulate(scene: Scene) -> Array:
    """Run the whole scene.

    Returns:
        Positions of every frame [m], shape (F + 1, rows, cols, 3).
    """
    every = steps_per_frame(scene)
    frames = [u for n, u in enumerate(displacements(scene)) if n % every == 0]
    return rest_positions(scene.sheet) + np.array(frames)
