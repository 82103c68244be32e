"""Time of a gradient, against a forward run and against Taichi's automatic differentiation of the same steps.

The loss is half the sum of squares of the last displacements; the parameters are the stiffness factors of all cells.
All in f64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.clock import in_turn
from benchmarks.process import FailedError, call
from benchmarks.race import Progress
from benchmarks.stepping.problem import Problem
from taichi_msm.gradients.gradient import Adjoint
from taichi_msm.model.plan import Plan
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan, with_time
from taichi_msm.system import runtime
from taichi_msm.system.process import available_threads

# Points along a side, and steps; Taichi stores every step and its derivative.
SIZES = {61: 1000, 331: 100}

OURS, AUTODIFF = "taichi_msm", "Taichi autodiff"

# Largest difference, relative to the largest derivative.
TOLERANCE = 1e-9


def plan_of(points: int, steps: int) -> Plan:
    """Return a plan with one frame of `steps` steps."""
    problem = Problem(points)
    duration = steps * problem.grid.step
    times = {"duration": duration, "frames_per_second": 1 / duration, "step": problem.grid.step, "precision": "f64"}
    return make_plan(with_time(problem.scene, **times))


def ours(points: int, steps: int, rounds: int) -> dict[str, Any]:
    """Time a forward run and a gradient of this program [s]; return the times and the gradient."""
    device = runtime.start("cpu", available_threads())
    plan = plan_of(points, steps)
    forward, adjoint = Dynamics(plan, device), Adjoint(plan, device)
    rest = np.zeros((2, points, points, 3))
    gradient = rest[0, 1:, 1:, 0]

    def run() -> None:
        forward.restart(plan)
        forward.advance(steps)
        forward.displacement()

    def differentiate() -> None:
        nonlocal gradient
        position, cotangent = adjoint.run(), np.zeros_like(rest)
        cotangent[-1] = position[-1] - position[0]
        gradient = adjoint.backward(cotangent).maps["springs.map"]

    times = in_turn({"forward": run, "gradient": differentiate}, rounds)
    return {**times, "gradient_values": gradient.tolist()}


def autodiff(points: int, steps: int, rounds: int) -> dict[str, Any]:
    """Time the same with Taichi's automatic differentiation [s]."""
    from benchmarks.taichi_autodiff import Differentiated

    peer = Differentiated(Problem(points), steps, available_threads())
    times = in_turn({"forward": peer.run, "gradient": peer.differentiate}, rounds)
    return {**times, "gradient_values": peer.gradient().tolist()}


def measure(rounds: int, progress: Progress) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Time both for every size; a FailedError means that their gradients differ."""
    results: dict[str, dict[str, dict[str, list[float]]]] = {}
    for points, steps in SIZES.items():
        peers, gradients = {}, []
        for name, task in ((OURS, "ours"), (AUTODIFF, "autodiff")):
            progress(f"{points} x {points}, {name}")
            answer = call(f"benchmarks.gradients:{task}", points=points, steps=steps, rounds=rounds)
            gradients.append(np.array(answer.pop("gradient_values")))
            peers[name] = answer
        if not np.abs(gradients[0] - gradients[1]).max() <= TOLERANCE * np.abs(gradients[0]).max():
            raise FailedError(f"{points} x {points}: the gradients differ")
        results[f"{points} × {points}, {steps} steps"] = peers
    return results
