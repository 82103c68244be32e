"""Sums of the contact corrections over the mass points, which determine the forces of tools."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import SheetArrays, SheetLayout
from taichi_msm.system.runtime import compilation_options, ti
from taichi_msm.terms.base import KernelConfig, KernelSheet
from taichi_msm.terms.contact import ContactTerm
from taichi_msm.terms.points import build_point_functions


def sum_corrections(layout: SheetLayout, arrays: SheetArrays, *, clear: bool) -> NDArray[np.float64]:
    """Return the sums of the contact corrections [m], weighted with shares of a cell's mass, shape (tools, 3).

    The order of summation depends neither on lanes nor on workers. With `clear`, the corrections are then set to 0.
    """
    contact = layout.config.get(ContactTerm)
    if contact is None:
        return np.zeros((0, 3))
    sums = np.empty((3 * len(contact.shapes), layout.rows))
    with compilation_options():
        _build_sum(layout.config)(layout.rows, layout.cols, clear, arrays.by_column, arrays.fields, sums)
    return sums.sum(axis=1).reshape(-1, 3)


@cache
def _build_sum(config: KernelConfig) -> Callable[..., None]:
    """Build the kernel that sums the corrections in every row, per tool and component."""
    vector, vectors, lanes, serial = config.vector, config.vectors, config.lanes, config.lanes > 1
    first, count = config.fields(ContactTerm).corrections[0].start, 3 * len(config.require(ContactTerm).shapes)
    by_area, area_share = config.by_area, build_point_functions(config).area_share

    @ti.kernel
    def add_up(
        rows: ti.i32, cols: ti.i32, clear: ti.i32,
        by_column: vectors, fields_of: vectors, sums: ti.types.ndarray(dtype=ti.f64, ndim=2),
    ):  # fmt: skip
        """Sum the corrections in every row from left to right into `sums` [m], shape (tools x 3, rows)."""
        fields = ti.static(fields_of)
        ti.loop_config(serialize=serial)
        for i in range(rows):
            strip, kind = (cols + lanes - 1) // lanes, ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
            for component in range(count):
                sheet = ti.static(KernelSheet((), (), by_column, fields, (), rows, strip + 2))
                row, largest, total = ((first + component) * rows + i) * (strip + 2), vector(0), ti.cast(0, ti.f64)
                for b in range(1, strip + 1):
                    correction = fields[row + b]
                    largest = ti.max(largest, ti.max(correction, correction * (-1)))
                # Most rows touch no tool.
                if largest.max() > 0:
                    for lane in ti.static(range(lanes)):
                        for b in range(1, strip + 1):
                            share = vector(1)
                            if ti.static(by_area):
                                share = area_share(sheet, i, kind, b)
                            total += ti.cast(share[lane], ti.f64) * ti.cast(fields[row + b][lane], ti.f64)
                    if clear:
                        for b in range(1, strip + 1):
                            fields[row + b] = vector(0)
                sums[component, i] = total

    return add_up
