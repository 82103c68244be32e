"""Numbers of a mass point within a kernel: its mobility, area and rest position.

On a uniform flat rectangle they are numbers per column, for the first, inner and last rows; otherwise fields.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from typing import Any, NamedTuple

from taichi_msm.terms.base import BY_COLUMN, DY, TOP_Y, KernelConfig

# Prevents a division by 0; representable in f32.
MIN_INVERSE = 1e-30


class PointFunctions(NamedTuple):
    """Taichi functions of entry b of row i, which is of a kind as in `KernelRow`."""

    mobility: Callable[..., Any]  # mobility(sheet, i, kind, b): the inverse share of a cell's mass, 0 if fixed
    area_share: Callable[..., Any]  # area_share(sheet, i, kind, b): the share of a cell's area, maybe 0 if fixed
    rest_position: Callable[..., Any]  # rest_position(sheet, i, b): x, y and z at rest [m], as a list


def build_point_functions(config: KernelConfig) -> PointFunctions:
    """Build the Taichi functions of the numbers of a mass point."""
    ti, vector, by_point, curved, fields = config.ti, config.vector, config.by_point, config.curved, config.point_fields
    by_area = config.by_area

    @ti.func
    def mobility(sheet: ti.template(), i, kind, b):
        if ti.static(by_point):
            return sheet.fields[(fields.mobility * sheet.rows + i) * sheet.width + b]
        else:  # noqa: RET505  # Taichi would compile the rest as well.
            return sheet.by_column[(BY_COLUMN.mobility.start + kind) * sheet.width + b]

    @ti.func
    def area_share(sheet: ti.template(), i, kind, b):
        if ti.static(by_point and by_area):
            inverse = sheet.fields[(fields.mobility * sheet.rows + i) * sheet.width + b]
            return ti.select(inverse > 0, 1 / ti.max(inverse, MIN_INVERSE), vector(0))
        elif ti.static(by_point):  # noqa: RET505  # Taichi would compile the rest as well.
            return sheet.fields[(fields.area_share * sheet.rows + i) * sheet.width + b]
        else:
            return sheet.by_column[(BY_COLUMN.area_share.start + kind) * sheet.width + b]

    @ti.func
    def rest_position(sheet: ti.template(), i, b):
        if ti.static(curved):
            return [sheet.fields[(fields.rest[c] * sheet.rows + i) * sheet.width + b] for c in ti.static(range(3))]
        else:  # noqa: RET505
            y = vector(sheet.constants[TOP_Y] - i * sheet.constants[DY])
            return [sheet.by_column[BY_COLUMN.rest_x * sheet.width + b], y, vector(0)]

    return PointFunctions(mobility, area_share, rest_position)
