"""Plausibility of the units of machine tests, from their forces and those of the initial scene."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.fitting.machine_model import MachineProblem
from taichi_msm.fitting.parameters import rounded
from taichi_msm.machines.loading import Loading
from taichi_msm.machines.titles import GRAVITY, UNITS
from taichi_msm.model.tools import SolidTool
from taichi_msm.scene.sheet import Foundation

# Young's moduli of soft tissue [Pa], and a typical one; largest pressure under a tool [Pa].
MIN_YOUNG, MAX_YOUNG, TYPICAL_YOUNG, MAX_PRESSURE = 100.0, 1e8, 1e5, 1e6

# Ratios of units that are confused.
RATIOS = (1000.0, 1 / 1000, GRAVITY, 1 / GRAVITY)


def unit_notes(problem: MachineProblem, predicted: Array) -> Iterator[str]:
    """Yield a warning for every test whose stiffness or pressure is that of no tissue, with another unit if one helps.

    `predicted`: forces of the initial scene [N], shape (frames of all tests, 1).
    """
    start, tissue = 0, problem.scene.tissue
    for loading in problem.tests:
        forces = predicted[start : start + len(loading.force), 0]
        start += len(loading.force)
        if tissue is not None and loading.test.columns and forces.any():
            foundation = tissue.foundation
            young = max(tissue.young, foundation.young if isinstance(foundation, Foundation) else 0.0)
            young *= float(np.linalg.norm(loading.force) / np.linalg.norm(forces))
            yield from _note(problem, loading, young, forces)


def _note(problem: MachineProblem, loading: Loading, young: float, predicted: Array) -> Iterator[str]:
    """Yield a warning about a Young's modulus [Pa] or a pressure beyond their limits."""
    travel, tool = loading.travel(), problem.approach.tool
    reach, half = float(travel.max()), float(np.interp(0.5 * travel.max(), *_rise(travel, predicted)))
    # Forces grow as a power of the travel.
    power = math.log2(max(float(predicted.max()), 1e-300) / max(half, 1e-300))

    def pressure(travel_m: float) -> float:
        if not isinstance(tool, SolidTool):
            return 0.0  # Tendons bear more.
        depth = min(travel_m, tool.radius) if tool.shape.is_round else tool.radius
        return loading.peak / (math.pi * depth * (2 * tool.radius - depth))

    def is_plausible(modulus: float, pressure_pa: float) -> bool:
        return MIN_YOUNG <= modulus <= MAX_YOUNG and pressure_pa <= MAX_PRESSURE

    if is_plausible(young, pressure(reach)):
        return
    choices = []
    for quantity, column in zip(UNITS, loading.test.columns, strict=True):
        for unit, scale in UNITS[quantity].items() if quantity != "time" else ():
            ratio = scale / column.scale
            if any(math.isclose(ratio, known, rel_tol=1e-6) for known in RATIOS):
                is_force = quantity == "force"
                modulus = young * (ratio if is_force else ratio ** -min(max(power, 1.0), 3.0))
                other_pressure = ratio * pressure(reach) if is_force else pressure(ratio * reach)
                if is_plausible(modulus, other_pressure):
                    option = f'--columns "{quantity}={column.choice}, {unit}"'
                    text = f"if the column {column.title!r} is in {unit}, read it by {option}"
                    choices.append((abs(math.log(modulus / TYPICAL_YOUNG)), text))
    remedy = min(choices)[1] if choices else "check the units of depth and force, and the scene"
    if MIN_YOUNG <= young <= MAX_YOUNG:
        pressure_mpa = rounded(pressure(reach) / 1e6)
        fault = f"the pressure under the tool is about {pressure_mpa} MPa, above {MAX_PRESSURE / 1e6:g} MPa"
    else:
        limits = f"{MIN_YOUNG:g} Pa to {MAX_YOUNG / 1e6:g} MPa"
        fault = f"the tissue has a Young's modulus of about {rounded(young)} Pa, outside {limits}"
    yield f"{loading.test.name}: {fault}; {remedy}"


def _rise(travel: Array, forces: Array) -> tuple[Array, Array]:
    """Return increasing travels up to the largest, and the forces there."""
    end = int(travel.argmax()) + 1
    return np.maximum.accumulate(travel[:end]), forces[:end]
