"""Comparison of displacements on two meshes of a sheet.

A rectangle is interpolated by cubics over the 4 x 4 mass points around a place, at the border the nearest ones. With a
mask, the stencil of a place is the square of mass points, of 4 x 4, else 3 x 3, else 2 x 2, whose cells are all sheet
and include that of the place, as central as possible, so that it crosses no hole or slit. Outlines of two meshes differ
by parts of a cell: places in a cell that is sheet on one mesh only are not compared, because the continuation of steep
displacements would differ far more than the runs.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.model.cells import sum_around_points
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.sheet import Sheet

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Fraction of the way from a mass point to the mean of its cells' middles, which selects among cells that touch there.
TOWARDS_INSIDE = 0.01


def difference(displacement: NDArray[Any], other: NDArray[Any], sheet: Sheet, other_sheet: Sheet) -> Array:
    """Subtract displacements on another mesh [m], interpolated, at mass points; 0 where both cannot be compared."""
    if sheet.mask is None:
        return np.asarray(displacement - interpolate(other, displacement))
    compared, weights = _masked_weights(_mask_of(sheet), _mask_of(other_sheet))
    result = np.zeros(displacement.shape)
    result[compared] = displacement[compared] - weights @ other.reshape(-1, 3)
    return result


def interpolate(displacement: NDArray[Any], target: NDArray[Any]) -> NDArray[np.float64]:
    """Interpolate displacements [m], shape (rows, cols, 3), at least 4 x 4, by cubics at the nodes of another lattice.

    The values of `target` do not matter, only its shape.
    """
    for count, target_count in zip(displacement.shape[:2], target.shape[:2], strict=True):
        first, weights = _cubic_weights(count - 1, target_count - 1)
        nodes = (weight[:, None, None] * displacement[first + n] for n, weight in enumerate(weights))
        displacement = sum(nodes, start=np.zeros(())).swapaxes(0, 1)
    return displacement


@lru_cache(maxsize=64)
def _cubic_weights(source: int, target: int) -> tuple[NDArray[np.intp], Array]:
    """Return the interpolation along a side from `source` to `target` cells.

    These are the index of the first of four neighbouring source nodes of every target node, shape (target + 1,), and
    the weights of the four, shape (4, target + 1).
    """
    position = np.arange(target + 1) * (source / target)
    first = np.clip(np.floor(position).astype(int) - 1, 0, source - 3)
    return first, _lagrange_weights(position - first, 4)


def _lagrange_weights(t: Array, count: int) -> Array:
    """Return the weights of the nodes 0, 1, ..., count - 1 at places t, shape (count, n)."""
    nodes = range(count)
    return np.stack([math.prod((t - zero) / (node - zero) for zero in nodes if zero != node) for node in nodes])


@lru_cache(maxsize=8)
def _masked_weights(mask: Mask, other: Mask) -> tuple[NDArray[np.bool_], csr_array]:
    """Return whether each mass point is compared, shape (rows, cols), and weights of all points of the other mesh."""
    from scipy.sparse import coo_array

    compared = mask.points.copy()
    scale = np.array(other.cells.shape) / mask.cells.shape
    cells = np.floor(_shifted_points(mask)[compared] * scale).astype(int)
    is_sheet = other.cells[tuple(cells.T)]
    compared[compared] = is_sheet
    cells, places = cells[is_sheet], np.argwhere(compared) * scale
    rows, cols, weights = [], [], []
    remaining, shape = np.ones(len(places), bool), other.points.shape
    for count in (4, 3, 2):
        squares = np.all(sliding_window_view(other.cells, (count - 1, count - 1)), axis=(2, 3))
        # Rows and columns of cells in the square before that of the place, the most central ones first.
        befores = product(range(count - 1), repeat=2)
        for before in sorted(befores, key=lambda pair: math.hypot(pair[0] - count / 2 + 1, pair[1] - count / 2 + 1)):
            first = cells - before
            chosen = np.flatnonzero(remaining & ((first >= 0) & (first < squares.shape)).all(axis=1))
            chosen = chosen[squares[tuple(first[chosen].T)]]
            remaining[chosen] = False
            down, across = (_lagrange_weights(t, count) for t in (places - first)[chosen].T)
            for n, m in product(range(count), repeat=2):
                rows.append(chosen)
                cols.append(np.ravel_multi_index((first[chosen, 0] + n, first[chosen, 1] + m), shape))
                weights.append(down[n] * across[m])
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(cols))
    return compared, coo_array(entries, (len(places), math.prod(shape))).tocsr()


def _shifted_points(mask: Mask) -> Array:
    """Return row and column of each mass point, moved a little into its own cells, shape (rows, cols, 2)."""
    points, middles = (np.moveaxis(np.indices(each.shape), 0, -1) for each in (mask.points, mask.cells))
    inside = sum_around_points((middles + 0.5) * mask.cells[..., None]) / np.maximum(mask.cell_counts, 1)[..., None]
    return np.asarray(points + TOWARDS_INSIDE * (inside - points))


def same_outline(sheet: Sheet, coarse: Sheet) -> bool:
    """Return whether a coarser mesh has the same parts and holes, and no mass point far from its sheet."""
    from scipy.ndimage import binary_dilation

    if sheet.mask is None:
        return True
    mask, other = _mask_of(sheet), _mask_of(coarse)
    cells = np.floor(_shifted_points(mask)[mask.points] * other.cells.shape / mask.cells.shape).astype(int)
    near = binary_dilation(other.cells, np.ones((3, 3)))
    return mask.topology == other.topology and bool(near[tuple(cells.T)].all())


def _mask_of(sheet: Sheet) -> Mask:
    mask = rest_of(sheet).mask
    assert mask is not None
    return mask
