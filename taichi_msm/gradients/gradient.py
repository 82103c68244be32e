"""A sheet and its adjoint: where it goes, and the derivatives of a loss of that by all numbers of its scene.

The gradient of a loss by the numbers of a scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, MsmError, Pause, SceneError, are_numbers, as_array
from taichi_msm.gradients.chain_rule import Derivatives, scene_derivatives
from taichi_msm.gradients.motion import MotionAdjoint, motion_bytes
from taichi_msm.gradients.rest import RestAdjoint
from taichi_msm.load.check import checked
from taichi_msm.load.resolve import resolve
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import stable_step
from taichi_msm.system import runtime
from taichi_msm.system.process import available_memory
from taichi_msm.system.runtime import Device

Array = NDArray[np.float64]

# Arrays of the positions of every frame at one time: displacements, positions, the loss's derivative, and their copies.
FRAME_COPIES = 4

# Bytes per point of a sparse solution at rest: 10,400 were measured with 81 x 81 points, 13,600 with 161 x 161.
SOLUTION_BYTES_PER_NODE = 14_000


def require_differentiable(plan: Plan) -> None:
    """Make sure that a scene has a gradient; SceneError: it has tools with a path."""
    for tool in plan.tools:
        said = "a tool with a path has no gradient, as points meet and leave it; fit such scenes by differences"
        raise SceneError([f"probes.{tool.probe}.path: {said}"])


def with_stiffness_map(plan: Plan) -> Plan:
    """Give a plan a map of the stiffness, of factors 1 where it has none, and steps in f64."""
    material, (rows, cols) = plan.material, plan.scene.sheet.points
    factors = np.ones((rows - 1, cols - 1)) if material.factors is None else material.factors
    return replace(plan.with_grid(precision="f64"), material=replace(material, factors=factors))


def _require_memory(plan: Plan) -> None:
    """Raise SceneError unless the adjoint and the positions of every frame, of which there are some copies, fit."""
    frames, points = plan.grid.frames + 1, math.prod(plan.scene.sheet.points)
    needed = FRAME_COPIES * 3 * 8 * frames * points
    needed += SOLUTION_BYTES_PER_NODE * points if plan.scene.time.at_rest else motion_bytes(plan)
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
        self._plan = with_stiffness_map(plan)
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
        return scene_derivatives(plan, *self._sheet.backward(np.asarray(slope, float), pause))

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


# Gives the value of a loss and its derivative by the positions, both of the positions of every frame.
Loss = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class Gradient(Derivatives):
    """A loss and its derivatives by the numbers of a scene; `numbers` and `maps` as below.

    Attributes:
        numbers: derivatives by the paths of keys: by material numbers that are not 0, such as tissue.young; by the
            components of a force, such as probes.0.total, shape (3,); by the percents of a load's keys, such as
            probes.0.load, shape (keys,); and by across and down of a control point, such as probes.0.at, shape (2,), or
            (keys, 2) where it has keys.
        maps: derivatives by the factors of maps, also where the scene has none, which is a factor of 1 everywhere:
            tissue.map or springs.map, of every cell, shape (rows - 1, cols - 1); with a foundation also
            tissue.foundation_map, of every point, shape (rows, cols).
        value: of the loss.
    """

    value: float


def gradient(scene: Scene | Mapping[str, Any], loss: Loss, threads: int | None = None) -> Gradient:
    """Differentiate a loss of where the points go by the numbers of a scene, in f64, exactly but for rounding.

    The steps are as the scene's numbers make them, and do not change with them. Neither sizes, times nor radii have
    derivatives. A scene with tolerances is resolved first.

    Args:
        scene: what `load_scene` returned, or the same as a mapping.
        loss: takes the positions of every frame [m], shape (F + 1, rows, cols, 3), and returns its value and its
            derivative by them, an array of their shape.
        threads: number of CPU threads; None takes every core.

    Raises:
        SceneError: when the scene cannot be run, or a tool has a path.
        ArgumentError: when the loss returns something else.
        DivergedError: when the simulation diverges.
        MsmError: when a sheet at rest has no stiffness against some motion.

    Example:
        >>> from taichi_msm import gradient, load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [21, 21], "time.duration": 0.4})
        >>> def depth(position):
        ...     slope = 0 * position
        ...     slope[-1, 10, 10, 2] = -1
        ...     return -position[-1, 10, 10, 2], slope
        >>> found = gradient(scene, depth)
        >>> sorted(found.maps)
        ['tissue.foundation_map', 'tissue.map']
        >>> bool(found.numbers["tissue.young"] < 0 < found.numbers["probes.0.load"][1])
        True
    """
    if not callable(loss):
        raise ArgumentError(f"loss: {loss!r}; take a function of the positions of every frame")
    plan = checked(scene)
    require_differentiable(plan)
    device = runtime.start("cpu", threads)
    adjoint = Adjoint(resolve(plan, device).plan, device)
    position = adjoint.run()
    position.flags.writeable = False
    returned = loss(position)
    if not (isinstance(returned, tuple) and len(returned) == 2):
        said = f"returned {type(returned).__name__}; return a pair, its value and its derivative by the positions"
        raise ArgumentError(f"loss: {said}")
    value, slope = returned
    given = as_array(value, "loss")
    if not are_numbers(given, ()) or not np.isfinite(given):
        said = f"an array of shape {given.shape}" if given.ndim else repr(value)
        raise ArgumentError(f"loss: its value is {said}; return a finite number")
    found = adjoint.backward(slope)
    return Gradient(found.numbers, found.maps, float(value))
