"""The deformed sheet: positions of mass points, the refined surface between them, and the tools that touch it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.geometry import Rest
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import control_point
from taichi_msm.model.tools import build_tools, solid_tools, unit_vector
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Instrument
from taichi_msm.shapes import SHAPES
from taichi_msm.shapes.shape import Shape


def to_positions(displacement: NDArray[Any], sheet: Sheet) -> NDArray[Any]:
    """Convert displacements [m], shape (rows, cols, 3), to positions in place, and make the array read-only."""
    position, rest = displacement, rest_of(sheet)
    # The sum is computed in float64 and rounded once, without a float64 copy of the sheet.
    for c in range(2 if rest.is_flat else 3):
        np.add(position[..., c], rest.position[..., c], out=position[..., c], casting="same_kind")
    position.flags.writeable = False
    return position


def surface_point(position: NDArray[np.floating], refine: int, sheet: Sheet, at: Array) -> tuple[Array, Array]:
    """Find the point of the refined surface with given coordinates at rest, see `Rest`, shape (2,).

    Return the point [m] and the unit normal of the surface there, upward at rest, shape (3,) each. A point outside the
    sheet moves with the nearest point of the sheet's edge. `refine` vertices lie between neighbouring mass points.
    """
    rest = rest_of(sheet)
    inside = np.clip(rest.fractions(at), 0.0, 1.0)
    place = np.clip(rest.mesh_places(inside[None]), 0.0, 1.0)
    point, normal = (values[0] for values in _interpolate(position, refine, place))
    outside = rest.place(np.asarray(at)[None])[0] - rest.place(rest.coordinates(inside)[None])[0]
    return point + outside, normal / max(float(np.linalg.norm(normal)), 1e-300)


def surface_positions(position: NDArray[np.floating], refine: int, coordinates: NDArray[np.floating]) -> Array:
    """Return the positions of material points on the refined surface [m], shape (n, 3).

    Their coordinates, shape (n, 2), are the fractions (u, v) of columns and rows.
    """
    return _interpolate(position, refine, coordinates.astype(np.float64))[0]


def surface_weights(coordinates: Array, sheet: Sheet, refine: int) -> tuple[NDArray[np.intp], Array]:
    """Return the four mass points around each point of `surface_positions`, and their weights, shape (n, 4) each.

    Coordinates are fractions across and down, shape (n, 2); mass points are numbered row by row. A point on no sheet,
    as of a coarser mesh, continues the nearest cell.
    """
    cols = sheet.points[1]
    rest = rest_of(sheet)
    i, j, s, t, twist = _cell_coordinates(rest.mesh_places(coordinates).clip(0, 1), sheet.points, refine, rest.mask)
    first = i * cols + j
    corners = np.stack([first, first + 1, first + cols, first + cols + 1], axis=1)
    return corners, np.stack([1 - s - t + twist, s - twist, t - twist, twist], axis=1)


def _interpolate(position: NDArray[np.floating], refine: int, coordinates: Array) -> tuple[Array, Array]:
    """Return points of the surface and its normals, not normalised, both of shape (n, 3)."""
    rows, cols = position.shape[:2]
    i, j, *in_cell = _cell_coordinates(coordinates, (rows, cols), refine)
    s, t, twist = (values[:, None] for values in in_cell)
    a, right, below, opposite = (position[i + n // 2, j + n % 2].astype(np.float64) for n in range(4))
    b, c, d = right - a, below - a, opposite - right - below + a
    return a + b * s + c * t + d * twist, np.cross(b + d * t, -(c + d * s))


def _cell_coordinates(
    coordinates: Array, points: tuple[int, int], refine: int, mask: Mask | None = None
) -> tuple[NDArray[Any], ...]:
    """Return row i and column j of each point's cell, the coordinates s (across) and t (down) in it, and a twist.

    The twist replaces the product s t of bilinear interpolation. It is linear in each triangle of a small quad.
    """
    (rows, cols), quads = points, refine + 1
    s, t = (coordinates * (cols - 1, rows - 1)).T
    j, i = np.minimum(s.astype(int), cols - 2), np.minimum(t.astype(int), rows - 2)
    if mask is not None:
        i, j = mask.nearest_cells(i, j, coordinates)
    s, t = s - j, t - i
    s0, t0 = (np.minimum((each * quads).astype(int), quads - 1) / quads for each in (s, t))
    s1, t1 = s - s0, t - t0
    return i, j, s, t, s0 * t0 + s1 * t0 + s0 * t1 + np.minimum(s1, t1) / quads


class Surface(NamedTuple):
    """Textured triangles, with vertices row by row from the top left; a mask leaves those of its cells."""

    vertices: NDArray[np.floating]  # positions [m], shape (vertices, 3)
    triangles: NDArray[np.int32]  # indices of vertices, shape (triangles, 3), counter-clockwise from above
    texture_coordinates: NDArray[np.float64]  # fractions of the texture from left and from top, shape (vertices, 2)


class Solid(NamedTuple):
    """The shape and position of an instrument at a time."""

    tip: Array  # end of the axis at the sheet [m], shape (3,)
    axis: Array  # unit vector from the tip along the shaft, shape (3,)
    length: float  # of the axis [m]
    radius: float  # of the shape [m]
    shape: Shape


def refine_surface(position: NDArray[np.floating], refine: int, rest: Rest | None = None) -> Surface:
    """Return the triangles of the sheet after bilinear refinement (section 2 of the paper).

    Every small quad is divided by the diagonal from top left to bottom right. `rest` has the cells that are sheet, by
    default all, and the places of the texture, by default those of columns and rows.
    """
    vertices = _insert(_insert(position, refine, 0), refine, 1)
    rows, cols = vertices.shape[:2]
    quads, points = np.ones((rows - 1, cols - 1), bool), np.ones((rows, cols), bool)
    if rest is not None and rest.mask is not None:
        quads = rest.mask.cells.repeat(refine + 1, axis=0).repeat(refine + 1, axis=1)
        points = Mask(quads).points
    corner = np.cumsum(points, dtype=np.int32).reshape(rows, cols) - 1
    upper_left, upper_right = corner[:-1, :-1], corner[:-1, 1:]
    lower_left, lower_right = corner[1:, :-1], corner[1:, 1:]
    lower = np.stack([upper_left, lower_left, lower_right], axis=-1)
    upper = np.stack([upper_left, lower_right, upper_right], axis=-1)
    across, down = np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows))
    mesh = np.stack([across, down], axis=-1)[points]
    # A place that the camera of a picture does not see is at the picture's corner.
    places = mesh if rest is None else np.nan_to_num(rest.sheet_places(mesh))
    return Surface(vertices[points], np.stack([lower, upper], axis=2)[quads].reshape(-1, 3), places)


def place_instruments(scene: Scene, position: NDArray[np.floating], time: float) -> list[Solid]:
    """Return a solid for every probe with an instrument at a time [s], in the order of the probes."""
    moved = {tool.probe: tool for tool in solid_tools(build_tools(scene.probes, scene.sheet)).values()}
    placed = []
    for index, probe in enumerate(scene.probes):
        if probe.instrument is None:
            continue
        if index in moved:
            tool = moved[index]
            tip = tool.path_at(np.array([time]))[0]
            placed.append(Solid(tip, tool.axis, tool.length, tool.radius, tool.shape))
        else:
            placed.append(place_instrument(probe.instrument, scene, position, control_point(probe, scene.sheet, time)))
    return placed


def place_instrument(instrument: Instrument, scene: Scene, position: NDArray[np.floating], rest: Array) -> Solid:
    """Place the instrument of a force-controlled probe above the material point with coordinates at rest, see `Rest`.

    Its tip is on the side of the deformed surface to which the shaft points.
    """
    axis = unit_vector(instrument.shaft)
    point, normal = surface_point(position, scene.render.refine, scene.sheet, rest)
    outward = normal if normal @ axis >= 0 else -normal
    shape, radius = SHAPES[instrument.shape], instrument.outer_radius
    return Solid(point + shape.tip_height(axis, radius) * outward, axis, instrument.length, radius, shape)


def _insert(values: NDArray[np.floating], refine: int, axis: int) -> NDArray[np.floating]:
    """Insert interpolated values between neighbours along an axis; the given values keep their bits."""
    intervals = refine + 1
    along = np.moveaxis(values, axis, 0)
    fraction = np.arange(intervals, dtype=values.dtype).reshape(-1, *(1,) * (along.ndim - 1)) / intervals
    filled = along[:-1, None] + fraction * (along[1:] - along[:-1])[:, None]
    return np.moveaxis(np.concatenate([filled.reshape(-1, *along.shape[1:]), along[-1:]]), 0, axis)
