"""Depth maps of walls in front of a pinhole camera with a horizontal field of view of 70 degrees."""

from __future__ import annotations

import numpy as np

from taichi_msm.arithmetic import Array

WIDTH, HEIGHT = 160, 128
FOCAL_LENGTH = WIDTH / 2 / np.tan(np.radians(35))
CENTRE = np.array([WIDTH, HEIGHT]) / 2

# Normalised image coordinates of the pixels' centres, shape (h, w).
X, Y = np.meshgrid(
    (np.arange(WIDTH) + 0.5 - CENTRE[0]) / FOCAL_LENGTH, (np.arange(HEIGHT) + 0.5 - CENTRE[1]) / FOCAL_LENGTH
)


def sight(pixels: Array) -> tuple[Array, Array]:
    return (pixels - CENTRE) / FOCAL_LENGTH, np.broadcast_to(np.eye(2) / FOCAL_LENGTH, (len(pixels), 2, 2))


def plane(degrees: float, azimuth: float = 0.0) -> Array:
    """Inverse depth [1/m] of a plane at 0.05 m on the axis, tilted towards an azimuth [rad]."""
    slope = np.tan(np.radians(degrees))
    return (1 + slope * (np.cos(azimuth) * X + np.sin(azimuth) * Y)) / 0.05


def folds(depth: float, spacing: float) -> Array:
    """Inverse depth [1/m] of a wall at 0.05 m with folds z = depth cos(2 pi x / spacing), by a fixed point."""
    z = np.full(X.shape, 0.05)
    for _ in range(200):
        z = 0.05 + (z - 0.05 + depth * np.cos(2 * np.pi * X * z / spacing)) / 2
    return 1 / z


def tube(radius: float, degrees: float) -> Array:
    """Inverse depth [1/m] of the inside of a tube through the eye's front, its axis tilted by degrees from the view."""
    axis = np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])
    ray = np.stack([X, Y, np.ones_like(X)], axis=-1)
    across = ray - (ray @ axis)[..., None] * axis
    return np.asarray(np.linalg.norm(across, axis=-1) / radius)
