"""The sheet at rest and its material: rest positions, fixed mass points, stiffness maps and checks of the scene.

With `springs`, the scene contains the coefficients of the model. With `tissue`, they are assembled cell by cell: each
cell contributes to the springs along its edges and diagonals and to the mass points at its corners. Springs and mass
points at an edge belong to fewer cells and are therefore softer and lighter. Each term of the model derives its own
coefficients (see `terms`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import Problem
from taichi_msm.images import file_sha256, read_grey
from taichi_msm.laws.law import LawNumbers
from taichi_msm.model.cells import sum_around_points
from taichi_msm.model.rest import rest_of, sample_bilinearly
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS, Side
from taichi_msm.scene.sheet import Sheet, StiffnessMap
from taichi_msm.system.array_cache import cached_arrays

# Largest number of branches of the stress relaxation.
MAX_BRANCHES = 4

# A larger ratio of the sides of a cell would require springs of negative stiffness.
MAX_CELL_ASPECT = math.sqrt(3)

# Mass points of each side, as indices of an array of shape (rows, cols).
SIDES: dict[Side, Any] = {"top": np.s_[0], "bottom": np.s_[-1], "left": np.s_[:, 0], "right": np.s_[:, -1]}


def spacing(sheet: Sheet) -> tuple[float, float]:
    """Return the distances between neighbouring columns and between neighbouring rows at rest, dx and dy [m]."""
    (rows, cols), (height, width) = sheet.points, sheet.size
    return width / (cols - 1), height / (rows - 1)


def axes(sheet: Sheet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x of the columns, shape (cols,), and y of the rows, shape (rows, 1), at rest [m].

    x_j = (j / (cols - 1) - 1/2) width, y_i = (1/2 - i / (rows - 1)) height.
    """
    (rows, cols), (height, width) = sheet.points, sheet.size
    return (np.arange(cols) / (cols - 1) - 0.5) * width, (0.5 - np.arange(rows)[:, None] / (rows - 1)) * height


def rest_positions(sheet: Sheet) -> NDArray[np.float64]:
    """Return the rest positions of the mass points [m], shape (rows, cols, 3)."""
    return rest_of(sheet).position.copy()


def fixed_points(sheet: Sheet) -> NDArray[np.bool_]:
    """Return whether each mass point is fixed, shape (rows, cols); one without a cell of the sheet is."""
    fixed, mask = np.zeros(sheet.points, dtype=bool), rest_of(sheet).mask
    if sheet.fixed == "corners":
        fixed[np.ix_((0, -1), (0, -1))] = True
    for side in fixed_sides(sheet):
        fixed[SIDES[side]] = True
    if mask is not None:
        fixed |= ~(mask.inner_points if fixes_outline(sheet) else mask.points)
    return fixed


def fixes_outline(sheet: Sheet) -> bool:
    """Return whether all mass points of fewer than four cells are fixed."""
    return "outline" in sheet.fixed


def fixed_sides(sheet: Sheet) -> tuple[Side, ...]:
    """Return the sides whose mass points are all fixed."""
    if sheet.fixed == "border" or fixes_outline(sheet):
        return tuple(SIDES)
    return tuple(side for side in SIDES if side in sheet.fixed)


def _held_points(scene: Scene, fixed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether each mass point is fixed or clamped, shape (rows, cols)."""
    held = fixed.copy()
    for probe in scene.probes:
        if probe.clamp is not None:
            held[SIDES[probe.clamp]] = True
    return held


class MapImage(NamedTuple):
    """The image of a stiffness map, read once, so that changes of the file during a run have no effect."""

    grey: NDArray[Any]  # 0 to 255, in 16-bit images 0 to 65535, shape (height, width)
    sha256: str  # of the file


# Images of a scene's stiffness maps, by their keys, map and foundation_map.
Maps = Mapping[str, MapImage]


class Springs(NamedTuple):
    """The springs of a sheet as arrays, in four families.

    Springs along rows have the shape (rows, cols - 1), those along columns (rows - 1, cols), and the diagonals of the
    cells, first those that fall to the right, then those that rise, (rows - 1, cols - 1) each.
    """

    stiffness: Sequence[Array]  # k of every spring [N/m]; 0 where there is none
    tension: Sequence[Array]  # tau, tension at rest per length [N/m]; in equilibrium
    rest: Array | None  # rest positions, shape (rows, cols, 3) [m]; None for a flat rectangle
    bounds: Array  # bound of the stiffness of linear springs at every mass point [N/m], shape (rows, cols)


@dataclass(frozen=True, eq=False)
class Material:
    """The coefficients of a sheet; a map multiplies them by its factors."""

    mass: float  # of a mass point [kg]
    drag: float  # C / m [1/s]
    # across, down, shear: stiffness k of springs along rows, along columns and along diagonals [N/m]
    across: float
    down: float
    shear: float
    tension: float  # e; the tension of a spring at rest, relative to its stiffness times its length
    virtual: float  # stiffness K of the virtual springs [N/m]; 0 if they are never active
    always_active: bool  # whether the virtual springs are always active; else only under load
    bending: float  # bending stiffness D times the area of a cell, D dx dy [N m3]
    stiffening: LawNumbers | None  # law of the springs; None if they are linear
    relaxation: tuple[tuple[float, float], ...]  # share and time [s] of every branch
    virtual_stiffening: LawNumbers | None  # law of the virtual springs; None if they are linear
    by_area: bool  # whether mass points and springs at an edge are lighter and softer, as with `tissue`
    factors: Array | None  # factor of the stiffness of every cell, shape (rows - 1, cols - 1); None without a map
    virtual_factors: Array | None  # factor of K at every mass point, shape (rows, cols); None without a map
    springs: Springs | None = None  # None where across, down, shear, tension and factors describe them
    # Area of every mass point as a share of a cell's, shape (rows, cols); None: 1, at edges 1/2 and at corners 1/4.
    shares: Array | None = None

    @property
    def is_tense(self) -> bool:
        """Whether the sheet is under tension at rest."""
        return self.tension > 0 or (self.springs is not None and any(tau.any() for tau in self.springs.tension))

    @property
    def tensions(self) -> tuple[float, float, float]:
        """Tension per length, tau, of springs along rows, along columns and along diagonals [N/m]."""
        return self.across * self.tension, self.down * self.tension, self.shear * self.tension


def read_map(stiffness_map: StiffnessMap) -> MapImage:
    """Read the image of a stiffness map; a PictureError reports a file that is not a readable grey image."""
    sha256 = file_sha256(stiffness_map.image)
    (grey,) = cached_arrays(("map", sha256), lambda: (read_grey(stiffness_map.image, sha256),))
    return MapImage(grey, sha256)


def cell_factors(stiffness_map: StiffnessMap, image: MapImage, sheet: Sheet) -> Array:
    """Return the factors of a stiffness map at the centres of the cells, shape (rows - 1, cols - 1)."""
    return map_factors(stiffness_map, image, *rest_of(sheet).cell_places)


def point_factors(stiffness_map: StiffnessMap, image: MapImage, sheet: Sheet) -> Array:
    """Return the factors of a stiffness map at the mass points, shape (rows, cols)."""
    return map_factors(stiffness_map, image, *rest_of(sheet).point_places)


def map_factors(stiffness_map: StiffnessMap, image: MapImage, across: Array, down: Array) -> Array:
    """Return the factors of a stiffness map, bilinear between pixel centres, constant beyond them, shape (m, n).

    `across` and `down` are fractions of the width from the left and of the height from the top, which broadcast to (m,
    n).
    """
    black, white = stiffness_map.range
    grey = sample_bilinearly(image.grey.astype(float), down, across)
    return black + (white - black) / np.iinfo(image.grey.dtype).max * grey


def largest_mean(factors: Array) -> float:
    """Return the largest mean of the factors of the cells around a mass point."""
    return float((sum_around_points(factors) / sum_around_points(np.ones_like(factors))).max())


def rectangle_shares(sheet: Sheet) -> Array:
    """Return the share of a cell's area at each point of a whole rectangle: 1, at edges 1/2, at corners 1/4."""
    rows, cols = np.ones(sheet.points[0]), np.ones(sheet.points[1])
    rows[[0, -1]], cols[[0, -1]] = 0.5, 0.5
    return np.outer(rows, cols)


def point_areas(material: Material, sheet: Sheet) -> Array:
    """Return the area of each mass point as a share of a cell's, shape (rows, cols)."""
    return rectangle_shares(sheet) if material.shares is None else material.shares


def cell_aspect_ratio(sheet: Sheet) -> float:
    """Return the ratio of the longer to the shorter side of a cell."""
    dx, dy = spacing(sheet)
    return max(dx, dy) / min(dx, dy)


def has_fixed_border(fixed: NDArray[np.bool_]) -> bool:
    """Return whether every mass point at an edge is fixed."""
    return bool(fixed[[0, -1]].all() and fixed[:, [0, -1]].all())


def material_key_problems(scene: Scene) -> Iterator[Problem]:
    """Report missing and superfluous keys of springs and tissue."""
    sheet = scene.sheet
    if scene.tissue is None:
        if sheet.mask is not None:
            yield Problem(("sheet", "mask"), "needs tissue, whose edges are softer; remove mask, or set tissue")
        if scene.springs is None:
            text = "missing; expected a mapping with young, thickness and density, or springs in its place"
            yield Problem(("tissue",), text)
        elif sheet.mass is None and not scene.time.at_rest:
            yield Problem(("sheet", "mass"), "missing; with springs expected a number above 0, in kg")
        if sheet.tolerance is not None:
            text = f"{sheet.tolerance:g} needs tissue: with springs the sheet depends on its points; remove tolerance"
            yield Problem(("sheet", "tolerance"), text)
        return
    if scene.tissue.density is None and not scene.time.at_rest:
        yield Problem(("tissue", "density"), "missing; expected a number above 0, in kg/m3")
    if scene.springs is not None:
        yield Problem(("springs",), "tissue already gives the stiffness of the sheet; remove springs or tissue")
    if sheet.mass is not None:
        yield Problem(("sheet", "mass"), "with tissue the mass is density x thickness x area; remove mass")
    if scene.damping:
        yield Problem(("damping",), f"{scene.damping:g} N s/m is per point; with tissue set tissue.damping, in 1/s")
    for index, probe in enumerate(scene.probes):
        if probe.force is not None:
            text = "is per point, so more points are pressed deeper; set total, the force of the whole tool, in newtons"
            yield Problem(("probes", index, "force"), text)


def tissue_problems(scene: Scene, fixed: NDArray[np.bool_], factors: Array | None) -> Iterator[Problem]:
    """Yield problems of values of tissue, with stiffness factors of shape (rows - 1, cols - 1) if a map is readable."""
    tissue, sheet = scene.tissue, scene.sheet
    if tissue is None:
        return
    aspect = cell_aspect_ratio(sheet)
    if sheet.surface is None and aspect > MAX_CELL_ASPECT * (1 + 1e-9):
        (dx, dy), (rows, cols), (height, width) = spacing(sheet), sheet.points, sheet.size
        candidates = (
            (rows, math.ceil(width / dy / MAX_CELL_ASPECT) + 1),
            (math.ceil(height / dx / MAX_CELL_ASPECT) + 1, cols),
        )
        finer = candidates[0] if dx > dy else candidates[1]
        remedy = f"try {list(finer)}" if max(finer) <= MAX_POINTS else "take another sheet.size"
        yield Problem(
            ("sheet", "points"),
            f"{list(sheet.points)} make cells {aspect:.3g} times as long as wide, and tissue allows "
            f"{MAX_CELL_ASPECT:.3g} times; {remedy}",
        )
    if tissue.foundation_map is not None and tissue.foundation_stiffness == 0:
        text = (
            "needs a foundation; set tissue.foundation, such as {young: 15.0e+3, depth: 0.05}, or remove foundation_map"
        )
        yield Problem(("tissue", "foundation_map"), text)
    if len(tissue.relaxation) > MAX_BRANCHES:
        text = f"{len(tissue.relaxation)} branches are too many; take at most {MAX_BRANCHES}"
        yield Problem(("tissue", "relaxation"), text)
    total = sum(branch.share for branch in tissue.relaxation)
    if total >= 1:
        text = f"the sum of shares is {total:g}, which leaves no elastic force; take shares with a sum below 1"
        yield Problem(("tissue", "relaxation"), text)
    if tissue.relaxation and tissue.foundation_stiffness and tissue.foundation_active == "loaded":
        text = "loaded, but tissue that relaxes needs a foundation at all times; set foundation_active: always"
        yield Problem(("tissue", "foundation_active"), text)
    needed, remedy = "every side fixed or clamped", "border"
    if sheet.mask is not None:
        needed, remedy = "the outline fixed where a mask is", "outline"
    if not (has_fixed_border(_held_points(scene, fixed)) if sheet.mask is None else fixes_outline(sheet)):
        bending = "plate" if tissue.bending == "plate" else f"{tissue.bending:g} N m"
        for name, value in (("pretension", f"{tissue.pretension:g} N/m"), ("bending", bending)):
            if getattr(tissue, name) != 0:
                text = f"{value} needs {needed}; set sheet.fixed: {remedy}, or {name}: 0"
                yield Problem(("tissue", name), text)
    if tissue.pretension > 0:
        softest = 1.0 if factors is None else float(factors[rest_of(sheet).present].min())
        max_pretension = 1.5 * tissue.young * tissue.thickness * softest
        if tissue.pretension >= max_pretension:
            yield Problem(
                ("tissue", "pretension"),
                f"{tissue.pretension:g} N/m is too much for young, {tissue.young:g} Pa, and thickness: without it the "
                f"sheet would shrink to nothing; take less than {max_pretension:.3g} N/m, or a larger young",
            )
