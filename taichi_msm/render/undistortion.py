"""Undistortion maps: undistorted positions of the samples of a picture, computed once per lens and picture size.

With the map, and with bounds of the distortion of a cell, kernel 2 covers distorted pictures like undistorted ones.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.lens import Lens
from taichi_msm.cameras.view import View
from taichi_msm.render.camera import border_points

Pair = tuple[float, float]

# Undistorted coordinate of a sample beyond the limit of the lens.
INVALID_COORDINATE = 1e9


class VisibleRegion(NamedTuple):
    """Visible region of the plane at depth 1, and bounds of the lens distortion in it.

    Distortion bends a line of length L into a curve at most `sagitta_factor` L^2 from its chord: the second derivatives
    are at most 8 `sagitta_factor`. The length of the curve is at most 2 `stretch_factor` L.
    """

    radius: float  # largest distance from the optical axis, in normalised image coordinates
    box: tuple[float, float, float, float]  # left, right, top and bottom without distortion [px]
    sagitta_factor: float  # [1/px]
    stretch_factor: float  # [1]


def visible_region(view: View) -> VisibleRegion:
    """Return the visible region of a camera with lens distortion."""
    assert view.lens is not None
    scale, centre, size = ((float(pair[0]), float(pair[1])) for pair in (view.scale, view.centre, view.size))
    return _visible_region(view.lens, scale, centre, size)


@lru_cache(maxsize=16)
def _visible_region(lens: Lens, scale: Pair, centre: Pair, size: Pair) -> VisibleRegion:
    border = lens.undistort((border_points(np.array(size)) - centre) / scale)
    radius = float(np.linalg.norm(border, axis=-1).max())
    if np.isnan(radius):
        radius = lens.limit
        border = np.array([[-radius, -radius], [radius, radius]])
    # The margin of one pixel is the spacing of the border points.
    (left, top), (right, bottom) = border.min(axis=0) * scale + centre - 1, border.max(axis=0) * scale + centre + 1
    # The derivatives are bounded by their maximum on a polar grid, with a safety factor.
    radii, angles = np.meshgrid(radius * np.linspace(0, 1, 256), np.linspace(0, 2 * np.pi, 64))
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)
    step = 1e-5 * radius
    differences = [lens.jacobian(points + shift) - lens.jacobian(points - shift) for shift in np.eye(2) * step]
    second_derivative = np.sqrt((np.stack(differences) ** 2).sum(axis=(0, -1))).max() / (2 * step)
    derivative = np.sqrt((lens.jacobian(points) ** 2).sum(axis=-1)).max()
    max_scale, min_scale, safety_factor = max(scale), min(scale), 1.25
    return VisibleRegion(
        radius * (1 + 1e-5),
        (float(left), float(right), float(top), float(bottom)),
        safety_factor * float(second_derivative) * max_scale / min_scale**2 / 8,
        safety_factor * float(derivative) * max_scale / min_scale / 2,
    )


def undistorted_view(view: View) -> View:
    """Return a camera with the same visible region, but no lens distortion; wide lenses lose resolution."""
    left, right, top, bottom = visible_region(view).box
    # The undistorted picture is at most four times as large as the distorted one.
    view_scale = min(1.0, 4 * float(view.size.max()) / max(right - left, bottom - top))
    origin, matrix = np.array([left, top]), view.matrix.copy()
    for row in (0, 1):
        matrix[row] = (matrix[row] - origin[row] * matrix[2]) * view_scale
    size = np.ceil(np.array([right - left, bottom - top]) * view_scale)
    return view._replace(
        matrix=matrix, scale=view.scale * view_scale, centre=(view.centre - origin) * view_scale, size=size, lens=None
    )


def undistortion_map(view: View, supersample: int, *, with_steps: bool) -> NDArray[np.float32]:
    """Compute the undistorted x and y of all samples of a picture [samples], shape (rows, columns, 2).

    They are INVALID_COORDINATE beyond the limit of the lens. With steps, the shape is (rows, columns, 6): also x and y
    of the step to the sample on the right, and x and y of that to the sample below.
    """
    assert view.lens is not None
    width, height = (int(side) * supersample for side in view.size)
    table = np.empty((height, width, 6 if with_steps else 2), np.float32)
    # In blocks of rows, to bound the memory.
    for first_row in range(0, height, 64):
        end_row = min(first_row + 64, height)
        pixels = (np.stack(np.meshgrid(np.arange(width), np.arange(first_row, end_row)), axis=-1) + 0.5) / supersample
        undistorted = view.undistort(pixels)
        is_valid = ~np.isnan(undistorted[..., :1])
        table[first_row:end_row, :, :2] = np.where(is_valid, undistorted * supersample, INVALID_COORDINATE)
        if with_steps:
            jacobian = view.lens.jacobian((np.where(is_valid, undistorted, view.centre) - view.centre) / view.scale)
            inverse = np.linalg.inv(jacobian) * view.scale[:, None] / view.scale
            table[first_row:end_row, :, 2:] = np.where(
                is_valid, np.moveaxis(inverse, -1, -2).reshape(*is_valid.shape[:2], 4), 0
            )
    return table
