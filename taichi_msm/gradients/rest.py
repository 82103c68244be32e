"""The derivatives of a loss by what a sheet at rest is made of: one linear solution for every frame.

At rest the forces vanish, F(u) = 0. So as a number changes them by f, u changes by K^-1 f, where K = -F'(u) is the
stiffness of the sheet in this shape, and the loss by p . f with K p = the derivative of the loss by u.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from functools import partial
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import MsmError, Pause
from taichi_msm.gradients.chain_rule import LoadGradient, SheetGradient
from taichi_msm.model.loads import Schedule, decay, decay_slope, frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import spacing
from taichi_msm.solver.rest import Rest
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import SpringFamily, spring_families
from taichi_msm.terms.foundation import point_shares

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

Array = NDArray[np.float64]

# A solution with a larger error, of the size of the right side, is none.
RESIDUAL_TOLERANCE = 1e-6

# Seconds between pauses while a solution is found.
PAUSE_INTERVAL_S = 0.1


class RestAdjoint:
    """A sheet at rest, frame by frame, and the derivatives by its numbers; its plan has a map of the stiffness."""

    def __init__(self, plan: Plan, device: Device) -> None:
        self.plan = plan
        self._sheet = Rest(plan, device)
        self._displacements = np.empty(0)

    def restart(self, plan: Plan) -> None:
        """Begin again with the same scene or another."""
        self.plan = plan
        self._sheet.restart(plan)

    def run(self, pause: Pause) -> Array:
        """Find all shapes anew; returns the displacements of every frame [m], shape (F + 1, rows, cols, 3).

        Raises:
            DivergedError: when a frame has no shape in which the forces balance.
        """
        self._sheet.restart(self.plan)
        frames = []
        for n in range(self.plan.grid.frames + 1):
            self._sheet.advance(int(n > 0), pause)
            frames.append(self._sheet.displacement())
        self._displacements = np.array(frames)
        return self._displacements.copy()

    def backward(self, by_frame: Array, pause: Pause) -> tuple[SheetGradient, LoadGradient]:
        """Differentiate at the last `run`; by_frame: derivative of the loss by what that returned.

        Raises:
            MsmError: when a shape resists some motion by nothing, and so has no derivative.
        """
        plan, (rows, cols) = self.plan, self.plan.scene.sheet.points
        families, curvature = list(spring_families(plan)), _laplacian(plan)
        slopes = SheetGradient(
            (np.zeros((rows, cols - 1)), np.zeros((rows - 1, cols)), np.zeros((rows - 1, cols - 1))),
            np.zeros(3), np.zeros((rows, cols)), 0.0,
        )  # fmt: skip
        loads = LoadGradient(plan)
        for n, slope in enumerate(by_frame):
            pause()
            u: Array = self._displacements[n]
            if not slope[~plan.fixed].any():
                continue
            at_frame = frame_loads(plan, n)
            held = plan.material.virtual * at_frame.active[0] * point_shares(plan)
            p = _run_interruptibly(partial(_solve, plan, _stiffness(plan, families, held, curvature, u), slope), pause)
            if p is None and u.any():
                raise MsmError(
                    f"frame {n} has no gradient: the sheet has no stiffness against some motion; give it a foundation, "
                    "pretension or bending"
                )
            if p is None:
                continue  # The sheet is flat, and stays flat whatever it is made of.
            _add_springs(slopes, families, u, p)
            slopes.held -= held * (u * p).sum(axis=-1)
            bent = curvature @ u.reshape(-1, 3), curvature @ p.reshape(-1, 3)
            slopes.bent -= plan.material.bending * float((bent[0] * bent[1]).sum())
            self._add_loads(loads, n, at_frame, p)
        return slopes, loads

    def _add_loads(self, loads: LoadGradient, frame: int, at_frame: Schedule, p: Array) -> None:
        """Add the derivatives by the loads of a frame."""
        scene, pushes = self.plan.scene, np.zeros((1, len(at_frame.slots), 5))
        for n, slot in enumerate(at_frame.slots):
            probe, at = scene.probes[slot.probe], at_frame.point[0, n]
            pushes[0, n, :3] = np.einsum("ij,ijc->c", decay(probe, scene.sheet, at), p)
            pushes[0, n, 3:] = np.einsum("aij,ij->a", decay_slope(probe, scene.sheet, at), p @ at_frame.strength[0, n])
        time = frame / self.plan.grid.frames_per_second
        nearly = 1e-3 / self.plan.grid.frames_per_second
        loads.add(lambda plan: frame_loads(plan, frame), pushes, (time - nearly, time + nearly))


def _add_springs(slopes: SheetGradient, families: Sequence[SpringFamily], u: Array, p: Array) -> None:
    """Add the derivatives by the springs."""
    for number, family in enumerate(families):
        between, length = family.apart(u)
        change, apart = p[family.here] - p[family.there], u[family.there] - u[family.here]
        kind = min(number, 2)  # The two diagonals are one.
        slopes.springs[kind][...] += (1 - family.length / length) * (change * between).sum(axis=-1)
        slopes.tensions[kind] += (change * apart).sum()


def _stiffness(plan: Plan, families: Sequence[SpringFamily], held: Array, curvature: Any, u: Array) -> csc_matrix:
    """Assemble K in a shape, for x, y and z of all points in turn [N/m]; held: K of the foundation at every point."""
    from scipy import sparse

    shape = plan.scene.sheet.points
    number, axis = np.arange(plan.fixed.size).reshape(shape), np.arange(3)
    total = sparse.diags(np.repeat(held.ravel(), 3)) + plan.material.bending * sparse.kron(
        curvature.T @ curvature, sparse.identity(3)
    )
    for family in families:
        blocks = family.tangent(u).reshape(-1, 3, 3)
        p, q = (3 * number[end].reshape(-1, 1, 1) for end in (family.here, family.there))
        for row, column, sign in ((p, p, 1), (q, q, 1), (p, q, -1), (q, p, -1)):
            places = np.broadcast_arrays(row + axis[:, None], column + axis)
            entries = sign * blocks.ravel(), (places[0].ravel(), places[1].ravel())
            total = total + sparse.coo_matrix(entries, (3 * number.size, 3 * number.size))
    return total.tocsc()


def _laplacian(plan: Plan) -> Any:
    """Give the matrix of the five-point Laplacian at the points with four neighbours, from all points [1/m2]."""
    from scipy import sparse

    (rows, cols), (dx, dy) = plan.scene.sheet.points, spacing(plan.scene.sheet)

    def second(count: int, h: float) -> tuple[Any, Any]:
        """Second differences of a line, and the choice of its inner points."""
        inner = sparse.eye(count - 2, count, 1) if count > 2 else sparse.csr_matrix((0, count))
        beside = sparse.eye(count - 2, count) + sparse.eye(count - 2, count, 2) if count > 2 else inner
        return (beside - 2 * inner) / h**2, inner

    (across, inner_cols), (down, inner_rows) = second(cols, dx), second(rows, dy)
    return (sparse.kron(inner_rows, across) + sparse.kron(down, inner_cols)).tocsr()


def _run_interruptibly(work: Callable[[], Array | None], pause: Pause) -> Array | None:
    """Return what some work in SciPy returns, with pauses meanwhile; what one raises leaves the work behind."""
    future: Future[Array | None] = Future()

    def finish() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=finish, daemon=True).start()
    while wait([future], PAUSE_INTERVAL_S).not_done:
        pause()
    return future.result()


def _solve(plan: Plan, stiffness: csc_matrix, slope: Array) -> Array | None:
    """Solve K p = slope where points move, p = 0 elsewhere; None: K is singular."""
    from scipy.sparse.linalg import splu

    moves = np.flatnonzero(np.repeat(~plan.fixed.ravel(), 3))
    inner, right, p = stiffness[moves][:, moves], slope.reshape(-1)[moves], np.zeros(slope.size)
    try:
        factors = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        found = factors.solve(right)
    except RuntimeError:
        return None
    if not np.abs(inner @ found - right).max() <= RESIDUAL_TOLERANCE * np.abs(right).max():
        return None
    p[moves] = found
    return p.reshape(slope.shape)
