"""Splines of a grid against SciPy's of one variable, and on polynomials, which they keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from taichi_msm.surfaces.splines import GridSpline

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (4, 3), (9, 12)])
def test_spline_is_that_of_scipy(shape: tuple[int, int]) -> None:
    """Row by row and then down, also half a pixel beyond the outermost centres, with both derivatives."""
    values = RANDOM.standard_normal((*shape, 3))
    row, column = (RANDOM.uniform(-0.5, count - 0.5, 50) for count in shape)
    spline = GridSpline(values)
    for got, (by_row, by_column) in zip(spline(row, column), [(0, 0), (1, 0), (0, 1)], strict=True):
        across = CubicSpline(np.arange(shape[1]), values, axis=1)(column, by_column)  # (rows, places, 3)
        down = CubicSpline(np.arange(shape[0]), across, axis=0)(row, by_row)  # (places, places, 3)
        assert got == pytest.approx(down[np.arange(50), np.arange(50)], abs=1e-12)


def test_cubics_stay_cubics() -> None:
    i, j = np.meshgrid(np.arange(6.0), np.arange(8.0), indexing="ij")
    row, column = RANDOM.uniform(-0.5, 5.5, 20), RANDOM.uniform(-0.5, 7.5, 20)
    value, by_row, by_column = GridSpline(i**3 * j - i * j**2 + j**3)(row, column)
    # Numbers up to 2000, with a rounding of 1e-16 each.
    assert value == pytest.approx(row**3 * column - row * column**2 + column**3, abs=1e-10)
    assert by_row == pytest.approx(3 * row**2 * column - column**2, abs=1e-10)
    assert by_column == pytest.approx(row**3 - 2 * row * column + 3 * column**2, abs=1e-10)
