from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm.model.sheet import fixed_points, rest_positions
from tests.reference.neighbours import springs
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


def test_springs_lead_to_the_rest_positions_of_the_neighbours() -> None:
    made = scene()
    rest = rest_positions(made.sheet)
    for spring in springs(made):
        between = rest[4 + spring.down, 4 + spring.right] - rest[4, 4]
        np.testing.assert_allclose(between[:2], spring.offset, atol=1e-15)
        assert spring.length == pytest.approx(np.linalg.norm(between))
        here, there = spring.ends(made.sheet.points)
        np.testing.assert_allclose(rest[there] - rest[here] - [*spring.offset, 0], 0, atol=1e-15)
        assert rest[here].shape == (9 - abs(spring.down), 11 - abs(spring.right), 3), "all that have it"
        assert spring.stiffness == (10 if spring.down and spring.right else 20)
    assert len(springs(made)) == 8
    assert len(springs(scene(springs={"shear": 1}))) == 4
