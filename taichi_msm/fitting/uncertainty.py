"""Uncertainty of a least-squares solution.

With J the Jacobian of the residuals r by x, the covariance of x is

    C = f (J^T W J)^-1 M (J^T W J)^-1,    M = J^T W^(1/2) K W^(1/2) J

- W is 1; in a robust fit the second derivative of rho / 2.
- f, at least 1, is the mean of r^2 per degree of freedom; in a robust fit the mean square of the first derivative of
  rho / 2, over the mean of W.
- K, the correlation of the errors, is 1; of tracks exp(-distance / length) at one time, exp(-interval / drift) of one
  track, or the product of both.

With the singular value decomposition W^(1/2) J = U S V^T,

    C = f V S^-1 (U^T K U) S^-1 V^T

which avoids the squared condition number of J^T W J.

Directions, columns of V, with large standard deviations are unidentified: images alone, for example, determine only the
ratio of stiffness to force. Parameters that share such directions form a group, whose combinations orthogonal to these
directions are identifiable.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.least_squares import Misfit, Scales, Solution
from taichi_msm.fitting.observation import ErrorCorrelation
from taichi_msm.fitting.parameters import Parameter, rounded

# Largest standard deviation of an identified direction.
MAX_DIRECTION_DEVIATION = 0.5

# Smaller components of unidentified directions are 0; larger ones than the second make a parameter unidentified.
MIN_COMPONENT, MIN_GROUP_COMPONENT = 1e-3, 0.05

# Largest correlation of parameters with symmetric intervals.
MAX_CORRELATION = 0.9

# Largest standard error of an identifiable parameter, as a share of its value or of a coordinate's range.
MAX_RELATIVE_ERROR = 1.0


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of n parameters, in units of x."""

    scales: Scales  # given or estimated
    factor: float  # f, at least 1
    freedom: int
    independent: float  # effective number of independent observations
    residuals: Array  # r, shape (known,)
    weighted: Array  # W^(1/2) J, shape (known, n)
    directions: Array  # V, shape (n, n); columns are uncorrelated combinations of x, the most certain first
    root: Array  # F, shape (n, n), with C = F F^T
    widening: Array  # ratio of the deviations with K to those with K = 1, shape (n,)

    @property
    def deviations(self) -> Array:
        """Standard deviations of x, shape (n,)."""
        return np.linalg.norm(self.root, axis=1)

    @property
    def direction_deviations(self) -> Array:
        """Standard deviations of the directions, shape (n,)."""
        return np.linalg.norm(self.directions.T @ self.root, axis=1)

    @property
    def correlation(self) -> Array:
        """Correlations of x, shape (n, n)."""
        each = self.root / np.maximum(self.deviations, np.finfo(float).tiny)[:, None]
        return np.clip(each @ each.T, -1.0, 1.0)

    @property
    def quantile(self) -> float:
        """Half width of the 95 % interval in standard deviations, by Student's t."""
        from scipy.stats import t

        return float(t.ppf((1 + 0.95) / 2, self.freedom))

    @property
    def unidentified_directions(self) -> Array:
        """Columns of V with large standard deviations, shape (n, m)."""
        return self.directions[:, self.direction_deviations > MAX_DIRECTION_DEVIATION]

    @property
    def unidentified(self) -> NDArray[np.bool_]:
        """Mask of the parameters in unidentified directions, where `shift` is invalid, shape (n,)."""
        return np.linalg.norm(self.unidentified_directions, axis=1) > MIN_GROUP_COMPONENT

    @property
    def is_correlated(self) -> NDArray[np.bool_]:
        """Mask of the identifiable parameters that are strongly correlated with another one, shape (n,)."""
        others = np.abs(self.correlation) - np.eye(len(self.root))
        return np.asarray((others.max(axis=1) > MAX_CORRELATION) & (self.deviations <= MAX_RELATIVE_ERROR))

    def shift(self, errors: Array) -> Array:
        """Return the shift of x, shape (n,), due to errors of the predictions, shape (known,), in units of r."""
        identified = self.directions[:, self.direction_deviations <= MAX_DIRECTION_DEVIATION]
        return identified @ np.linalg.lstsq(self.weighted @ identified, errors, rcond=None)[0]


def uncertainty(
    misfit: Misfit, solution: Solution, derivatives: Array, error_correlation: ErrorCorrelation
) -> Uncertainty:
    """Return the uncertainty of a solution; `derivatives`: Jacobian of the predictions by x, shape (known, n)."""
    parameters = len(solution.x)
    freedom = max(1, misfit.freedom - parameters)
    scales = misfit.scales(misfit.deviations(solution.predicted, parameters))
    residuals, jacobian = misfit.residuals(solution.predicted, scales), misfit.scaled(derivatives, scales)
    robust_factor = misfit.robust_factor(residuals)
    weighted = jacobian * robust_factor[:, None] ** (-0.75)
    factor = max(1.0, float(np.sum(residuals**2 / robust_factor)) / freedom / float(np.mean(robust_factor**-1.5)))
    singular = np.linalg.svd(weighted, full_matrices=False)
    # Small singular values are rounding errors: their directions are unidentified, with a standard deviation of 1e4.
    is_unidentified = 1e-8 * max(1.0, singular.S[0]) >= singular.S
    singular_values = np.where(is_unidentified, 1 / 1e4, singular.S)
    directions = np.where(is_unidentified & (np.abs(singular.Vh.T) < MIN_COMPONENT), 0.0, singular.Vh.T)
    independent_root = root = np.sqrt(factor) * directions / singular_values
    sigma_freedom = min(observed.sigma_freedom for observed in misfit.observations)
    # The estimate of sigma adds 2 / sigma_freedom to the relative variance 2 / freedom of chi-square.
    independent = 1 / (1 / freedom + 1 / sigma_freedom)
    if error_correlation != (None, None):
        # U^T K U, and the effective number of observations tr(K)^2 / tr(K^2).
        pairs = zip(misfit.observations, misfit.split(singular.U), strict=True)
        parts = (observed.correlated(part, error_correlation) for observed, part in pairs)
        matrices, squares = zip(*parts, strict=True)
        independent = min(len(singular.U) ** 2 / sum(squares), freedom)
        values, vectors = np.linalg.eigh(np.sum(matrices, axis=0))
        root = independent_root @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    widening = np.linalg.norm(root, axis=1) / np.linalg.norm(independent_root, axis=1)
    return Uncertainty(scales, factor, freedom, independent, residuals, weighted, singular.Vh.T, root, widening)


class Combination(NamedTuple):
    """Identifiable product of powers of parameters."""

    exponents: dict[str, float]  # by key
    standard_error: float  # relative

    def __str__(self) -> str:
        text = ""
        for key, exponent in sorted(self.exponents.items(), key=lambda item: item[1] < 0):
            power = "" if abs(exponent) == 1 else f"^{abs(exponent):.3g}"
            sign = (" / " if exponent < 0 else " x ") if text else ("1 / " if exponent < 0 else "")
            text += f"{sign}{key}{power}"
        return text


class UnidentifiedGroup(NamedTuple):
    """Parameters that are not identifiable one by one."""

    parameters: list[str]  # keys
    known: list[Combination]  # identifiable combinations of them
    text: str  # description, with a remedy

    def as_json(self) -> dict[str, Any]:
        """Return JSON data."""
        known = [{"combination": str(combination), **combination._asdict()} for combination in self.known]
        return {"parameters": self.parameters, "known": known, "text": self.text}


def unidentified_groups(
    parameters: Sequence[Parameter], x: Array, uncertainties: Uncertainty, *, forces: bool
) -> list[UnidentifiedGroup]:
    """Return the groups of unidentifiable parameters; `forces`: whether forces were measured, which is a remedy."""
    from scipy.sparse.csgraph import connected_components

    directions, members = uncertainties.unidentified_directions, np.flatnonzero(uncertainties.unidentified)
    # The projection onto the directions couples parameters that share one; it does not depend on the basis.
    is_coupled = np.abs(directions @ directions.T) > MIN_GROUP_COMPONENT**2
    count, labels = connected_components(is_coupled[np.ix_(members, members)], directed=False)
    groups = [members[labels == label] for label in range(count)]
    pairs = zip(parameters, x.tolist(), uncertainties.deviations.tolist(), strict=True)
    errors = np.array([parameter.relative_error(coordinate, deviation) for parameter, coordinate, deviation in pairs])
    described, remedy = [], "" if forces else ", or give a force (--forces)"
    for group in groups:
        known = list(_known_combinations(parameters, uncertainties, group, directions[group]))
        described.append(_describe_group([parameters[n] for n in group], float(errors[group].max()), known, remedy))
    return described


def _known_combinations(
    parameters: Sequence[Parameter], uncertainties: Uncertainty, group: Array, directions: Array
) -> Iterator[Combination]:
    """Yield the identifiable combinations of a group; `directions`: its rows of the unidentified directions."""
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


def _complement(directions: Array) -> Array:
    """Return a basis of the orthogonal complement of directions, shape (m, directions), in reduced echelon form."""
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
    return rows
