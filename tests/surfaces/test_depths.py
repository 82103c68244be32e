"""Depth maps: numbers without depth, units and distances."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_msm.surfaces.depths import Depths
from tests.surfaces.walls import X, Y, plane


@pytest.mark.parametrize(
    ("numbers", "known"),
    [
        (np.array([[0, 1, 254, 255]], np.uint8), [0, 1, 1, 0]),
        (np.array([[0, 255, 65534, 65535]], np.uint16), [0, 1, 1, 0]),
        (np.array([[0, -1, 7, 2**31 - 1]], np.int32), [0, 0, 1, 0]),
        (np.array([[0.0, -1.0, np.nan, np.inf, -np.inf, 255.0]], np.float32), [0, 0, 0, 0, 0, 1]),
    ],
)
def test_numbers_without_depth(numbers: np.ndarray, known: list[int]) -> None:
    depths = Depths.of(numbers, 1e-3)
    assert depths.is_known.tolist() == [[bool(each) for each in known]]
    is_known = depths.is_known
    assert depths.depth.dtype == np.float64
    assert (depths.depth[is_known] == numbers[is_known].astype(float) * 1e-3).all()
    assert (depths.depth > 0).all()
    assert depths.filled() == pytest.approx(1 - np.mean(known))


def test_mask() -> None:
    """Outside there is no depth, and the share is that of the mask's pixels."""
    depths = Depths.of(np.array([[0, 2], [3, 0]], np.uint16), 1.0)
    is_sheet = np.array([[True, True], [False, False]])
    assert depths.within(is_sheet).is_known.tolist() == [[False, True], [False, False]]
    assert depths.filled(is_sheet) == 0.5


def test_distances_from_the_eye() -> None:
    depth = 1 / plane(30)
    ray = np.stack([X, Y, np.ones_like(X)], axis=-1)
    distances = np.linalg.norm(depth[..., None] * ray, axis=-1)
    assert Depths.of(distances, 1.0).from_distances(X, Y).depth == pytest.approx(depth, rel=1e-14)
