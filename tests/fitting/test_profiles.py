"""Profile likelihood of analytical models: conditional minima."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from taichi_msm.fitting.forces import ToolForces
from taichi_msm.fitting.least_squares import Misfit, Solution
from taichi_msm.fitting.observation import ErrorCorrelation
from taichi_msm.fitting.predict import Prediction
from taichi_msm.fitting.profiles import Profiler
from taichi_msm.fitting.uncertainty import uncertainty

Array = NDArray[np.float64]

Model = Callable[[Array], Array]


def profiler(model: Model, x: Array, observed: Array) -> Profiler:
    """Profiler of a minimum at x, for errors of 1."""
    count, low = len(observed), np.full(len(x), -5.0)
    forces = ToolForces("", np.arange(float(count)), observed[:, None], 1.0, np.zeros(count, np.intp))

    def predict(coordinates: list[Array]) -> list[Prediction]:
        return [Prediction((model(each)[:, None],), 1, np.zeros(1)) for each in coordinates]

    runs: Any = SimpleNamespace(predict_many=predict, problem=SimpleNamespace(limits=(low, -low)), expected=0, count=0)
    jacobian = np.stack([(model(x + step) - model(x - step)) / 2e-5 for step in 1e-5 * np.eye(len(x))], axis=1)
    misfit = Misfit([forces], [1.0], robust=False)
    solution = Solution(x, predict([x])[0], (1.0,), 0.0, True)
    return Profiler(runs, misfit, solution, uncertainty(misfit, solution, jacobian, ErrorCorrelation(None, None)))


def test_conditional_minima_of_a_curved_model() -> None:
    """The ends of 0.7 a (exp(b t) - 1) / b, whose parameters correlate, agree with full minimisations over b."""
    time = np.linspace(0.1, 2, 40)

    def model(x: Array) -> Array:
        return 0.7 * np.exp(x[0]) * np.expm1(np.exp(x[1]) * time) / np.exp(x[1])

    observed, profiled = model(np.zeros(2)), profiler(model, np.zeros(2), model(np.zeros(2)))
    profile = profiled.profiles([0])[0]
    quantile = profiled._uncertainties.quantile
    for end in (profile.low, profile.high):
        assert end is not None
        rise = minimize_scalar(lambda b, end=end: np.sum((model(np.array([end, b])) - observed) ** 2), (-1, 1)).fun
        # An end is determined to 1 % of its distance, and a conditional minimum to 0.01 of a cost of 2.
        assert rise == pytest.approx(quantile**2, rel=0.03)
