"""Fitted machine tests, and explanations of a rejected model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.machine_model import MachineProblem
from taichi_msm.fitting.parameters import Parameter, rounded
from taichi_msm.fitting.uncertainty import Uncertainty
from taichi_msm.machines.loading import CONTACT_NOISES, Loading
from taichi_msm.machines.reader import TORE

# Largest change of the depth while the tool is held, as a share of the travel.
HELD_SHARE = 0.02

# Largest error of a parameter with an estimated contact that is not reported, in half widths of its interval.
MAX_CONTACT_EFFECT = 1.5


@dataclass(frozen=True, eq=False)
class FittedTest:
    """Machine test with the forces of the fitted scene."""

    loading: Loading  # without the fitted offset
    contact: float  # depth of contact, fitted or given, as in the table [m]
    force: Array  # fitted force at every frame [N], shape (frames,)
    offset_error: float = 0.0  # standard error of the offset [N]

    @property
    def residual(self) -> float:
        """Root mean square of the residual over the frames [N]."""
        return float(np.sqrt(np.mean((self.force - self.loading.force) ** 2)))

    @property
    def rise(self) -> float:
        """Time from contact to the largest force [s]."""
        loading = self.loading
        in_contact = loading.travel(self.contact) > 0
        return float(loading.time[loading.force.argmax()] - loading.time[in_contact.argmax()])

    def as_json(self) -> dict[str, Any]:
        """Return JSON data, as in fit.json."""
        loading = self.loading
        return {
            "name": loading.test.name,
            "contact": self.contact,
            "noise": loading.noise,
            "sigma": float(loading.sigma.mean()),
            "offset": {"value": loading.offset, "standard_error": self.offset_error},
            "peak": loading.peak,
            "residual_force": self.residual,
            "frames": len(loading.force),
        }


def fitted_tests(
    problem: MachineProblem, values: Mapping[str, float], forces: Array, slopes: Array, uncertainties: Uncertainty
) -> tuple[FittedTest, ...]:
    """Return the fitted tests, without their offsets, the weighted means of measured minus fitted forces.

    The fitted forces [N] have shape (frames of all tests, 1), their derivatives by x, `slopes`, (frames of all tests,
    n).
    """
    tests, start = [], 0
    for loading, key in zip(problem.tests, problem.contact_keys, strict=True):
        frames = slice(start, start := start + len(loading.force))
        force, weights = forces[frames, 0], (loading.information > 0) / loading.sigma**2
        # Residuals r of informative frames lack the offset.
        frame = int(np.argmax(loading.information > 0))
        residual = loading.sigma[frame] * uncertainties.residuals[frames][frame]
        offset = 0.0 if loading.has_exact_offset else float(residual - (force - loading.force)[frame])
        mean_slopes = weights @ slopes[frames] / weights.sum()
        by_parameters = float(np.linalg.norm(mean_slopes @ uncertainties.root))
        error = math.hypot(math.sqrt(uncertainties.factor / weights.sum()), by_parameters)
        error = 0.0 if loading.has_exact_offset else error
        tests.append(FittedTest(loading.without_offset(offset), values.get(key, loading.contact), force, error))
    return tuple(tests)


def contact_notes(
    parameters: Sequence[Parameter], x: Array, uncertainties: Uncertainty, slopes: Array
) -> Iterator[str]:
    """Yield a warning about estimated depths of contact whose errors exceed the intervals of parameters.

    `slopes`: derivatives of the residuals r by these depths [1/m], shape (known, contacts).
    """
    # Step to the minimum with free depths of contact, and its standard deviations.
    inverse = np.linalg.pinv(np.column_stack([uncertainties.weighted, slopes]))
    errors = np.abs(inverse @ uncertainties.residuals)
    errors += uncertainties.quantile * np.sqrt(uncertainties.factor) * np.linalg.norm(inverse, axis=1)
    contact, count = rounded(1000 * float(errors[len(x) :].max(initial=0.0))), len(x)
    half_widths = uncertainties.quantile * uncertainties.deviations
    moved = np.flatnonzero((errors[:count] > MAX_CONTACT_EFFECT * half_widths) & ~uncertainties.unidentified).tolist()
    if moved and slopes.shape[1]:
        known = " and ".join(f"{parameters[n].key} to {parameters[n].format_error(x[n], errors[n])}" for n in moved)
        fault = f"the depth of contact, found from the noise, is known to {contact} mm, and {known}"
        yield f"{fault}, beyond the interval; take --free contact, or give an exact depth by --contact"


def unknown_notes(tests: Sequence[FittedTest], values: Mapping[str, float]) -> Iterator[str]:
    """Yield the reasons why parameters are not identifiable; `values`: those of these parameters by key."""
    for key, value in values.items():
        if key.startswith("tissue.relaxation.") and key.endswith(".time"):
            shortest = min(fitted.rise for fitted in tests)
            longest = max(float(fitted.loading.test.time[-1]) for fitted in tests)
            if value < shortest:
                yield f"{key}: {value:.2g} s is shorter than the rise of the force, {shortest:.2g} s; press faster"
            elif value > longest:
                yield f"{key}: {value:.2g} s is longer than the test, {longest:.2g} s; hold for longer"
        elif key == "tissue.foundation.lock":
            reach = max(float(fitted.loading.travel(fitted.contact).max()) for fitted in tests)
            if value > reach:
                yield f"{key}: {value:.2g} m is beyond the depth reached, {reach:.2g} m; press deeper, or leave it out"
        elif key == "tissue.stiffening.lock":
            reason = "the test does not stretch the tissue far enough; pull further, or leave it out"
            if any(TORE in note for fitted in tests for note in fitted.loading.test.notes):
                reason = f"{TORE}, which the model does not describe; cut the table there by --window"
            yield f"{key}: {reason}"


def explanations(tests: Sequence[FittedTest], *, fits_contact: bool) -> Iterator[str]:
    """Yield probable reasons for the rejection of a model: relaxation, curvature, a sign, or an unfitted contact."""
    for fitted in tests:
        if reason := _explain(fitted, fits_contact=fits_contact):
            yield f"{fitted.loading.test.name}: {reason}"


def _explain(fitted: FittedTest, *, fits_contact: bool) -> str:
    """Return a probable reason for the residual of a test, or an empty string."""
    loading, predicted = fitted.loading, fitted.force
    if float(predicted @ loading.force) < 0:
        return "the measured and the fitted force are opposite: is the sign of the path, or of a column, wrong?"
    test, travel = loading.test, loading.travel(fitted.contact)
    peak = int(test.force.argmax())
    reach = float(travel.max())
    held = np.flatnonzero(np.abs(test.depth[peak:] - test.depth[peak]) <= HELD_SHARE * reach) + peak
    last = int(held[-1])
    fall = 1 - float(test.force[last] / test.force[peak])
    at_ends = np.interp(test.time[[peak, last]], loading.time, predicted)
    model_fall = 1 - float(at_ends[1] / at_ends[0]) if last > peak and at_ends[0] > 0 else 0.0
    if fall > 0.05 and model_fall < 0.5 * fall:
        falls = f"{100 * fall:.0f} % while the tool is held, the fitted force by {100 * max(model_fall, 0.0):.0f} %"
        return f"the force falls by {falls}: free the shares and times of tissue.relaxation"
    at_peak = float(travel[loading.force.argmax()])
    rising = slice(0, int(np.argmax(travel >= (1 - HELD_SHARE) * at_peak)) + 1)
    if not fits_contact and at_peak and (reason := _explain_by_another_contact(fitted, rising)):
        return reason
    depth, measured, model = travel[rising], loading.force[rising], predicted[rising]
    if min(measured[-1], model[-1]) <= 0:
        return ""  # A thin tool may touch no mass point.
    shares = []
    for force in (measured, model):
        at_half = float(np.interp(0.5 * depth[-1], np.maximum.accumulate(depth), force))
        shares.append(100 * at_half / float(force[-1]))
    if abs(shares[0] - shares[1]) <= 4:
        return ""
    comparison = "more" if shares[0] < shares[1] else "less"
    halves = f"{rounded(shares[0])} % of the peak, the fitted force {rounded(shares[1])} %"
    remedy = f"the tissue stiffens {comparison} with the depth: free or change a lock"
    return f"at half the depth the force is {halves}: {remedy}"


def _explain_by_another_contact(fitted: FittedTest, rising: slice) -> str:
    """Return a sentence about another depth of contact that explains the residual, or an empty string.

    The fitted forces, shifted in depth and scaled, are compared with the measured ones at the frames `rising`, up to
    the peak; the scale is free, as the fitted stiffness depends on the contact. A later contact adds a constant: the
    friction or weight of a slack. The shift must fit better than a scale that is linear in depth.
    """
    loading = fitted.loading
    travel, place = loading.travel(fitted.contact)[rising], loading.depth[rising] - fitted.contact
    measured, model = loading.force[rising], fitted.force[rising]
    reach, is_pressed = float(travel[-1]), (place > 0).astype(float)
    end_slope = (model[-1] - np.interp(0.9 * reach, travel, model)) / (0.1 * reach)

    def fit_shifted(shift: float) -> tuple[float, Array]:
        # Extrapolate linearly beyond the greatest travel.
        curve = np.interp(place - shift, travel, model) + end_slope * np.maximum(place - shift - reach, 0.0)
        return _fit_linear(measured, curve, *([is_pressed] if shift > 0 else []))

    shift = 0.0
    for shifts in (np.linspace(-0.5, 0.9, 141), np.linspace(-0.01, 0.01, 41)):
        shift = min((shift + reach * shifts).tolist(), key=lambda shift: fit_shifted(shift)[0])
    shifted_misfit, coefficients = fit_shifted(shift)
    linear_misfit, _ = _fit_linear(measured, model, model * travel, is_pressed)
    explained = 1 - shifted_misfit / max(float((model - measured) @ (model - measured)), 1e-300)
    if abs(shift) <= 0.02 * reach or explained <= 0.7 or shifted_misfit >= linear_misfit:
        return ""
    slack = ""
    if shift > 0 and coefficients[1] > CONTACT_NOISES * loading.noise:
        slack = f" after a slack with {coefficients[1]:.2g} N"
    contact = f"{fitted.contact + shift:.4g}"
    depths = f"{1000 * float(contact):g} mm of the table, not {1000 * fitted.contact:.4g} mm,{slack}"
    effect = f"explains {rounded(100 * explained)} % of the residual"
    return f"a contact at {depths} {effect}: give --contact {contact}, or --free contact"


def _fit_linear(values: Array, *columns: Array) -> tuple[float, Array]:
    """Return the sum of squared residuals, and the coefficients, of a linear fit of `values` by `columns`."""
    matrix = np.stack(columns, axis=1)
    coefficients = np.asarray(np.linalg.lstsq(matrix, values, rcond=None)[0], np.float64)
    return float(((values - matrix @ coefficients) ** 2).sum()), coefficients
