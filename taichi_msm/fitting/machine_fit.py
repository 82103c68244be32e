"""Fitted machine tests, and explanations of a rejected model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taichi_msm.fitting.machine_model import MachineProblem
from taichi_msm.fitting.observation import Array
from taichi_msm.fitting.parameters import rounded
from taichi_msm.machines.loading import CONTACT_NOISES, Loading

# The tool is held while the depth differs by at most this share of the travel.
HELD_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class FittedTest:
    """A machine test, and the forces of the fitted scene.

    Attributes:
        loading: the test at the frames of its scene.
        contact: depth of contact, fitted or of the test [m of the table].
        force: fitted force at every frame [N], shape (frames,).
    """

    loading: Loading
    contact: float
    force: Array

    @property
    def residual(self) -> float:
        """Root mean square of the residual over the frames [N]."""
        return float(np.sqrt(np.mean((self.force - self.loading.force) ** 2)))

    @property
    def rise(self) -> float:
        """Time between contact and the largest force [s]."""
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
            "peak": loading.peak,
            "residual_force": self.residual,
            "frames": len(loading.force),
        }


def fitted_tests(problem: MachineProblem, values: Mapping[str, float], forces: Array) -> tuple[FittedTest, ...]:
    """Return the fitted tests.

    Args:
        problem: the fit.
        values: fitted values of the parameters by key.
        forces: fitted forces of all tests [N], shape (frames of all tests, 1).
    """
    ends = np.cumsum([len(loading.force) for loading in problem.tests])[:-1]
    return tuple(
        FittedTest(loading, values.get(key, loading.contact), force)
        for loading, key, force in zip(problem.tests, problem.contact_keys, np.split(forces[:, 0], ends), strict=True)
    )


def unknown_notes(tests: Sequence[FittedTest], values: Mapping[str, float]) -> Iterator[str]:
    """Yield the reasons for parameters that the tests do not identify.

    Args:
        tests: the fitted tests.
        values: values of these parameters by key.
    """
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
            yield f"{key}: the test does not stretch the tissue far enough; pull further, or leave it out"


def explanations(tests: Sequence[FittedTest], *, fits_contact: bool) -> Iterator[str]:
    """Yield the reasons for a rejected model that tables show: relaxation, contact, curvature, or a sign.

    Args:
        tests: the fitted tests.
        fits_contact: whether depths of contact are parameters, and therefore no reason.
    """
    for fitted in tests:
        if reason := _explain(fitted, fits_contact=fits_contact):
            yield f"{fitted.loading.test.name}: {reason}"


def _explain(fitted: FittedTest, *, fits_contact: bool) -> str:
    """Return the reason for the residual of a test, or an empty text."""
    loading, predicted = fitted.loading, fitted.force
    if float(predicted @ loading.force) < 0:
        return "the measured force acts against the model's: is the sign of the path, or of a column, wrong?"
    test, travel = loading.test, loading.travel(fitted.contact)
    peak = int(test.force.argmax())
    reach = float(travel.max())
    held = np.flatnonzero(np.abs(test.depth[peak:] - test.depth[peak]) <= HELD_SHARE * reach) + peak
    last = int(held[-1])
    fall = 1 - float(test.force[last] / test.force[peak])
    at_ends = np.interp(test.time[[peak, last]], loading.time, predicted)
    model_fall = 1 - float(at_ends[1] / at_ends[0]) if last > peak and at_ends[0] > 0 else 0.0
    if fall > 0.05 and model_fall < 0.5 * fall:
        return (
            f"the force falls by {100 * fall:.0f} % while the tool is held, and the model's by "
            f"{100 * max(model_fall, 0.0):.0f} %: relaxation? Free the shares and times of tissue.relaxation"
        )
    at_peak = float(travel[loading.force.argmax()])
    rising = slice(0, int(np.argmax(travel >= (1 - HELD_SHARE) * at_peak)) + 1)
    if not fits_contact and at_peak and (reason := _explain_by_contact(fitted, rising)):
        return reason
    depth, measured, model = travel[rising], loading.force[rising], predicted[rising]
    halves = [float(np.interp(0.5 * depth[-1], np.maximum.accumulate(depth), force)) for force in (measured, model)]
    shares = [100 * half / float(force[-1]) for half, force in zip(halves, (measured, model), strict=True)]
    if abs(shares[0] - shares[1]) <= 4:
        return ""
    comparison = "more" if shares[0] < shares[1] else "less"
    return (
        f"at half the depth the force is {rounded(shares[0])} % of that at the peak, and the model's "
        f"{rounded(shares[1])} %: the tissue stiffens {comparison} with the depth: lock? Free or change it"
    )


def _explain_by_contact(fitted: FittedTest, rising: slice) -> str:
    """Return the reason of another depth of contact, or an empty text; `rising`: frames up to the peak.

    The fit has adapted the stiffness to its contact. So the measured force is compared with the model's curve, shifted
    in depth, times a factor, plus a constant if the contact is later: the friction or weight of a slack. Another
    curvature, a factor linear in depth with such a constant, must explain less.
    """
    loading = fitted.loading
    travel, place = loading.travel(fitted.contact)[rising], loading.depth[rising] - fitted.contact
    measured, model = loading.force[rising], fitted.force[rising]
    reach, is_pressed = float(travel[-1]), (place > 0).astype(float)
    end_slope = (model[-1] - np.interp(0.9 * reach, travel, model)) / (0.1 * reach)

    def fit_shifted(shift: float) -> tuple[float, Array]:
        # The curve is linear beyond its end.
        curve = np.interp(place - shift, travel, model) + end_slope * np.maximum(place - shift - reach, 0.0)
        return _fit_linear(measured, curve, *([is_pressed] if shift > 0 else []))

    shift = 0.0
    for shifts in (np.linspace(-0.5, 0.9, 141), np.linspace(-0.01, 0.01, 41)):
        shift = min((shift + reach * shifts).tolist(), key=lambda shift: fit_shifted(shift)[0])
    square, coefficients = fit_shifted(shift)
    square_by_curvature, _ = _fit_linear(measured, model, model * travel, is_pressed)
    explained = 1 - square / max(float((model - measured) @ (model - measured)), 1e-300)
    if abs(shift) <= 0.02 * reach or explained <= 0.7 or square >= square_by_curvature:
        return ""
    slack = ""
    if shift > 0 and coefficients[1] > CONTACT_NOISES * loading.noise:
        slack = f" after a slack with {coefficients[1]:.2g} N"
    return (
        f"a contact at {fitted.contact + shift:.4g} m of the table, not {fitted.contact:.4g} m,{slack} would explain "
        f"{rounded(100 * explained)} % of the residual: give --contact, or --free contact"
    )


def _fit_linear(values: Array, *columns: Array) -> tuple[float, Array]:
    """Return the sum of squared residuals of a linear fit of values, and its coefficients."""
    matrix = np.stack(columns, axis=1)
    coefficients = np.asarray(np.linalg.lstsq(matrix, values, rcond=None)[0], np.float64)
    return float(((values - matrix @ coefficients) ** 2).sum()), coefficients
