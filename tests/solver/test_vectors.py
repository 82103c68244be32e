"""The kernels' operations on vectors have the bits of those that Taichi splits into scalars.

Some other operations do not: `any` and `all` of a mask test one lane only.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.system.runtime import Device, compilation_options, ti

RESULTS, INTEGER_RESULTS = 28, 7


def operations(precision: str, lanes: int) -> Callable[..., None]:
    """Build a kernel that stores the results of all operations on two vectors in consecutive entries."""
    real = getattr(ti, precision)
    vector, integers = ti.types.vector(lanes, real), ti.types.vector(lanes, ti.i32)

    @ti.kernel
    def apply(
        a_of: ti.types.ndarray(dtype=vector, ndim=1), b_of: ti.types.ndarray(dtype=vector, ndim=1),
        table: ti.types.ndarray(dtype=real, ndim=1), scalar: real,
        results: ti.types.ndarray(dtype=vector, ndim=1), integer_results: ti.types.ndarray(dtype=integers, ndim=1),
    ):  # fmt: skip
        ti.loop_config(serialize=True)
        for n in range(a_of.shape[0]):
            a, b = a_of[n], b_of[n]
            mask = (a <= b) & (a > scalar) & (b >= 0.0) & (b < 5.0)
            carried = a
            for _ in range(3):
                carried += b
                carried *= scalar
            branched = carried
            if scalar > 0.0:
                branched = b
            index = integers([ti.cast(ti.floor(ti.max(b, 0.0))[lane], ti.i32) for lane in ti.static(range(lanes))])
            for k, result in ti.static(enumerate([
                a + b, a - b, a * b, a / b, a + scalar, scalar - a, a * scalar, scalar / b,
                ti.sqrt(ti.max(a, 0.0)), ti.floor(a), ti.round(a),
                ti.min(a, b), ti.max(a, scalar), ti.max(a, a * (-1.0)),
                ti.select(mask, a, b), ti.select(mask, a, 0.0), ti.select(a > b, scalar, b),
                ti.select(scalar > 0.0, a, b), ti.select((a > b) | (b > 5.0), a, scalar),
                vector(a.sum()), vector(a.min()),
                # Whether a mask is True in any lane, for no lane and for one.
                vector(ti.select(a > 1e9, vector(1), vector(0)).max()),
                vector(ti.select(a >= a.max(), vector(1), vector(0)).max()),
                vector([a[(lane + 1) % lanes] for lane in ti.static(range(lanes))]),
                vector([ti.exp(-a[lane]) for lane in ti.static(range(lanes))]),
                vector([table[index[lane]] for lane in ti.static(range(lanes))]),
                carried, branched,
            ])):  # fmt: skip
                results[n * RESULTS + k] = result
            for k, result in ti.static(enumerate([
                index + 3, (index + 1) * 7, ti.min(index, 4), ti.max(index - 2, 0), index * 3 + index,
                ti.max(ti.min(index + 1, 5), 0), ti.select(a > b, n, index),
            ])):  # fmt: skip
                integer_results[n * INTEGER_RESULTS + k] = result

    return apply


def aligned(shape: tuple[int, int], dtype: Any) -> NDArray[Any]:
    """Allocate zeros at an address for vectors, as Taichi's own arrays have it."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    raw = np.zeros(size + 64, np.uint8)
    begin = -raw.ctypes.data % 64
    return raw[begin : begin + size].view(dtype).reshape(shape)


@pytest.mark.parametrize(("precision", "lanes"), [("f32", 8), ("f32", 16), ("f64", 4), ("f64", 8)])
def test_vectors_have_the_bits_of_scalars(precision: str, lanes: int, device: Device) -> None:
    real = np.float32 if precision == "f32" else np.float64
    count = 50
    a, b = (aligned((count, lanes), real) for _ in range(2))
    a[:], b[:] = np.random.default_rng(lanes).uniform(-9, 9, (2, count, lanes))
    table = np.linspace(1, 2, 10).astype(real)

    def compute(scalarised: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        apply, config = operations(precision, lanes), ti.lang.impl.current_cfg()
        results, integers = aligned((count * RESULTS, lanes), real), aligned((count * INTEGER_RESULTS, lanes), np.int32)
        with compilation_options():
            config.real_matrix_scalarize = scalarised
            apply(a, b, table, 0.75, results, integers)
        return results.reshape(count, RESULTS, lanes), integers

    (vectors, integers), (scalars, scalar_integers) = compute(scalarised=False), compute(scalarised=True)
    for k in range(RESULTS):
        assert vectors[:, k].tobytes() == scalars[:, k].tobytes(), k
    assert integers.tobytes() == scalar_integers.tobytes()
    in_numpy = {0: a + b, 3: a / b, 8: np.sqrt(np.maximum(a, 0)), 9: np.floor(a), 10: np.round(a)}
    for k, expected in {**in_numpy, 21: 0 * a, 22: 0 * a + 1, 23: np.roll(a, -1, 1)}.items():
        np.testing.assert_array_equal(vectors[:, k], expected)
    assert integers.any()
