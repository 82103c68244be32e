"""What the data cannot tell: combinations of parameters that could change without anybody seeing it, in words.

Parameters that are not seen each for itself may be seen together: pictures tell a stiffness over a force, but neither
of them. The directions in which nothing is seen leave those combinations of the parameters known that are across them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.uncertainty import NOT_SEEN, Uncertainty

Array = NDArray[np.float64]

# A parameter is not identifiable if its standard error is above this share of its value, of a place of its range.
MOST_ERROR = 1.0

# Parameters whose part in a direction is above this belong to it.
PART = 0.05

# Exponents this close to a half of a whole number are written as such.
CLOSE = 0.06


class Combination(NamedTuple):
    """A product of powers of parameters that is known."""

    exponents: dict[str, float]
    standard_error: float  # as a share

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class Unseen(NamedTuple):
    """Parameters that the data cannot tell from each other, or at all."""

    parameters: list[str]
    known: list[Combination]  # what is known of them
    text: str

    def as_json(self) -> dict[str, Any]:
        """Give it as plain data."""
        known = [{"combination": str(one), **one._asdict()} for one in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unseen(parameters: Sequence[Parameter], x: Array, uncertain: Uncertainty, *, forces: bool) -> list[Unseen]:
    """Find what the data cannot tell; forces: whether any were seen."""
    blind = uncertain.directions[:, uncertain.along > NOT_SEEN]
    pairs = zip(parameters, x.tolist(), uncertain.deviations.tolist(), strict=True)
    alone = np.array([one.share(place, deviation) for one, place, deviation in pairs])
    return [_in_words(parameters, uncertain, alone, part, blind[part], forces=forces) for part in _groups(blind)]


def _groups(blind: Array) -> Iterator[Array]:
    """Part the parameters that are not seen into groups that have no direction in common; gives their numbers."""
    # The projection onto the directions does not depend on which of them were chosen.
    together = np.abs(blind @ blind.T) > PART**2
    left = set(np.flatnonzero(np.linalg.norm(blind, axis=1) > PART).tolist())
    while left:
        group, new = set[int](), {min(left)}
        while new:
            group |= new
            new = {m for n in new for m in left if together[n, m]} - group
        left -= group
        yield np.array(sorted(group))


def _in_words(
    parameters: Sequence[Parameter], uncertain: Uncertainty, alone: Array, group: Array, blind: Array, *, forces: bool
) -> Unseen:
    """Say what is known of some parameters.

    alone: every standard error as a share; group: which parameters; blind: their parts in what is not seen.
    """
    keys = [parameters[n].key for n in group]
    known = []
    for exponents in _across(blind):
        whole = np.zeros(len(parameters))
        nice = np.round(2 * exponents) / 2
        exponents = np.where(np.abs(exponents - nice) < CLOSE, nice, exponents)
        whole[group] = exponents
        parts = {key: float(power) for key, power in zip(keys, exponents, strict=True) if power}
        known.append(Combination(parts, uncertain.of_combination(whole)))
    remedy = "" if forces else ", or give a force (--forces)"
    names = " and ".join([", ".join(keys[:-1]), keys[-1]] if len(keys) > 1 else keys)
    known = [one for one in known if one.standard_error <= MOST_ERROR]
    if known and not all(parameters[n].is_log for n in group):
        return Unseen(keys, [], f"{names} cannot be told apart by what was seen: fix one{remedy}")
    if not known:
        it = "it" if len(keys) == 1 else "them"
        if alone[group].max() <= MOST_ERROR:
            return Unseen(keys, [], f"{names}: known only to {rounded(100 * float(alone[group].max()))} %: fix {it}")
        return Unseen(keys, [], f"{names}: what was seen does not tell {it}: fix {it}")
    said = ", ".join(f"{one} is known to {rounded(100 * one.standard_error)} %" for one in known)
    most = float(alone[group].max())
    each = "is not" if most > MOST_ERROR else f"only to {rounded(100 * most)} %"
    return Unseen(keys, known, f"{said}, each alone {each}: fix one{remedy}")


def _across(blind: Array) -> Iterator[Array]:
    """Give independent combinations that are orthogonal to all directions, each with a 1 that the others lack.

    blind: parts of m parameters in the directions that are not seen, shape (m, directions).
    """
    vectors, singular, _ = np.linalg.svd(blind)
    rank = int(np.sum(singular > PART * singular[0]))
    rows = vectors[:, rank:].T.copy()
    # Reduced to echelon form from the parameters that are seen best on.
    order = list(np.argsort(np.linalg.norm(blind, axis=1), kind="stable"))
    for n in range(len(rows)):
        pivot = max(order, key=lambda column: (abs(rows[n, column]) > 0.1, -order.index(column)))
        order.remove(pivot)
        rows[n] /= rows[n, pivot]
        for other in range(len(rows)):
            if other != n:
                rows[other] -= rows[other, pivot] * rows[n]
    yield from rows
