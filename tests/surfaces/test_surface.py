"""Surfaces over a picture: points on the lines of sight, with derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_msm.arithmetic import Array
from taichi_msm.surfaces.surface import Surface, depth_surface, given_grid, point_surface, positions
from tests.surfaces.walls import CENTRE, FOCAL_LENGTH, HEIGHT, WIDTH, plane, sight, tube

RANDOM = np.random.default_rng(4)


def distorted_sight(pixels: Array) -> tuple[Array, Array]:
    """Sight through a lens with x (1 + x^2 + y^2 / 2) on the way out."""
    xy, slope = sight(pixels)
    x, y = xy.T
    factor = 1 + x * x + y * y / 2
    jacobian = np.stack([np.stack([factor + 2 * x * x, x * y], -1), np.stack([2 * x * y, factor + y * y], -1)], axis=1)
    return xy * factor[:, None], jacobian @ slope


SURFACES = {
    "pinhole": depth_surface(tube(0.025, 65), sight),
    "lens": depth_surface(plane(30), distorted_sight),
    "points": point_surface(RANDOM.standard_normal((5, 7, 3))),
}


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_derivatives(surface: Surface) -> None:
    """Against central differences, whose error is the third derivative times h^2 / 6."""
    p, h = RANDOM.random((30, 2)), 1e-5
    slope = surface(p)[1]
    for axis in (0, 1):
        shift = h * np.eye(2)[axis]
        difference = (surface(p + shift)[0] - surface(p - shift)[0]) / (2 * h)
        assert slope[..., axis] == pytest.approx(difference, rel=1e-6, abs=1e-7)


def test_points_of_a_plane() -> None:
    """1 / depth is linear, so splines keep it up to the picture's corners: n . X = n . X0."""
    x = positions(depth_surface(plane(40, 0.7), sight), given_grid((6, 9)))
    normal = np.array([np.tan(np.radians(40)) * np.cos(0.7), np.tan(np.radians(40)) * np.sin(0.7), 1])
    assert x @ normal == pytest.approx(np.full((6, 9), 0.05), rel=1e-12)
    corner = x[0, 0]
    assert corner[:2] / corner[2] * FOCAL_LENGTH + CENTRE == pytest.approx(np.array([0.0, 0.0]), abs=1e-11)
    corner = x[-1, -1]
    assert corner[:2] / corner[2] * FOCAL_LENGTH + CENTRE == pytest.approx(np.array([WIDTH, HEIGHT]), abs=1e-11)


def test_points_stay() -> None:
    points = RANDOM.standard_normal((5, 7, 3))
    assert positions(point_surface(points), given_grid((5, 7))) == pytest.approx(points, abs=1e-13)
