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
from tests.reference import surface as curved
from tests.reference.mask import cell_counts, present_cells

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
    bending: Any  # D dx dy [N m3], a number; with a mask of every point with four neighbours, 0 at an outline
    share: Array  # area of every point as a share of a cell's, shape (rows, cols)
    rest: Array  # rest positions [m], shape (rows, cols, 3)
    normal: Array  # unit normals at rest, shape (rows, cols, 3)
    area: Array  # of every point [m2], shape (rows, cols)
    is_curved: bool  # whether the sheet has a surface


# Rows and columns from the start of a spring to its end.
ALONG_ROW, ALONG_COLUMN, TO_RIGHT, TO_LEFT = (0, 1), (1, 0), (1, 1), (1, -1)


def _factors(scene: Scene) -> Array:
    """Return the factor at the centre of every cell, shape (rows - 1, cols - 1); 1 without a map, 0 without sheet."""
    present = present_cells(scene.sheet).astype(float)
    if scene.stiffness_map is None:
        return present
    return present * cell_factors(scene.stiffness_map, _image(scene.stiffness_map), scene.sheet)


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


def sheet(scene: Scene, rest: Array | None = None) -> Sheet:
    """Assemble the sheet of a scene, flat or with its surface.

    Springs from `springs` have its constants; those of tissue are the ones of a cell dx by dy whose strain energy is
    that of an isotropic membrane with Poisson's ratio 1/3 (Lloyd et al. 2007), half of each edge's from the cell at
    either side. Masses and virtual springs of tissue are shares of the cells' area.

    Args:
        scene: scene with springs or tissue.
        rest: rest positions [m], shape (rows, cols, 3), in place of those of the scene.
    """
    surface = getattr(scene.sheet, "surface", None)
    if rest is None and surface is not None:
        rest = curved.rest_positions(surface, scene.sheet.points, scene.sheet.size)
    if rest is not None:
        return _curved(scene, rest)
    if scene.tissue is not None:
        return _of_tissue(scene, scene.tissue)
    return _of_springs(scene, curved.flat_positions(scene.sheet.points, scene.sheet.size), is_curved=False)


def _of_springs(scene: Scene, rest: Array, *, is_curved: bool) -> Sheet:
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
    every, measured = np.ones(scene.sheet.points), curved.cells(rest)
    springs = tuple(
        _springs_between(rest, ahead, k, 0 * k) if is_curved else _springs(scene, ahead, k, 0 * k)
        for ahead, k in stiffness.items()
    )
    mass, virtual, drag = (scene.sheet.mass or 0.0) * every, scene.springs.virtual * every, scene.damping * every
    area, share = curved.point_areas(measured), _rows_of(_columns_of(cells)) / 4
    return Sheet(springs, mass, drag, virtual, 0.0, share, rest, curved.normals(measured), area, is_curved)


def _curved(scene: Scene, rest: Array) -> Sheet:
    """Assemble a sheet with given rest positions, without bending."""
    tissue = scene.tissue
    if tissue is None:
        return _of_springs(scene, rest, is_curved=True)
    present, factor, membrane = present_cells(scene.sheet), _factors(scene), tissue.young * tissue.thickness
    measured = curved.cells(rest)
    area = curved.point_areas(measured, present)
    stretch = tissue.pretension / (3 / 2 * membrane)
    along_row, along_column, to_right, to_left = np.moveaxis(membrane * measured.constants, -1, 0)
    families = {
        ALONG_ROW: (_rows_of(factor * along_row), _rows_of(present * along_row)),
        ALONG_COLUMN: (_columns_of(factor * along_column), _columns_of(present * along_column)),
        TO_RIGHT: (factor * to_right, present * to_right),
        TO_LEFT: (factor * to_left, present * to_left),
    }
    springs = []
    for ahead, (k, k1) in families.items():
        start, end = _windows(scene.sheet.points, ahead)
        square = ((rest[end] - rest[start]) ** 2).sum(axis=-1)
        springs.append(_springs_between(rest, ahead, square * k, stretch * square * k1))
    mass = (tissue.density or 0.0) * tissue.thickness * area
    virtual = tissue.foundation_stiffness * area * _foundation_factors(scene)
    share = _rows_of(_columns_of(present.astype(float))) / 4
    drag, normal = tissue.damping * mass, curved.normals(measured, present)
    return Sheet(tuple(springs), mass, drag, virtual, 0.0, share, rest, normal, area, is_curved=True)


def cell_stiffness(scene: Scene, rest: Array) -> Array:
    """Return the spring constants of tissue in each cell over length^2 [N/m3], shape (rows - 1, cols - 1, 4)."""
    assert scene.tissue is not None
    return scene.tissue.young * scene.tissue.thickness * _factors(scene)[..., None] * curved.cells(rest).constants


def highest_frequency(scene: Scene, rest: Array | None = None) -> float:
    """Return the bound of the angular frequencies from which the largest step follows [rad/s].

    w^2 = max over the points of (factor sum of Lam of its cells + factor_K K) / m, Lam by `stiffness_bounds`; with
    `springs` (max(8 structural, 4 structural + 8 shear) + K) / m, with the largest factor of a map around a point.
    """
    assembled, tissue = sheet(scene, rest), scene.tissue
    if tissue is None:
        assert scene.springs is not None
        structural, shear, factor = scene.springs.structural, scene.springs.shear, _factors(scene)
        around = curved.sum_at_corners(factor) / curved.sum_at_corners(np.ones_like(factor))
        springs = max(8 * structural, 4 * structural + 8 * shear) * around
        return math.sqrt(float(((springs + assembled.virtual) / assembled.mass).max()))
    stiffening, foundation = tissue.stiffening, getattr(tissue.foundation, "lock", None)
    of_springs = 1.0 if stiffening is None else stiffening.factor
    of_foundation = 1.0 if foundation is None else tissue.foundation.factor  # type: ignore[union-attr]
    bounds = curved.stiffness_bounds(assembled.rest, cell_stiffness(scene, assembled.rest))
    total, part = of_springs * curved.sum_at_corners(bounds) + of_foundation * assembled.virtual, assembled.mass > 0
    return math.sqrt(float((total[part] / assembled.mass[part]).max()))


def largest_pressure(assembled: Sheet, free: NDArray[np.bool_]) -> float:
    """Return the largest pressure that the pretension needs in equilibrium, |N . sum of tau o| / area [Pa].

    Args:
        assembled: assembled sheet.
        free: whether a mass point is neither fixed nor clamped, shape (rows, cols).
    """
    force = np.zeros_like(assembled.rest)
    for springs in assembled.springs:
        tau = springs.stiffness * (springs.length - springs.unstretched) / springs.length
        force[springs.start] += tau[..., None] * springs.offset
        force[springs.end] -= tau[..., None] * springs.offset
    pressure = np.abs((force * assembled.normal).sum(axis=-1))[free] / assembled.area[free]
    return float(pressure.max())


def _of_tissue(scene: Scene, tissue: Tissue) -> Sheet:
    dx, dy = spacing(scene.sheet)
    factor, membrane, present = _factors(scene), tissue.young * tissue.thickness, present_cells(scene.sheet)
    cells = present.astype(float)
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
    if not present.all():
        bending = bending * (cell_counts(present) == 4)[1:-1, 1:-1, None]
    virtual = tissue.foundation_stiffness * dx * dy / 4 * quarters * _foundation_factors(scene)
    rest = curved.flat_positions(scene.sheet.points, scene.sheet.size)
    normal = np.zeros_like(rest)
    normal[..., 2] = 1
    drag, area = tissue.damping * mass, dx * dy * quarters / 4
    return Sheet(springs, mass, drag, virtual, bending * dx * dy, quarters / 4, rest, normal, area, is_curved=False)


def _rows_of(cells: Array) -> Array:
    """Add the contributions of cells to the edges above and below them; the result has one row more."""
    return np.pad(cells, ((0, 1), (0, 0))) + np.pad(cells, ((1, 0), (0, 0)))


def _columns_of(cells: Array) -> Array:
    """Add the contributions of cells to the edges at their left and right; the result has one column more."""
    return np.pad(cells, ((0, 0), (0, 1))) + np.pad(cells, ((0, 0), (1, 0)))


def _windows(points: tuple[int, int], ahead: tuple[int, int]) -> tuple[Window, Window]:
    (rows, cols), (down, right) = points, ahead
    start = slice(0, rows - down), slice(max(0, -right), cols - max(0, right))
    return start, (slice(down, rows), slice(max(0, right), cols - max(0, -right)))


def _springs(scene: Scene, ahead: tuple[int, int], stiffness: Array, pull: Array) -> Springs:
    """Build the springs `ahead` rows and columns long; `pull` is their force at rest over their length [N/m]."""
    (down, right), (dx, dy) = ahead, spacing(scene.sheet)
    length = math.hypot(right * dx, down * dy)
    offset = np.array([right * dx, -down * dy, 0.0])
    return _with_pull(*_windows(scene.sheet.points, ahead), offset, length, stiffness, pull)


def _springs_between(rest: Array, ahead: tuple[int, int], stiffness: Array, pull: Array) -> Springs:
    """Build the springs `ahead` rows and columns long between rest positions, shape (rows, cols, 3)."""
    start, end = _windows((rest.shape[0], rest.shape[1]), ahead)
    offset = rest[end] - rest[start]
    return _with_pull(start, end, offset, np.linalg.norm(offset, axis=-1), stiffness, pull)


def _with_pull(start: Window, end: Window, offset: Array, length: Any, stiffness: Array, pull: Array) -> Springs:
    shorter = np.divide(pull * length, stiffness, out=np.zeros_like(pull), where=stiffness.real > 0)
    return Springs(start, end, offset, length, stiffness, length - shorter)
