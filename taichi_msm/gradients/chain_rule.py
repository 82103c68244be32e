"""Derivatives of a loss by the numbers that the steps of a sheet are made of, and by those of its scene.

From the scene to a `Material`, and on to what a step keeps and gains, lead short closed forms (`derive` of every term,
`damping.coefficients`). They are differentiated by complex steps, exact to the last digits: f(x + i h) is
f(x) + i h f'(x) with an h so small that its square vanishes. Loads are linear in percents, in components of forces, and
control points in their keys; so the derivative by one of these is what comes out for 1, with 0 for all others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan, ProbeSegment
from taichi_msm.model.tool_force import control_points
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import Section
from taichi_msm.scene.sheet import Foundation
from taichi_msm.scene.tools import Probe
from taichi_msm.terms import material_of
from taichi_msm.terms.damping import coefficients
from taichi_msm.terms.springs import stiffness

Array = NDArray[np.float64]

# The imaginary part of a complex step.
COMPLEX_STEP = 1e-60


@dataclass
class SheetGradient:
    """Derivatives by the numbers of a sheet."""

    # by k - tau of every spring: along rows, along columns, and of both diagonals of a cell; as in `springs.stiffness`
    springs: tuple[Array, Array, Array]
    tensions: Array  # by tau of each family, with k - tau as it is, shape (3,)
    held: Array  # by the logarithm of K of every point, shape (rows, cols)
    bent: float  # by the logarithm of the bending stiffness
    keep: float = 0.0  # by the factor `keep` of the steps
    gain: float = 0.0  # by the logarithm of their gain, after step 0
    first_gain: float = 0.0  # by that of the gain of step 0

    def work(self, plan: Plan) -> float:
        """Give the derivative by the logarithm of all forces of the sheet together."""
        factors, material = plan.material.factors, plan.material
        assert factors is not None
        total = float(self.tensions @ material.tensions) + float(self.held.sum()) + self.bent
        for slope, k, tension in zip(self.springs, stiffness(material, factors), material.tensions, strict=True):
            total += float((slope * (k - tension)).sum())
        return total


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a loss by the numbers of a scene.

    Attributes:
        numbers: by the paths of keys, such as tissue.young, probes.0.total (one for each component), probes.0.load (by
            the percent of each key), and probes.0.at (by across and down; of keys in rows of two). A material number
            that is 0 is not among them.
        maps: by the factor of every cell, `tissue.map` or `springs.map`, shape (rows - 1, cols - 1), and with a
            foundation by that of every point, `tissue.foundation_map`, shape (rows, cols); also where the scene has no
            such map, which is a factor of 1 everywhere.
    """

    numbers: dict[str, float | Array]
    maps: dict[str, Array]


def scene_derivatives(plan: Plan, slopes: SheetGradient, loads: LoadGradient) -> Derivatives:
    """Go from the numbers of a sheet to those of its scene."""
    material, kind = plan.material, plan.scene.kind
    assert material.factors is not None
    by_number = _gradient_by_numbers(plan, slopes)
    numbers: dict[str, float | Array] = {}
    for path in _paths(plan.scene):
        value = _value(plan.scene, path)
        changed = _sheet_numbers(plan, _with(plan.scene, path, value + 1j * COMPLEX_STEP))
        numbers[".".join(path)] = float(by_number @ changed.imag) / COMPLEX_STEP
    maps = {f"{kind}.map": _gradient_by_factors(plan, slopes)}
    if kind == "tissue" and material.virtual > 0:
        factors = material.virtual_factors
        maps["tissue.foundation_map"] = slopes.held / (1.0 if factors is None else factors)
    return Derivatives(numbers | loads.by_key, maps)


def _sheet_numbers(plan: Plan, scene: Scene) -> NDArray[Any]:
    """List the numbers of a sheet of which `_gradient_by_numbers` gives the derivatives; they may be complex."""
    one = material_of(scene, {})
    springs = [one.across, one.down, one.shear, one.tension]
    steps = () if scene.time.at_rest else coefficients(replace(plan, scene=scene, material=one))
    return np.array([*springs, one.virtual, one.bending, *steps])


def _gradient_by_numbers(plan: Plan, slopes: SheetGradient) -> Array:
    """List the derivatives by across, down, shear, tension, virtual, bending, keep, gain and the first gain."""
    material = plan.material
    assert material.factors is not None
    unit = stiffness(replace(material, across=1.0, down=1.0, shear=1.0), material.factors)
    # tau is a stiffness times the tension, and k - tau falls as it grows.
    tensions = slopes.tensions - [float(slope.sum()) for slope in slopes.springs]
    springs = [
        float((slope * share).sum()) + material.tension * tension
        for slope, share, tension in zip(slopes.springs, unit, tensions, strict=True)
    ]
    by = [*springs, float(tensions @ (material.across, material.down, material.shear))]
    by += [_by_log(float(slopes.held.sum()), material.virtual), _by_log(slopes.bent, material.bending)]
    if not plan.scene.time.at_rest:
        _, gain, first_gain = coefficients(plan)
        by += [slopes.keep, slopes.gain / gain, slopes.first_gain / first_gain]
    return np.array(by)


def _by_log(slope: float, value: float) -> float:
    return slope / value if value else 0.0


def _gradient_by_factors(plan: Plan, slopes: SheetGradient) -> Array:
    """Give the derivatives by the factors of the cells: `springs.stiffness` transposed."""
    material = plan.material
    along_rows, along_columns = slopes.springs[0].copy(), slopes.springs[1].copy()
    if not material.by_area:
        along_rows[[0, -1]] *= 2
        along_columns[:, [0, -1]] *= 2
    across = material.across / 2 * (along_rows[:-1] + along_rows[1:])
    down = material.down / 2 * (along_columns[:, :-1] + along_columns[:, 1:])
    return across + down + material.shear * slopes.springs[2]


def _paths(scene: Scene) -> Iterator[tuple[str, ...]]:
    """List the keys of the material that have a derivative."""
    names = ["young", "thickness", "foundation", "pretension", "bending"]
    moving: list[tuple[str, ...]] = [("tissue", "density"), ("tissue", "damping")]
    every: list[tuple[str, ...]] = [("tissue", name) for name in names]
    if scene.tissue is None:
        every = [("springs", name) for name in ("structural", "shear", "virtual")]
        moving = [("sheet", "mass"), ("damping",)]
    elif isinstance(scene.tissue.foundation, Foundation):
        every[2:3] = [("tissue", "foundation", "young"), ("tissue", "foundation", "depth")]
    for path in every if scene.time.at_rest else every + moving:
        value = _value(scene, path)
        if value and not isinstance(value, str):
            yield path


def _value(section: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        section = getattr(section, name)
    return section


def _with(section: Any, path: tuple[str, ...], value: complex) -> Any:
    """Change a number of a scene without checking it."""
    assert isinstance(section, Section)
    name, *inner = path
    changed = {name: _with(getattr(section, name), tuple(inner), value) if inner else value}
    return BaseModel.model_copy(section, update=changed)


class LoadGradient:
    """Derivatives by the loads of the probes, added up from some steps to the next.

    Attributes:
        by_key: derivatives by the paths of keys, as in `Derivatives`.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self.by_key: dict[str, float | Array] = {}
        self._own = {
            index: [n for n, slot in enumerate(plan.slots) if slot.probe == index]
            for index in sorted({slot.probe for slot in plan.slots})
        }
        for index in self._own:
            probe = plan.scene.probes[index]
            self.by_key[f"probes.{index}.{_force(probe)}"] = np.zeros(3)
            self.by_key[f"probes.{index}.load"] = np.zeros(len(probe.load))
            self.by_key[f"probes.{index}.at"] = np.zeros((*np.shape(probe.at)[:-1], 2))

    def add(self, schedule_of: Callable[[Plan], Schedule], pushes: Array, times: tuple[float, float]) -> None:
        """Add the derivatives by some steps.

        Args:
            schedule_of: gives the loads of these steps, of a plan with other loads.
            pushes: derivatives by the forces at the control points, and by the control points; (steps, slots, 5).
            times: no load before or after these times enters the steps [s].
        """
        height, width = self._plan.scene.sheet.size
        for index, own in self._own.items():
            probe, by_force, by_place = self._plan.scene.probes[index], pushes[:, own, :3], pushes[:, own, 3:]
            unit = schedule_of(self._with_probe(index, {_force(probe): (1.0, 1.0, 1.0)})).strength
            self._at(index, _force(probe))[:] += (by_force * unit).sum(axis=(0, 1))
            keys = [time for time, _ in probe.load]
            for n in _acting(keys, times):
                load = tuple((time, float(m == n)) for m, time in enumerate(keys))
                unit = schedule_of(self._with_probe(index, {"load": load})).strength
                self._at(index, "load")[n] += (by_force * unit).sum()
            places = self._at(index, "at").reshape(-1, 2)
            at = control_points(probe, self._plan.scene.sheet)[0].tolist()
            # A control point is held before its first key, too.
            for n in _acting(at, times, before=True):
                share = schedule_of(self._with_place(index, n)).point
                places[n] += (by_place * share).sum(axis=(0, 1)) * (width, -height)

    def _at(self, index: int, name: str) -> Array:
        slope = self.by_key[f"probes.{index}.{name}"]
        assert isinstance(slope, np.ndarray)
        return slope

    def _with_probe(self, index: int, changes: dict[str, Any]) -> Plan:
        """Change a probe, and leave the slots of the others out."""
        scene, slots = self._plan.scene, self._plan.slots
        probes = list(scene.probes)
        probes[index] = probes[index].model_copy(update=changes)
        changed = scene.model_copy(update={"probes": tuple(probes)})
        return replace(self._plan, scene=changed, slots=tuple(slots[n] for n in self._own[index]))

    def _with_place(self, index: int, key: int) -> Plan:
        """Put a key of a control point to (1, 1) m, all others to the middle; where it jumps stays as it is."""
        plan, slots = self._with_probe(index, {}), []
        for slot in plan.slots:
            ends = np.cumsum([len(segment.times) for segment in slot.segments])
            unit = np.zeros((ends[-1], 2))
            unit[key] = 1.0
            points = np.split(unit, ends[:-1])
            segments = [ProbeSegment(one.times, own) for one, own in zip(slot.segments, points, strict=True)]
            slots.append(replace(slot, segments=tuple(segments)))
        return replace(plan, slots=tuple(slots))


def _force(probe: Probe) -> str:
    return "force" if probe.total is None else "total"


def _acting(keys: list[float], times: tuple[float, float], *, before: bool = False) -> Iterator[int]:
    """List the keys of a piecewise linear function that matter between two times; the last holds on."""
    for n in range(len(keys)):
        begin = keys[max(0, n - 1)] if n or not before else -np.inf
        end = keys[n + 1] if n + 1 < len(keys) else np.inf
        if begin <= times[1] and times[0] <= end:
            yield n
