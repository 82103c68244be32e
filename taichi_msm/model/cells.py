"""Cells of a curved sheet: sides, angles and areas, and the stiffness of their springs.

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

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import Array


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
    along_b: Array  # each of the two sides along b
    falling: Array  # diagonal X00-X11
    rising: Array  # diagonal X01-X10
    is_clamped: NDArray[np.bool_]  # whether any number was negative


def cell_stiffness(cells: Cells, membrane: Array | float) -> CellStiffness:
    """Return the stiffness of the springs of cells, for f E t of each [N/m]."""
    p, q, c = cells.side_a, cells.side_b, cells.cosine
    w = 3 / 16 * membrane / (p * q * (1 - c * c) ** 1.5)
    along_a, along_b = w * (3 * (q / p) ** 2 - 1 - 2 * c * c), w * (3 * (p / q) ** 2 - 1 - 2 * c * c)
    falling, rising = w * (1 - c) * (1 - 2 * c), w * (1 + c) * (1 + 2 * c)
    is_clamped = np.minimum.reduce((along_a, along_b, falling, rising)) < -1e-9 * w  # Not by rounding.
    along_a, along_b, falling, rising = np.maximum((along_a, along_b, falling, rising), 0)
    return CellStiffness(along_a, along_b, falling, rising, is_clamped)


def isotropy_errors(cells: Cells) -> Array:
    """Return the largest |energy of the springs / energy of plane stress - 1| of each cell over all strains.

    In axes with the first one along a, the strain has the parts e = (E11 + E22) / 2, f = (E11 - E22) / 2 and g = E12.
    A spring along (x, y) is stretched by (x^2 + y^2) e + (x^2 - y^2) f + 2 x y g over its length. Twice the energy of
    plane stress with nu = 1/3 is E t (3 e^2 + 3/2 f^2 + 3/2 g^2) per area.
    """
    k, p, q, c = cell_stiffness(cells, 1.0), cells.side_a, cells.side_b, cells.cosine
    x, y = q * c, q * np.sqrt(1 - c * c)
    springs = ((2 * k.along_a, p, 0 * y), (2 * k.along_b, x, y), (k.falling, p + x, y), (k.rising, p - x, -y))
    # The quadratic form of the ratio of both energies; each cell has two sides along a and two along b.
    matrix = np.zeros((*c.shape, 3, 3))
    for stiffness, d_x, d_y in springs:
        square = d_x * d_x + d_y * d_y
        parts = square / np.sqrt(3), (d_x * d_x - d_y * d_y) / np.sqrt(1.5), 2 * d_x * d_y / np.sqrt(1.5)
        for i, j in np.ndindex(3, 3):
            matrix[..., i, j] += stiffness / cells.area * parts[i] * parts[j]
    return np.asarray(np.abs(np.linalg.eigvalsh(matrix) - 1).max(axis=-1))


def sum_around_points(values: NDArray[Any]) -> Array:
    """Sum values of cells around each mass point, shape (rows, cols, ...) from (rows - 1, cols - 1, ...)."""
    padded = np.pad(values.astype(float), ((1, 1), (1, 1), *((0, 0),) * (values.ndim - 2)))
    return padded[:-1, :-1] + padded[:-1, 1:] + padded[1:, :-1] + padded[1:, 1:]


def unit(vectors: Array) -> Array:
    """Normalise vectors, shape (..., 3); a vector of length 0 becomes NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
