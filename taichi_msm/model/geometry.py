"""The sheet at rest, flat or curved: positions, normals and areas of its mass points, and places on it.

Places on the sheet are fractions (across, down) of its width from the left and of its height from the top, the u and v
of a curved sheet. Between mass points a sheet at rest is bilinear; beyond its edges, the outermost cells are continued.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.cells import Cells, isotropy_errors, sum_around_points, unit
from taichi_msm.model.mask import EDGE_TOLERANCE, Mask


class Rest(ABC):
    """The sheet at rest.

    Its coordinates are x and y [m] of a flat sheet, and fractions across and down of a curved one: control points and
    paths of tools are linear in them.
    """

    position: Array  # of the mass points [m], shape (rows, cols, 3), read-only
    mask: Mask | None  # cells that are sheet; None: all
    cell_area: float  # area of a cell, on a curved sheet the mean [m2]
    cell_sides: tuple[float, float]  # lengths along rows and along columns, on a curved sheet the means [m]
    shortest_side: float  # of the sides of all cells [m]
    longest_side: float

    @property
    def present(self) -> NDArray[np.bool_]:
        """Whether each cell is sheet, shape (rows - 1, cols - 1)."""
        rows, cols = self.position.shape[:2]
        return np.ones((rows - 1, cols - 1), bool) if self.mask is None else self.mask.cells

    @property
    def present_positions(self) -> Array:
        """Positions of the mass points of cells that are sheet [m], shape (n, 3)."""
        return self.position.reshape(-1, 3) if self.mask is None else self.position[self.mask.points]

    @cached_property
    def box(self) -> Array:
        """Lower and upper corner of the sheet's box [m], shape (2, 3)."""
        return np.stack([self.present_positions.min(axis=0), self.present_positions.max(axis=0)])

    @cached_property
    def unmasked_box(self) -> Array:
        """Lower and upper corner of the box of all mass points, with and without sheet [m], shape (2, 3)."""
        return np.stack([self.position.min(axis=(0, 1)), self.position.max(axis=(0, 1))])

    @property
    def sides(self) -> tuple[float, float]:
        """Height and width of the sheet, on a curved one means of its lengths along columns and rows [m]."""
        rows, cols = self.position.shape[:2]
        return (rows - 1) * self.cell_sides[1], (cols - 1) * self.cell_sides[0]

    @property
    def hull(self) -> Array:
        """Points whose convex hull contains the sheet [m], shape (n, 3)."""
        return self.present_positions

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal [m]."""
        return math.hypot(*np.ptp(self.box, axis=0))

    @property
    def extent(self) -> float:
        """Larger side of the box [m]."""
        return float(np.ptp(self.box, axis=0).max())

    @property
    def is_flat(self) -> bool:
        """Whether the sheet is a `FlatRest`, a rectangle in the plane z = 0."""
        return isinstance(self, FlatRest)

    @abstractmethod
    def coordinates(self, fractions: Array) -> Array:
        """Return the coordinates of places, shape (..., 2) each."""

    @abstractmethod
    def fractions(self, coordinates: Array) -> Array:
        """Return the fractions across and down of places, shape (..., 2) each."""

    def mesh_places(self, fractions: Array) -> Array:
        """Return the fractions (u, v) of columns and rows at places across and down, shape (n, 2) each."""
        return fractions

    def sheet_places(self, mesh: Array) -> Array:
        """Return the fractions across and down at (u, v), shape (n, 2) each: the inverse of `mesh_places`."""
        return mesh

    def covers(self, fractions: Array, tolerance: float = EDGE_TOLERANCE) -> NDArray[np.bool_]:
        """Return whether places across and down, shape (n, 2), are on the sheet; `tolerance` in sides of a cell."""
        if self.mask is None:
            return np.ones(len(fractions), bool)
        return self.mask.covers(self.mesh_places(fractions), tolerance)

    def first_gap(self, start: Array, end: Array) -> float | None:
        """Return the fraction of a line between two places across and down at which it leaves the sheet, or None."""
        return None if self.mask is None else self.mask.first_gap(start, end)

    @property
    def cell_places(self) -> tuple[Array, Array]:
        """Fractions across and down at the middle of cells, which broadcast to shape (rows - 1, cols - 1)."""
        rows, cols = (count - 1 for count in self.position.shape[:2])
        return (np.arange(cols) + 0.5) / cols, ((np.arange(rows) + 0.5) / rows)[:, None]

    @property
    def point_places(self) -> tuple[Array, Array]:
        """Fractions across and down at the mass points, which broadcast to shape (rows, cols)."""
        rows, cols = self.position.shape[:2]
        return np.arange(cols) / (cols - 1), (np.arange(rows) / (rows - 1))[:, None]

    def mesh_positions(self, mesh: Array) -> Array:
        """Return the positions at (u, v) [m], shape (n, 3) from (n, 2)."""
        return self.place(self.coordinates(mesh))

    def refined(self, refine: int) -> Array:
        """Return points of the sheet [m], shape (n, 3), with `refine` between neighbouring mass points."""
        across, down = (np.linspace(0, 1, (count - 1) * (refine + 1) + 1) for count in self.position.shape[1::-1])
        mesh = np.stack(np.meshgrid(across, down), axis=-1)
        if self.mask is not None:
            mesh = mesh[Mask(np.kron(self.mask.cells, np.ones((refine + 1, refine + 1), bool))).points]
        return self.mesh_positions(mesh.reshape(-1, 2))

    @abstractmethod
    def place(self, coordinates: Array) -> Array:
        """Return the positions of places [m], shape (n, 3), for coordinates of shape (n, 2)."""

    @abstractmethod
    def normals(self, coordinates: Array) -> Array:
        """Return the unit normals at places, shape (n, 3), for coordinates of shape (n, 2)."""

    @abstractmethod
    def load_points(self, coordinates: Array) -> Array:
        """Return x and y of places on a flat sheet, shape (n, 2), x, y and z on a curved one, shape (n, 3) [m]."""

    @abstractmethod
    def distances(self, coordinates: Array) -> Array:
        """Return the distance of every mass point from a place [m], shape (rows, cols)."""


class FlatRest(Rest):
    """A rectangle in the plane z = 0 about the origin."""

    def __init__(self, points: tuple[int, int], size: tuple[float, float], mask: Mask | None = None) -> None:
        (rows, cols), (height, width) = points, size
        self._size, self.mask = size, mask
        # x of the columns, shape (cols,), and y of the rows, shape (rows, 1).
        self._axes = (
            (np.arange(cols) / (cols - 1) - 0.5) * width,
            (0.5 - np.arange(rows)[:, None] / (rows - 1)) * height,
        )
        self.position = np.zeros((rows, cols, 3))
        self.position[..., 0], self.position[..., 1] = self._axes
        self.position.flags.writeable = False
        dx, dy = width / (cols - 1), height / (rows - 1)
        self.cell_area, self.cell_sides = dx * dy, (dx, dy)
        self.shortest_side, self.longest_side = min(dx, dy), max(dx, dy)

    @property
    def sides(self) -> tuple[float, float]:
        return self._size

    @property
    def hull(self) -> Array:
        return self.position[[0, 0, -1, -1], [0, -1, 0, -1]] if self.mask is None else self.present_positions

    @property
    def diagonal(self) -> float:
        return math.hypot(*self._size)

    @property
    def extent(self) -> float:
        return max(self._size)

    def coordinates(self, fractions: Array) -> Array:
        height, width = self._size
        across, down = np.moveaxis(fractions, -1, 0)
        return np.stack([(across - 0.5) * width, (0.5 - down) * height], axis=-1)

    def fractions(self, coordinates: Array) -> Array:
        height, width = self._size
        x, y = np.moveaxis(coordinates, -1, 0)
        return np.stack([x / width + 0.5, 0.5 - y / height], axis=-1)

    def place(self, coordinates: Array) -> Array:
        return np.concatenate([coordinates, np.zeros((len(coordinates), 1))], axis=1)

    def normals(self, coordinates: Array) -> Array:
        return np.tile([0.0, 0.0, 1.0], (len(coordinates), 1))

    def load_points(self, coordinates: Array) -> Array:
        return coordinates

    def distances(self, coordinates: Array) -> Array:
        (x, y), (at_x, at_y) = self._axes, coordinates
        return np.hypot(x - at_x, y - at_y)


class Origin(NamedTuple):
    """The part of a file in the positions of a curved sheet."""

    grid: Array | None = None  # even grid, fractions of the file across and down, shape (rows, cols, 2)
    filled: float = 0.0  # share of pixels without depth
    deviation: float | None = None  # standard deviation of the smoothing [px]


class CurvedRest(Rest):
    """Mass points anywhere in space."""

    def __init__(self, position: Array, mask: Mask | None = None, origin: Origin | None = None) -> None:
        self.position, self.mask, self.origin = position, mask, origin or Origin()
        self.position.flags.writeable = False
        self.cells = Cells.of(position)
        cells = self.present_cells
        self.cell_area = float(cells.area.mean())
        self.cell_sides = float(cells.side_a.mean()), float(cells.side_b.mean())
        sides = self.side_lengths()
        self.shortest_side = float(min(np.nanmin(each) for each in sides))
        self.longest_side = float(max(np.nanmax(each) for each in sides))

    @property
    def present_cells(self) -> Cells:
        """Cells that are sheet, shape (n,); others may have any shape."""
        return Cells(*(values[self.present] for values in self.cells))

    def side_lengths(self) -> tuple[Array, Array]:
        """Compute the lengths of the sides of cells along columns and along rows [m], NaN of cells without sheet."""
        down, across = (np.linalg.norm(np.diff(self.position, axis=axis), axis=-1) for axis in (0, 1))
        if self.mask is not None:
            # A side belongs to the cells on both sides of it.
            columns, rows = np.pad(self.present, ((0, 0), (1, 1))), np.pad(self.present, ((1, 1), (0, 0)))
            down[~(columns[:, :-1] | columns[:, 1:])] = np.nan
            across[~(rows[:-1] | rows[1:])] = np.nan
        return down, across

    @cached_property
    def areas(self) -> Array:
        """Area of every mass point [m2], shape (rows, cols)."""
        return sum_around_points(np.where(self.present, self.cells.area / 4, 0))

    @cached_property
    def isotropy_errors(self) -> Array:
        """Isotropy error of each cell, 0 without sheet, shape (rows - 1, cols - 1)."""
        errors = np.zeros(self.present.shape)
        errors[self.present] = isotropy_errors(self.present_cells)
        return errors

    @cached_property
    def cell_normals(self) -> Array:
        """Unit normals of the cells, shape (rows - 1, cols - 1, 3); NaN for a cell without area."""
        return unit(np.cross(self.cells.b, self.cells.a))

    @cached_property
    def point_normals(self) -> Array:
        """Unit normals at the mass points, along the sum of b x a of their cells, shape (rows, cols, 3).

        A point without sheet has that of all cells around it.
        """
        normals = np.cross(self.cells.b, self.cells.a)
        if self.mask is None:
            return unit(sum_around_points(normals))
        of_sheet, of_all = (sum_around_points(values) for values in (normals * self.present[..., None], normals))
        return np.nan_to_num(unit(np.where(self.mask.points[..., None], of_sheet, of_all)))

    def coordinates(self, fractions: Array) -> Array:
        return np.asarray(fractions, dtype=float)

    def fractions(self, coordinates: Array) -> Array:
        return coordinates

    def place(self, coordinates: Array) -> Array:
        return self._interpolate(self.position, self.mesh_places(coordinates))

    def normals(self, coordinates: Array) -> Array:
        return unit(self._interpolate(self.point_normals, self.mesh_places(coordinates)))

    def mesh_positions(self, mesh: Array) -> Array:
        return self._interpolate(self.position, mesh)

    load_points = place

    def distances(self, coordinates: Array) -> Array:
        return np.asarray(np.linalg.norm(self.position - self.place(coordinates[None]), axis=-1))

    def _interpolate(self, values: Array, fractions: Array) -> Array:
        """Interpolate values at the mass points, shape (rows, cols, 3), bilinearly within cells at (u, v)."""
        rows, cols = values.shape[:2]
        at = fractions * (cols - 1, rows - 1)
        j, i = np.clip(np.floor(at).astype(int), 0, (cols - 2, rows - 2)).T
        s, t = (at - np.stack([j, i], axis=1)).T[..., None]
        upper = values[i, j] + s * (values[i, j + 1] - values[i, j])
        lower = values[i + 1, j] + s * (values[i + 1, j + 1] - values[i + 1, j])
        return np.asarray(upper + t * (lower - upper))
