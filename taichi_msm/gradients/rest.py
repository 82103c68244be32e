"""Adjoint of the quasi-static equilibrium: one linear solution per frame.

At equilibrium F(u) = 0. A change f of the forces changes u by K^-1 f, with the tangent stiffness K = -F'(u). It changes
the loss by p . f, where the adjoint p solves K p = l, and l is the derivative of the loss with respect to u.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from functools import partial
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import MsmError, Pause
from taichi_msm.gradients.chain_rule import LoadGradient, SheetGradient
from taichi_msm.laws.law import LawNumbers
from taichi_msm.model.loads import Schedule, decay, decay_gradient, evaluate_frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import spacing
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import SpringFamily, spring_families
from taichi_msm.terms.foundation import FoundationForce, foundation_force, point_shares

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

# Largest residual of a linear solution, relative to the right-hand side. Above it, the stiffness counts as singular.
RESIDUAL_TOLERANCE = 1e-6


class RestAdjoint:
    """Adjoint of a quasi-static sheet on a CPU; its plan is in f64 with a stiffness map."""

    def __init__(self, plan: Plan, device: Device) -> None:
        self._forward = QuasiStatics(plan, device)

    def restart(self, plan: Plan) -> None:
        """Restart with a plan of the same terms, in f64 with a stiffness map."""
        self._forward.restart(plan)

    @property
    def plan(self) -> Plan:
        """The current plan."""
        return self._forward.plan

    def run(self, pause: Pause) -> Array:
        """Solve all frames; return the displacements at every frame [m], shape (F + 1, rows, cols, 3)."""
        frames = []
        for n in range(self.plan.grid.frames + 1):
            self._forward.advance(int(n > 0), pause)
            frames.append(self._forward.displacement())
        self._displacements = np.array(frames)
        return self._displacements.copy()

    def backward(self, by_frame: Array, pause: Pause) -> tuple[SheetGradient, LoadGradient]:
        """Differentiate a loss at the last `run`; raise an MsmError if the tangent stiffness is singular.

        `by_frame` is the derivative of the loss with respect to the displacements at every frame, as `run` returns
        them.
        """
        plan, (rows, cols) = self.plan, self.plan.scene.sheet.points
        families, laplacian = list(spring_families(plan)), _laplacian(plan)
        gradient = SheetGradient(
            (np.zeros((rows, cols - 1)), np.zeros((rows - 1, cols)), np.zeros((rows - 1, cols - 1))),
            np.zeros(3), np.zeros((rows, cols)), 0.0, _zeros(plan.material.stiffening),
            _zeros(plan.material.virtual_stiffening),
        )  # fmt: skip
        loads = LoadGradient(plan)
        for n, by_displacement in enumerate(by_frame):
            pause()
            u: Array = self._displacements[n]
            if not by_displacement[~plan.fixed].any():
                continue
            at_frame = evaluate_frame_loads(plan, n)
            foundation = plan.material.virtual * at_frame.active[0] * point_shares(plan)
            of_foundation = foundation_force(plan.material, foundation, u)
            stiffness = _stiffness(plan, families, of_foundation, laplacian, u)
            p = _run_interruptibly(partial(_solve, plan, stiffness, by_displacement), pause)
            if p is None:
                if not u.any():
                    continue  # A flat sheet remains flat with any material.
                fault = f"frame {n} has no gradient: the sheet has no stiffness against some motion"
                raise MsmError(f"{fault}; give it a foundation, pretension or bending")
            _add_springs(gradient, families, u, p)
            gradient.foundation_stiffening += [float((by * p[..., 2]).sum()) for by in of_foundation.by_numbers]
            gradient.foundation += (of_foundation.force * p).sum(axis=-1)
            curvatures = laplacian @ u.reshape(-1, 3), laplacian @ p.reshape(-1, 3)
            gradient.bending -= plan.material.bending * float((curvatures[0] * curvatures[1]).sum())
            self._add_loads(loads, n, at_frame, p)
        return gradient, loads

    def _add_loads(self, loads: LoadGradient, frame: int, at_frame: Schedule, p: Array) -> None:
        """Add the derivatives with respect to the loads of a frame, for the adjoint p."""
        scene, by_slot = self.plan.scene, np.zeros((1, len(at_frame.slots), 5))
        for n, slot in enumerate(at_frame.slots):
            probe, at = scene.probes[slot.probe], at_frame.point[0, n]
            by_slot[0, n, :3] = np.einsum("ij,ijc->c", decay(probe, self.plan, at), p)
            by_decay = p @ at_frame.strength[0, n]
            by_slot[0, n, 3:] = np.einsum("aij,ij->a", decay_gradient(probe, self.plan, at), by_decay)
        time = frame / self.plan.grid.frames_per_second
        margin = 1e-3 / self.plan.grid.frames_per_second
        loads.add(lambda plan: evaluate_frame_loads(plan, frame), by_slot, (time - margin, time + margin))


def _zeros(law: LawNumbers | None) -> Array:
    """Return zeros for the derivatives by log m and the shape of a law."""
    return np.zeros(law.law.shape_count + 1 if law else 0)


def _add_springs(gradient: SheetGradient, families: Sequence[SpringFamily], u: Array, p: Array) -> None:
    """Add the derivatives with respect to the coefficients of the springs, for the adjoint p at displacements u."""
    for n, family in enumerate(families):
        q, edges, square_difference, square = family.elongation(u)
        p_difference = p[family.start] - p[family.end]
        along = (p_difference * edges).sum(axis=-1)
        _, _, by_stiffness, by_tension, by_numbers = family.derivatives(square_difference, square, along)
        index = min(n, 2)  # both diagonals count as one family
        gradient.springs[index][...] += by_stiffness * along
        gradient.stiffening += [float((by * along).sum()) for by in by_numbers]
        gradient.tensions[index] += (p_difference * q).sum() + (by_tension * along).sum()


def _stiffness(
    plan: Plan, families: Sequence[SpringFamily], foundation: FoundationForce, laplacian: Any, u: Array
) -> csc_matrix:
    """Assemble the tangent stiffness K [N/m], in the order x, y, z of each mass point."""
    from scipy import sparse

    shape = plan.scene.sheet.points
    number, axis = np.arange(plan.fixed.size).reshape(shape), np.arange(3)
    bending = plan.material.bending * sparse.kron(laplacian.T @ laplacian, sparse.identity(3))
    total = sparse.diags(foundation.tangent.ravel()) + bending
    for family in families:
        blocks = family.tangent(u).reshape(-1, 3, 3)
        p, q = (3 * number[end].reshape(-1, 1, 1) for end in (family.start, family.end))
        for row, column, sign in ((p, p, 1), (q, q, 1), (p, q, -1), (q, p, -1)):
            indices = np.broadcast_arrays(row + axis[:, None], column + axis)
            entries = sign * blocks.ravel(), (indices[0].ravel(), indices[1].ravel())
            total = total + sparse.coo_matrix(entries, (3 * number.size, 3 * number.size))
    return total.tocsc()


def _laplacian(plan: Plan) -> Any:
    """Assemble the five-point Laplacian from all mass points to those with four neighbours [1/m2]."""
    from scipy import sparse

    (rows, cols), (dx, dy) = plan.scene.sheet.points, spacing(plan.scene.sheet)

    def second_difference(count: int, h: float) -> tuple[Any, Any]:
        """Return the matrices of the second difference along a line, and of the selection of its inner mass points."""
        inner = sparse.eye(count - 2, count, 1) if count > 2 else sparse.csr_matrix((0, count))
        neighbours = sparse.eye(count - 2, count) + sparse.eye(count - 2, count, 2) if count > 2 else inner
        return (neighbours - 2 * inner) / h**2, inner

    (across, inner_cols), (down, inner_rows) = second_difference(cols, dx), second_difference(rows, dy)
    return (sparse.kron(inner_rows, across) + sparse.kron(down, inner_cols)).tocsr()


def _run_interruptibly(work: Callable[[], Array | None], pause: Pause) -> Array | None:
    """Run a function in a thread, and call `pause` meanwhile; an exception from `pause` leaves the thread behind."""
    future: Future[Array | None] = Future()

    def finish() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=finish, daemon=True).start()
    while wait([future], timeout=0.1).not_done:
        pause()
    return future.result()


def _solve(plan: Plan, stiffness: csc_matrix, by_displacement: Array) -> Array | None:
    """Solve K p = by_displacement at free mass points, with p = 0 elsewhere; return None if K is singular."""
    from scipy.sparse.linalg import splu

    free = np.flatnonzero(np.repeat(~plan.fixed.ravel(), 3))
    inner, right, p = stiffness[free][:, free], by_displacement.reshape(-1)[free], np.zeros(by_displacement.size)
    try:
        factors = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solution = factors.solve(right)
    except RuntimeError:
        return None
    if not np.abs(inner @ solution - right).max() <= RESIDUAL_TOLERANCE * np.abs(right).max():
        return None
    p[free] = solution
    return p.reshape(by_displacement.shape)
