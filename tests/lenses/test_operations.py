"""A lens that applies every operation to its coefficients, in NumPy, with derivatives and in kernels."""

# No `from __future__ import annotations`: Taichi reads the annotations of the kernel.

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest

from taichi_msm.arithmetic import Operations
from taichi_msm.cameras.lens import Lens
from taichi_msm.lenses import MODELS
from taichi_msm.lenses.model import Coefficient, LensModel
from taichi_msm.render.lens_kernels import compile_lens
from taichi_msm.system.runtime import Device, ti


class Trial(LensModel):
    """With c of all coefficients: x' = x (c + q (k1 - k2)), where q is the squared radius."""

    name = "trial"
    meaning = "lens of this test"
    coefficients: ClassVar = {name: Coefficient("coefficient") for name in ("k1", "k2")}

    def build(self, operations: Operations) -> Callable[..., Any]:
        sqrt, exp, log, arctan = operations.sqrt, operations.exp, operations.log, operations.arctan
        maximum, minimum, where = operations.maximum, operations.minimum, operations.where

        def distort(x, y, k1, k2):
            q = x * x + y * y
            c = (
                sqrt(k1)
                + exp(k2)
                + log(k1)
                + arctan(k2)
                + maximum(k2, 0.25)
                - minimum(0.5, k1)
                + where(k1 < k2, k1, k2)
            )
            growth = where(q < k1, log(1.0 + q), arctan(q)) + exp(minimum(q, k1) - maximum(k2, q)) - 1.0 / (k1 + q)
            return x * (c + growth), y * (c + q * (k1 - k2))

        return distort

    def limit(self, coefficients: Sequence[float]) -> float:
        return 1.0


COEFFICIENTS = 0.6, -0.3


@pytest.fixture
def lens(monkeypatch: pytest.MonkeyPatch) -> Lens:
    monkeypatch.setitem(MODELS, "trial", Trial())
    return Lens("trial", COEFFICIENTS)


def points() -> Any:
    return np.random.default_rng(1).uniform(-0.7, 0.7, (100, 2))


def test_jacobian(lens: Lens) -> None:
    """Central differences of 1e-6, whose rounding error is 1e-16 / 1e-6, of values near 1."""
    slope = [(lens.distort(points() + step) - lens.distort(points() - step)) / 2e-6 for step in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(lens.jacobian(points()), np.stack(slope, axis=-1), atol=1e-8)


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_kernel(lens: Lens, precision: str, device: Device) -> None:
    distort, real = compile_lens("trial"), getattr(ti, precision)

    @ti.kernel
    def apply(values: ti.types.ndarray(dtype=real, ndim=2), k: ti.types.ndarray(dtype=real, ndim=1)):
        for n in range(values.shape[0]):
            x, y = distort(values[n, 0], values[n, 1], k[0], k[1])
            values[n, 0], values[n, 1] = x, y

    dtype = np.dtype(precision.replace("f", "float"))
    values = points().astype(dtype)
    apply(values, np.array(COEFFICIENTS, dtype))
    # About 20 operations on values near 1.
    np.testing.assert_allclose(values, lens.distort(points()), atol=20 * np.finfo(dtype).eps)
