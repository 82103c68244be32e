"""Spatial bins: squares of the picture, each with a list of the cells whose bounding box overlaps it.

For gpu.py, the cells are parts of cells.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.config import Integers
from taichi_msm.system.launches import Launches, end_thread
from taichi_msm.system.runtime import compilation_options, ti

# Layout of `bounds`: for every cell the first and last column and row, clipped to the picture; if the cell is
# invisible, the last column or row is before the first.
FIRST_X, FIRST_Y, LAST_X, LAST_Y, BOUNDS_STRIDE = range(5)

# Limit of the coordinates, which fit into integers.
MAX_BOUND = 1e6

# Maximum number of entries of all lists, divided by the number of cells and bins together.
MAX_MEAN_ENTRIES = 64

# Maximum number of rounds of a binary search among the cells of a sheet.
SEARCH_ROUNDS = 32


class Bins(NamedTuple):
    """Lists of the cells that overlap each bin."""

    size: int  # width and height of a bin [px or samples]
    columns: int  # bins in a row
    lengths: NDArray[np.int32]  # number of cells in each list, shape (rows of bins, columns)
    starts: Any  # first entry of each list, then the end of the last one; on the device
    entries: Any  # cells of all lists, on the device; on a GPU the order within a list is arbitrary


def build_bins(launches: Launches, bounds: Any, cells: int, extent: tuple[int, int], size: int) -> Bins:
    """Build the bins of a picture from bounding boxes as stored by `store_bounds`, on the device.

    `extent`, the width and height of the picture, and `size`, those of a bin, are in the unit of the bounds. The size
    is doubled while the lists have more than `MAX_MEAN_ENTRIES` per cell and bin. On a GPU (`launches.bounded`) the
    bins are built in parallel.
    """
    corners = launches.download(bounds).reshape(cells, 2, 2)
    while True:
        columns, rows = (-(-side // size) for side in extent)
        bins_per_cell = np.maximum(corners[:, 1] // size - corners[:, 0] // size + 1, 0).prod(axis=1, dtype=np.int64)
        ends = np.cumsum(bins_per_cell)
        total = int(ends[-1])
        if total <= MAX_MEAN_ENTRIES * (cells + columns * rows):
            break
        size *= 2
    if not launches.bounded:
        lengths, entries = np.zeros(columns * rows, np.int32), np.empty(max(1, total), np.int32)
        with compilation_options(optimised=False):
            # The first call only counts: its lists all start at 0.
            _list_cells(cells, size, columns, bounds, lengths, entries)
            starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
            _list_cells(cells, size, columns, bounds, starts[:-1].copy(), entries)
        return Bins(size, columns, lengths.reshape(rows, columns), starts, entries)
    counts, cell_ends = launches.upload(np.zeros(columns * rows, np.int32)), launches.upload(ends.astype(np.int32))
    bins, positions, entries = (launches.array(np.int32, max(1, total)) for _ in range(3))
    launches.launch(
        _assign_entries, total, cells, size, columns, bounds, cell_ends, counts, bins, positions, rounds=SEARCH_ROUNDS
    )
    lengths = launches.download(counts)
    starts = launches.upload(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32))
    launches.launch(_list_entries, total, cells, cell_ends, bins, positions, starts, entries, rounds=SEARCH_ROUNDS)
    return Bins(size, columns, lengths.reshape(rows, columns), starts, entries)


@ti.func
def store_bounds(cell, left, right, top, bottom, width, height, bounds: ti.template()):
    """Store the bounding box of a cell, clipped to the picture; all lengths in [px] or all in [samples]."""
    entry = cell * BOUNDS_STRIDE
    bounds[entry + FIRST_X] = ti.cast(ti.floor(ti.math.clamp(left, 0.0, MAX_BOUND)), ti.i32)
    bounds[entry + FIRST_Y] = ti.cast(ti.floor(ti.math.clamp(top, 0.0, MAX_BOUND)), ti.i32)
    bounds[entry + LAST_X] = ti.cast(ti.floor(ti.math.clamp(right, -1.0, width - 1.0)), ti.i32)
    bounds[entry + LAST_Y] = ti.cast(ti.floor(ti.math.clamp(bottom, -1.0, height - 1.0)), ti.i32)


@ti.func
def is_in_bounds(cell, x, y, bounds: ti.template()):
    """Return whether sample (x, y) is within the bounding box of a cell."""
    entry = cell * BOUNDS_STRIDE
    return (
        bounds[entry + FIRST_X] <= x
        and x <= bounds[entry + LAST_X]
        and bounds[entry + FIRST_Y] <= y
        and y <= bounds[entry + LAST_Y]
    )


@ti.func
def _bin_range(cell, size, bounds: ti.template()):
    """Return the bins that a cell overlaps: first and end column, first and end row."""
    entry = cell * BOUNDS_STRIDE
    return (
        bounds[entry + FIRST_X] // size,
        bounds[entry + LAST_X] // size + 1,
        bounds[entry + FIRST_Y] // size,
        bounds[entry + LAST_Y] // size + 1,
    )


@ti.kernel
def _list_cells(cells: ti.i32, size: ti.i32, columns: ti.i32, bounds: Integers, ends: Integers, entries: Integers):
    """List the cells of every bin; `ends`, at first the start of each list, is updated to its end."""
    ti.loop_config(serialize=True)
    for cell in range(cells):
        left, right, top, bottom = _bin_range(cell, size, bounds)
        for row in range(top, bottom):
            for column in range(left, right):
                entries[ends[row * columns + column]] = cell
                ends[row * columns + column] += 1


@ti.func
def owner_of(item, owners, ends: ti.template()):
    """Return the index of an item's owner, by binary search in `ends`: the index after the last item of each owner."""
    low, high = 0, owners - 1
    while low < high:
        middle = (low + high) // 2
        if ends[middle] > item:
            high = middle
        else:
            low = middle + 1
    return low


@ti.kernel
def _assign_entries(
    first: ti.i32, end: ti.i32, ended: Integers, cells: ti.i32, size: ti.i32, columns: ti.i32,
    bounds: Integers, ends: Integers, counts: Integers, bins: Integers, positions: Integers,
):  # fmt: skip
    """Assign every entry to a bin and to a position in its list, and count the entries of each bin."""
    for entry in range(first, end):
        cell = owner_of(entry, cells, ends)
        left, right, top, bottom = _bin_range(cell, size, bounds)
        # Index of the entry among those of its cell.
        n = (right - left) * (bottom - top) + entry - ends[cell]
        bins[entry] = (top + n // (right - left)) * columns + left + n % (right - left)
        positions[entry] = ti.atomic_add(counts[bins[entry]], 1)
        end_thread(ended)


@ti.kernel
def _list_entries(
    first: ti.i32, end: ti.i32, ended: Integers, cells: ti.i32, ends: Integers, bins: Integers,
    positions: Integers, starts: Integers, entries: Integers,
):  # fmt: skip
    """Write the cell of every entry to its position."""
    for entry in range(first, end):
        entries[starts[bins[entry]] + positions[entry]] = owner_of(entry, cells, ends)
        end_thread(ended)
