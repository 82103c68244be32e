"""NumPy reference of a sheet that is curved at rest: rest positions, cells, springs, normals and the step limit.

Cells and springs take any rest positions, so a flat sheet is a case of them. A surface is read from a mapping, or an
object with attributes, of its kind: height, tube, dome or points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

Array = NDArray[np.float64]

UNITS_M = {"m": 1.0, "mm": 1e-3, "um": 1e-6}


class Cells(NamedTuple):
    """The cells of a surface; arrays of shape (rows - 1, cols - 1, ...)."""

    a: Array  # mean of the sides that run to the right [m], shape (..., 3)
    b: Array  # mean of the sides that run down [m], shape (..., 3)
    cosine: Array  # of the angle between a and b
    area: Array  # [m2]
    # Spring constants over the square of the length, and over E t [1/m2], before numbers below 0 become 0: of each
    # side along a, each side along b, the diagonal to the bottom right and that to the bottom left; shape (..., 4).
    unclamped: Array

    @property
    def constants(self) -> Array:
        """Spring constants over the square of the length, and over E t [1/m2], shape (..., 4)."""
        return np.maximum(self.unclamped, 0)

    @property
    def clamped(self) -> NDArray[np.bool_]:
        """Whether a spring constant of each cell has been set to 0."""
        return np.asarray((self.unclamped < 0).any(axis=-1))


class Summary(NamedTuple):
    """Cells of a surface."""

    sides: tuple[float, float]  # shortest and longest [m]
    mean: float  # isotropy error, mean over the area
    worst: float  # isotropy error, largest
    clamped: int  # number of cells with a spring constant that was set to 0


def _get(section: Any, name: str, default: Any = None) -> Any:
    """Return an entry of a mapping, or an attribute of an object; the default where it is missing or None."""
    value = section.get(name) if isinstance(section, Mapping) else getattr(section, name, None)
    return default if value is None else value


def flat_positions(points: tuple[int, int], size: tuple[float, float]) -> Array:
    """Return the rest positions of the flat sheet [m], shape (rows, cols, 3)."""
    (rows, cols), (height, width) = points, size
    position = np.zeros((rows, cols, 3))
    position[..., 0] = (np.arange(cols) / (cols - 1) - 0.5) * width
    position[..., 1] = (0.5 - np.arange(rows) / (rows - 1))[:, None] * height
    return position


def rest_positions(
    surface: Any, points: tuple[int, int] | None, size: tuple[float, float] | None = None, folder: str | Path = "."
) -> Array:
    """Return the rest positions of the mass points [m], shape (rows, cols, 3).

    Args:
        surface: mapping or object with one of height, tube, dome and points; None for a flat sheet.
        points: rows and cols; None for those of the file of a surface of points.
        size: height and width of the flat sheet [m]; not of a surface of points.
        folder: folder of the files.
    """
    if surface is not None and (keys := _get(surface, "points")) is not None:
        return _of_points(keys, points, Path(folder))
    assert points is not None
    assert size is not None
    flat = flat_positions(points, size)
    if surface is None:
        return flat
    if (keys := _get(surface, "height")) is not None:
        flat[..., 2] = _heights(keys, points, Path(folder))
        return flat
    if (keys := _get(surface, "tube")) is not None:
        return _tube(keys, flat)
    return _dome(_get(surface, "dome"), flat)


def _tube(keys: Any, flat: Array) -> Array:
    x, y, radius, folds = flat[..., 0], flat[..., 1], _get(keys, "radius"), _get(keys, "folds")
    r = np.full(x.shape, radius)
    if folds is not None:
        r = radius - _get(folds, "depth") * (1 + np.cos(2 * np.pi * y / _get(folds, "spacing"))) / 2
    return np.stack([r * np.sin(x / radius), y, radius - r * np.cos(x / radius)], axis=-1)


def _dome(keys: Any, flat: Array) -> Array:
    radius = _get(keys, "radius")
    ray = np.stack([np.tan(flat[..., 0] / radius), np.tan(flat[..., 1] / radius), np.ones(flat.shape[:2])], axis=-1)
    return np.asarray(radius * (ray / np.linalg.norm(ray, axis=-1)[..., None] - [0, 0, 1]))


def _heights(keys: Any, points: tuple[int, int], folder: Path) -> Array:
    """Return z of a picture's greys or of an array at the mass points [m], shape (rows, cols)."""
    path = folder / _get(keys, "file")
    if path.suffix == ".npy":
        z = np.load(path).astype(float) * _in_metres(_get(keys, "unit"))
    else:
        grey = np.array(Image.open(path))
        black, white = _get(keys, "range")
        # Pillow opens greys of 16 bits as I;16, or as I with 32 bits.
        z = black + (white - black) * grey / (255 if grey.dtype == np.uint8 else 65535)
    (h, w), (rows, cols) = z.shape, points
    # Pixel centres are at (k + 1/2) / n, clamped beyond the outermost.
    row, column = (np.clip(np.arange(count) / (count - 1) * n - 0.5, 0, n - 1) for count, n in ((rows, h), (cols, w)))
    down = np.array([np.interp(row, np.arange(h), z[:, k]) for k in range(w)]).T
    return np.array([np.interp(column, np.arange(w), line) for line in down])


def _of_points(keys: Any, points: tuple[int, int] | None, folder: Path) -> Array:
    loaded = np.load(folder / _get(keys, "file"))
    if isinstance(loaded, np.lib.npyio.NpzFile):
        loaded = loaded["points" if "points" in loaded.files else loaded.files[0]]
    given = loaded.astype(float) * _in_metres(_get(keys, "unit"))
    if points is None or given.shape[:2] == tuple(points):
        return given
    return resample(given, points)


def resample(given: Array, points: tuple[int, int]) -> Array:
    """Sample not-a-knot cubic splines in (u, v) through positions of shape (r, c, 3) at rows and cols of points."""
    for axis, count in enumerate(points):
        spline = CubicSpline(np.linspace(0, 1, given.shape[axis]), given, axis=axis)
        given = spline(np.linspace(0, 1, count))
    return given


def _in_metres(unit: Any) -> float:
    return UNITS_M[unit] if isinstance(unit, str) else float(unit)


def cells(rest: Array) -> Cells:
    """Measure the cells of rest positions, shape (rows, cols, 3), and derive their spring constants.

    With c and s, cosine and sine of the angle between the mean sides a and b, p = |a|, q = |b|, w = 3/16 / (p q s^3):
    w (3 q^2 / p^2 - 1 - 2 c^2) along a, the same with p and q exchanged along b, and w (1 -+ c) (1 -+ 2 c) along
    a + b and a - b. Rectangles and rhombi are then isotropic with Poisson's ratio 1/3.
    """
    x00, x01, x10, x11 = rest[:-1, :-1], rest[:-1, 1:], rest[1:, :-1], rest[1:, 1:]
    a, b = (x01 - x00 + x11 - x10) / 2, (x10 - x00 + x11 - x01) / 2
    p, q = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    c = (a * b).sum(axis=-1) / (p * q)
    s = np.sqrt(1 - c**2)
    w = 3 / 16 / (p * q * s**3)
    along_a, along_b = w * (3 * q**2 / p**2 - 1 - 2 * c**2), w * (3 * p**2 / q**2 - 1 - 2 * c**2)
    diagonals = w * (1 - c) * (1 - 2 * c), w * (1 + c) * (1 + 2 * c)
    return Cells(a, b, c, p * q * s, np.stack([along_a, along_b, *diagonals], axis=-1))


def isotropy_error(cells: Cells) -> Array:
    """Return the largest relative error of a cell's strain energy over all strains, shape (rows - 1, cols - 1).

    Twice the energy of the springs and of plane stress with nu = 1/3, both over E t, as quadratic forms of
    (E_xx, E_yy, E_xy) in orthonormal axes of the plane of a and b; x is along a.
    """
    p, q = np.linalg.norm(cells.a, axis=-1), np.linalg.norm(cells.b, axis=-1)
    a = np.stack([p, np.zeros_like(p)], axis=-1)
    b = np.stack([q * cells.cosine, q * np.sqrt(1 - cells.cosine**2)], axis=-1)
    energy = np.zeros((*p.shape, 3, 3))
    weights = cells.constants * [2, 2, 1, 1]
    for k, d in enumerate((a, b, a + b, a - b)):
        form = np.stack([d[..., 0] ** 2, d[..., 1] ** 2, 2 * d[..., 0] * d[..., 1]], axis=-1)
        energy += weights[..., k, None, None] * form[..., :, None] * form[..., None, :]
    membrane = np.array([[9 / 8, 3 / 8, 0], [3 / 8, 9 / 8, 0], [0, 0, 4 * 3 / 8]])
    errors = [
        np.abs(eigh(energy[cell], cells.area[cell] * membrane, eigvals_only=True) - 1).max()
        for cell in np.ndindex(p.shape)
    ]
    return np.reshape(errors, p.shape)


def summary(rest: Array) -> Summary:
    """Measure a surface, as check and run.json report it."""
    measured, errors = cells(rest), isotropy_error(cells(rest))
    sides = [np.linalg.norm(np.diff(rest, axis=axis), axis=-1) for axis in (0, 1)]
    mean = float((errors * measured.area).sum() / measured.area.sum())
    shortest, longest = min(side.min() for side in sides), max(side.max() for side in sides)
    return Summary((float(shortest), float(longest)), mean, float(errors.max()), int(measured.clamped.sum()))


def sum_at_corners(values: Array) -> Array:
    """Add values of the cells, shape (rows - 1, cols - 1, ...), to their four corners, shape (rows, cols, ...)."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1, *values.shape[2:]))
    for down in (slice(0, -1), slice(1, None)):
        for right in (slice(0, -1), slice(1, None)):
            total[down, right] += values
    return total


def point_areas(cells: Cells, present: Any = True) -> Array:
    """Return the area of each mass point, a quarter of each of its cells that are present [m2], shape (rows, cols)."""
    return sum_at_corners(cells.area * present) / 4


def normals(cells: Cells, present: Any = True) -> Array:
    """Return the unit normals of the mass points, along the sum of b x a of their cells, shape (rows, cols, 3).

    Those of cells that are not present count at points without any other.
    """
    every, share = np.cross(cells.b, cells.a), np.broadcast_to(present, cells.area.shape)[..., None]
    normal = sum_at_corners(every * share)
    normal = np.where(sum_at_corners(share * 1.0) > 0, normal, sum_at_corners(every))
    return np.asarray(normal / np.linalg.norm(normal, axis=-1)[..., None])


def at_fractions(values: Array, across: float, down: float) -> Array:
    """Interpolate values of the mass points, shape (rows, cols, 3), bilinearly; beyond them continue the last cell."""
    rows, cols = values.shape[:2]
    i = int(np.clip(math.floor(down * (rows - 1)), 0, rows - 2))
    j = int(np.clip(math.floor(across * (cols - 1)), 0, cols - 2))
    v, u = down * (rows - 1) - i, across * (cols - 1) - j
    above = (1 - u) * values[i, j] + u * values[i, j + 1]
    below = (1 - u) * values[i + 1, j] + u * values[i + 1, j + 1]
    return np.asarray((1 - v) * above + v * below)


def normal_at(normal: Array, across: float, down: float) -> Array:
    """Return the unit normal at fractions across and down, bilinear and normalised, shape (3,)."""
    between = at_fractions(normal, across, down)
    return np.asarray(between / np.linalg.norm(between))


def stiffness_bounds(rest: Array, stiffness: Array) -> Array:
    """Return a bound of each cell's stiffness matrix [N/m], shape (rows - 1, cols - 1).

    The largest eigenvalue of a scalar network of two equal sides k_a, two equal sides k_b and two diagonals k_m, k_n:
    max(2 (k_a + k_b), k_a + k_b + k_m + k_n + ((k_a - k_b)^2 + (k_m - k_n)^2)^(1/2)).

    Args:
        rest: rest positions [m], shape (rows, cols, 3).
        stiffness: spring constants over the square of the length [N/m3], shape (rows - 1, cols - 1, 4).
    """
    right, down = np.linalg.norm(np.diff(rest, axis=1), axis=-1), np.linalg.norm(np.diff(rest, axis=0), axis=-1)
    main = np.linalg.norm(rest[1:, 1:] - rest[:-1, :-1], axis=-1)
    other = np.linalg.norm(rest[:-1, 1:] - rest[1:, :-1], axis=-1)
    # The longer of the two sides has the larger constant.
    lengths = np.maximum(right[:-1], right[1:]), np.maximum(down[:, :-1], down[:, 1:]), main, other
    k_a, k_b, k_m, k_n = (length**2 * stiffness[..., n] for n, length in enumerate(lengths))
    crossed = k_a + k_b + k_m + k_n + np.hypot(k_a - k_b, k_m - k_n)
    return np.asarray(np.maximum(2 * (k_a + k_b), crossed))
