"""The cells of a curved sheet: sides, angles, areas and normals; stiffness of their springs.

A cell has the corners X00, X01 (right), X10 (below) and X11, and the mean sides a and b,

    a = (X01 - X00 + X11 - X10) / 2,    b = (X10 - X00 + X11 - X01) / 2

With p = |a|, q = |b|, c = a . b / (p q), s = (1 - c^2)^(1/2), the area A = p q s and w = 3/16 f E t / (p q s^3), a
spring gets from each of its cells the stiffness L^2 times

    sides along a       w (3 q^2 / p^2 - 1 - 2 c^2) each     falling diagonal, X00-X11   w (1 - c) (1 - 2 c)
    sides along b       w (3 p^2 / q^2 - 1 - 2 c^2) each     rising diagonal, X01-X10    w (1 + c) (1 + 2 c)

where L is the spring's own rest length. A negative number counts as 0; the cell is then clamped. A rectangle or a
rhombus is exactly isotropic, with Poisson's ratio 1/3, unless it is clamped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

Array = NDArray[np.float64]


class Cells(NamedTuple):
    """Cells of a curved sheet; arrays have the shape (rows - 1, cols - 1), vectors a last axis of 3."""

    a: Array  # mean side to the right [m]
    b: Array  # mean side down [m]
    side_a: Array  # p, length of a [m]
    side_b: Array  # q, length of b [m]
    cosine: Array  # c, of the angle between a and b
    area: Array  # [m2]

    @classmethod
    def of(cls, position: Array) -> Self:
        """Return the cells between mass points [m], shape (rows, cols, 3)."""
        x00, x01, x10, x11 = position[:-1, :-1], position[:-1, 1:], position[1:, :-1], position[1:, 1:]
        a, b = (x01 - x00 + x11 - x10) / 2, (x10 - x00 + x11 - x01) / 2
        p, q = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = (a * b).sum(axis=-1) / (p * q)
        return cls(a, b, p, q, cosine, np.linalg.norm(np.cross(a, b), axis=-1))


class CellStiffness(NamedTuple):
    """Stiffness of the springs of cells divided by their squared lengths, from this cell alone [N/m3]."""

    along_a: Array  # each of the two sides along a, shape (rows - 1, cols - 1)
    along_b: Array
    falling: Array  # diagonal
    rising: Array
    is_clamped: NDArray[np.bool_]  # whether any number was negative


def cell_stiffness(cells: Cells, membrane: Array | float) -> CellStiffness:
    """Return the stiffness of the springs of cells, for f E t of each [N/m]."""
    p, q, c = cells.side_a, cells.side_b, cells.cosine
    w = 3 / 16 * membrane / (p * q * (1 - c * c) ** 1.5)
    along_a, along_b = w * (3 * (q / p) ** 2 - 1 - 2 * c * c), w * (3 * (p / q) ** 2 - 1 - 2 * c * c)
    falling, rising = w * (1 - c) * (1 - 2 * c), w * (1 + c) * (1 + 2 * c)
    is_clamped = (along_a < 0) | (along_b < 0) | (falling < 0) | (rising < 0)
    along_a, along_b, falling, rising = np.maximum((along_a, along_b, falling, rising), 0)
    return CellStiffness(along_a, along_b, falling, rising, is_clamped)


def isotropy_errors(cells: Cells) -> Array:
    """Return the largest |energy of the springs / energy of plane stress - 1| of each cell over all strains.

    The energies are quadratic forms of the strain with the components a . E a, b . E b and a . E b, in which springs
    have a.Ea and b.Eb squared, and (a +- b) . E (a +- b) squared.
    """
    k, (p, q, c) = cell_stiffness(cells, 1.0), (cells.side_a, cells.side_b, cells.cosine)
    springs = np.zeros((*c.shape, 3, 3))
    for stiffness, direction in (
        (2 * k.along_a, (1, 0, 0)),
        (2 * k.along_b, (0, 1, 0)),
        (k.falling, (1, 1, 2)),
        (k.rising, (1, 1, -2)),
    ):
        springs += stiffness[..., None, None] * np.outer(direction, direction)
    # Strains in orthonormal axes: e1 along a, e2 towards b.
    s = np.sqrt(1 - c * c)
    to_axes = np.zeros((*c.shape, 3, 3))  # (a.Ea, b.Eb, a.Eb) of (E11, E22, E12)
    to_axes[..., 0, 0] = p * p
    to_axes[..., 1, :] = np.stack([(q * c) ** 2, (q * s) ** 2, 2 * q * q * c * s], axis=-1)
    to_axes[..., 2, :] = np.stack([p * q * c, np.zeros_like(c), p * q * s], axis=-1)
    # Plane stress, nu = 1/3, twice the energy per E t: 9/8 (E11^2 + E22^2 + 2/3 E11 E22) + 3/2 E12^2.
    stress = np.array([[9 / 8, 3 / 8, 0], [3 / 8, 9 / 8, 0], [0, 0, 3 / 2]])
    inverse_root = np.linalg.inv(np.linalg.cholesky(stress))
    of_strains = to_axes.swapaxes(-1, -2) @ springs @ to_axes / cells.area[..., None, None]
    ratios = np.linalg.eigvalsh(inverse_root @ of_strains @ inverse_root.T)
    return np.asarray(np.abs(ratios - 1).max(axis=-1))


def sum_around_points(values: Array) -> Array:
    """Sum values of cells around each mass point, shape (rows, cols, ...) from (rows - 1, cols - 1, ...)."""
    padded = np.pad(values, ((1, 1), (1, 1), *((0, 0),) * (values.ndim - 2)))
    return padded[:-1, :-1] + padded[:-1, 1:] + padded[1:, :-1] + padded[1:, 1:]


def unit(vectors: Array) -> Array:
    """Normalise vectors, shape (..., 3); a vector of length 0 becomes NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
