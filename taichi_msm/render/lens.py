"""Lenses that bend lines: OpenCV's rational model and its fisheye, forward and back.

A place is where a line of sight meets the plane at depth 1, in OpenCV's axes: x to the right, y down. With r its
distance from the axis of view and q = r^2, the rational model gives

    x' = x R + 2 p1 x y + p2 (q + 2 x^2),    y' = y R + p1 (q + 2 y^2) + 2 p2 x y,
    R = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3),

and the fisheye, with t = atan(r),    (x', y') = (x, y) t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r.

Source: OpenCV's documentation of calib3d, "Detailed Description" and "Fisheye camera model".
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]

# No lens shows what is farther than this from its axis.
WIDEST = math.tan(math.radians(88))

# Coefficients up to this change nothing within it, and dividing by them may overflow.
TINY = 1e-100

# The inverse is exact to this, where the focal length is 1: well below 1e-6 px.
EXACT = 1e-11
MOST_ROUNDS = 50

# Radii at which is looked for the first fold that tangential distortion makes.
RADII = 4096

# Below this distance from the axis a fisheye's quotient t / r is 1 to rounding.
CENTRAL = 1e-8


class Lens(NamedTuple):
    """A lens: which model, and its coefficients in OpenCV's order, all of them."""

    fisheye: bool
    coefficients: tuple[float, ...]

    @property
    def limit(self) -> float:
        """The largest r up to which the lens is taken: it folds back there, or is too far from the axis."""
        return _limit(self)

    def distort(self, place: Array) -> Array:
        """Give the distorted places of places, both of shape (..., 2)."""
        return self._bend(place)[0]

    def jacobian(self, place: Array) -> Array:
        """Differentiate distorted places, rows, by places, columns; shape (..., 2, 2)."""
        return self._bend(place)[1]

    def undistort(self, distorted: Array) -> Array:
        """Give the places whose distorted places are these, both of shape (..., 2); NaN for those beyond the limit.

        Newton's method, begun at the solution without tangential distortion.
        """
        limit = self.limit
        # Not up to the limit, which may be a pole.
        near = limit * np.sin(np.linspace(0, np.pi / 2, 4097)[:-1])
        reach = np.linalg.norm(distorted, axis=-1, keepdims=True)
        radius = np.interp(reach, self._radial(near)[0], near)
        with np.errstate(invalid="ignore", divide="ignore"):
            place = np.where(reach > 0, distorted * (radius / reach), 0.0)
        error = np.full(reach.shape[:-1], np.inf)
        for _ in range(MOST_ROUNDS):
            seen, slope = self._bend(place)
            off = distorted - seen
            error = np.abs(off).max(axis=-1)
            if not (error > EXACT).any():
                break
            (a, b), (c, d) = np.moveaxis(slope, (-2, -1), (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - c * off[..., 0]], axis=-1)
                place = place + step / (a * d - b * c)[..., None]
                # Not beyond the limit, where another solution may be.
                place *= np.minimum(1, limit / np.linalg.norm(place, axis=-1, keepdims=True))
        good = (error <= EXACT) & (np.linalg.norm(place, axis=-1) < limit)
        return np.where(good[..., None], place, np.nan)

    def _radial(self, r: Array) -> tuple[Array, Array]:
        """Give R r, how far from the axis a point is seen without tangential distortion, and its derivative by r."""
        if self.fisheye:
            t = np.arctan(r)
            polynomial = _angular(self)
            return polynomial(t), polynomial.deriv()(t) / (1 + r * r)
        above, below = _rational(self)
        q = r * r
        ratio = above(q) / below(q)
        slope = (above.deriv()(q) - ratio * below.deriv()(q)) / below(q)
        return r * ratio, ratio + 2 * q * slope

    def _bend(self, place: Array) -> tuple[Array, Array]:
        """Give distorted places and their derivatives."""
        x, y = place[..., 0], place[..., 1]
        q = x * x + y * y
        r = np.sqrt(q)
        reach, growth = self._radial(r)
        central = r < CENTRAL
        safe = np.where(central, 1.0, r)
        ratio = np.where(central, 1.0, reach / safe)
        # Derivative of the ratio by r, over r.
        slope = np.where(central, 0.0, (growth - ratio) / (safe * safe))
        p1, p2 = (0.0, 0.0) if self.fisheye else self.coefficients[2:4]
        seen = np.stack(
            [x * ratio + 2 * p1 * x * y + p2 * (q + 2 * x * x), y * ratio + p1 * (q + 2 * y * y) + 2 * p2 * x * y],
            axis=-1,
        )
        mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
        across = ratio + slope * x * x + 2 * p1 * y + 6 * p2 * x
        down = ratio + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return seen, np.stack([np.stack([across, mixed], axis=-1), np.stack([mixed, down], axis=-1)], axis=-2)


def _rational(lens: Lens) -> tuple[Polynomial, Polynomial]:
    """Give numerator and denominator of R as polynomials in q."""
    k1, k2, _, _, k3, k4, k5, k6 = lens.coefficients
    return Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])


def _angular(lens: Lens) -> Polynomial:
    """Give the polynomial in t of a fisheye."""
    k1, k2, k3, k4 = lens.coefficients
    return Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])


@lru_cache(maxsize=16)
def _limit(lens: Lens) -> float:
    """Find the first distance from the axis where distorted places no longer increase, or have a pole."""
    if lens.fisheye:
        folds = _positive(_angular(lens).deriv())
        return min(WIDEST, math.tan(min([*folds, math.radians(88)])))
    above, below = _rational(lens)
    q = Polynomial([0, 1])
    growth = (above + 2 * q * above.deriv()) * below - 2 * q * above * below.deriv()
    radial = float(min([WIDEST, *np.sqrt([*_positive(growth), *_positive(below)])]))
    tangential = math.hypot(*lens.coefficients[2:4])
    if tangential <= TINY:
        return radial
    radii = radial * np.linspace(0, 1, RADII + 1)[:-1]
    folded = np.flatnonzero(_least_determinant(lens, radii, tangential) <= 0)
    if not len(folded):
        return radial
    from scipy.optimize import brentq

    return float(brentq(lambda r: _least_determinant(lens, r, tangential), radii[folded[0] - 1], radii[folded[0]]))


def _least_determinant(lens: Lens, r: Any, tangential: float) -> Any:
    """Give the least determinant of the jacobian among all places at a distance r from the axis.

    With a = `tangential` r, and g the derivative of R r, it is g R - 4 a^2 + 2 a (g + 3 R) c + 16 a^2 c^2, where c is
    the cosine of the angle between the place and (p2, p1). As the jacobian is symmetric, and I on the axis, the lens
    does not fold within a circle where this is above 0.
    """
    r = np.maximum(r, CENTRAL)
    reach, g = lens._radial(r)
    ratio, a = reach / r, tangential * r
    c = np.maximum(-(g + 3 * ratio) / (16 * a), -1)
    return g * ratio - 4 * a * a + 2 * a * (g + 3 * ratio) * c + 16 * a * a * c * c


def _positive(polynomial: Polynomial) -> list[float]:
    """List the positive zeros of a polynomial."""
    # Leading zeros would be zeros at infinity.
    roots = polynomial.trim(TINY).roots()
    return [float(root.real) for root in roots if root.real > 0 and abs(root.imag) <= 1e-9 * abs(root)]
