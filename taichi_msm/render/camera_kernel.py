"""The camera in kernels: from a mass point to the picture, and from a sample back. Its host side is camera.py."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from taichi_msm.render import uniforms as uni
from taichi_msm.system.runtime import ti

# The numbers of a mass point: (X, Y, w, depth), its place in the picture [samples].
SEEN, POINT_NUMBERS = 4, 6


@ti.func
def project(position: ti.template(), i, j, cols, numbers: ti.template(), point: ti.template(), double: ti.template()):
    """Store the numbers of mass point (i, j); `double` tells that they are in f64, and summed in another order."""
    here = (i * cols + j) * POINT_NUMBERS
    x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
    for n in ti.static(range(4)):
        row = uni.MATRIX + 4 * n
        if ti.static(double):
            point[here + n] = numbers[row + 3] + numbers[row] * x + numbers[row + 1] * y + numbers[row + 2] * z
        else:
            point[here + n] = numbers[row] * x + numbers[row + 1] * y + numbers[row + 2] * z + numbers[row + 3]
    point[here + SEEN] = point[here] / point[here + 2]
    point[here + SEEN + 1] = point[here + 1] / point[here + 2]


@ti.func
def w_at(depth, numbers: ti.template()):
    """Give w of points at a depth."""
    return depth * numbers[uni.PINHOLE] + (1.0 - numbers[uni.PINHOLE])


@ti.func
def line_of_sight(x, y, numbers: ti.template()):
    """Give how far points that are seen at (x, y) are to the right and above the axis of view, at w = 1 [m]."""
    return (x - numbers[uni.CENTRE_X]) * numbers[uni.SPREAD], (numbers[uni.CENTRE_Y] - y) * numbers[uni.SPREAD]
