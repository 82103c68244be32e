"""NumPy reference of the sheet: masses, springs and virtual springs, assembled from the cells."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.sheet import MapImage, cell_factors, point_factors, read_map, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import StiffnessMap, Tissue

Array = NDArray[np.float64]
Window = tuple[slice, slice]


class Springs(NamedTuple):
    """All springs with the same number of points down and to the right between their ends."""

    # windows of the mass points at their ends; `end` is down or to the right of `start`
    start: Window
    end: Window
    offset: Array  # vector from start to end at rest [m], x right, y up, z; shape (3,) or (..., 3)
    length: Any  # at rest [m], a number or the shape of the window `start`
    stiffness: Array  # k of each [N/m], shape of the window `start`
    unstretched: Array  # length without force [m], same shape; `length`, unless the sheet is under tension


class Sheet(NamedTuple):
    """A sheet, point by point and spring by spring."""

    springs: tuple[Springs, ...]  # along rows, along columns and along both diagonals, each spring once
    mass: Array  # of every point [kg], shape (rows, cols)
    drag: Array  # C of every point [N s/m], shape (rows, cols)
    virtual: Array  # K of every point [N/m], shape (rows, cols)
    bending: Any  # D dx dy [N m3]
    share: Array  # area of every point as a share of a cell's, shape (rows, cols)


# Rows and columns from the start of a spring to its end.
ALONG_ROW, ALONG_COLUMN, TO_RIGHT, TO_LEFT = (0, 1), (1, 0), (1, 1), (1, -1)


def _factors(scene: Scene) -> Array:
    """Return the stiffness factor at the centre of every cell, shape (rows - 1, cols - 1); ones without a map."""
    rows, cols = scene.sheet.points
    if scene.stiffness_map is None:
        return np.ones((rows - 1, cols - 1))
    return cell_factors(scene.stiffness_map, _image(scene.stiffness_map), scene.sheet)


def _foundation_factors(scene: Scene) -> Array:
    """Return the factor of the foundation at every point, shape (rows, cols); ones without a map."""
    stiffness_map = scene.maps.get("foundation_map")
    if stiffness_map is None:
        return np.ones(scene.sheet.points)
    return point_factors(stiffness_map, _image(stiffness_map), scene.sheet)


def _image(stiffness_map: StiffnessMap) -> MapImage:
    """Read the file of a map, again only when it has changed."""
    return _read(stiffness_map, Path(stiffness_map.image).stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(stiffness_map: StiffnessMap, _changed: int) -> MapImage:
    return read_map(stiffness_map)


def sheet(scene: Scene) -> Sheet:
    """Assemble the sheet of a scene.

    Springs from `springs` have its constants; those of tissue are the ones of a cell dx by dy whose strain energy is
    that of an isotropic membrane with Poisson's ratio 1/3 (Lloyd et al. 2007), half of each edge's from the cell at
    either side. Masses and virtual springs of tissue are shares of the cells' area.
    """
    rows, cols = scene.sheet.points
    if scene.tissue is not None:
        return _of_tissue(scene, scene.tissue)
    assert scene.springs is not None
    factor = _factors(scene)
    cells = np.ones_like(factor)
    structural, shear = scene.springs.structural, scene.springs.shear
    stiffness = {
        ALONG_ROW: structural * _rows_of(factor) / _rows_of(cells),
        ALONG_COLUMN: structural * _columns_of(factor) / _columns_of(cells),
        TO_RIGHT: shear * factor,
        TO_LEFT: shear * factor,
    }
    every = np.ones((rows, cols))
    share = _rows_of(_columns_of(cells)) / 4
    springs = tuple(_springs(scene, ahead, k, 0 * k) for ahead, k in stiffness.items())
    mass, virtual = (scene.sheet.mass or 0.0) * every, scene.springs.virtual * every
    return Sheet(springs, mass, scene.damping * every, virtual, 0.0, share)


def _of_tissue(scene: Scene, tissue: Tissue) -> Sheet:
    dx, dy = spacing(scene.sheet)
    factor, membrane = _factors(scene), tissue.young * tissue.thickness
    cells = np.ones_like(factor)
    along_row = membrane * (9 / 8 * dy / dx - 3 / 8 * dx / dy) / 2
    along_column = membrane * (9 / 8 * dx / dy - 3 / 8 * dy / dx) / 2
    diagonal = 3 / 16 * membrane * (dx**2 + dy**2) / (dx * dy)
    stretch = tissue.pretension / (3 / 2 * membrane)
    springs = (
        _springs(scene, ALONG_ROW, along_row * _rows_of(factor), stretch * along_row * _rows_of(cells)),
        _springs(scene, ALONG_COLUMN, along_column * _columns_of(factor), stretch * along_column * _columns_of(cells)),
        _springs(scene, TO_RIGHT, diagonal * factor, stretch * diagonal * cells),
        _springs(scene, TO_LEFT, diagonal * factor, stretch * diagonal * cells),
    )
    quarters = _rows_of(_columns_of(cells))
    mass = (tissue.density or 0.0) * tissue.thickness * dx * dy / 4 * quarters
    plate = tissue.young * tissue.thickness**3 / 12 / (1 - 1 / 9)
    bending = plate if tissue.bending == "plate" else tissue.bending
    virtual = tissue.foundation_stiffness * dx * dy / 4 * quarters * _foundation_factors(scene)
    return Sheet(springs, mass, tissue.damping * mass, virtual, bending * dx * dy, quarters / 4)


def _rows_of(cells: Array) -> Array:
    """Add the contributions of cells to the edges above and below them; the result has one row more."""
    return np.pad(cells, ((0, 1), (0, 0))) + np.pad(cells, ((1, 0), (0, 0)))


def _columns_of(cells: Array) -> Array:
    """Add the contributions of cells to the edges at their left and right; the result has one column more."""
    return np.pad(cells, ((0, 0), (0, 1))) + np.pad(cells, ((0, 0), (1, 0)))


def _springs(scene: Scene, ahead: tuple[int, int], stiffness: Array, pull: Array) -> Springs:
    """Build the springs `ahead` rows and columns long; `pull` is their force at rest over their length [N/m]."""
    (down, right), (dx, dy) = ahead, spacing(scene.sheet)
    rows, cols = scene.sheet.points
    start = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
    end = slice(down, rows), slice(max(0, right), cols - max(0, -right))
    length = math.hypot(right * dx, down * dy)
    shorter = np.divide(pull * length, stiffness, out=np.zeros_like(pull), where=stiffness.real > 0)
    return Springs(start, end, np.array([right * dx, -down * dy, 0.0]), length, stiffness, length - shorter)
