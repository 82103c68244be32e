"""Surfaces over a picture or a grid of points: positions and their derivatives by fractions across and down."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.surfaces.splines import GridSpline

# Maps fractions across and down, shape (k, 2), to positions X [m], shape (k, 3), and dX/dp, shape (k, 3, 2).
Surface = Callable[[Array], tuple[Array, Array]]

# Maps pixels, shape (k, 2), to normalised undistorted coordinates x / z and y / z, shape (k, 2), and their Jacobian,
# shape (k, 2, 2).
Sight = Callable[[Array], tuple[Array, Array]]


def depth_surface(inverse_depth: Array, sight: Sight) -> Surface:
    """Return the points at the depth 1 / e_s on the lines of sight, in the camera's axes (right, down, forward).

    `inverse_depth` is e_s of the pixels [1/m], shape (h, w), with their centres at k + 1/2.
    """
    spline = GridSpline(inverse_depth)
    size = np.array(inverse_depth.shape[::-1])

    def surface(fractions: Array) -> tuple[Array, Array]:
        pixels = fractions * size
        e, e_down, e_across = spline(pixels[:, 1] - 0.5, pixels[:, 0] - 0.5)
        depth = (1 / e)[:, None]
        xy, jacobian = sight(pixels)
        ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        slope = -(depth**2) * np.stack([e_across, e_down], axis=1) * size
        position_slope = ray[:, :, None] * slope[:, None]
        position_slope[:, :2] += depth[:, None] * jacobian * size
        return depth * ray, position_slope

    return surface


def point_surface(points: Array) -> Surface:
    """Return the cubic splines in (u, v) through points [m], shape (r, c, 3)."""
    spline = GridSpline(points)
    counts = np.array(points.shape[1::-1]) - 1

    def surface(fractions: Array) -> tuple[Array, Array]:
        across, down = (fractions * counts).T
        position, by_row, by_column = spline(down, across)
        return position, np.stack([by_column, by_row], axis=-1) * counts

    return surface


def given_grid(points: tuple[int, int]) -> Array:
    """Return the fractions (u, v) of the grid as in the file, shape (rows, cols, 2)."""
    rows, cols = points
    return np.stack(np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows)), axis=-1)


def positions(surface: Surface, fractions: Array) -> Array:
    """Return the positions [m] at fractions across and down, shape (rows, cols, 3) from (rows, cols, 2)."""
    return surface(fractions.reshape(-1, 2))[0].reshape(*fractions.shape[:2], 3)
