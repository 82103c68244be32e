"""Identifiability of parameters, one by one and in combinations.

Images determine only the ratio of stiffness to force, for example. Singular vectors with large standard deviations span
the unidentifiable directions; combinations orthogonal to these are identifiable.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.fitting.observation import Array
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.uncertainty import MAX_DIRECTION_DEVIATION, Uncertainty

# Largest standard error of an identifiable parameter, as a share of its value or of a coordinate's range.
MAX_RELATIVE_ERROR = 1.0

# Smallest component of a direction along a parameter that belongs to it.
MIN_GROUP_COMPONENT = 0.05


class Combination(NamedTuple):
    """Identifiable product of powers of parameters.

    Attributes:
        exponents: exponents by key.
        standard_error: relative standard error of the product.
    """

    exponents: dict[str, float]
    standard_error: float

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class UnidentifiedGroup(NamedTuple):
    """Parameters that are not identifiable one by one.

    Attributes:
        parameters: keys of the parameters.
        known: identifiable combinations of them.
        text: description, with a remedy.
    """

    parameters: list[str]
    known: list[Combination]
    text: str

    def as_json(self) -> dict[str, Any]:
        """Return JSON data."""
        known = [{"combination": str(combination), **combination._asdict()} for combination in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unidentified_groups(
    parameters: Sequence[Parameter], x: Array, uncertainties: Uncertainty, *, forces: bool
) -> list[UnidentifiedGroup]:
    """Return the groups of unidentifiable parameters.

    Args:
        parameters: parameters of the fit.
        x: their coordinates at the solution, shape (n,).
        uncertainties: uncertainty of the solution.
        forces: whether forces were measured; if not, measuring them is a remedy.
    """
    from scipy.sparse.csgraph import connected_components

    directions = uncertainties.directions[:, uncertainties.direction_deviations > MAX_DIRECTION_DEVIATION]
    members = np.flatnonzero(np.linalg.norm(directions, axis=1) > MIN_GROUP_COMPONENT)
    # Groups share directions; the projection, unlike the directions, does not depend on a basis.
    is_coupled = np.abs(directions @ directions.T) > MIN_GROUP_COMPONENT**2
    count, labels = connected_components(is_coupled[np.ix_(members, members)], directed=False)
    groups = [members[labels == label] for label in range(count)]
    pairs = zip(parameters, x.tolist(), uncertainties.deviations.tolist(), strict=True)
    errors = np.array([parameter.relative_error(coordinate, deviation) for parameter, coordinate, deviation in pairs])
    return [
        _describe_group(
            [parameters[n] for n in group],
            float(errors[group].max()),
            list(_known_combinations(parameters, uncertainties, group, directions[group])),
            "" if forces else ", or give a force (--forces)",
        )
        for group in groups
    ]


def _known_combinations(
    parameters: Sequence[Parameter], uncertainties: Uncertainty, group: Array, directions: Array
) -> Iterator[Combination]:
    """Yield the identifiable combinations of a group of parameters, with their components in `directions`."""
    for exponents in _complement(directions):
        # Exponents close to a multiple of 1/2 are rounded.
        half = np.round(2 * exponents) / 2
        all_exponents = np.zeros(len(parameters))
        all_exponents[group] = np.where(np.abs(exponents - half) < 0.06, half, exponents)
        powers = {parameters[n].key: float(all_exponents[n]) for n in group if all_exponents[n]}
        error = float(np.linalg.norm(all_exponents @ uncertainties.root))
        if error <= MAX_RELATIVE_ERROR:
            yield Combination(powers, error)


def _describe_group(
    group: Sequence[Parameter], largest: float, known: list[Combination], remedy: str
) -> UnidentifiedGroup:
    """Describe a group of parameters by their largest relative error, and by the combinations that are known."""
    keys = [parameter.key for parameter in group]
    names = " and ".join([", ".join(keys[:-1]), keys[-1]] if len(keys) > 1 else keys)
    fix = f"fix {'it' if len(keys) == 1 else 'them'}"
    share = f"only to {rounded(100 * largest)} %" if largest <= MAX_RELATIVE_ERROR else ""
    if known and not all(parameter.is_log for parameter in group):
        return UnidentifiedGroup(keys, [], f"{names} are not identifiable one by one: fix one{remedy}")
    if not known:
        status = f"known {share}" if share else "not identifiable"
        return UnidentifiedGroup(keys, [], f"{names}: {status}: {fix}")
    combinations = ", ".join(f"{each} is known to {rounded(100 * each.standard_error)} %" for each in known)
    return UnidentifiedGroup(keys, known, f"{combinations}, each alone {share or 'is not'}: fix one{remedy}")


def _complement(directions: Array) -> Iterator[Array]:
    """Yield a basis of the orthogonal complement of directions, shape (m, directions), in reduced echelon form."""
    vectors, singular, _ = np.linalg.svd(directions)
    rank = int(np.sum(singular > MIN_GROUP_COMPONENT * singular[0]))
    rows = vectors[:, rank:].T.copy()
    # Pivots are the best identified parameters.
    order = list(np.argsort(np.linalg.norm(directions, axis=1), kind="stable"))
    for n in range(len(rows)):
        pivot = max(order, key=lambda column: (abs(rows[n, column]) > 0.1, -order.index(column)))
        order.remove(pivot)
        rows[n] /= rows[n, pivot]
        for row in range(len(rows)):
            if row != n:
                rows[row] -= rows[row, pivot] * rows[n]
    yield from rows
