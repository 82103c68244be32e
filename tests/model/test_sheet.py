from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.model.sheet import fixed_points, rest_positions
from tests.scenes import SHEET, scene


def test_rest_positions() -> None:
    position = rest_positions(scene(sheet={**SHEET, "points": [3, 5], "size": [0.2, 0.4]}).sheet)
    np.testing.assert_allclose(position[..., 0], np.tile([-0.2, -0.1, 0, 0.1, 0.2], (3, 1)), atol=1e-15)
    np.testing.assert_allclose(position[..., 1], np.tile([[0.1], [0], [-0.1]], (1, 5)), atol=1e-15)
    assert not position[..., 2].any()


@pytest.mark.parametrize(
    ("fixed", "pattern"),
    [
        ("border", "####/#..#/####"),
        ("corners", "#..#/..../#..#"),
        ("none", "..../..../...."),
        (["top"], "####/..../...."),
        (["bottom", "right"], "...#/...#/####"),
        ([], "..../..../...."),
    ],
)
def test_fixed_points(fixed: Any, pattern: str) -> None:
    made = scene(sheet={**SHEET, "points": [3, 4], "fixed": fixed})
    rows = ["".join(".#"[point] for point in row) for row in fixed_points(made.sheet).astype(int)]
    assert "/".join(rows) == pattern
