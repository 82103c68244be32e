"""The capsule, a rod with round ends: all points within `radius` of the axis."""

# No `from __future__ import annotations` here: Taichi reads the functions of a shape.

from collections.abc import Callable
from typing import Any

import numpy as np

from taichi_msm.arithmetic import Array, Operations
from taichi_msm.shapes.shape import MIN_DISTANCE_M, Shape


class Capsule(Shape):
    """A rod with round ends."""

    name = "capsule"
    max_stride = 0.5
    is_round = True

    def build_depth(self, operations: Operations) -> Callable[..., Any]:
        """Build the depth, radius - |r'|, and the normal r' / |r'|, or +z on the axis; see `Shape.build_depth`."""
        sqrt, maximum, minimum, where = operations.sqrt, operations.maximum, operations.minimum, operations.where

        def depth(x, y, z, a_x, a_y, a_z, length, radius):
            s = maximum(minimum(x * a_x + y * a_y + z * a_z, length), 0)
            r_x, r_y, r_z = x - s * a_x, y - s * a_y, z - s * a_z
            distance = sqrt(r_x * r_x + r_y * r_y + r_z * r_z)
            divisor = maximum(distance, MIN_DISTANCE_M)
            return radius - distance, r_x / divisor, r_y / divisor, where(distance > 0, r_z / divisor, 1)

        return depth

    def build_ray(self, operations: Operations) -> Callable[..., Any]:
        """Build the intersection with the cylinder, or with the sphere around the nearer end of the axis."""
        sqrt, maximum, minimum, where = operations.sqrt, operations.maximum, operations.minimum, operations.where

        def intersect(d_d, d_a, o_a, o_d, o_o, length, radius):
            # The cylinder: a t^2 + 2 b t + c = 0.
            a = maximum(d_d - d_a * d_a, 1e-12)
            b = o_d - o_a * d_a
            c = o_o - o_a * o_a - radius * radius
            discriminant = b * b - a * c
            t_side = (sqrt(maximum(discriminant, 0.0)) + b) * (-1.0) / a
            along = o_a + t_side * d_a
            # The sphere around the nearer end of the axis.
            end = where(along < length * 0.5, 0.0, length)
            b_end = o_d - end * d_a
            c_end = o_o - 2.0 * end * o_a + end * end - radius * radius
            discriminant_end = b_end * b_end - d_d * c_end
            t_end = (sqrt(maximum(discriminant_end, 0.0)) + b_end) * (-1.0) / d_d
            on_side = (along >= 0.0) & (along <= length)
            t = where(on_side, t_side, t_end)
            is_hit = (discriminant >= 0.0) & (on_side | (discriminant_end >= 0.0))
            foot = maximum(minimum(o_a + t * d_a, length), 0.0)
            return t, is_hit, foot, t * 0.0

        return intersect

    def profile(self, length: float, radius: float) -> Array:
        # Two quarters of a circle, of 8 segments each.
        latitude = np.linspace(np.pi / 2, 0, 9)
        latitude, offset = np.concatenate([latitude, -latitude[::-1]]), np.repeat([length, 0.0], len(latitude))
        normals = np.stack([np.sin(latitude), np.cos(latitude)])
        return np.stack([offset + radius * normals[0], radius * normals[1], *normals], axis=1)

    def tip_height(self, axis: Array, radius: float) -> float:
        return radius

    def gap(self, tip: Array, axis: Array, length: float, radius: float, half: Array) -> float:
        def distance(s: float) -> float:
            point = tip + s * axis
            return float(np.linalg.norm(point - np.clip(point, -half, half)))

        # Ternary search, because the distance of the axis from the rectangle is a convex function of s.
        low, high = 0.0, length
        for _ in range(200):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            low, high = (low, right) if distance(left) <= distance(right) else (left, high)
        return distance(low) - radius
