"""The sheet of a scene at rest: the kinds of surfaces."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.view import first_view
from taichi_msm.images import PictureError
from taichi_msm.model.depth import depth_positions
from taichi_msm.model.geometry import CurvedRest, FlatRest, Origin, Rest
from taichi_msm.model.grids import kept_grid
from taichi_msm.model.mask import Mask, sample_nearest
from taichi_msm.model.pictured import Picture, PicturedRest
from taichi_msm.scene.sheet import Sheet, SheetMask
from taichi_msm.scene.surface import Dome, HeightField, KeptGrid, PointGrid, RestSurface, Tube
from taichi_msm.surfaces.surface import point_surface, positions


def rest_of(sheet: Sheet) -> Rest:
    """Return the sheet at rest; a PictureError if the file of its surface cannot be used."""
    file = sheet.surface.file if sheet.surface else None
    mask = sheet.mask.pixels.sha256 if sheet.mask else ""
    return _rest(sheet.points, sheet.size, sheet.surface, sheet.mask, (file.sha256 if file else "", mask))


def rest_normals(sheet: Sheet) -> Array:
    """Return the unit normals at the mass points at rest, shape (rows, cols, 3)."""
    rest = rest_of(sheet)
    return rest.point_normals if isinstance(rest, CurvedRest) else np.tile([0.0, 0.0, 1.0], (*sheet.points, 1))


def heights(displacement: NDArray[Any], sheet: Sheet) -> NDArray[Any]:
    """Return the components of displacements, shape (rows, cols, 3), along the normals at rest [m]."""
    rest = rest_of(sheet)
    return (displacement * rest.point_normals).sum(axis=-1) if isinstance(rest, CurvedRest) else displacement[..., 2]


def freeze_surface(sheet: Sheet) -> Sheet:
    """Return a sheet with the smoothing and the even grid that its mass points have, in place of their choice.

    The sheet read again from run.json and rest.npz is then the same, also if its mass points were chosen for a
    tolerance, while smoothing and grid follow from those of the scene.
    """
    if sheet.surface is None or sheet.surface.frame is None:
        return sheet
    rest = rest_of(sheet)
    assert isinstance(rest, CurvedRest)
    smooth = None if sheet.surface.frame.points == sheet.points else rest.origin.deviation
    return sheet.with_frozen_surface(smooth, None if rest.origin.grid is None else KeptGrid.of(rest.origin.grid))


@lru_cache(maxsize=8)
def _rest(
    points: tuple[int, int],
    size: tuple[float, float],
    surface: RestSurface | None,
    mask: SheetMask | None,
    sha256: tuple[str, str],  # noqa: ARG001  # of the files, part of the key of the cache
) -> Rest:
    is_sheet = None if mask is None else mask.pixels.is_sheet
    sampled = None if is_sheet is None else Mask.at_cells(is_sheet, points)
    if surface is None:
        return FlatRest(points, size, sampled)
    frame, origin = surface.frame, Origin()
    picture = Picture(first_view(frame.cameras, frame.image_size), frame.region) if frame and frame.cameras else None
    if surface.frame_key and picture is None:
        raise PictureError("its picture, image, cannot be read", "name the picture that the camera took")
    if surface.depth:
        assert frame is not None
        assert picture is not None
        position, origin = depth_positions(surface.depth, frame, picture, points, mask, even=surface.is_even)
    elif surface.points and surface.is_even:
        assert frame is not None
        values, sha256_of_file = surface.points.points.values, surface.points.points.sha256
        on_file = point_surface(values)
        grid = kept_grid(on_file, frame, points, (sha256_of_file, surface.points.unit))
        position, origin = positions(on_file, grid), Origin(grid)
    else:
        position = KINDS[surface.kind](getattr(surface, surface.kind), FlatRest(points, size).position)
    if picture is None:
        return CurvedRest(position, sampled, origin)
    if is_sheet is not None:
        across, down = np.moveaxis(picture.at_cells(position), -1, 0)
        sampled = Mask(sample_nearest(is_sheet, across, down))
    return PicturedRest(position, sampled, picture, origin)


def _height_positions(field: HeightField, flat: Array) -> Array:
    """Return (x, y, z(u, v))."""
    v, u = (np.arange(count) / (count - 1) for count in flat.shape[:2])
    return np.dstack([flat[..., :2], sample_bilinearly(field.heights.values, v[:, None], u)])


def _tube_positions(tube: Tube, flat: Array) -> Array:
    """Return (r sin(x / R), y, R - r cos(x / R)), r = R - depth (1 + cos(2 pi y / spacing)) / 2."""
    radius, x, y = tube.radius, flat[..., 0], flat[..., 1]
    r = np.full(x.shape, radius)
    if tube.folds is not None:
        r -= tube.folds.depth * (1 + np.cos(2 * np.pi * y / tube.folds.spacing)) / 2
    return np.stack([r * np.sin(x / radius), y, radius - r * np.cos(x / radius)], axis=-1)


def _dome_positions(dome: Dome, flat: Array) -> Array:
    """Return R ((a, b, 1) / (1 + a^2 + b^2)^(1/2) - (0, 0, 1)), a = tan(x / R), b = tan(y / R)."""
    a, b = np.tan(flat[..., 0] / dome.radius), np.tan(flat[..., 1] / dome.radius)
    length = np.sqrt(1 + a * a + b * b)
    # 1 / length - 1 without cancellation.
    return dome.radius * np.stack([a / length, b / length, -(a * a + b * b) / (length * (1 + length))], axis=-1)


def _point_positions(grid: PointGrid, flat: Array) -> Array:
    """Return the points of the file, or with another number of points those of cubic splines in (u, v)."""
    from scipy.interpolate import CubicSpline

    positions = grid.points.values
    if positions.shape[:2] == flat.shape[:2]:
        return positions.copy()
    for axis, count in enumerate(flat.shape[:2]):
        splines = CubicSpline(np.linspace(0, 1, positions.shape[axis]), positions, axis)
        positions = splines(np.arange(count) / (count - 1))
    return positions


# Positions of the mass points [m] of each kind, from those of the flat sheet, shape (rows, cols, 3) each.
KINDS: dict[str, Callable[[Any, Array], Array]] = {
    "height": _height_positions,
    "tube": _tube_positions,
    "dome": _dome_positions,
    "points": _point_positions,
}


def sample_bilinearly(values: NDArray[Any], down: Array, across: Array) -> Array:
    """Sample pixels bilinearly between their centres, constant beyond them, shape (m, n).

    `down` and `across` are fractions of the height from the top and of the width from the left, which broadcast to (m,
    n).
    """
    height, width = values.shape
    row = np.clip(down * height - 0.5, 0, height - 1)
    column = np.clip(across * width - 0.5, 0, width - 1)
    top, left = row.astype(int), column.astype(int)
    bottom, right = np.minimum(top + 1, height - 1), np.minimum(left + 1, width - 1)
    down, across = row - top, column - left
    above = values[top, left] * (1 - across) + values[top, right] * across
    below = values[bottom, left] * (1 - across) + values[bottom, right] * across
    return np.asarray(above * (1 - down) + below * down)
