"""Numba: all steps in one function, rows in parallel by prange, columns vectorised by the compiler.

Coordinates are separate arrays and neighbours are read from three rows, so that every index is plain. All numbers are
float32: a single float64 would promote all arithmetic.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from benchmarks.stepping.planes import Planes
from benchmarks.stepping.problem import FORCE, Problem
from taichi_msm.model.sheet import spacing


@numba.njit(fastmath=True, inline="always", cache=True)
def pull(to_x, to_y, to_z, length, stiffness):
    """Return the force of a spring over the vector along it."""
    return stiffness - stiffness * length / math.sqrt(to_x * to_x + to_y * to_y + to_z * to_z)


@numba.njit(fastmath=True, error_model="numpy", cache=True)
def step_row(ux, uy, uz, wx, wy, wz, share, i, load, dx, dy, diagonal, structural, shear, virtual, keep, gain):
    """Step the points of a row: u is u_n, w becomes u_{n+1} from u_{n-1}."""
    load_x, load_y, load_z = load
    n = ux.shape[1]
    x0, y0, z0 = ux[i - 1], uy[i - 1], uz[i - 1]
    x1, y1, z1 = ux[i], uy[i], uz[i]
    x2, y2, z2 = ux[i + 1], uy[i + 1], uz[i + 1]
    px, py, pz, s = wx[i], wy[i], wz[i], share[i]
    for k in range(n - 2):
        j = k + 1
        x, y, z = x1[j], y1[j], z1[j]
        fx = load_x * s[j] - virtual * x
        fy = load_y * s[j] - virtual * y
        fz = load_z * s[j] - virtual * z

        tx, ty, tz = x1[k] - x - dx, y1[k] - y, z1[k] - z
        f = pull(tx, ty, tz, dx, structural)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x1[k + 2] - x + dx, y1[k + 2] - y, z1[k + 2] - z
        f = pull(tx, ty, tz, dx, structural)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x0[j] - x, y0[j] - y + dy, z0[j] - z
        f = pull(tx, ty, tz, dy, structural)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x2[j] - x, y2[j] - y - dy, z2[j] - z
        f = pull(tx, ty, tz, dy, structural)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz

        tx, ty, tz = x0[k] - x - dx, y0[k] - y + dy, z0[k] - z
        f = pull(tx, ty, tz, diagonal, shear)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x0[k + 2] - x + dx, y0[k + 2] - y + dy, z0[k + 2] - z
        f = pull(tx, ty, tz, diagonal, shear)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x2[k] - x - dx, y2[k] - y - dy, z2[k] - z
        f = pull(tx, ty, tz, diagonal, shear)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz
        tx, ty, tz = x2[k + 2] - x + dx, y2[k + 2] - y - dy, z2[k + 2] - z
        f = pull(tx, ty, tz, diagonal, shear)
        fx, fy, fz = fx + f * tx, fy + f * ty, fz + f * tz

        px[j] = x + keep * (x - px[j]) + gain * fx
        py[j] = y + keep * (y - py[j]) + gain * fy
        pz[j] = z + keep * (z - pz[j]) + gain * fz


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
def advance(
    now, before, share, load, dx, dy, diagonal, structural, shear, virtual, keep, gain, first_gain, done, steps
):
    """Advance by all steps; now and before, shape (3, n, n), alternate."""
    n = share.shape[0]
    for step in range(done, done + steps):
        this_gain = gain if step else first_gain
        even = (step - done) % 2 == 0
        u = now if even else before
        w = before if even else now
        for row in numba.prange(n - 2):
            step_row(
                u[0], u[1], u[2], w[0], w[1], w[2], share, row + 1, load,
                dx, dy, diagonal, structural, shear, virtual, keep, this_gain,
            )  # fmt: skip


class Stepper(Planes):
    """State and parameters of the compiled function."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.points)
        sheet = problem.material
        dx, dy = spacing(problem.scene.sheet)
        self._numbers = tuple(
            np.float32(number)
            for number in (
                *(dx, dy, math.hypot(dx, dy), sheet.across, sheet.shear, sheet.virtual),
                *(problem.keep, problem.gain, problem.first_gain),
            )
        )
        self._load = tuple(np.float32(force) for force in FORCE)
        self._share = np.ascontiguousarray(problem.load[0] / self._load[0])

    def advance(self, steps: int) -> None:
        """Advance by all steps in one call."""
        advance(self._now, self._before, self._share, self._load, *self._numbers, self._done, steps)
        self._count(steps)


def prepare(problem: Problem, threads: int | None) -> Stepper:
    """Set up the sheet at rest; Numba reads the number of threads from the environment."""
    del threads
    return Stepper(problem)
