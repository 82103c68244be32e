"""Springs between a mass point and its neighbours, for scenes with `springs` and without a map."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

from taichi_msm.model.sheet import spacing
from taichi_msm.scene.scene import Scene

Window = tuple[slice, slice]


class Spring(NamedTuple):
    """A spring from a point to one of its neighbours."""

    # down, right: rows and columns from the point to its neighbour
    down: int
    right: int
    offset: tuple[float, float]  # rest vector from the point to its neighbour [m], x right, y up
    length: float  # rest length L0 [m]
    stiffness: float  # k [N/m]

    def ends(self, points: tuple[int, int]) -> tuple[Window, Window]:
        """Return the windows of the points of a sheet (rows, cols) that have this spring, and of their neighbours."""
        i, i_q = _ends(self.down, points[0])
        j, j_q = _ends(self.right, points[1])
        return (i, j), (i_q, j_q)


def _ends(ahead: int, count: int) -> tuple[slice, slice]:
    """Return the slices of `count` points with a neighbour `ahead` further on, and of these neighbours."""
    return slice(max(0, -ahead), count - max(0, ahead)), slice(max(0, ahead), count - max(0, -ahead))


def springs(scene: Scene) -> tuple[Spring, ...]:
    """Return the springs from a point to its neighbours, up to 8, without those of stiffness 0."""
    assert scene.springs is not None
    (dx, dy), stencil = spacing(scene.sheet), []
    for down, right in itertools.product((-1, 0, 1), repeat=2):
        stiffness = scene.springs.shear if down and right else scene.springs.structural
        if (down, right) != (0, 0) and stiffness > 0:
            offset = right * dx, -down * dy
            stencil.append(Spring(down, right, offset, math.hypot(*offset), stiffness))
    return tuple(stencil)
