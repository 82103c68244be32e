"""Gradient of a loss, a function of the positions at all frames, with respect to the numbers of a scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ArgumentError, Pause, SceneError, as_array, is_real_array
from taichi_msm.gradients.chain_rule import Derivatives, scene_derivatives
from taichi_msm.gradients.motion import MotionAdjoint, motion_bytes
from taichi_msm.gradients.rest import RestAdjoint
from taichi_msm.load.check import check_scene
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import stable_step
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory
from taichi_msm.system.runtime import Device
from taichi_msm.terms import build_terms

_NUMBERS = "fit numbers instead of a map, or take finite differences"


def require_differentiable(plan: Plan) -> None:
    """Raise a SceneError if a sheet is curved or has a mask, or for a tool with a path or a term without a gradient."""
    if plan.scene.sheet.surface:
        reason = "a sheet that is curved at rest has no gradient"
        raise SceneError([f"sheet.surface: {reason}; {_NUMBERS}"])
    if plan.scene.sheet.mask:
        raise SceneError([f"sheet.mask: a sheet with a mask has no gradient; {_NUMBERS}"])
    for tool in plan.tools:
        reason = "a tool with a path has no gradient, as its contact begins and ends"
        raise SceneError([f"probes.{tool.probe}.path: {reason}; {_NUMBERS}"])
    for term in build_terms(plan):
        if not term.has_gradient:
            reason = "has no gradient, which the fit of a map needs; remove it, or fit numbers"
            raise SceneError([f"{term.key}: {reason}"])


def with_stiffness_map(plan: Plan) -> Plan:
    """Return a plan in f64 with a stiffness map; its factors are 1 for a scene without a map."""
    material, (rows, cols) = plan.material, plan.scene.sheet.points
    factors = np.ones((rows - 1, cols - 1)) if material.factors is None else material.factors
    return replace(plan.with_grid(precision="f64"), material=replace(material, factors=factors))


def _require_memory(plan: Plan) -> None:
    """Raise a SceneError unless the adjoint and the positions of all frames fit in memory."""
    frames, points = plan.grid.frames + 1, math.prod(plan.scene.sheet.points)
    # Four arrays of all positions: displacements, positions, the derivative of the loss, and a copy.
    needed = 4 * 3 * 8 * frames * points
    # A sparse solution takes 10,400 bytes per mass point with 81 x 81 mass points, and 13,600 with 161 x 161.
    needed += 14_000 * points if plan.scene.time.at_rest else motion_bytes(plan)
    if needed > (free := available_memory()):
        raise SceneError([
            f"a gradient with {points} points, {frames} frames and {plan.grid.steps} steps takes about "
            f"{needed / 2**30:.3g} GiB of memory, and {free / 2**30:.3g} GiB is free; take fewer points, or a shorter "
            "time.duration"
        ])  # fmt: skip


class Adjoint:
    """Differentiable simulation in f64 on a CPU, compiled once for runs with several stiffness maps.

    A scene without a gradient, or too large for the memory, raises a SceneError.
    """

    def __init__(self, plan: Plan, device: Device, cores: int | None = None) -> None:
        require_differentiable(plan)
        self._plan = with_stiffness_map(plan)
        _require_memory(self._plan)
        self._sheet: MotionAdjoint | RestAdjoint
        if plan.scene.time.at_rest:
            self._sheet = RestAdjoint(self._plan, device)
        else:
            self._sheet = MotionAdjoint(self._plan, device, cores=cores)

    def run(self, factors: Array | None = None, pause: Pause = lambda: None, scene: Scene | None = None) -> Array:
        """Run the scene; return the positions at every frame [m], shape (F + 1, rows, cols, 3).

        `factors` are the stiffness factors of the cells, shape (rows - 1, cols - 1), for which the step is stable, and
        `scene` is the plan's with other forces of its probes; None for those of the plan. An exception from `pause`
        ends the run, without derivatives.
        """
        plan = self._plan
        if factors is not None:
            material = replace(plan.material, factors=factors)
            limit = stable_step(material, plan.scene.sheet, plan.scene.time.damping_difference)
            plan = replace(plan, material=material, stable_step=limit)
        plan = plan if scene is None else replace(plan, scene=scene)
        self._sheet.restart(plan)
        return rest_positions(plan.scene.sheet) + self._sheet.run(pause)

    def backward(self, by_position: Array, pause: Pause = lambda: None) -> Derivatives:
        """Differentiate a loss at the last `run`, from its derivative by positions, shape (F + 1, rows, cols, 3)."""
        return scene_derivatives(self._sheet.plan, *self._sheet.backward(by_position, pause))


# Loss, a function of the positions at every frame. Returns its value, and its derivative in the shape of the positions.
Loss = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class Gradient(Derivatives):
    """Value of a loss, and its derivatives with respect to the numbers of a scene, as in `Derivatives`."""

    value: float


def gradient(scene: Scene | Mapping[str, Any], loss: Loss, threads: int | None = None) -> Gradient:
    """Differentiate a loss with respect to the numbers of a scene, in f64, exactly but for rounding.

    The time step follows from the scene and is held constant. There are no derivatives with respect to sizes, times or
    radii. A scene with tolerances is resolved first.

    Args:
        scene: scene from `load_scene`, or a mapping of its keys.
        loss: function of the positions at every frame [m], shape (F + 1, rows, cols, 3). It returns its value and its
            derivative with respect to the positions, an array of the same shape.
        threads: number of CPU threads; None for all cores.

    Returns:
        The value of the loss and its derivatives.

    Raises:
        SceneError: when the scene cannot be run, a tool has a path, or the sheet has a surface or a mask.
        ArgumentError: when the loss does not return a number and such an array.
        DivergedError: when the simulation diverges.
        MsmError: when the stiffness of a quasi-static sheet is singular.

    Example:
        >>> from taichi_msm import gradient, load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [21, 21], "time.duration": 0.4})
        >>> def depth(position):
        ...     slope = 0 * position
        ...     slope[-1, 10, 10, 2] = -1
        ...     return -position[-1, 10, 10, 2], slope
        >>> result = gradient(scene, depth)
        >>> sorted(result.maps)
        ['tissue.foundation_map', 'tissue.map']
        >>> bool(result.numbers["tissue.young"] < 0 < result.numbers["probes.0.load"][1])
        True
    """
    if not callable(loss):
        raise ArgumentError(f"loss: {loss!r}; take a function of the positions of every frame")
    plan = check_scene(scene)
    require_differentiable(plan)
    device = runtime.start("cpu", threads)
    adjoint = Adjoint(resolve(plan, device).plan, device)
    position = adjoint.run()
    position.flags.writeable = False
    returned = loss(position)
    if not (isinstance(returned, tuple) and len(returned) == 2):
        reason = f"returned {type(returned).__name__}; return a pair, its value and its derivative by the positions"
        raise ArgumentError(f"loss: {reason}")
    value, by_position = returned
    array = as_array(value, "loss")
    if not is_real_array(array, ()) or not np.isfinite(array):
        description = f"an array of shape {array.shape}" if array.ndim else repr(value)
        raise ArgumentError(f"loss: its value is {description}; return a finite number")
    slope = as_array(by_position, "slope")
    if not is_real_array(slope, position.shape) or not np.isfinite(slope).all():
        remedy = f"take finite numbers of shape {position.shape}, that of the positions"
        raise ArgumentError(f"the loss's derivative: {slope.dtype} of shape {slope.shape}; {remedy}")
    derivatives = adjoint.backward(np.asarray(slope, float))
    return Gradient(derivatives.numbers, derivatives.maps, float(value))
