"""The plate, a cylinder with flat ends, as the punches of indentation tests."""

# No `from __future__ import annotations` here: Taichi reads the functions of a shape.

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from taichi_msm.arithmetic import NUMPY, Array, Operations
from taichi_msm.shapes.shape import MIN_DISTANCE_M, Shape

# Lower bound of divisors, for rays parallel to the axis or to the ends.
MIN_COSINE = 1e-12


class Plate(Shape):
    """A cylinder with flat ends. Its strides must be short, because points under an end are pushed along the axis."""

    name = "plate"
    max_stride = 0.05

    def build_depth(self, operations: Operations) -> Callable[..., Any]:
        """Build the depth below the side or an end, and its normal; see `Shape.build_depth`."""
        sqrt, maximum, where = operations.sqrt, operations.maximum, operations.where

        def depth(x, y, z, a_x, a_y, a_z, length, radius):
            s = x * a_x + y * a_y + z * a_z
            r_x, r_y, r_z = x - s * a_x, y - s * a_y, z - s * a_z
            distance = sqrt(r_x * r_x + r_y * r_y + r_z * r_z)
            divisor = maximum(distance, MIN_DISTANCE_M)
            outside_side, outside_end = distance - radius, maximum(s * (-1.0), s - length)
            # An end counts as nearest unless the side is 8 times nearer, so points near the rim stay under the end.
            is_side = outside_side * 8.0 > outside_end
            sign = where(s < length * 0.5, -1.0, 1.0)
            return (
                where(is_side, outside_side, outside_end) * (-1.0),
                where(is_side, r_x / divisor, sign * a_x),
                where(is_side, r_y / divisor, sign * a_y),
                where(is_side, r_z / divisor, sign * a_z),
            )

        return depth

    def build_ray(self, operations: Operations) -> Callable[..., Any]:
        """Build the intersection with the infinite cylinder, limited to t between the planes of the ends."""
        sqrt, maximum, where = operations.sqrt, operations.maximum, operations.where

        def intersect(d_d, d_a, o_a, o_d, o_o, length, radius):
            # The side, without the components along the axis: a t^2 + 2 b t + c = 0.
            a = maximum(d_d - d_a * d_a, MIN_COSINE)
            b = o_d - o_a * d_a
            c = o_o - o_a * o_a - radius * radius
            discriminant = b * b - a * c
            half = sqrt(maximum(discriminant, 0.0)) / a
            enters_side, leaves_side = b * (-1.0) / a - half, half - b / a
            # The ends.
            slope = where(d_a < 0.0, -1.0, 1.0) * maximum(where(d_a < 0.0, d_a * (-1.0), d_a), MIN_COSINE)
            sign = where(d_a < 0.0, 1.0, -1.0)
            enters_end = (where(d_a < 0.0, length, 0.0) - o_a) / slope
            leaves_end = (where(d_a < 0.0, 0.0, length) - o_a) / slope
            t = maximum(enters_side, enters_end)
            is_hit = (discriminant >= 0.0) & (t <= leaves_side) & (t <= leaves_end)
            return t, is_hit, o_a + t * d_a, where(enters_side > enters_end, 0.0, sign)

        return intersect

    def profile(self, length: float, radius: float) -> Array:
        # The far end, the side and the end at the tip.
        ends = [[length, 0, 1, 0], [length, radius, 1, 0], [length, radius, 0, 1]]
        return np.array([*ends, [0, radius, 0, 1], [0, radius, -1, 0], [0, 0, -1, 0]], float)

    def tip_height(self, axis: Array, radius: float) -> float:
        # The height of the centre of the end above its rim's lowest point; 0 where the axis is vertical.
        return radius * math.hypot(*axis[:2])

    def gap(self, tip: Array, axis: Array, length: float, radius: float, half: Array) -> float:
        # Inside, the largest depth on a grid of points; outside, the distance by alternating projection.
        grid = np.stack(np.meshgrid(*np.linspace(-half[:2], half[:2], 401).T, [0.0]), axis=-1).reshape(-1, 3) - tip
        if (deepest := float(self.build_depth(NUMPY)(*grid.T, *axis, length, radius)[0].max())) > 0:
            return -deepest
        point = np.zeros(3)
        for _ in range(1000):
            r = point - tip
            s = float(np.clip(r @ axis, 0, length))
            across = r - (r @ axis) * axis
            nearest = tip + s * axis + across * min(1.0, radius / max(float(np.linalg.norm(across)), MIN_DISTANCE_M))
            point = np.clip(nearest, -half, half)
        return float(np.linalg.norm(point - nearest))
