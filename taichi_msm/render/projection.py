"""Where the mass points are seen, and the normals of the sheet there."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

from taichi_msm.render.coverage import NORMAL, POINT_NUMBERS, SEEN
from taichi_msm.render.numbers import AXES, MATRIX
from taichi_msm.render.samples import Code
from taichi_msm.system.runtime import ti


@cache
def projection(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that projects a mass point.

    Args:
        code: what it is compiled for.
    """

    @ti.func
    def project(position: ti.template(), numbers: ti.template(), point: ti.template(), i, j, rows, cols):
        """Store where mass point (i, j) is seen, and its normal; for tissue, in the camera's frame."""
        here = (i * cols + j) * POINT_NUMBERS
        x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
        for n in ti.static(range(4)):
            row = MATRIX + 4 * n
            point[here + n] = numbers[row] * x + numbers[row + 1] * y + numbers[row + 2] * z + numbers[row + 3]
        point[here + SEEN] = point[here] / point[here + 2]
        point[here + SEEN + 1] = point[here + 1] / point[here + 2]
        if ti.static(code.headlit or code.tissue):
            i0, i1 = ti.max(i - 1, 0), ti.min(i + 1, rows - 1)
            j0, j1 = ti.max(j - 1, 0), ti.min(j + 1, cols - 1)
            r_x = position[i, j1, 0] - position[i, j0, 0]
            r_y = position[i, j1, 1] - position[i, j0, 1]
            r_z = position[i, j1, 2] - position[i, j0, 2]
            u_x = position[i0, j, 0] - position[i1, j, 0]
            u_y = position[i0, j, 1] - position[i1, j, 1]
            u_z = position[i0, j, 2] - position[i1, j, 2]
            n_x = r_y * u_z - r_z * u_y
            n_y = r_z * u_x - r_x * u_z
            n_z = r_x * u_y - r_y * u_x
            length = ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
            n_x, n_y, n_z = n_x / length, n_y / length, n_z / length
            if ti.static(code.tissue):
                for n in ti.static(range(3)):
                    axis = AXES + 3 * n
                    point[here + NORMAL + n] = numbers[axis] * n_x + numbers[axis + 1] * n_y + numbers[axis + 2] * n_z
            else:
                point[here + NORMAL] = n_x
                point[here + NORMAL + 1] = n_y
                point[here + NORMAL + 2] = n_z

    return project
