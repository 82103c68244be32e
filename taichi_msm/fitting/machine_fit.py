"""Fitted machine tests, and explanations of a rejected model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taichi_msm.fitting.machine_model import MachineProblem
from taichi_msm.fitting.observation import Array
from taichi_msm.fitting.parameters import rounded
from taichi_msm.machines.loading import Loading

# The tool is held while the depth differs by at most this share of the travel.
HELD_SHARE = 0.02

# Smallest differences that are explained: of a fall of the force, of the force at half the depth, as shares of the
# peak, and of the depth of contact, as a share of the travel.
MIN_FALL_SHARE, MIN_CURVATURE_SHARE, MIN_CONTACT_SHARE = 0.05, 0.04, 0.02


@dataclass(frozen=True, eq=False)
class FittedTest:
    """A machine test, and the forces of the fitted scene."""

    loading: Loading
    contact: float  # depth of contact [m of the table]
    force: Array  # fitted force at every frame [N], shape (frames,)

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


def fitted_tests(job: MachineProblem, values: Mapping[str, float], forces: Array) -> tuple[FittedTest, ...]:
    """Split fitted forces, shape (frames of all tests, 1), by test; `values`: fitted values by key."""
    ends = np.cumsum([len(loading.force) for loading in job.tests])[:-1]
    return tuple(
        FittedTest(loading, values.get(key, loading.contact), force)
        for loading, key, force in zip(job.tests, job.contact_keys, np.split(forces[:, 0], ends), strict=True)
    )


def unknown_notes(tests: Sequence[FittedTest], values: Mapping[str, float]) -> Iterator[str]:
    """Yield the reasons for parameters that the tests do not identify, with their values by key."""
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
    """Yield reasons that a table shows for the rejection of a model, where depths of contact are parameters or not."""
    for fitted in tests:
        if reason := _explain(fitted, fits_contact=fits_contact):
            yield f"{fitted.loading.test.name}: {reason}"


def _explain(fitted: FittedTest, *, fits_contact: bool) -> str:
    """Return the reason that a table shows, or an empty text."""
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
    if fall > MIN_FALL_SHARE and model_fall < 0.5 * fall:
        return (
            f"the force falls by {100 * fall:.0f} % while the tool is held, and the model's by "
            f"{100 * max(model_fall, 0.0):.0f} %: relaxation? Free the shares and times of tissue.relaxation"
        )
    at_peak = float(travel[loading.force.argmax()])
    rising = slice(0, int(np.argmax(travel >= (1 - HELD_SHARE) * at_peak)) + 1)
    depth, measured, model = travel[rising], loading.force[rising], predicted[rising]
    residual = model - measured
    # A shift of the depth by a changes the model's force by a dF/dd.
    moves = np.gradient(depth) > 1e-3 * reach / len(depth)
    slope = np.where(moves, np.gradient(model) / np.where(moves, np.gradient(depth), 1.0), 0.0)
    # A curvature changes the model's force by a factor that is linear in depth.
    (shift, *_), by_contact = _explained(residual, slope)
    _, by_curvature = _explained(residual, model, model * depth / reach)
    if not fits_contact and abs(shift) > MIN_CONTACT_SHARE * reach and by_contact > max(0.7, by_curvature - 0.05):
        return (
            f"a contact at {fitted.contact + shift:.4g} m of the table, not {fitted.contact:.4g} m, would explain "
            f"{rounded(100 * by_contact)} % of the residual: give --contact, or --free contact"
        )
    halves = [float(np.interp(0.5 * depth[-1], np.maximum.accumulate(depth), force)) for force in (measured, model)]
    shares = [100 * half / float(force[-1]) for half, force in zip(halves, (measured, model), strict=True)]
    if abs(shares[0] - shares[1]) <= 100 * MIN_CURVATURE_SHARE:
        return ""
    way = "more" if shares[0] < shares[1] else "less"
    return (
        f"at half the depth the force is {rounded(shares[0])} % of that at the peak, and the model's "
        f"{rounded(shares[1])} %: the tissue stiffens {way} with the depth: lock? Free or change it"
    )


def _explained(residual: Array, *columns: Array) -> tuple[Array, float]:
    """Return the coefficients of a linear fit of a residual, and the share of its square that the fit explains."""
    matrix = np.stack(columns, axis=1)
    coefficients = np.asarray(np.linalg.lstsq(matrix, residual, rcond=None)[0], np.float64)
    rest = residual - matrix @ coefficients
    return coefficients, 1 - float(rest @ rest) / max(float(residual @ residual), 1e-300)
