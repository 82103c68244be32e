"""A lens: a model with its coefficients, its inverse and its Jacobian, in NumPy."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from taichi_msm.arithmetic import NUMPY, Array
from taichi_msm.dual import DUAL, Dual
from taichi_msm.lenses import MODELS

# Maximum residual of the undistortion, in normalised image coordinates; well below 1e-6 px.
UNDISTORTION_TOLERANCE = 1e-11


class Lens(NamedTuple):
    """A lens model and its coefficients."""

    model: str  # name of the model, a key of `lenses.MODELS`
    coefficients: tuple[float, ...]  # all coefficients, in the order of the model

    @property
    def limit(self) -> float:
        """Largest valid radius: there the distortion folds back, or the angle from the optical axis is 88 degrees."""
        return _limit(self)

    def distort(self, points: Array) -> Array:
        """Distort normalised image coordinates, shape (..., 2); the result has the same shape."""
        distort = MODELS[self.model].build(NUMPY)
        return np.stack(distort(points[..., 0], points[..., 1], *self.coefficients), axis=-1)

    def jacobian(self, points: Array) -> Array:
        """Return the Jacobian of `distort`, shape (..., 2, 2); the rows are those of the distorted coordinates."""
        return self._distort_with_jacobian(points)[1]

    def undistort(self, distorted: Array) -> Array:
        """Invert `distort`, in closed form or by Newton's method from the solution without tangential distortion.

        Coordinates without a solution within the limit of the lens become NaN.
        """
        inverse = MODELS[self.model].undistort(distorted, self.coefficients)
        if inverse is not None:
            return inverse
        limit = self.limit
        # Without the limit, which may be a pole.
        radii = limit * np.sin(np.linspace(0, np.pi / 2, 4097)[:-1])
        radial = self._replace(coefficients=MODELS[self.model].without_tangential(self.coefficients))
        profile = radial.distort(np.stack([radii, 0 * radii], axis=-1))[..., 0]
        distorted_radius = np.linalg.norm(distorted, axis=-1, keepdims=True)
        radius = np.interp(distorted_radius, profile, radii)
        with np.errstate(invalid="ignore", divide="ignore"):
            points = np.where(distorted_radius > 0, distorted * (radius / distorted_radius), 0.0)
        error = np.full(distorted_radius.shape[:-1], np.inf)
        for _ in range(50):
            image, jacobian = self._distort_with_jacobian(points)
            residual = distorted - image
            error = np.abs(residual).max(axis=-1)
            if not (error > UNDISTORTION_TOLERANCE).any():
                break
            (a, b), (c, d) = np.moveaxis(jacobian, (-2, -1), (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                x, y = residual[..., 0], residual[..., 1]
                step = np.stack([d * x - b * y, a * y - c * x], axis=-1)
                points = points + step / (a * d - b * c)[..., None]
                # Clamp to the limit: beyond it there may be a second solution.
                points *= np.minimum(1, limit / np.linalg.norm(points, axis=-1, keepdims=True))
        is_converged = (error <= UNDISTORTION_TOLERANCE) & (np.linalg.norm(points, axis=-1) < limit)
        return np.where(is_converged[..., None], points, np.nan)

    def _distort_with_jacobian(self, points: Array) -> tuple[Array, Array]:
        distort = MODELS[self.model].build(DUAL)
        unit = np.eye(2).reshape(2, 2, *(1,) * (points.ndim - 1))
        x, y = (Dual(points[..., n], np.broadcast_to(unit[n], (2, *points.shape[:-1]))) for n in (0, 1))
        distorted = distort(x, y, *self.coefficients)
        jacobian = np.stack([np.moveaxis(number.slope, 0, -1) for number in distorted], axis=-2)
        return np.stack([number.value for number in distorted], axis=-1), jacobian


@lru_cache(maxsize=16)
def _limit(lens: Lens) -> float:
    return MODELS[lens.model].limit(lens.coefficients)


# The lens without distortion.
IDENTITY_LENS = Lens("pinhole", (0.0,) * 8)
