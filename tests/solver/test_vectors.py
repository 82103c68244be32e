"""Operations on vectors that stay vectors give the bits of those that Taichi turns into scalars.

Some of Taichi's do not: `any` and `all` of a mask look at one lane, and a wrong one draws a picture that looks almost
right. These are the operations that the kernels use.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.system.runtime import Device, compilation_options, ti

NUMBERS, WHOLE = 28, 7


def operations(precision: str, lanes: int) -> Callable[..., None]:
    """Make a kernel that puts the results of all operations on two vectors into rows."""
    real = getattr(ti, precision)
    vector, integers = ti.types.vector(lanes, real), ti.types.vector(lanes, ti.i32)

    @ti.kernel
    def apply(
        a_of: ti.types.ndarray(dtype=vector, ndim=1),
        b_of: ti.types.ndarray(dtype=vector, ndim=1),
        table: ti.types.ndarray(dtype=real, ndim=1),
        scalar: real,
        numbers: ti.types.ndarray(dtype=vector, ndim=1),
        whole: ti.types.ndarray(dtype=integers, ndim=1),
    ):
        ti.loop_config(serialize=True)
        for n in range(a_of.shape[0]):
            a, b = a_of[n], b_of[n]
            at = n * NUMBERS
            numbers[at] = a + b
            numbers[at + 1] = a - b
            numbers[at + 2] = a * b
            numbers[at + 3] = a / b
            numbers[at + 4] = a + scalar
            numbers[at + 5] = scalar - a
            numbers[at + 6] = a * scalar
            numbers[at + 7] = scalar / b
            numbers[at + 8] = ti.sqrt(ti.max(a, 0.0))
            numbers[at + 9] = ti.floor(a)
            numbers[at + 10] = ti.round(a)
            numbers[at + 11] = ti.min(a, b)
            numbers[at + 12] = ti.max(a, scalar)
            numbers[at + 13] = ti.max(a, a * (-1.0))
            mask = (a <= b) & (a > scalar) & (b >= 0.0) & (b < 5.0)
            numbers[at + 14] = ti.select(mask, a, b)
            numbers[at + 15] = ti.select(mask, a, 0.0)
            numbers[at + 16] = ti.select(a > b, scalar, b)
            numbers[at + 17] = ti.select(scalar > 0.0, a, b)
            numbers[at + 18] = vector(a.sum())
            numbers[at + 19] = vector(a.min())
            # Whether any lane of a mask is set: of none, one and all.
            numbers[at + 20] = vector(ti.select(a > 1e9, vector(1), vector(0)).max())
            numbers[at + 21] = vector(ti.select(a >= a.max(), vector(1), vector(0)).max())
            numbers[at + 22] = vector([a[(lane + 1) % lanes] for lane in ti.static(range(lanes))])
            numbers[at + 23] = vector([ti.exp(-a[lane]) for lane in ti.static(range(lanes))])
            carried = a
            for _ in range(3):
                carried += b
                carried *= scalar
            numbers[at + 24] = carried
            index = integers([ti.cast(ti.floor(ti.max(b, 0.0))[lane], ti.i32) for lane in ti.static(range(lanes))])
            numbers[at + 25] = vector([table[index[lane]] for lane in ti.static(range(lanes))])
            if scalar > 0.0:
                carried = b
            numbers[at + 26] = carried
            numbers[at + 27] = ti.select((a > b) | (b > 5.0), a, scalar)
            whole[n * WHOLE] = index + 3
            whole[n * WHOLE + 1] = (index + 1) * 7
            whole[n * WHOLE + 2] = ti.min(index, 4)
            whole[n * WHOLE + 3] = ti.max(index - 2, 0)
            whole[n * WHOLE + 4] = index * 3 + index
            whole[n * WHOLE + 5] = ti.max(ti.min(index + 1, 5), 0)
            whole[n * WHOLE + 6] = ti.select(a > b, n, index)

    return apply


def aligned(shape: tuple[int, int], dtype: Any) -> NDArray[Any]:
    """Make zeros where vectors may lie; Taichi's own arrays do."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    raw = np.zeros(size + 64, np.uint8)
    begin = -raw.ctypes.data % 64
    return raw[begin : begin + size].view(dtype).reshape(shape)


@pytest.mark.parametrize(("precision", "lanes"), [("f32", 8), ("f32", 16), ("f64", 4), ("f64", 8)])
def test_vectors_give_the_bits_of_scalars(precision: str, lanes: int, device: Device) -> None:
    real = np.float32 if precision == "f32" else np.float64
    rng = np.random.default_rng(lanes)
    count = 50
    a, b = (aligned((count, lanes), real) for _ in range(2))
    a[:], b[:] = rng.uniform(-9, 9, (2, count, lanes))
    table = np.linspace(1, 2, 10).astype(real)

    def results(scalarised: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        apply, config = operations(precision, lanes), ti.lang.impl.current_cfg()
        numbers, whole = aligned((count * NUMBERS, lanes), real), aligned((count * WHOLE, lanes), np.int32)
        with compilation_options():
            config.real_matrix_scalarize = scalarised
            apply(a, b, table, 0.75, numbers, whole)
        return numbers.reshape(count, NUMBERS, lanes), whole

    vectors, scalars = results(scalarised=False), results(scalarised=True)
    for row in range(NUMBERS):
        assert vectors[0][:, row].tobytes() == scalars[0][:, row].tobytes(), row
    assert vectors[1].tobytes() == scalars[1].tobytes()
    # And what NumPy makes of some of them.
    expected = {
        0: a + b,
        3: a / b,
        8: np.sqrt(np.maximum(a, 0)),
        9: np.floor(a),
        10: np.round(a),
        22: np.roll(a, -1, 1),
    }
    for row, values in expected.items():
        np.testing.assert_array_equal(vectors[0][:, row], values)
    assert (vectors[0][:, 20] == 0).all()
    assert (vectors[0][:, 21] == 1).all()
