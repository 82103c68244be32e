"""Result of a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.machine_fit import FittedTest
from taichi_msm.fitting.observation import Observation, root_mean_square
from taichi_msm.fitting.outliers import LeftOut
from taichi_msm.fitting.parameters import rounded
from taichi_msm.fitting.profiles import ProfilePoint
from taichi_msm.fitting.tikhonov import SmoothnessWeight
from taichi_msm.fitting.uncertainty import UnidentifiedGroup
from taichi_msm.scene.scene import Scene


class Estimate(NamedTuple):
    """Estimate of a parameter.

    Attributes:
        value: best value.
        standard_error: standard error of the value.
        interval: ends of the 95 % confidence interval; None for an end beyond the bounds.
        start: initial value.
        identifiable: whether the standard error is at most the value, or the range of a coordinate or time.
        mesh_error: conservative estimate of the discretisation error of the value, or None if unknown.
    """

    value: float
    standard_error: float
    interval: tuple[float | None, float | None]
    start: float
    identifiable: bool
    mesh_error: float | None


def sixteen_bits(shares: Array) -> NDArray[np.uint16]:
    """Convert values from 0 to 1 to 16-bit grey."""
    return np.asarray((65535 * shares).round(), np.uint16)


@dataclass(frozen=True, eq=False)
class FittedMap:
    """Estimated stiffness map.

    Attributes:
        factors: factors of young, shape (R, R), from the upper left corner of the sheet.
        errors: relative standard errors, shape (R, R), NaN if not identifiable.
        choice: weight of the smoothness.
        sigma: combined standard deviation of the observations and the mesh error [m] or [px].
    """

    FILE: ClassVar = "map.png"

    factors: Array
    errors: Array
    choice: SmoothnessWeight = field(repr=False)
    sigma: float

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Mask of the unknown map cells, shape (R, R)."""
        return np.isnan(self.errors)

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest factor: black and white in map.png."""
        return float(self.factors.min()), float(self.factors.max())

    @property
    def grey(self) -> NDArray[np.uint16]:
        """Content of map.png, 16 bits, shape (R, R)."""
        low, high = self.range
        return sixteen_bits((self.factors - low) / ((high - low) or 1.0))

    def as_json(self) -> dict[str, Any]:
        """Return JSON data, as in fit.json."""
        errors = [[None if math.isnan(error) else error for error in row] for row in self.errors.tolist()]
        return {
            "resolution": len(self.factors),
            "range": self.range,
            "factors": self.factors.tolist(),
            "standard_error": errors,
            "unknown": int(self.unknown.sum()),
            "weight": self.choice.weight,
            "sigma": self.sigma,
        }

    def summary(self) -> str:
        """Format the map in a line."""
        low, high = self.range
        size, known = len(self.factors), self.errors[~self.unknown]
        errors = "all unknown"
        if known.size:
            middle, ends = 100 * np.median(known), 100 * np.array([known.min(), known.max()])
            errors = f"known to {rounded(middle)} % in the middle, {rounded(ends[0])} to {rounded(ends[1])} %"
        return f"tissue.map: {size} x {size} cells, {low:.3g} to {high:.3g} times young, {errors}"


@dataclass(frozen=True, eq=False, kw_only=True)
class FitResult:
    """Result of a fit.

    Attributes:
        parameters: estimates by key.
        correlation: correlation matrix of the parameters, in their order.
        residual: root mean square of predicted minus observed values [m] or [px], or None without points.
        residual_force: root mean square of predicted minus observed forces [N], or None without forces.
        sigma_force: given standard deviation of the forces [N], or None without forces.
        rejection: reason for rejecting the model, or None if it is not rejected.
        sigma: standard deviation of the values [m] or [px], given or estimated, or None without points.
        unit: unit of residual and sigma, m or px.
        chi_square: sum of (predicted - observed)^2 / sigma^2, or None without a given sigma.
        degrees_of_freedom: number of observed numbers, of a fit of numbers less the number of parameters.
        identifiable: whether all parameters are identifiable.
        unseen: groups of parameters that are not identifiable one by one.
        mesh_error: mesh error of the fitted scene, as a fraction of its largest displacement, or None if unknown.
        runs: number of runs.
        seconds: duration [s].
        notes: warnings, a line each.
        scene: fitted scene; a map refers to map.png in the given directory.
        observations: the observations, of a robust fit without outliers.
        left_out: outliers of every observation of a robust fit of points.
        fitted: values of every observation, predicted by the fitted scene.
        curves: profiles of the parameters by key, or their quadratic approximations.
        map: estimated map, or None for a fit of numbers.
        tests: the machine tests with their fitted forces.
        other_scenes: fitted scenes of the machine tests after the first one.
    """

    parameters: dict[str, Estimate] = field(default_factory=dict)
    correlation: list[list[float]] = field(default_factory=list)
    residual: float | None = None
    residual_force: float | None = None
    sigma_force: float | None = None
    rejection: str | None = None
    sigma: float | None = None
    unit: str = "m"
    chi_square: float | None
    degrees_of_freedom: int
    identifiable: bool
    unseen: list[UnidentifiedGroup] = field(default_factory=list)
    mesh_error: float | None
    runs: int
    seconds: float = 0.0
    notes: list[str]
    scene: Scene = field(repr=False)
    observations: tuple[Observation, ...] = field(repr=False)
    fitted: tuple[Array, ...] = field(repr=False)
    left_out: list[LeftOut] = field(repr=False, default_factory=list)
    curves: dict[str, list[ProfilePoint]] = field(repr=False, default_factory=dict)
    map: FittedMap | None = None
    tests: tuple[FittedTest, ...] = ()
    other_scenes: Sequence[Scene] = field(repr=False, default_factory=list)

    @property
    def model_rejected(self) -> bool:
        """Whether the observations reject the model, with any parameter values."""
        return self.rejection is not None

    def as_json(self) -> dict[str, Any]:
        """Return JSON data, as in fit.json."""
        names = (
            "model_rejected correlation residual residual_force sigma sigma_force unit chi_square degrees_of_freedom "
            "identifiable mesh_error runs seconds notes"
        )
        return {
            "observed": self.observations[0].name,
            "parameters": {key: item._asdict() for key, item in self.parameters.items()},
            **{name: getattr(self, name) for name in names.split()},
            "unseen": [item.as_json() for item in self.unseen],
            **({"left_out": [item.as_json() for item in self.left_out]} if self.left_out else {}),
            **({} if self.map is None else {"map": self.map.as_json()}),
            **({"tests": [fitted.as_json() for fitted in self.tests]} if self.tests else {}),
        }

    def summary(self) -> list[str]:
        """Format the result in lines."""
        intervals = "intervals" if self.map is None else "errors of the cells"
        lines = []
        if self.rejection is not None:
            lines.append(f"the model is rejected: {self.rejection}; the {intervals} do not cover this")
        lines += [f"{key}: {_format_estimate(item)}" for key, item in self.parameters.items()]
        lines += [item.text for item in self.unseen]
        lines += [] if self.map is None else [self.map.summary()]
        chi_text = ""
        if self.chi_square is not None:
            chi_text = f", chi-square {self.chi_square:.3g} for {self.degrees_of_freedom} degrees of freedom"
        for fitted in self.tests:
            peak, frames = fitted.loading.peak, len(fitted.loading.force)
            share = rounded(100 * fitted.residual / peak)
            residual = f"{fitted.residual:.3g} N, {share} % of the peak, at {frames} frames"
            noise = f"noise of the first {fitted.loading.test.noise_rows} rows {fitted.loading.noise:.2g} N"
            error = "N, as given," if fitted.loading.has_exact_offset else f"+- {rounded(fitted.offset_error)} N"
            offset = f"offset {fitted.loading.offset:.3g} {error} subtracted"
            details = f"{noise}, {offset}, contact at {1000 * fitted.contact:.4g} mm"
            lines.append(f"{fitted.loading.test.name}: residual {residual}; {details}{chi_text}")
        if not self.tests:
            texts = []
            for observed, values in zip(self.observations, self.fitted, strict=True):
                residual_size = root_mean_square((values - observed.values)[observed.known])
                texts.append(observed.format_residual(residual_size))
            lines.append(f"residual {', '.join(texts)}{chi_text}")
        lines += [str(item) for item in self.left_out]
        if self.mesh_error is not None:
            qualifier = "at most about " if any(probe.moved for probe in self.scene.probes) else ""
            error = f"{qualifier}{rounded(100 * self.mesh_error)} % of the largest displacement"
            lines.append(f"mesh error of the fitted scene: {error}")
        return [*lines, *self.notes, f"{self.runs} runs, {self.seconds:.1f} s"]


def _format_estimate(estimate: Estimate) -> str:
    """Format an estimate with its significant digits."""
    error = estimate.standard_error
    digits = 3 if not estimate.value else math.floor(math.log10(abs(estimate.value) / max(error, 1e-300))) + 3

    def written(number: float | None) -> str:
        return "?" if number is None else f"{float(f'{number:.{min(max(digits, 2), 9)}g}'):.10g}"

    low, high = map(written, estimate.interval)
    is_vague = not estimate.identifiable and error > 1000 * max(abs(estimate.value), abs(estimate.start))
    error_text = "?" if is_vague else rounded(error)
    suffix = "" if estimate.identifiable else ": not identifiable"
    return f"{written(estimate.value)} +- {error_text}, 95 % {low} to {high}, from {estimate.start:.6g}{suffix}"
