"""Even grids: their objective against its formula, and their cells on walls."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from taichi_msm.arithmetic import Array
from taichi_msm.model.cells import Cells, isotropy_errors
from taichi_msm.surfaces import even_grid as even_grid_module
from taichi_msm.surfaces.even_grid import FoldedGridError, even_grid
from taichi_msm.surfaces.grid_objective import GridObjective, is_unfolded
from taichi_msm.surfaces.smoothing import smooth_inverse_depth
from taichi_msm.surfaces.surface import Surface, depth_surface, given_grid, point_surface, positions
from tests.surfaces.walls import X, Y, folds, plane, sight, tube


def rough() -> Array:
    """Smoothed inverse depth of a plane with noise of 0.2 mm, in steps of 0.8 mm."""
    depth = 1 / plane(30) + 2e-4 * np.random.default_rng(5).standard_normal(X.shape)
    return smooth_inverse_depth(1 / (8e-4 * np.round(depth / 8e-4)), np.ones(X.shape, bool), X, Y, 3.0)


WALLS = {
    "plane 30": plane(30),
    "plane 40": plane(40),
    "folds": folds(0.0025, 0.02),
    "tube": tube(0.025, 65),
    "rough plane": rough(),
}
POINTS = (41, 51)


def mean_isotropy_error(x: Array) -> float:
    cells = Cells.of(x)
    return float(np.average(isotropy_errors(cells), weights=cells.area))


def moved(points: tuple[int, int], share: float) -> Array:
    """A grid with its points moved by up to a share of a cell, on the sides along them alone."""
    p = given_grid(points)
    shift = share * np.random.default_rng(6).uniform(-1, 1, p.shape) / (points[1] - 1, points[0] - 1)
    shift[:, [0, -1], 0] = 0
    shift[[0, -1], :, 1] = 0
    return p + shift


def formula(surface: Surface, p: Array, r: float) -> float:
    """The objective, corner by corner."""
    rows, cols = p.shape[:2]
    x = positions(surface, p)
    mean_area = Cells.of(positions(surface, given_grid((rows, cols)))).area.mean()
    total = 0.0
    for i in range(rows - 1):
        for j in range(cols - 1):
            for down in (0, 1):
                for across in (0, 1):
                    a, b = x[i + down, j + 1] - x[i + down, j], x[i + 1, j + across] - x[i, j + across]
                    area = np.linalg.norm(np.cross(a, b))
                    total += (a @ a / r + b @ b * r) / (2 * area) + 0.01 * (area / mean_area + mean_area / area)
    return float(total / (4 * (rows - 1) * (cols - 1)))


def test_objective_is_the_smallest_of_the_formula_over_r() -> None:
    surface, p = depth_surface(tube(0.025, 65), sight), moved((4, 6), 0.2)
    value, r, _ = GridObjective(surface, (4, 6)).at(positions(surface, p))
    assert value == pytest.approx(formula(surface, p, r), rel=1e-12)
    assert value < min(formula(surface, p, 1.001 * r), formula(surface, p, r / 1.001))


@pytest.mark.parametrize("name", ["folds", "rough plane"])
def test_gradient(name: str) -> None:
    """Against central differences, whose error is the third derivative times h^2 / 6, along the cells' sides."""
    p, h = moved((5, 7), 0.2), 1e-6
    objective = GridObjective(depth_surface(WALLS[name], sight), (5, 7))
    gradient = objective(p)[1]
    for at in np.ndindex(p.shape):
        shift = np.zeros_like(p)
        shift[at] = h
        difference = (objective(p + shift)[0] - objective(p - shift)[0]) / (2 * h)
        is_fixed = (at[1] in (0, 6)) if at[2] == 0 else (at[0] in (0, 4))
        assert gradient[at] == (0 if is_fixed else pytest.approx(difference, rel=1e-5, abs=1e-6))


@pytest.mark.parametrize("name", WALLS)
def test_cells_on_walls_are_isotropic(name: str) -> None:
    surface = depth_surface(WALLS[name], sight)
    grid = even_grid(surface, POINTS)
    x, given = positions(surface, grid), positions(surface, given_grid(POINTS))
    assert mean_isotropy_error(given) > 0.1
    assert mean_isotropy_error(x) < 0.007  # as on planes at 40 degrees
    area = Cells.of(x).area
    sides = [np.linalg.norm(np.diff(x, axis=axis), axis=-1).min() for axis in (0, 1)]
    assert min(sides) > 0.15 * np.sqrt(area.mean())
    assert is_unfolded(grid)


def test_points_on_sides_stay_there() -> None:
    p = even_grid(depth_surface(WALLS["tube"], sight), POINTS)
    given = given_grid(POINTS)
    assert (p[:, [0, -1], 0] == given[:, [0, -1], 0]).all()
    assert (p[[0, -1], :, 1] == given[[0, -1], :, 1]).all()
    assert np.abs(p - given).max() > 0.02


def test_aspect_is_that_of_square_cells() -> None:
    """On a plane across the view the grid stays, and r is that of the picture's cells."""
    surface = depth_surface(plane(0), sight)
    grid = even_grid(surface, (17, 33))
    # Where r is best, the first term is 1 for rectangles, and the second smallest for equal areas.
    assert grid == pytest.approx(given_grid((17, 33)), abs=1e-6)
    assert GridObjective(surface, (17, 33)).at(positions(surface, grid)).aspect == pytest.approx(
        (160 / 32) / (128 / 16)
    )


def test_result_is_a_minimum() -> None:
    """Another minimiser, from another start, finds the same grid."""
    surface, points = depth_surface(WALLS["folds"], sight), (11, 13)
    objective = GridObjective(surface, points)
    grid = even_grid(surface, points)

    def flat(p: Array) -> tuple[float, Array]:
        value, gradient = objective(p.reshape(grid.shape))
        return min(value, 1e2), gradient.ravel()

    options = {"ftol": 1e-15, "gtol": 1e-8}
    expected = minimize(flat, moved(points, 0.2).ravel(), jac=True, method="L-BFGS-B", options=options)
    assert objective(grid)[0] == pytest.approx(expected.fun, rel=1e-9)
    # The tolerance of 1e-10 of the value is about 0.001 cells.
    assert np.abs(grid.ravel() - expected.x).max() * 12 < 0.01


def test_points_of_a_grid() -> None:
    """Points of a plane, bunched together: the even grid spreads them."""
    u, v = np.moveaxis(given_grid((9, 11)), -1, 0)
    surface = point_surface(np.stack([u + u * u, v + u * v, 0 * u], axis=-1))
    x = positions(surface, even_grid(surface, (21, 26)))
    assert mean_isotropy_error(x) < 0.01 < 0.1 < mean_isotropy_error(positions(surface, given_grid((21, 26))))


@pytest.mark.parametrize("points", [(2, 2), (2, 9), (9, 2)])
def test_points_on_sides_alone(points: tuple[int, int]) -> None:
    """Those of a plane across the view stay, also across the sides that have no others."""
    assert even_grid(depth_surface(plane(0), sight), points) == pytest.approx(given_grid(points), abs=1e-5)


def test_turned_corners_are_refused() -> None:
    p = given_grid((3, 3))
    assert is_unfolded(p)
    p[1, 1] = 1.1, 0.5
    assert not is_unfolded(p)
    assert GridObjective(depth_surface(plane(0), sight), (3, 3))(p)[0] == np.inf


def test_grid_without_area() -> None:
    """All points of the left half are one."""
    u, v = np.moveaxis(given_grid((33, 33)), -1, 0)
    surface = point_surface(np.stack([np.maximum(u - 0.5, 0), v * (u > 0.5), 0 * u], axis=-1))
    with pytest.raises(FoldedGridError) as caught:
        even_grid(surface, (21, 21))
    assert caught.value.place[0] < 0.5


def test_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(even_grid_module, "MAX_ITERATIONS", 40)
    calls: list[tuple[int, int]] = []
    even_grid(depth_surface(plane(30), sight), (17, 17), lambda *call: calls.append(call))
    assert calls == sorted(calls)
    assert calls[0] == (0, 80)
    assert calls[-1] == (80, 80)
