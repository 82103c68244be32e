"""A sheet and its adjoint: where it goes, and the derivatives of a loss of that by all numbers of its scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arguments import are_numbers, as_array
from taichi_msm.errors import ArgumentError, MsmError, SceneError
from taichi_msm.physics.adjoint_motion import MotionAdjoint, motion_bytes
from taichi_msm.physics.adjoint_rest import RestAdjoint
from taichi_msm.physics.lattice import rest_positions
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import stable_step
from taichi_msm.physics.slopes import Derivatives, derivatives
from taichi_msm.progress import Pause
from taichi_msm.system.resources import available_memory
from taichi_msm.system.runtime import Device

Array = NDArray[np.float64]

# Arrays of the positions of every frame at one time: displacements, positions, the loss's derivative, and their copies.
FRAME_COPIES = 4

# Bytes per point of a sparse solution at rest: 10,400 were measured with 81 x 81 points, 13,600 with 161 x 161.
SOLUTION_BYTES = 14_000


def require_differentiable(plan: Plan) -> None:
    """Make sure that a scene has a gradient; SceneError: it has tools with a path."""
    for tool in plan.tools:
        said = "a tool with a path has no gradient, as points meet and leave it; fit such scenes by differences"
        raise SceneError([f"probes.{tool.probe}.path: {said}"])


def mapped(plan: Plan) -> Plan:
    """Give a plan a map of the stiffness, of factors 1 where it has none, and steps in f64."""
    material, (rows, cols) = plan.material, plan.scene.sheet.points
    factors = np.ones((rows - 1, cols - 1)) if material.factors is None else material.factors
    return replace(plan.with_grid(precision="f64"), material=replace(material, factors=factors))


def _require_memory(plan: Plan) -> None:
    """Raise SceneError unless the adjoint and the positions of every frame, of which there are some copies, fit."""
    frames, points = plan.grid.frames + 1, math.prod(plan.scene.sheet.points)
    needed = FRAME_COPIES * 3 * 8 * frames * points
    needed += SOLUTION_BYTES * points if plan.scene.time.at_rest else motion_bytes(plan)
    if needed > (free := available_memory()):
        raise SceneError([
            f"a gradient by {points} points in {frames} frames and {plan.grid.steps} steps takes about "
            f"{needed / 2**30:.3g} GiB of memory, and {free / 2**30:.3g} GiB is free; take fewer points, or a shorter "
            "time.duration"
        ])  # fmt: skip


class Adjoint:
    """A compiled sheet that is run and differentiated any number of times, in f64; a map of its stiffness may change.

    Args:
        plan: of the scene.
        device: a CPU.
        cores: number of cores that it may use; None: all.

    Raises:
        SceneError: when a probe has a path, or the memory does not suffice.
    """

    def __init__(self, plan: Plan, device: Device, cores: int | None = None) -> None:
        require_differentiable(plan)
        self._plan = mapped(plan)
        _require_memory(self._plan)
        self._sheet: MotionAdjoint | RestAdjoint
        if plan.scene.time.at_rest:
            self._sheet = RestAdjoint(self._plan, device)
        else:
            self._sheet = MotionAdjoint(self._plan, device, cores=cores)
        self._ran = False

    def run(self, factors: Array | None = None, pause: Pause = lambda: None) -> Array:
        """Run the scene.

        Args:
            factors: of the stiffness of every cell, shape (rows - 1, cols - 1), in the place of those of the scene.
            pause: called some times a second; what it raises stops here, and nothing has run.

        Returns:
            Positions of every frame [m], shape (F + 1, rows, cols, 3).

        Raises:
            ArgumentError: when the factors are not positive numbers of that shape, or too large for the step.
            DivergedError: when the simulation diverges.
        """
        self._ran = False
        plan = self._plan if factors is None else self._with_factors(factors)
        self._sheet.restart(plan)
        displacements = self._sheet.run(pause)
        self._ran = True
        return rest_positions(plan.scene.sheet) + displacements

    def backward(self, slope: Array, pause: Pause = lambda: None) -> Derivatives:
        """Differentiate a loss at the last `run`.

        Args:
            slope: derivative of the loss by the positions of every frame, shape (F + 1, rows, cols, 3).
            pause: called some times a second; what it raises stops here.

        Raises:
            ArgumentError: when it is not an array of finite numbers of that shape.
            MsmError: when nothing has run.
        """
        if not self._ran:
            raise MsmError("nothing has run yet that could be differentiated; call run first")
        plan, slope = self._sheet.plan, as_array(slope, "slope")
        shape = plan.grid.frames + 1, *plan.scene.sheet.points, 3
        if not are_numbers(slope, shape) or not np.isfinite(slope).all():
            raise ArgumentError(
                f"the loss's derivative: {slope.dtype} of shape {slope.shape}; take finite numbers of shape {shape}, "
                "that of the positions"
            )
        return derivatives(plan, *self._sheet.backward(np.asarray(slope, float), pause))

    def _with_factors(self, factors: Array) -> Plan:
        """Change the map of the stiffness."""
        plan, factors = self._plan, as_array(factors, "factors")
        assert plan.material.factors is not None
        shape, least = plan.material.factors.shape, plan.material.tension
        if not are_numbers(factors, shape) or not (np.isfinite(factors) & (factors > least)).all():
            raise ArgumentError(f"factors: take numbers above {least:g}, of shape {shape}")
        material = replace(plan.material, factors=np.asarray(factors, float))
        limit = stable_step(material, plan.scene.sheet, plan.scene.time.damping_difference)
        if not plan.scene.time.at_rest and plan.grid.step > limit:
            raise ArgumentError(
                f"factors: up to {factors.max():g} need a step of {limit:.6g} s or less, and the scene's is "
                f"{plan.grid.step:.6g} s; set a smaller time.step"
            )
        return replace(plan, material=material, stable_step=limit)
