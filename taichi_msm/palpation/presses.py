"""Presses of a ball, row by row: reasons to leave some out, and sums over each press."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.palpation.table import Table

# Option that chooses the labels of the presses.
PLACE_OPTION = '--columns "place=NAME"'

# Rows of a press, and presses of a table.
MIN_ROWS, MIN_PRESSES, MAX_PRESSES = 4, 10, 5000

# Smallest rise of the force of a press, in standard deviations of the noise.
RISE_NOISES = 5.0

# Standard deviation of normal errors over their median magnitude.
NORMAL_FACTOR = 1.48


class LeftOut(NamedTuple):
    """Press that is not fitted, and the reason."""

    place: str
    reason: str


@dataclass(frozen=True, eq=False)
class Presses:
    """Presses at n places; rows of all of them, shape (N,), in the order of the places."""

    places: tuple[str, ...]
    position: Array  # of the places [m], shape (n, 3)
    index: NDArray[np.intp]  # place of each row
    depth: Array  # [m]
    force: Array  # along the normal [N]

    @property
    def count(self) -> int:
        """Number of presses."""
        return len(self.places)

    @cached_property
    def rows(self) -> Array:
        """Number of rows of each press, shape (n,)."""
        return self.sum(np.ones(len(self.index)))

    @cached_property
    def peak(self) -> Array:
        """Largest force of each press [N], shape (n,)."""
        return self._largest(self.force)

    @cached_property
    def greatest_depth(self) -> Array:
        """Greatest depth of each press [m], shape (n,)."""
        return self._largest(self.depth)

    @cached_property
    def target(self) -> Array:
        """Force of each row over the peak of its press, shape (N,)."""
        return np.asarray(self.force / self.peak[self.index])

    def sum(self, values: Array) -> Array:
        """Sum values of rows, shape (N,), over each press."""
        return np.bincount(self.index, values, minlength=self.count).astype(np.float64)

    def root_mean_square(self, values: Array) -> Array:
        """Return the root mean square of values of rows, shape (N,), of each press."""
        return np.asarray(np.sqrt(self.sum(values**2) / self.rows))

    def subset(self, kept: NDArray[np.intp]) -> Presses:
        """Return the presses of given indices, in increasing order."""
        new = np.full(self.count, -1)
        new[kept] = np.arange(len(kept))
        rows = new[self.index] >= 0
        places = tuple(self.places[n] for n in kept)
        return Presses(places, self.position[kept], new[self.index[rows]], self.depth[rows], self.force[rows])

    def _largest(self, values: Array) -> Array:
        return np.asarray(np.maximum.reduceat(values, np.flatnonzero(np.diff(self.index, prepend=-1))))


def choose_presses(table: Table) -> tuple[Presses, list[LeftOut]]:
    """Return the presses of a table that can be fitted, and the others; raise a SceneError for too few or too many."""
    names, position, index = table.places, table.position, table.index
    if len(names) > MAX_PRESSES:
        fault = f"{len(names):,} presses, more than {MAX_PRESSES:,}"
        raise SceneError([f"{table.name}: {fault}; split the table, or choose their labels by {PLACE_OPTION}"])
    counts = np.bincount(index, minlength=len(names))
    starts = np.concatenate([[0], np.cumsum(counts)])
    presses = [slice(start, end) for start, end in pairwise(starts)]
    noise, left_out, kept = _noise(table, presses), list[LeftOut](), list[int]()
    for n, press in enumerate(presses):
        if reason := _reason(table.depth[press], table.force[press], noise):
            left_out.append(LeftOut(names[n], reason))
        else:
            kept.append(n)
    if len(kept) < MIN_PRESSES:
        fault = f"{len(kept)} presses of {len(names)} can be fitted, fewer than {MIN_PRESSES}"
        example = f"; place {left_out[0].place}: {left_out[0].reason}" if left_out else ""
        remedy = f"add presses, or choose the column of their labels by {PLACE_OPTION}"
        raise SceneError([f"{table.name}: {fault}{example}; {remedy}"])
    everything = Presses(names, position, index, table.depth, table.force)
    return everything.subset(np.array(kept)), left_out


def _reason(depth: Array, force: Array, noise: float) -> str:
    """Return the reason to leave a press out, or an empty string."""
    if len(depth) < MIN_ROWS:
        return f"rows with a force: {len(depth)}, fewer than {MIN_ROWS}"
    if np.ptp(depth) <= 0 or depth.max() <= 0:
        return "the depth does not grow"
    rise = float(force[depth.argmax()] - force[depth.argmin()])
    if rise < 0:
        return f"the force falls by {-rise:.3g} N while the depth grows"
    if rise < RISE_NOISES * noise or force.max() <= 0:
        return f"the force rises by {rise:.3g} N, less than {RISE_NOISES:g} times the noise of {noise:.3g} N"
    return ""


def _noise(table: Table, presses: Sequence[slice]) -> float:
    """Return the standard deviation of the forces [N] about cubics in depth, at least a digit of the file.

    A cubic fits four rows exactly, so a press of four rows gets a parabola.
    """
    residuals = [np.zeros(1)]
    for press in presses:
        depth, force = table.depth[press], table.force[press]
        if len(depth) >= MIN_ROWS and np.ptp(depth) > 0:
            degree = min(3, len(depth) - 2)
            powers = np.vander((depth - depth.min()) / np.ptp(depth), degree + 1)
            fitted = powers @ np.linalg.lstsq(powers, force, rcond=None)[0]
            residuals.append((force - fitted) * np.sqrt(len(depth) / (len(depth) - degree - 1)))
    return max(NORMAL_FACTOR * float(np.median(np.abs(np.concatenate(residuals)))), table.digit)


def presses_to_predict(table: Table) -> Presses:
    """Return the presses of a table without forces."""
    return Presses(table.places, table.position, table.index, table.depth, np.zeros(len(table.depth)))
