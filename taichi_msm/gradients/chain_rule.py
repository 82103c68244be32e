"""Chain rule from the coefficients of a sheet to the numbers of its scene.

Closed forms lead from the scene to a `Material` (`derive` of every term), and on to the coefficients of a time step
(`Plan.step_coefficients`). Complex steps differentiate them, exactly but for rounding: f(x + i h) is f(x) + i h f'(x)
with an h so small that its square vanishes. Loads are linear in their percents and in the components of the force,
control points in their keyframes. The derivative with respect to one of these values therefore follows from a schedule
with 1 for this value and 0 for all others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from taichi_msm.arithmetic import Array
from taichi_msm.laws import law_of
from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan, ProbeSegment
from taichi_msm.model.tool_force import control_points
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import Section
from taichi_msm.scene.sheet import Foundation
from taichi_msm.scene.tools import Probe
from taichi_msm.terms import derive_material
from taichi_msm.terms.springs import spring_stiffness

# Imaginary part of the complex steps.
COMPLEX_STEP = 1e-60


@dataclass
class SheetGradient:
    """Derivatives of a loss with respect to the coefficients of a sheet; the comments name the coefficients."""

    springs: tuple[Array, Array, Array]  # k - tau of every spring, shapes as from `springs.spring_stiffness`
    tensions: Array  # tau of springs along rows, along columns and along diagonals at constant k - tau, shape (3,)
    foundation: Array  # log K, the foundation stiffness of every mass point, shape (rows, cols)
    bending: float  # logarithm of the bending stiffness
    stiffening: Array  # log m and shape of the law of springs, () without a law
    foundation_stiffening: Array  # log m and shape of the law of the foundation
    keep: float = 0.0  # factor `keep` of the steps
    gain: float = 0.0  # logarithm of the gain of all steps but step 0
    first_gain: float = 0.0  # logarithm of the gain of step 0

    def work(self, plan: Plan) -> float:
        """Return p . F of internal forces F, the derivative with respect to the logarithm of their common factor."""
        factors, material = plan.material.factors, plan.material
        assert factors is not None
        total = float(self.tensions @ material.tensions) + float(self.foundation.sum()) + self.bending
        stiffness = spring_stiffness(material, factors)
        for by_spring, k, tension in zip(self.springs, stiffness, material.tensions, strict=True):
            total += float((by_spring * (k - tension)).sum())
        return total


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a loss with respect to the numbers of a scene.

    Attributes:
        numbers: derivatives by key: material numbers other than 0, such as tissue.young; the components of a force,
            such as probes.0.total, shape (3,); the percents of a load, such as probes.0.load, shape (keyframes,); and
            across and down of a control point, such as probes.0.at, shape (2,), or (keyframes, 2) for a moving one.
        maps: derivatives by key: the stiffness factors of the cells, tissue.map or springs.map, shape (rows - 1,
            cols - 1); and of a foundation its factors at the mass points, tissue.foundation_map, shape (rows, cols).
            The factors are 1 in a scene without this map.
    """

    numbers: dict[str, float | Array]
    maps: dict[str, Array]


def scene_derivatives(plan: Plan, gradient: SheetGradient, loads: LoadGradient) -> Derivatives:
    """Apply the chain rule to derivatives by the coefficients and the loads of a sheet with a stiffness map."""
    material, kind = plan.material, plan.scene.kind
    assert material.factors is not None
    by_coefficient = _coefficient_gradient(plan, gradient)
    numbers: dict[str, float | Array] = {}
    for key, value in _material_numbers(plan.scene):
        perturbed = _sheet_coefficients(plan, _with_value(plan.scene, key, value + 1j * COMPLEX_STEP))
        numbers[key] = float(by_coefficient @ perturbed.imag) / COMPLEX_STEP
    maps = {f"{kind}.map": _gradient_by_factors(plan, gradient)}
    if kind == "tissue" and material.virtual > 0:
        factors = material.virtual_factors
        maps["tissue.foundation_map"] = gradient.foundation / (1.0 if factors is None else factors)
    return Derivatives({**numbers, **loads.by_key}, maps)


def _sheet_coefficients(plan: Plan, scene: Scene) -> NDArray[Any]:
    """Return the coefficients of a sheet, real or complex, in the order of `_coefficient_gradient`."""
    material = derive_material(scene, {})
    springs = [material.across, material.down, material.shear, material.tension]
    steps = () if scene.time.at_rest else replace(plan, scene=scene, material=material).step_coefficients
    laws = (law for law in (material.stiffening, material.virtual_stiffening) if law)
    of_laws = [number for law in laws for number in (law.scale, *law.shape)]
    return np.array([*springs, material.virtual, material.bending, *of_laws, *steps])


def _coefficient_gradient(plan: Plan, gradient: SheetGradient) -> Array:
    """Return the derivatives with respect to the coefficients of a sheet, in the order of `_sheet_coefficients`."""
    material = plan.material
    assert material.factors is not None
    unit = spring_stiffness(replace(material, across=1.0, down=1.0, shear=1.0), material.factors)
    # The derivatives with respect to tau = k e at constant k: k - tau decreases with tau.
    tensions = gradient.tensions - [float(by_spring.sum()) for by_spring in gradient.springs]
    # A stiffness changes the k of its springs, and their tau = k e.
    springs = [
        float((by_spring * share).sum()) + material.tension * tension
        for by_spring, share, tension in zip(gradient.springs, unit, tensions, strict=True)
    ]
    derivatives = [*springs, float(tensions @ (material.across, material.down, material.shear))]
    derivatives.append(_from_logarithm(float(gradient.foundation.sum()), material.virtual))
    derivatives.append(_from_logarithm(gradient.bending, material.bending))
    laws = (material.stiffening, gradient.stiffening), (material.virtual_stiffening, gradient.foundation_stiffening)
    for law, by_numbers in laws:
        if law:
            derivatives += [_from_logarithm(by_numbers[0], law.scale), *by_numbers[1 : 1 + law.law.shape_count]]
    if not plan.scene.time.at_rest:
        _, gain, first_gain = plan.step_coefficients
        derivatives += [gradient.keep, gradient.gain / gain, gradient.first_gain / first_gain]
    return np.array(derivatives)


def _from_logarithm(derivative: float, value: float) -> float:
    """Convert a derivative with respect to the logarithm of a value to that with respect to the value."""
    return derivative / value if value else 0.0


def _gradient_by_factors(plan: Plan, gradient: SheetGradient) -> Array:
    """Return the derivatives with respect to the factors of the cells, by the transpose of `spring_stiffness`."""
    material = plan.material
    along_rows, along_columns = gradient.springs[0].copy(), gradient.springs[1].copy()
    if not material.by_area:
        along_rows[[0, -1]] *= 2
        along_columns[:, [0, -1]] *= 2
    across = material.across / 2 * (along_rows[:-1] + along_rows[1:])
    down = material.down / 2 * (along_columns[:, :-1] + along_columns[:, 1:])
    return across + down + material.shear * gradient.springs[2]


def _material_numbers(scene: Scene) -> Iterator[tuple[str, float]]:
    """Yield the keys and values of the material numbers that have a derivative."""
    tissue = scene.tissue
    if tissue is None:
        static, dynamic = ["springs.structural", "springs.shear", "springs.virtual"], ["sheet.mass", "damping"]
    else:
        foundation, laws = ["foundation"], _law_keys("stiffening", tissue.stiffening)
        if isinstance(tissue.foundation, Foundation):
            foundation = ["foundation.young", "foundation.depth", *_law_keys("foundation", tissue.foundation)]
        names = ["young", "thickness", *foundation, "pretension", "bending", *laws]
        static, dynamic = [f"tissue.{name}" for name in names], ["tissue.density", "tissue.damping"]
    for key in static if scene.time.at_rest else static + dynamic:
        value = attrgetter(key)(scene)
        if value and not isinstance(value, str):
            yield key, value


def _law_keys(name: str, section: Section | None) -> list[str]:
    """Return the keys of the numbers of a section's law; a linear one has no derivatives by them."""
    law = law_of(section)
    return [f"{name}.{key}" for key in (law.law.scale, *law.law.keys)] if law else []


def _with_value(section: Any, key: str, value: complex) -> Any:
    """Return a copy of a section with another number, without validation."""
    assert isinstance(section, Section)
    name, _, inner = key.partition(".")
    changed = {name: _with_value(getattr(section, name), inner, value) if inner else value}
    return BaseModel.model_copy(section, update=changed)


class LoadGradient:
    """Derivatives with respect to the loads, by the keys of `Derivatives.numbers`, accumulated over blocks of steps."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self.by_key: dict[str, Array] = {}
        self._slots: dict[int, list[int]] = {}  # of every probe, in the order of probes
        for n, slot in sorted(enumerate(plan.slots), key=lambda item: item[1].probe):
            self._slots.setdefault(slot.probe, []).append(n)
        for index in self._slots:
            probe = plan.scene.probes[index]
            self.by_key[f"probes.{index}.{_force_key(probe)}"] = np.zeros(3)
            self.by_key[f"probes.{index}.load"] = np.zeros(len(probe.load))
            self.by_key[f"probes.{index}.at"] = np.zeros((*np.shape(probe.at)[:-1], 2))

    def add(self, schedule_of: Callable[[Plan], Schedule], by_slot: Array, times: tuple[float, float]) -> None:
        """Add the derivatives of a block of steps, whose loads are in a time interval [s].

        `schedule_of` returns the schedule of these steps for a plan with other loads. `by_slot` are the derivatives
        with respect to the force (3) and the control point (2) of every slot, shape (steps, slots, 5).
        """
        height, width = self._plan.scene.sheet.size
        for index, slots in self._slots.items():
            probe, by_force, by_point = self._plan.scene.probes[index], by_slot[:, slots, :3], by_slot[:, slots, 3:]
            unit = schedule_of(self._with_probe(index, {_force_key(probe): (1.0, 1.0, 1.0)})).strength
            self.by_key[f"probes.{index}.{_force_key(probe)}"] += (by_force * unit).sum(axis=(0, 1))
            keys = [time for time, _ in probe.load]
            for n in _active_keys(keys, times):
                load = tuple((time, float(m == n)) for m, time in enumerate(keys))
                unit = schedule_of(self._with_probe(index, {"load": load})).strength
                self.by_key[f"probes.{index}.load"][n] += (by_force * unit).sum()
            by_position = self.by_key[f"probes.{index}.at"].reshape(-1, 2)
            keys = control_points(probe, self._plan.scene.sheet)[0].tolist()
            # Unlike the load, the control point is not 0 before the first keyframe.
            for n in _active_keys(keys, times, before=True):
                share = schedule_of(self._with_unit_position(index, n)).point
                by_position[n] += (by_point * share).sum(axis=(0, 1)) * (width, -height)

    def _with_probe(self, index: int, changes: dict[str, Any]) -> Plan:
        """Return a plan with a changed probe, and with the slots of this probe only."""
        scene, slots = self._plan.scene, self._plan.slots
        probes = list(scene.probes)
        probes[index] = probes[index].model_copy(update=changes)
        changed = scene.model_copy(update={"probes": tuple(probes)})
        return replace(self._plan, scene=changed, slots=tuple(slots[n] for n in self._slots[index]))

    def _with_unit_position(self, index: int, key: int) -> Plan:
        """Return a plan with the control point of a probe at (1, 1) m in one keyframe, and at 0 in all others."""
        plan, slots = self._with_probe(index, {}), []
        for slot in plan.slots:
            ends = np.cumsum([len(segment.times) for segment in slot.segments])
            unit = np.zeros((ends[-1], 2))
            unit[key] = 1.0
            points = np.split(unit, ends[:-1])
            segments = map(ProbeSegment, (segment.times for segment in slot.segments), points)
            slots.append(replace(slot, segments=tuple(segments)))
        return replace(plan, slots=tuple(slots))


def _force_key(probe: Probe) -> str:
    return "force" if probe.total is None else "total"


def _active_keys(keys: list[float], times: tuple[float, float], *, before: bool = False) -> Iterator[int]:
    """Yield the indices of the keyframes that affect a piecewise linear function in a time interval.

    The function is constant after the last keyframe. Before the first one it is 0, or with `before` constant.
    """
    for n in range(len(keys)):
        begin = keys[max(0, n - 1)] if n or not before else -np.inf
        end = keys[n + 1] if n + 1 < len(keys) else np.inf
        if begin <= times[1] and times[0] <= end:
            yield n
