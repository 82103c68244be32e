"""The refined surface as arrays that other programs can draw; and instruments, whose tips touch it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.deformed import touched
from taichi_msm.physics.paths import tools_of, unit
from taichi_msm.physics.probe_force import control_point
from taichi_msm.scene import Instrument, Scene

Array = NDArray[np.float64]


class Surface(NamedTuple):
    """Textured triangles.

    Attributes:
        vertices: positions [m], shape (vertices, 3), row after row from the top left.
        triangles: indices of vertices, shape (triangles, 3), counter-clockwise as seen from above.
        texture_coordinates: fractions of the picture's width from its left and of its height from its top, shape
            (vertices, 2).
    """

    vertices: NDArray[np.floating]
    triangles: NDArray[np.int32]
    texture_coordinates: NDArray[np.float64]


class Rod(NamedTuple):
    """The shape and place of an instrument at one time: a rod with rounded ends."""

    tip: Array  # middle of its rounded tip [m], shape (3,)
    axis: Array  # unit vector from there along the rod, shape (3,)
    length: float  # between the middles of its ends [m]
    radius: float  # of the rod and its ends [m]


def surface(position: NDArray[np.floating], refine: int) -> Surface:
    """Refine the sheet bilinearly (section 2 of the paper); every small quad is cut from top left to bottom right.

    The mass points are at `position` [m], shape (rows, cols, 3); `refine` vertices are inserted between neighbours.
    """
    vertices = _between(_between(position, refine, 0), refine, 1)
    rows, cols = vertices.shape[:2]
    corner = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols)
    upper_left, upper_right = corner[:-1, :-1], corner[:-1, 1:]
    lower_left, lower_right = corner[1:, :-1], corner[1:, 1:]
    lower = np.stack([upper_left, lower_left, lower_right], axis=-1)
    upper = np.stack([upper_left, lower_right, upper_right], axis=-1)
    across, down = np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows))
    return Surface(
        vertices.reshape(-1, 3),
        np.stack([lower, upper], axis=2).reshape(-1, 3),
        np.stack([across, down], axis=-1).reshape(-1, 2),
    )


def rods(scene: Scene, position: NDArray[np.floating], time: float) -> list[Rod]:
    """Place the instruments of a scene at a time [s]; the mass points are at `position` [m], shape (rows, cols, 3)."""
    moved = {tool.probe: tool for tool in tools_of(scene.probes, scene.sheet)}
    placed = []
    for index, probe in enumerate(scene.probes):
        if index in moved:
            tool = moved[index]
            placed.append(Rod(tool.middle(np.array([time]))[0], tool.axis, tool.length, tool.radius))
        elif probe.instrument is not None:
            placed.append(rod(probe.instrument, scene, position, control_point(probe, scene.sheet, time)))
    return placed


def rod(instrument: Instrument, scene: Scene, position: NDArray[np.floating], rest: Array) -> Rod:
    """Place an instrument; `rest` is the rest position of the point that it touches, x and y [m], shape (2,)."""
    axis = unit(instrument.shaft)
    point, normal = touched(position, scene.render.refine, scene.sheet, rest)
    outward = normal if normal @ axis >= 0 else -normal
    return Rod(point + instrument.radius * outward, axis, instrument.length, instrument.radius)


def _between(values: NDArray[np.floating], refine: int, axis: int) -> NDArray[np.floating]:
    """Insert values between neighbours along an axis; the given values keep their bits."""
    parts = refine + 1
    along = np.moveaxis(values, axis, 0)
    share = np.arange(parts, dtype=values.dtype).reshape(-1, *(1,) * (along.ndim - 1)) / parts
    filled = along[:-1, None] + share * (along[1:] - along[:-1])[:, None]
    return np.moveaxis(np.concatenate([filled.reshape(-1, *along.shape[1:]), along[-1:]]), 0, axis)
