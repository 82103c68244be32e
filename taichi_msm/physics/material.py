"""What a sheet is made of: masses, springs and damping of the model, whichever way a scene describes them.

With `springs`, the scene has these numbers. With `tissue`, they are derived from it cell by cell: each cell, dx by dy,
adds to the springs along its edges and diagonals and to the points at its corners (f: the factor of the map there)

    along x     f E t (9/8 dy/dx - 3/8 dx/dy) / 2        along y: the same with x and y exchanged
    diagonals   f 3/16 E t (dx^2 + dy^2) / (dx dy)
    corners     mass rho t dx dy / 4,   K = foundation dx dy / 4,   C = damping mass

so that the lattice is an isotropic sheet in plane stress. Springs impose its Poisson's ratio of 1/3; docs/model.md has
the derivation. Points and springs at an edge belong to fewer cells, and so get less.

Under a tension S each spring of length L pulls at rest with tau L. Here tau = k1 e, where k1 is its stiffness for f = 1
and e = S / (3/2 E t). Its force, less that at rest, which cancels, is

    (k - tau) (1 - L / |o + q|) (o + q) + tau q          o: the spring at rest, q: difference of its ends' displacements
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Problem
from taichi_msm.physics import stiffness_map
from taichi_msm.physics.lattice import spacing
from taichi_msm.physics.stiffness_map import MapImage
from taichi_msm.scene import MAX_POINTS, Scene, Sheet, Tissue

# Poisson's ratio of a lattice of springs between nearest and diagonal neighbours.
POISSON = 1 / 3

# Cells longer than this many times their width would need springs of negative stiffness.
LONGEST_CELL = math.sqrt(3)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Material:
    """The numbers of a sheet; with a map, those for a factor of 1.

    Attributes:
        mass: of a point [kg].
        drag: C / m [1/s].
        across, down, shear: stiffness k of springs along a row, along a column and along diagonals [N/m].
        tension: e; a spring pulls at rest with this share of its stiffness times its length.
        virtual: stiffness K of the virtual springs [N/m]; 0 if they never act.
        always: whether the virtual springs always act; else only under a load.
        bending: D dx dy [N m3].
        by_area: whether points and springs at an edge get less than others, as in tissue.
        factors: of the stiffness at the centre of every cell, shape (rows - 1, cols - 1); None without a map.
    """

    mass: float
    drag: float
    across: float
    down: float
    shear: float
    tension: float
    virtual: float
    always: bool
    bending: float
    by_area: bool
    factors: Array | None

    @property
    def stiffness(self) -> tuple[float, float, float]:
        """Stiffness less tension, k - tau, of springs along rows, along columns and of diagonals [N/m]."""
        return self._times(1 - self.tension)

    @property
    def tensions(self) -> tuple[float, float, float]:
        """Tension per length, tau, of springs along rows, along columns and of diagonals [N/m]."""
        return self._times(self.tension)

    def _times(self, factor: float) -> tuple[float, float, float]:
        return self.across * factor, self.down * factor, self.shear * factor

    @property
    def has_springs(self) -> bool:
        """Whether there are springs between points."""
        return max(self.across, self.down, self.shear) > 0


class Stiffness(NamedTuple):
    """Stiffness k of every spring [N/m].

    Attributes:
        across: along rows, shape (rows, cols - 1).
        down: along columns, shape (rows - 1, cols).
        shear: along both diagonals of a cell, shape (rows - 1, cols - 1).
    """

    across: Array
    down: Array
    shear: Array


def material(scene: Scene, image: MapImage | None) -> Material:
    """Find the numbers of a scene's sheet.

    Args:
        scene: in which `kind_problems` finds nothing.
        image: of its map; None: it has none.
    """
    rows, cols = scene.sheet.points
    factors = None
    if image is not None:
        assert scene.stiffness_map is not None
        factors = stiffness_map.factors(scene.stiffness_map, image, rows - 1, cols - 1)
    if scene.tissue is not None:
        return _of_tissue(scene, scene.tissue, factors)
    springs, mass = scene.springs, scene.sheet.mass
    assert springs is not None
    assert mass is not None
    return Material(
        mass=mass,
        drag=scene.damping / mass,
        across=springs.structural,
        down=springs.structural,
        shear=springs.shear,
        tension=0.0,
        virtual=springs.virtual if springs.virtual_active == "always" or scene.probes else 0.0,
        always=springs.virtual_active == "always",
        bending=0.0,
        by_area=False,
        factors=factors,
    )


def _of_tissue(scene: Scene, tissue: Tissue, factors: Array | None) -> Material:
    dx, dy = spacing(scene.sheet)
    membrane, area = tissue.young * tissue.thickness, dx * dy
    plate = tissue.young * tissue.thickness**3 / (12 * (1 - POISSON**2))
    return Material(
        mass=tissue.density * tissue.thickness * area,
        drag=tissue.damping,
        across=membrane * (9 / 8 * dy / dx - 3 / 8 * dx / dy),
        down=membrane * (9 / 8 * dx / dy - 3 / 8 * dy / dx),
        shear=3 / 16 * membrane * (dx * dx + dy * dy) / area,
        tension=tissue.pretension / (1.5 * membrane),
        virtual=tissue.foundation * area if tissue.foundation_active == "always" or scene.probes else 0.0,
        always=tissue.foundation_active == "always",
        bending=(plate if tissue.bending == "plate" else tissue.bending) * area,
        by_area=True,
        factors=factors,
    )


def stiffness(material: Material, factors: Array) -> Stiffness:
    """Assemble the stiffness of every spring from its cells.

    Args:
        material: of the sheet.
        factors: of every cell, shape (rows - 1, cols - 1).
    """
    above_and_below, beside = np.pad(factors, ((1, 1), (0, 0))), np.pad(factors, ((0, 0), (1, 1)))
    across = material.across / 2 * (above_and_below[:-1] + above_and_below[1:])
    down = material.down / 2 * (beside[:, :-1] + beside[:, 1:])
    if not material.by_area:
        # A spring at an edge is as stiff as any other: with the factor of its only cell, not with half of it.
        across[[0, -1]] *= 2
        down[:, [0, -1]] *= 2
    return Stiffness(across, down, material.shear * factors)


def area_shares(sheet: Sheet) -> Array:
    """Tell which share of a cell's area belongs to each point: 1, at edges 1/2, at corners 1/4; shape (rows, cols)."""
    rows, cols = np.ones(sheet.points[0]), np.ones(sheet.points[1])
    rows[[0, -1]], cols[[0, -1]] = 0.5, 0.5
    return np.outer(rows, cols)


def highest_frequency(material: Material, sheet: Sheet) -> float:
    """Bound the highest angular frequency of the sheet [rad/s] in any shape without springs below half their length.

    The energy is a sum over cells. The springs of a cell have at most the energy k / 2 |q|^2, so that no mode of a cell
    with a quarter of the points' mass at its corners has a higher frequency than

        w^2 = (4 max(across + down, across + 2 shear, down + 2 shear) + K) / m

    and hence no mode of the sheet. If factors differ, each cell takes the share of a point's mass that it has of the
    point's stiffness; the maximum is then multiplied by the largest mean of the factors around a point. Bending adds
    the square of the largest Laplacian, (4 / dx^2 + 4 / dy^2)^2 D dx dy / m.
    """
    (dx, dy), across, down, shear = spacing(sheet), material.across, material.down, material.shear
    springs = 4 * max(across + down, across + 2 * shear, down + 2 * shear) * _largest_factor(material)
    bending = material.bending * (4 / dx**2 + 4 / dy**2) ** 2
    return math.sqrt((springs + material.virtual + bending) / material.mass)


def cell_ratio(sheet: Sheet) -> float:
    """Give the ratio of the longer to the shorter side of a cell."""
    dx, dy = spacing(sheet)
    return max(dx, dy) / min(dx, dy)


def has_fixed_border(fixed: NDArray[np.bool_]) -> bool:
    """Tell whether every point at an edge is fixed."""
    return bool(fixed[[0, -1]].all() and fixed[:, [0, -1]].all())


def _largest_factor(material: Material) -> float:
    """Find the largest mean of the factors of the cells around a point; with springs, the largest factor."""
    if material.factors is None:
        return 1.0
    return stiffness_map.largest_mean(material.factors) if material.by_area else float(material.factors.max())


def kind_problems(scene: Scene) -> Iterator[Problem]:
    """Find missing and superfluous keys of springs and of tissue."""
    sheet = scene.sheet
    if scene.tissue is None:
        if scene.springs is None:
            said = "missing; expected a mapping with young, thickness and density, or springs in its place"
            yield Problem(("tissue",), said)
        elif sheet.mass is None:
            yield Problem(("sheet", "mass"), "missing; with springs expected a number above 0, in kg")
        if sheet.tolerance is not None:
            said = f"{sheet.tolerance:g} needs tissue: with springs other points make another sheet; remove tolerance"
            yield Problem(("sheet", "tolerance"), said)
        return
    if scene.springs is not None:
        yield Problem(("springs",), "tissue already gives the stiffness of the sheet; remove springs or tissue")
    if sheet.mass is not None:
        yield Problem(("sheet", "mass"), "tissue has the mass of density x thickness x area; remove mass")
    if scene.damping:
        yield Problem(("damping",), f"{scene.damping:g} N s/m is per point; with tissue set tissue.damping, in 1/s")
    for index, probe in enumerate(scene.probes):
        if probe.force is not None:
            said = "is per point, so that more points would be pressed deeper; set total, of the whole tool, in newtons"
            yield Problem(("probes", index, "force"), said)


def tissue_problems(scene: Scene, fixed: NDArray[np.bool_], factors: Array | None) -> Iterator[Problem]:
    """Find tissue that is impossible.

    Args:
        scene: in which `kind_problems` finds nothing.
        fixed: which points of its sheet are fixed, shape (rows, cols).
        factors: of the stiffness of its cells; None: not known, or there is no map.
    """
    tissue, sheet = scene.tissue, scene.sheet
    if tissue is None:
        return
    longest = cell_ratio(sheet)
    if longest > LONGEST_CELL * (1 + 1e-9):
        (dx, dy), (rows, cols), (height, width) = spacing(sheet), sheet.points, sheet.size
        enough = (rows, math.ceil(width / dy / LONGEST_CELL) + 1), (math.ceil(height / dx / LONGEST_CELL) + 1, cols)
        more = enough[0] if dx > dy else enough[1]
        remedy = f"try {list(more)}" if max(more) <= MAX_POINTS else "take another sheet.size"
        yield Problem(
            ("sheet", "points"),
            f"{list(sheet.points)} make cells {longest:.3g} times as long as wide, and tissue allows "
            f"{LONGEST_CELL:.3g} times; {remedy}",
        )
    if not has_fixed_border(fixed):
        bending = "plate" if tissue.bending == "plate" else f"{tissue.bending:g} N m"
        for name, value in (("pretension", f"{tissue.pretension:g} N/m"), ("bending", bending)):
            if getattr(tissue, name) != 0:
                said = f"{value} needs every side fixed; set sheet.fixed: border, or {name}: 0"
                yield Problem(("tissue", name), said)
    if tissue.pretension > 0:
        softest = 1.0 if factors is None else float(factors.min())
        most = 1.5 * tissue.young * tissue.thickness * softest
        if tissue.pretension >= most:
            yield Problem(
                ("tissue", "pretension"),
                f"{tissue.pretension:g} N/m needs springs without length; take less than {most:.3g} N/m, or a larger "
                "young",
            )
