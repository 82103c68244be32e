"""Bins: squares of the picture, each with a list of the cells whose bounds reach it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.config import Integers
from taichi_msm.system.launches import Launches, end_thread
from taichi_msm.system.runtime import compilation_options, ti

# The bounds of a cell: its first and last column and row, within the picture; the last is before the first for a cell
# that is not seen.
FIRST_X, FIRST_Y, LAST_X, LAST_Y, BOUNDS = range(5)

# Farther from the picture nothing is followed.
FARTHEST = 1e6

# The largest number of entries in all lists, per cell and bin.
MOST_ENTRIES = 64

# Rounds of a search among as many cells as a sheet may have.
ROUNDS_OF_SEARCH = 32


class Bins(NamedTuple):
    """Lists of cells."""

    size: int  # width and height of a bin
    across: int  # bins in a row
    lengths: NDArray[np.int32]  # of the lists, shape (rows of bins, bins in a row)
    starts: Any  # where each list begins, and the end of the last; on the device
    entries: Any  # the cells of all lists, on the device; on a GPU, the order within a list is arbitrary


def binned(launches: Launches, bounds: Any, cells: int, extent: tuple[int, int], size: int) -> Bins:
    """List the cells of every bin: on a CPU one after the other, on a GPU all at once.

    The `bounds` of so many cells, in a picture of this width and height, are on the device. Bins have this size, or are
    larger where the lists would be too long.
    """
    if launches.bounded:
        return _at_once(launches, bounds, cells, extent, size)
    while True:
        across, down = (-(-side // size) for side in extent)
        ends = np.zeros(across * down + 1, np.int32)
        with compilation_options(optimised=False):
            _count(cells, size, across, bounds, ends)
        starts = np.cumsum(ends, dtype=np.int64)
        if starts[-1] <= MOST_ENTRIES * (cells + across * down):
            break
        size *= 2
    entries = np.empty(max(1, starts[-1]), np.int32)
    with compilation_options(optimised=False):
        _fill(cells, size, across, bounds, starts[:-1].astype(np.int32), entries)
    return Bins(size, across, ends[1:].reshape(down, across), starts.astype(np.int32), entries)


def _at_once(launches: Launches, bounds: Any, cells: int, extent: tuple[int, int], size: int) -> Bins:
    corners = launches.download(bounds).reshape(cells, 2, 2)
    while True:
        across, down = (-(-side // size) for side in extent)
        reached = np.maximum(corners[:, 1] // size - corners[:, 0] // size + 1, 0).prod(axis=1, dtype=np.int64)
        ends = np.cumsum(reached)
        if ends[-1] <= MOST_ENTRIES * (cells + across * down):
            break
        size *= 2
    total = int(ends[-1])
    counts, of_cells = launches.upload(np.zeros(across * down, np.int32)), launches.upload(ends.astype(np.int32))
    squares, places, entries = (launches.array(np.int32, max(1, total)) for _ in range(3))
    launches.launch(
        _enter, total, cells, size, across, bounds, of_cells, counts, squares, places, rounds=ROUNDS_OF_SEARCH
    )
    lengths = launches.download(counts)
    starts = launches.upload(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32))
    launches.launch(_enlist, total, cells, of_cells, squares, places, starts, entries, rounds=ROUNDS_OF_SEARCH)
    return Bins(size, across, lengths.reshape(down, across), starts, entries)


@ti.func
def store_bounds(cell, left, right, top, bottom, width, height, bounds: ti.template()):
    """Store the bounds of a cell in a picture of this width and height."""
    here = cell * BOUNDS
    bounds[here + FIRST_X] = ti.cast(ti.floor(ti.math.clamp(left, 0.0, FARTHEST)), ti.i32)
    bounds[here + FIRST_Y] = ti.cast(ti.floor(ti.math.clamp(top, 0.0, FARTHEST)), ti.i32)
    bounds[here + LAST_X] = ti.cast(ti.floor(ti.math.clamp(right, -1.0, width - 1.0)), ti.i32)
    bounds[here + LAST_Y] = ti.cast(ti.floor(ti.math.clamp(bottom, -1.0, height - 1.0)), ti.i32)


@ti.func
def reaches(cell, x, y, bounds: ti.template()):
    """Tell whether (x, y) is within the bounds of a cell."""
    here = cell * BOUNDS
    return (
        bounds[here + FIRST_X] <= x
        and x <= bounds[here + LAST_X]
        and bounds[here + FIRST_Y] <= y
        and y <= bounds[here + LAST_Y]
    )


@ti.func
def _reached(cell, size, bounds: ti.template()):
    """Give the bins that a cell reaches: their first and end column, their first and end row."""
    here = cell * BOUNDS
    return (
        bounds[here + FIRST_X] // size,
        bounds[here + LAST_X] // size + 1,
        bounds[here + FIRST_Y] // size,
        bounds[here + LAST_Y] // size + 1,
    )


@ti.kernel
def _count(cells: ti.i32, size: ti.i32, across: ti.i32, bounds: Integers, ends: Integers):
    """Count the cells of every bin; the count of bin n is in entry n + 1."""
    ti.loop_config(serialize=True)
    for cell in range(cells):
        left, right, top, bottom = _reached(cell, size, bounds)
        for row in range(top, bottom):
            for column in range(left, right):
                ends[row * across + column + 1] += 1


@ti.kernel
def _fill(cells: ti.i32, size: ti.i32, across: ti.i32, bounds: Integers, ends: Integers, entries: Integers):
    """List the cells of every bin; `ends` holds where each list begins, and afterwards where it ends."""
    ti.loop_config(serialize=True)
    for cell in range(cells):
        left, right, top, bottom = _reached(cell, size, bounds)
        for row in range(top, bottom):
            for column in range(left, right):
                entries[ends[row * across + column]] = cell
                ends[row * across + column] += 1


@ti.func
def owner(item, count, ends: ti.template()):
    """Find which of `count` owners an item is of, where `ends` counts the items of all owners up to each."""
    low, high = 0, count - 1
    while low < high:
        middle = (low + high) // 2
        if ends[middle] > item:
            high = middle
        else:
            low = middle + 1
    return low


@ti.kernel
def _enter(
    first: ti.i32, end: ti.i32, ended: Integers, cells: ti.i32, size: ti.i32, across: ti.i32,
    bounds: Integers, ends: Integers, counts: Integers, squares: Integers, places: Integers,
):  # fmt: skip
    """Find the bin and the place in its list of every entry, and so the length of every list."""
    for entry in range(first, end):
        cell = owner(entry, cells, ends)
        left, right, top, bottom = _reached(cell, size, bounds)
        # The cell's last entry is that before its end.
        n = (right - left) * (bottom - top) + entry - ends[cell]
        squares[entry] = (top + n // (right - left)) * across + left + n % (right - left)
        places[entry] = ti.atomic_add(counts[squares[entry]], 1)
        end_thread(ended)


@ti.kernel
def _enlist(
    first: ti.i32, end: ti.i32, ended: Integers, cells: ti.i32, ends: Integers, squares: Integers, places: Integers,
    starts: Integers, entries: Integers,
):  # fmt: skip
    """Put every entry into its place."""
    for entry in range(first, end):
        entries[starts[squares[entry]] + places[entry]] = owner(entry, cells, ends)
        end_thread(ended)
