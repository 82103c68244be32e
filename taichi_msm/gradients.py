"""The gradient of a loss by the numbers of a scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arguments import are_numbers, as_array
from taichi_msm.errors import ArgumentError
from taichi_msm.physics.adjoint import Adjoint, require_differentiable
from taichi_msm.physics.slopes import Derivatives
from taichi_msm.scene import Scene
from taichi_msm.scenefile.resolve import resolve
from taichi_msm.scenefile.validation import checked
from taichi_msm.system import runtime

Array = NDArray[np.float64]

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
