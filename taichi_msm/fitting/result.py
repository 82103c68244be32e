"""What a fit found.

What the user of a fit should know beside its numbers, a line each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting.least_squares import Alike, Place, Solution, Uncertainty, Unseen
from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.tikhonov import Choice
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """What was found of a parameter.

    Attributes:
        value: the best one.
        standard_error: of the value.
        interval: both ends of the 95 % interval; None: there is none within the bounds.
        start: where the search began.
        identifiable: whether the standard error is at most the value, or of a place or a time its range.
        mesh_error: how far, about, the number of points moves the value, rather too large; None: not known.
    """

    value: float
    standard_error: float
    interval: tuple[float | None, float | None]
    start: float
    identifiable: bool
    mesh_error: float | None


def sixteen_bits(shares: Array) -> NDArray[np.uint16]:
    """Turn shares, 0 to 1, into greys."""
    return np.asarray((65535 * shares).round(), np.uint16)


@dataclass(frozen=True, eq=False)
class FittedMap:
    """A map of the stiffness that was found.

    Attributes:
        factors: of young, from the upper left corner of the sheet, shape (R, R).
        errors: relative standard error of each; NaN: unknown, as what was seen does not tell it.
        choice: the weight of the smoothness, and how it was chosen.
        sigma: the standard deviation of what was seen, with the error of the number of points [m] or [px].
    """

    FILE: ClassVar = "map.png"

    factors: Array
    errors: Array
    choice: Choice = field(repr=False)
    sigma: float

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Which fields are unknown, shape (R, R)."""
        return np.isnan(self.errors)

    @property
    def range(self) -> tuple[float, float]:
        """The smallest and the largest factor, black and white in map.png."""
        return float(self.factors.min()), float(self.factors.max())

    @property
    def grey(self) -> NDArray[np.uint16]:
        """The picture map.png, 16 bits, shape (R, R)."""
        low, high = self.range
        return sixteen_bits((self.factors - low) / ((high - low) or 1.0))

    def as_json(self) -> dict[str, Any]:
        """Give it as plain data, as in fit.json."""
        errors = [[None if math.isnan(one) else one for one in row] for row in self.errors.tolist()]
        return {
            **{"resolution": len(self.factors), "range": self.range, "factors": self.factors.tolist()},
            **{"standard_error": errors, "unknown": int(self.unknown.sum())},
            **{"weight": self.choice.weight, "sigma": self.sigma},
        }

    def summary(self) -> str:
        """Say in a line what was found."""
        low, high = self.range
        size, known = len(self.factors), self.errors[~self.unknown]
        errors = "all unknown"
        if known.size:
            middle, ends = 100 * np.median(known), 100 * np.array([known.min(), known.max()])
            errors = f"known to {rounded(middle)} % in the middle, {rounded(ends[0])} to {rounded(ends[1])} %"
        return f"tissue.map: {size} x {size} fields, {low:.3g} to {high:.3g} times young, {errors}"


@dataclass(frozen=True, eq=False, kw_only=True)
class FitResult:
    """What a fit found.

    Attributes:
        parameters: what was found of each, by its key.
        correlation: of the parameters, in their order.
        residual: the root mean square of predicted minus seen, of each coordinate [m] or [px].
        residual_force: the same of the forces [N]; None: none were seen.
        sigma_force: the standard deviation of the forces, as given [N]; None: none were seen.
        sigma: the standard deviation of the coordinates, as given, else as found.
        unit: of residual and sigma, m or px.
        chi_square: the sum of (predicted - seen)^2 / sigma^2, where sigma is given.
        rejection: why the scene cannot move as was seen, whatever its numbers are; None: it may.
        degrees_of_freedom: how many numbers were seen, less the parameters, but not less the fields of a map.
        identifiable: whether all parameters are.
        unseen: the combinations of parameters that the data cannot tell.
        mesh_error: of the fitted scene, as a fraction of its largest displacement; None: not known.
        runs: how many there were.
        seconds: that they took.
        notes: what the user should know, a line each.
        scene: the scene with the best values; of a map, its picture is map.png in the directory that was given.
        observations: what was seen.
        fitted: where the points are in the fitted scene, as in the observations.
        fitted_forces: the forces in the fitted scene, as in the observations [N], shape (rows, 3).
        curves: by key, the root of twice the rise of the cost, signed, at values of a parameter while the others
            follow: its profile, or else what follows from the curvature at the best value.
        map: the map that was fitted, in the place of parameters; None: numbers were.
    """

    parameters: dict[str, Estimate] = field(default_factory=dict)
    correlation: list[list[float]] = field(default_factory=list)
    residual: float
    residual_force: float | None = None
    sigma_force: float | None = None
    rejection: str | None = None
    sigma: float
    unit: str
    chi_square: float | None
    degrees_of_freedom: int
    identifiable: bool
    unseen: list[Unseen] = field(default_factory=list)
    mesh_error: float | None
    runs: int
    seconds: float = 0.0
    notes: list[str]
    scene: Scene = field(repr=False)
    observations: Observations = field(repr=False)
    fitted: Array = field(repr=False)
    fitted_forces: Array = field(repr=False, default_factory=lambda: np.empty((0, 3)))
    curves: dict[str, list[Place]] = field(repr=False, default_factory=dict)
    map: FittedMap | None = None

    @property
    def model_rejected(self) -> bool:
        """Whether the scene cannot move as was seen, whatever its numbers are."""
        return self.rejection is not None

    def as_json(self) -> dict[str, Any]:
        """Give it as plain data, as in fit.json."""
        plain = "model_rejected correlation residual residual_force sigma sigma_force unit chi_square "
        plain += "degrees_of_freedom identifiable mesh_error"
        return {
            "observed": self.observations.name,
            "parameters": {key: one._asdict() for key, one in self.parameters.items()},
            **{name: getattr(self, name) for name in (*plain.split(), "runs", "seconds", "notes")},
            "unseen": [one.as_json() for one in self.unseen],
            **({} if self.map is None else {"map": self.map.as_json()}),
        }

    def summary(self) -> list[str]:
        """Say in lines what was found."""
        seen = self.observations
        known = "intervals" if self.map is None else "errors of the fields"
        lines = (
            []
            if self.rejection is None
            else [f"the model is rejected: {self.rejection}; the {known} do not cover this"]
        )
        lines += [f"{key}: {_in_words(one)}" for key, one in self.parameters.items()]
        lines += [one.text for one in self.unseen]
        lines += [] if self.map is None else [self.map.summary()]
        points, times = seen.there.shape
        chi = ""
        if self.chi_square is not None:
            chi = f", chi-square {self.chi_square:.3g} for {self.degrees_of_freedom} degrees of freedom"
        force = "" if self.residual_force is None else f", {self.residual_force:.3g} N"
        lines.append(f"residual {self.residual:.3g} {self.unit} of {points} points at {times} times{force}{chi}")
        if self.mesh_error is not None:
            most = "at most about " if any(probe.moved for probe in self.scene.probes) else ""
            error = f"{most}{rounded(100 * self.mesh_error)} % of the largest displacement"
            lines.append(f"mesh error of the fitted scene: {error}")
        return [*lines, *self.notes, f"{self.runs} runs, {self.seconds:.1f} s"]


def _in_words(one: Estimate) -> str:
    """Write an estimate with as many digits as its error leaves."""
    error = one.standard_error
    digits = 3 if not one.value else math.floor(math.log10(abs(one.value) / max(error, 1e-300))) + 3

    def written(number: float | None) -> str:
        return "?" if number is None else f"{float(f'{number:.{min(max(digits, 2), 9)}g}'):.10g}"

    low, high = map(written, one.interval)
    known = "?" if error > 1000 * max(abs(one.value), abs(one.start)) else rounded(error)
    doubt = "" if one.identifiable else ": not identifiable"
    return f"{written(one.value)} +- {known}, 95 % {low} to {high}, from {one.start:.6g}{doubt}"


# A parameter this close to a bound, in units of x, has ended there.
AT_BOUND = 1e-3

# Parameters are tied together, and errors are alike, if they correlate by more than this.
TIED, ALIKE = 0.95, 0.3

# What is left is too small to say anything of below this share of the motion.
NOTHING_LEFT = 1e-6

# Nor below this share of a sigma that is given.
LITTLE_LEFT = 0.1


def of_the_search(solution: Solution, parameters: Sequence[Parameter], *, fits: bool) -> Iterator[str]:
    """Note what is wrong with the place where the search ended; fits: whether little is left there."""
    if not solution.converged:
        yield "the search ended before it came to rest; start nearer by --set, or give --bounds"
    if not fits:
        yield "the residual is large: no values of these parameters reproduce the observations"
    for one, x in zip(parameters, solution.x.tolist(), strict=True):
        low, high = one.limits
        if min(x - low, high - x) < AT_BOUND:
            bounded = math.isfinite(one.low) or math.isfinite(one.high)
            end = "a bound" if bounded else "1000 times from where it starts"
            yield f"{one.key}: ended at {one.value(x):.4g}, {end}: its interval says little"


def of_the_points(
    parameters: Sequence[Parameter], x: Array, uncertain: Uncertainty, shifts: Array | None
) -> Iterator[str]:
    """Note the parameters that the number of points moves farther than what was seen leaves open."""
    wide = uncertain.quantile * uncertain.deviations
    if shifts is not None and (
        moved := [
            f"{one.key} by about {rounded(100 * one.share(x[n], float(shifts[n])))} %"
            for n, one in enumerate(parameters)
            if shifts[n] > wide[n]
        ]
    ):
        said = "more than what was seen leaves open; take more sheet.points"
        yield f"the number of points moves {', '.join(moved)}: {said}"


def of_ties(parameters: Sequence[Parameter], uncertain: Uncertainty, blind: Sequence[Unseen]) -> Iterator[str]:
    """Note parameters that are tied together, but for those that are not seen."""
    for n, m in zip(*np.nonzero(np.triu(np.abs(uncertain.correlation) > TIED, 1)), strict=True):
        keys = parameters[n].key, parameters[m].key
        if not any(set(keys) <= set(one.parameters) for one in blind):
            tied = f"{keys[0]} and {keys[1]} correlate by {uncertain.correlation[n, m]:.3f}"
            yield f"{tied}: they are known best together"


def of_what_is_left(
    seen: Observations, solution: Solution, uncertain: Uncertainty, motion: float, alike: Alike
) -> Iterator[str]:
    """Note errors that are larger than sigma, or that are not independent though they are taken to be."""
    if uncertain.factor > 1.5:
        times = rounded(math.sqrt(uncertain.factor))
        yield f"what is left is {times} times sigma, and the intervals are widened by as much"
    left = solution.predicted.values - seen.values
    if np.sqrt(np.nanmean(left**2)) < max(NOTHING_LEFT * motion, LITTLE_LEFT * (seen.sigma or 0.0)):
        if seen.sigma is None:
            yield "next to nothing is left, and the intervals are those of so small errors; give their size by --sigma"
        return
    beside, after = _alike(left, seen.coordinates)
    if beside > ALIKE and alike.correlation is None:
        remedy = "; give --correlation PX" if seen.kind == "pixel" else ""
        said = f"what is left of neighbouring points is alike (correlation {beside:.2f})"
        yield f"{said}, so that the intervals are too narrow{remedy}"
    elif after > ALIKE and alike.drift is None:
        said = f"what is left of a point is alike from one time to the next (correlation {after:.2f})"
        yield f"{said}, so that the intervals are too narrow; give --drift SECONDS"


def _alike(left: Array, coordinates: Array) -> tuple[float, float]:
    """Correlate what is left of points, shape (N, T, numbers), with that of their nearest neighbours, and in time."""
    from scipy.spatial import KDTree

    def likeness_of(one: Array, other: Array) -> float:
        product, square = one * other, one**2 + other**2
        there = np.isfinite(product)
        return 2 * float(product[there].sum()) / max(float(square[there].sum()), 1e-300)

    # The nearest to a point but for itself.
    beside = likeness_of(left, left[KDTree(coordinates).query(coordinates, 2)[1][:, 1]]) if len(left) > 1 else 0.0
    return beside, likeness_of(left[:, 1:], left[:, :-1])
