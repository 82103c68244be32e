"""The pushes of the tools that are moved, added up over the points."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.solver.arrays import SheetArrays, SheetLayout
from taichi_msm.system.runtime import compilation_options, ti
from taichi_msm.terms.base import AREA, StepCode
from taichi_msm.terms.contact import PUSHES, ContactTerm


def sum_pushes(layout: SheetLayout, arrays: SheetArrays, *, clear: bool) -> NDArray[np.float64]:
    """Add up the pushes [m] that the fields of contact hold, each times its point's share of a cell's mass.

    clear: set them to 0 then.

    Returns:
        Sums [m], shape (tools, 3); the order of adding depends neither on lanes nor on workers.
    """
    contact = layout.code.get(ContactTerm)
    if contact is None:
        return np.zeros((0, 3))
    sums = np.empty((PUSHES * contact.tools, layout.rows))
    with compilation_options():
        _summing(layout.code)(layout.rows, layout.cols, clear, arrays.by_column, arrays.fields, sums)
    return sums.sum(axis=1).reshape(-1, PUSHES)


@cache
def _summing(code: StepCode) -> Callable[..., None]:
    """Make the kernel that adds up every component of the pushes of every tool in every row, from left to right."""
    vector, vectors, lanes, serial = code.vector, code.vectors, code.lanes, code.lanes > 1
    first, count, by_area = code.first_field(ContactTerm), PUSHES * code.require(ContactTerm).tools, code.by_area

    @ti.kernel
    def add_up(
        rows: ti.i32,
        cols: ti.i32,
        clear: ti.i32,
        by_column: vectors,
        fields: vectors,
        sums: ti.types.ndarray(dtype=ti.f64, ndim=2),
    ):
        share_of, pushes = ti.static(by_column, fields)
        ti.loop_config(serialize=serial)
        for i in range(rows):
            strip, kind = (cols + lanes - 1) // lanes, ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
            for part in range(count):
                row, largest, total = ((first + part) * rows + i) * (strip + 2), vector(0), ti.cast(0, ti.f64)
                for b in range(1, strip + 1):
                    push = pushes[row + b]
                    largest = ti.max(largest, ti.max(push, push * (-1)))
                # Most rows are touched by no tool.
                if largest.max() > 0:
                    for lane in ti.static(range(lanes)):
                        for b in range(1, strip + 1):
                            share = ti.cast(1, ti.f64)
                            if ti.static(by_area):
                                share = ti.cast(share_of[(AREA + kind) * (strip + 2) + b][lane], ti.f64)
                            total += share * ti.cast(pushes[row + b][lane], ti.f64)
                    if clear:
                        for b in range(1, strip + 1):
                            pushes[row + b] = vector(0)
                sums[part, i] = total

    return add_up
