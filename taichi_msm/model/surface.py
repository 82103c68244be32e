"""The deformed sheet: its points, and any place on the surface that is drawn between them.

The refined surface as arrays that other programs can draw; and instruments, whose tips touch it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.sheet import axes
from taichi_msm.model.tool_force import control_point
from taichi_msm.model.tools import build_tools, unit_vector
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Instrument

Array = NDArray[np.float64]


def to_positions(displacement: NDArray[Any], sheet: Sheet) -> NDArray[Any]:
    """Turn displacements [m], shape (rows, cols, 3), into positions, which are not to be written to."""
    position, (x, y) = displacement, axes(sheet)
    # The sum is computed in float64 and rounded once, without a float64 copy of the sheet.
    np.add(position[..., 0], x, out=position[..., 0], casting="same_kind")
    np.add(position[..., 1], y, out=position[..., 1], casting="same_kind")
    position.flags.writeable = False
    return position


def surface_point(position: NDArray[np.floating], refine: int, sheet: Sheet, rest: Array) -> tuple[Array, Array]:
    """Find the point of the refined surface whose rest position, x and y [m], is `rest`.

    A point outside the sheet moves with the nearest point of its edge. The mass points are at `position` [m], shape
    (rows, cols, 3), and `refine` vertices are inserted between neighbours.

    Returns:
        The point [m], and the unit normal of its cell there, upward at rest; both of shape (3,).
    """
    height, width = sheet.size
    across = min(1.0, max(0.0, rest[0] / width + 0.5))
    down = min(1.0, max(0.0, 0.5 - rest[1] / height))
    point, normal = (each[0] for each in _on_cells(position, refine, np.array([[across, down]])))
    beside = np.array([rest[0] - (across - 0.5) * width, rest[1] - (0.5 - down) * height, 0.0])
    return point + beside, normal / max(float(np.linalg.norm(normal)), 1e-300)


def surface_positions(position: NDArray[np.floating], refine: int, coordinates: NDArray[np.floating]) -> Array:
    """Place material points on the refined surface [m], shape (n, 3).

    `coordinates` are fractions of the sheet's width from its left and of its height from its top, shape (n, 2);
    `position` and `refine` as for `surface_point`.
    """
    return _on_cells(position, refine, coordinates.astype(np.float64))[0]


def surface_weights(coordinates: Array, sheet: Sheet, refine: int) -> tuple[NDArray[np.intp], Array]:
    """Give the four mass points around each point of the surface that is drawn, and their weights, shapes (N, 4).

    coordinates: across and down, shape (N, 2). The points are numbered row after row; the same place on the surface as
    that of `surface_positions`.
    """
    cols = sheet.points[1]
    i, j, s, t, twist = _in_cells(coordinates, sheet.points, refine)
    first = i * cols + j
    corners = np.stack([first, first + 1, first + cols, first + cols + 1], axis=1)
    return corners, np.stack([1 - s - t + twist, s - twist, t - twist, twist], axis=1)


def _on_cells(position: NDArray[np.floating], refine: int, coordinates: Array) -> tuple[Array, Array]:
    """Give the points at some coordinates, and normals of their cells there, of any length; both of shape (n, 3)."""
    rows, cols = position.shape[:2]
    i, j, *shares = _in_cells(coordinates, (rows, cols), refine)
    s, t, twist = (share[:, None] for share in shares)
    a, right, below, far = (position[i + n // 2, j + n % 2].astype(np.float64) for n in range(4))
    b, c, d = right - a, below - a, far - right - below + a
    return a + b * s + c * t + d * twist, np.cross(b + d * t, -(c + d * s))


def _in_cells(coordinates: Array, points: tuple[int, int], refine: int) -> tuple[NDArray[Any], ...]:
    """Give the row i and the column j of each coordinate's cell, s and t across and down in it, and a twist.

    That takes the place of s t: in a small quad of the refined surface it is linear on either side of the diagonal.
    """
    (rows, cols), parts = points, refine + 1
    s, t = (coordinates * (cols - 1, rows - 1)).T
    j, i = np.minimum(s.astype(int), cols - 2), np.minimum(t.astype(int), rows - 2)
    s, t = s - j, t - i
    s0, t0 = (np.minimum((each * parts).astype(int), parts - 1) / parts for each in (s, t))
    s1, t1 = s - s0, t - t0
    return i, j, s, t, s0 * t0 + s1 * t0 + s0 * t1 + np.minimum(s1, t1) / parts


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


class Capsule(NamedTuple):
    """The shape and place of an instrument at one time: a rod with rounded ends."""

    tip: Array  # middle of its rounded tip [m], shape (3,)
    axis: Array  # unit vector from there along the rod, shape (3,)
    length: float  # between the middles of its ends [m]
    radius: float  # of the rod and its ends [m]


def refine_surface(position: NDArray[np.floating], refine: int) -> Surface:
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


def place_capsules(scene: Scene, position: NDArray[np.floating], time: float) -> list[Capsule]:
    """Place the instruments of a scene at a time [s]; the mass points are at `position` [m], shape (rows, cols, 3)."""
    moved = {tool.probe: tool for tool in build_tools(scene.probes, scene.sheet)}
    placed = []
    for index, probe in enumerate(scene.probes):
        if index in moved:
            tool = moved[index]
            placed.append(Capsule(tool.tip_centre(np.array([time]))[0], tool.axis, tool.length, tool.radius))
        elif probe.instrument is not None:
            placed.append(place_capsule(probe.instrument, scene, position, control_point(probe, scene.sheet, time)))
    return placed


def place_capsule(instrument: Instrument, scene: Scene, position: NDArray[np.floating], rest: Array) -> Capsule:
    """Place an instrument; `rest` is the rest position of the point that it touches, x and y [m], shape (2,)."""
    axis = unit_vector(instrument.shaft)
    point, normal = surface_point(position, scene.render.refine, scene.sheet, rest)
    outward = normal if normal @ axis >= 0 else -normal
    return Capsule(point + instrument.radius * outward, axis, instrument.length, instrument.radius)


def _between(values: NDArray[np.floating], refine: int, axis: int) -> NDArray[np.floating]:
    """Insert values between neighbours along an axis; the given values keep their bits."""
    parts = refine + 1
    along = np.moveaxis(values, axis, 0)
    share = np.arange(parts, dtype=values.dtype).reshape(-1, *(1,) * (along.ndim - 1)) / parts
    filled = along[:-1, None] + share * (along[1:] - along[:-1])[:, None]
    return np.moveaxis(np.concatenate([filled.reshape(-1, *along.shape[1:]), along[-1:]]), 0, axis)
