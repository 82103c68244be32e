"""Interface of a tool's shape, shared by NumPy and kernels.

A shape is convex and has an axis, from its tip c along the unit vector a: it lies within `radius` of the points c + s a
with 0 <= s <= length. Its formulas are plain arithmetic: NumPy calls them as they are, kernels call them wrapped by
Taichi.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from taichi_msm.arithmetic import Array, Operations

# Distances below this count as 0; the square is representable in f32.
MIN_DISTANCE_M = 1e-18


class Shape(ABC):
    """The shape of a tool."""

    name: ClassVar[str]  # for messages
    max_stride: ClassVar[float]  # largest allowed displacement of a tool in a step, in radii
    is_round: ClassVar[bool] = False  # whether it contains every point within `radius` of the axis

    @abstractmethod
    def build_depth(self, operations: Operations) -> Callable[..., Any]:
        """Build the function depth(x, y, z, a_x, a_y, a_z, length, radius) of points relative to the tip [m].

        It returns the depth inside the shape [m], negative outside, and x, y and z of the outward unit normal at the
        nearest point of its surface.
        """

    @abstractmethod
    def build_ray(self, operations: Operations) -> Callable[..., Any]:
        """Build the function intersect(d_d, d_a, o_a, o_d, o_o, length, radius) of lines o + t d relative to the tip.

        d_d is the product d . d, and so on. The function returns four values:

        - t at the point where the line enters the shape;
        - whether it enters;
        - `foot`, the coordinate s of the axis point nearest to that point [m];
        - `end`: on a flat end 1 or -1, with the normal `end` a; elsewhere 0, with the normal along o + t d - `foot` a.
        """

    @abstractmethod
    def profile(self, length: float, radius: float) -> Array:
        """Return the profile of the surface of revolution, from the far end to the tip, shape (points, 4).

        The columns are the axial and radial coordinate [m], and the axial and radial component of the normal.

        Args:
            length: length of the axis [m].
            radius: radius of the shape [m].
        """

    @abstractmethod
    def tip_height(self, axis: Array, radius: float) -> float:
        """Return the height of the tip above the lowest point of the end of the shape [m].

        Args:
            axis: unit vector from the tip along the shaft, shape (3,).
            radius: radius of the shape [m].
        """

    @abstractmethod
    def gap(self, tip: Array, axis: Array, length: float, radius: float, half: Array) -> float:
        """Return the distance of the shape from a rectangle at z = 0 around the origin [m]; minus the depth on contact.

        Args:
            tip: position of the tip [m], shape (3,).
            axis: unit vector from the tip along the shaft, shape (3,).
            length: length of the axis [m].
            radius: radius of the shape [m].
            half: half the sides of the rectangle along x and y, and 0 [m], shape (3,).
        """
