"""The springs from a point to its neighbours, for scenes with `springs` and without a map."""

from __future__ import annotations

import math
from typing import NamedTuple

from taichi_msm.model.sheet import spacing
from taichi_msm.scene.scene import Scene

Window = tuple[slice, slice]


class Spring(NamedTuple):
    """A spring from a point to one of its neighbours.

    Attributes:
        down: rows from the point to its neighbour, i counted down.
        right: columns from the point to its neighbour.
        offset: rest vector from the point to its neighbour [m], x right, y up.
        length: rest length L0 [m].
        stiffness: k [N/m].
    """

    down: int
    right: int
    offset: tuple[float, float]
    length: float
    stiffness: float

    def ends(self, points: tuple[int, int]) -> tuple[Window, Window]:
        """Select the points of a sheet (rows, cols) that have this spring, and the neighbours it connects them to."""
        i, i_q = _ends(self.down, points[0])
        j, j_q = _ends(self.right, points[1])
        return (i, j), (i_q, j_q)


def _ends(ahead: int, count: int) -> tuple[slice, slice]:
    """Select, of `count` in a line, those with a neighbour `ahead` places further on, and these neighbours."""
    return slice(max(0, -ahead), count - max(0, ahead)), slice(max(0, ahead), count - max(0, -ahead))


def springs(scene: Scene) -> tuple[Spring, ...]:
    """List the springs from a point to its neighbours, up to 8, in a scene with `springs` and without a map.

    Families of stiffness 0 are left out.
    """
    assert scene.springs is not None
    dx, dy = spacing(scene.sheet)
    around = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)]
    stencil = (
        Spring(
            down,
            right,
            (right * dx, -down * dy),
            math.hypot(right * dx, down * dy),
            scene.springs.shear if down and right else scene.springs.structural,
        )
        for down, right in around
    )
    return tuple(spring for spring in stencil if spring.stiffness > 0)
