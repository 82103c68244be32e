"""Bending: the stiffness of a plate. Scene: `tissue.bending`.

The energy is D / 2 times the integral of the squared Laplacian of u. With the moment M = D dx dy Laplacian(u), which is
0 at the simply supported edges, the force on a mass point is -Laplacian(M).
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import Material, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.terms.base import BY_COLUMN, DX, DY, KernelConfig, Term
from taichi_msm.terms.places import Places


@dataclass(frozen=True)
class BendingTerm(Term):
    """Bending. Moments are stored in additional rows of u, one row ahead of the row that is stepped."""

    masked: bool = False  # whether a field has 1 at the points of four cells, which have moments, and else 0

    has_gradient: ClassVar[bool] = True
    # The force on a row depends on the moments of both neighbouring rows, and these on displacements one row further.
    reach: ClassVar[int] = 2
    reductions: ClassVar[tuple[str, ...]] = ("sum",)

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        """Derive D dx dy [N m3]; for `plate`, D = E t^3 / (12 (1 - nu^2)) with nu = 1/3, as in `terms.springs`."""
        tissue, (dx, dy) = scene.tissue, spacing(scene.sheet)
        if tissue is None:
            return {"bending": 0.0}
        plate = tissue.young * tissue.thickness**3 / (12 * (1 - (1 / 3) ** 2))
        return {"bending": (plate if tissue.bending == "plate" else tissue.bending) * (dx * dy)}

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        return cls(rest_of(plan.scene.sheet).mask is not None) if plan.material.bending > 0 else None

    @staticmethod
    def stiffness_bound(material: Material, sheet: Sheet) -> float:
        # The largest eigenvalue of the discrete Laplacian is 4 / dx^2 + 4 / dy^2.
        dx, dy = spacing(sheet)
        return material.bending * (4 / dx**2 + 4 / dy**2) ** 2

    @classmethod
    def node_stiffness_bounds(cls, material: Material, sheet: Sheet) -> NDArray[Any] | float:
        # The outline of a mask is fixed.
        mask, bound = rest_of(sheet).mask, cls.stiffness_bound(material, sheet)
        return bound if mask is None else bound * mask.inner_points

    @property
    def constant_places(self) -> Places:
        return Places(stiffness=1)

    @property
    def field_places(self) -> Places:
        return Places(inside=int(self.masked))

    @property
    def measure_places(self) -> Places:
        return Places(squared_laplacian=1)

    def constants(self, plan: Plan) -> tuple[float, ...]:
        return (plan.material.bending,)

    def fields(self, plan: Plan) -> NDArray[Any]:
        mask = rest_of(plan.scene.sheet).mask
        return super().fields(plan) if mask is None else mask.inner_points[None].astype(float)

    def energy(self, sums: NDArray[Any], plan: Plan) -> float:
        return plan.material.bending * float(sums[0])

    def _build_inside(self, config: KernelConfig) -> Callable[..., Any]:
        """Build the Taichi function inside(sheet, i, b), 1 for a point of an inner row with four cells, else 0."""
        ti, masked, field = config.ti, self.masked, config.fields(BendingTerm).inside

        @ti.func
        def inside(sheet: ti.template(), i, b):
            if ti.static(masked):
                return sheet.fields[(field * sheet.rows + i) * sheet.width + b]
            else:  # noqa: RET505  # Taichi would compile the rest as well.
                left, right = BY_COLUMN.has_left * sheet.width + b, BY_COLUMN.has_right * sheet.width + b
                return sheet.by_column[left] * sheet.by_column[right]

        return inside

    def build_store_moment(self, config: KernelConfig) -> Callable[..., None]:
        """Build the Taichi function store_moment(sheet, i, before, row, after, b, target)."""
        ti = config.ti
        vector, constants, laplacian = config.vector, config.constants(BendingTerm), build_laplacian(config)
        inside = self._build_inside(config)

        @ti.func
        def store_moment(sheet: ti.template(), i, before, row, after, b, target):
            """Store the moment of entry b of row i, which is row `row` of u, in row `target` of u."""
            dx, dy, stiffness = sheet.constants[DX], sheet.constants[DY], sheet.constants[constants.stiffness]
            across, down = stiffness / (dx * dx), stiffness / (dy * dy)
            for c in ti.static(range(3)):
                sheet.u[c][target * sheet.width + b] = vector(0)
            if 0 < i < sheet.rows - 1:
                share = inside(sheet, i, b)
                for c in ti.static(range(3)):
                    curved = laplacian(sheet.u[c], sheet.width, before, row, after, b, across, down)
                    sheet.u[c][target * sheet.width + b] = share * curved

        return store_moment

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        ti = config.ti
        laplacian = build_laplacian(config)

        @ti.func
        def add(force: ti.template(), sheet: ti.template(), entry: ti.template(), _now: ti.template()):
            row = ti.static(entry.row)
            dx, dy = sheet.constants[DX], sheet.constants[DY]
            across, down = 1 / (dx * dx), 1 / (dy * dy)
            for c in ti.static(range(3)):
                bent = laplacian(sheet.u[c], sheet.width, row.before, row.at, row.after, entry.b, across, down)
                force[c] = force[c] - bent

        return (add,)

    def build_tangents(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        return self.build_forces(config)

    def build_measures(self, config: KernelConfig) -> Sequence[Callable[..., None]]:
        ti = config.ti
        real, vector, places = config.real, config.vector, config.measures(BendingTerm)
        laplacian, inside = build_laplacian(config), self._build_inside(config)

        @ti.func
        def measure(measures: ti.template(), sheet: ti.template(), p, i, kind, b):
            share = inside(sheet, i, b) * ti.cast(kind == 1, real)
            # The first and the last row have no neighbour on one side.
            before, after = p - ti.cast(kind == 1, ti.i32), p + ti.cast(kind == 1, ti.i32)
            dx, dy = sheet.constants[DX], sheet.constants[DY]
            across, down = 1 / (dx * dx), 1 / (dy * dy)
            squared_curvature = vector(0)
            for c in ti.static(range(3)):
                curvature = share * laplacian(sheet.u[c], sheet.width, before, p, after, b, across, down)
                squared_curvature += curvature * curvature
            measures[places.squared_laplacian] += squared_curvature

        return (measure,)


def build_laplacian(config: KernelConfig) -> Callable[..., Any]:
    """Build the Taichi function that computes the five-point Laplacian of an array."""
    ti = config.ti

    @ti.func
    def laplacian(field: ti.template(), width, before, row, after, b, across, down):
        """Return the Laplacian at entry b of a row, with the factors across = 1 / dx^2 and down = 1 / dy^2."""
        centre = field[row * width + b]
        horizontal = (field[row * width + b - 1] - centre) + (field[row * width + b + 1] - centre)
        vertical = (field[before * width + b] - centre) + (field[after * width + b] - centre)
        return across * horizontal + down * vertical

    return laplacian
