"""Mass points and springs given as arrays: fixed, light and absent ones, and a curved sheet, against the twin."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.loads import evaluate_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Springs, rectangle_shares, rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan, stable_step
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from taichi_msm.terms.elasticity import spring_families
from taichi_msm.terms.springs import assemble_springs, spring_ends
from tests import reference
from tests.reference.sheet import Sheet as TwinSheet
from tests.reference.sheet import Springs as TwinSprings
from tests.reference.sheet import sheet as twin_sheet

ROWS, COLS = 9, 11
TISSUE = {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 1e5, "damping": 30}
LOADS: Any = [
    {"at": [0.4, 0.6], "total": [0.1, 0, -0.4], "radius": 0.01, "load": [[0, 0], [0.05, 100]]},
    {"at": [[0, 0.1, 0.2], [0.1, 0.9, 0.7]], "total": [0, 0, 0.2], "radius": 0.005, "load": [[0, 100]]},
]


def plan_with(shares: Any = None, springs: Springs | None = None, fixed: Any = None, **changes: Any) -> Plan:
    """Plan of a free sheet with other mass points or springs, at half its stability limit."""
    made = Scene(
        output=[],
        sheet={"points": [ROWS, COLS], "size": [0.08, 0.1], "fixed": ["left"]},
        tissue={**TISSUE, **changes.pop("tissue", {})},
        probes=changes.pop("probes", LOADS),
        time={"duration": 0.1, "frames_per_second": 50, "precision": "f64", **changes},
    )
    plan = make_plan(made)
    material = replace(plan.material, shares=shares, springs=springs)
    limit = stable_step(material, made.sheet, "central")
    plan = replace(plan, material=material, stable_step=limit, fixed=plan.fixed if fixed is None else fixed)
    return plan if made.time.at_rest else plan.with_grid(steps_per_frame=int(np.ceil(2 / 50 / limit)))


def assembled(plan: Plan) -> TwinSheet:
    """Twin of a sheet, with the mass points and the springs of a plan."""
    own = twin_sheet(plan.scene)
    if plan.material.shares is not None:
        ratio = plan.material.shares / own.share
        scaled = {name: getattr(own, name) * ratio for name in ("mass", "drag", "virtual", "share")}
        own = own._replace(**scaled)
    springs = plan.material.springs
    if springs is None:
        return own
    rest = rest_positions(plan.scene.sheet) if springs.rest is None else springs.rest
    families = []
    for k, tau, (start, end) in zip(springs.stiffness, springs.tension, spring_ends((ROWS, COLS)), strict=True):
        offset = rest[end] - rest[start]
        length = np.linalg.norm(offset, axis=-1)
        unstretched = length * (1 - np.divide(tau, k, out=np.zeros_like(k), where=k > 0))
        families.append(TwinSprings(start, end, offset, length, k, unstretched))
    return own._replace(springs=tuple(families))


def random_springs(plan: Plan, *, tense: bool = False, curved: bool = False) -> Springs:
    """Springs of random stiffness, 5 % of them absent."""
    rng, own = np.random.default_rng(5), assemble_springs(plan.material, plan.scene.sheet)
    stiffness = [k * rng.uniform(0.5, 2, k.shape) * (rng.random(k.shape) > 0.05) for k in own.stiffness]
    rest = rest_positions(plan.scene.sheet) + 0.2 * rng.uniform(0, 0.01, (ROWS, COLS, 3)) if curved else None
    if rest is not None:
        rest[..., 2] += 8 * rest[..., 0] ** 2 - 5 * rest[..., 1] ** 2
    tension = [k * (0.1 * tense) for k in stiffness]
    # The energy k |q|^2 / 2 of a spring is at most k (u_P^2 + u_Q^2).
    bounds = np.zeros((ROWS, COLS))
    for k, ends in zip(stiffness, spring_ends((ROWS, COLS)), strict=True):
        for end in ends:
            bounds[end] += 2 * k
    return Springs(tuple(stiffness), tuple(tension), rest, bounds)


def points() -> dict[str, Any]:
    """An inner point that is fixed, one with half a mass and area, and one with twice as much."""
    fixed, shares = np.zeros((ROWS, COLS), dtype=bool), rectangle_shares(plan_with().scene.sheet)
    fixed[:, 0] = fixed[4, 5] = True
    shares[6, 3], shares[2, 8] = 0.5, 2.0
    return {"fixed": fixed, "shares": shares}


LOCK = {"stiffening": {"lock": 0.3}, "foundation": {"young": 2e4, "depth": 0.2, "lock": 0.02}}
CASES: dict[str, Any] = {
    "points": points,
    "springs": lambda: {"springs": random_springs(plan_with())},
    "tense springs that lock": lambda: {"springs": random_springs(plan_with(), tense=True), "tissue": LOCK},
    "curved": lambda: {"springs": random_springs(plan_with(), curved=True), "probes": LOADS[:1]},
    "curved, tense, locking, points": lambda: {
        "springs": random_springs(plan_with(), tense=True, curved=True),
        "tissue": LOCK,
        "probes": LOADS[:1],
        **points(),
    },
}

# Each case has other terms, and therefore other kernels.
SELECTED = [pytest.param(case, marks=pytest.mark.slow if case in ("springs", "curved") else ()) for case in CASES]


def frames(plan: Plan, device: Device, **layout: Any) -> NDArray[Any]:
    chosen = choose_layout(plan, device)
    lanes = layout.pop("lanes", chosen.config.lanes)
    dynamics = Dynamics(plan, device, replace(chosen, config=replace(chosen.config, lanes=lanes), **layout))
    displacements = []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        displacements.append(dynamics.displacement())
    return np.array(displacements)


@pytest.mark.parametrize("case", SELECTED)
def test_motion_matches_twin(case: str, device: Device) -> None:
    plan = plan_with(**CASES[case]())
    every = [u for u, _ in reference.steps(plan, assembled(plan))]
    expected = np.array(every[plan.grid.steps_per_frame :: plan.grid.steps_per_frame])
    actual = frames(plan, device, workers=1)
    # A rounding per step, amplified by the number of steps.
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-13 * np.abs(expected).max() * plan.grid.steps)
    # Bands of rows, passes of several steps, and the gathering kernel of GPUs.
    assert frames(plan, device, workers=2, depth=3).tobytes() == actual.tobytes()
    assert frames(plan, device, workers=0, lanes=1).tobytes() == actual.tobytes()


@pytest.mark.parametrize("case", SELECTED)
def test_equilibrium_has_no_force(case: str, device: Device) -> None:
    plan = plan_with(**{**CASES[case](), "probes": LOADS[:1]}, motion="quasistatic")
    rest = QuasiStatics(plan, device)
    rest.advance(plan.grid.frames)
    u, loads = rest.displacement(), evaluate_loads(plan, np.array([0.1]))
    force = reference.force(plan.scene, u, loads, 0, assembled(plan))[~plan.fixed]
    assert np.abs(u).max() > 1e-3
    # The criterion is 1e-7 of the largest force of a spring, which exceeds that of the load, 0.4 N over some points.
    assert np.abs(force).max() < 1e-7


@pytest.mark.parametrize("case", SELECTED)
def test_bound_of_frequencies(case: str) -> None:
    plan = plan_with(**CASES[case]())
    own, size = assembled(plan), ROWS * COLS * 3
    modes, flat = np.eye(size).reshape(size, ROWS, COLS, 3), np.zeros((ROWS, COLS, 3))
    matrix = np.array([-reference.tangent(plan.scene, flat, mode, 1.0, own).ravel() for mode in modes])
    inverse = np.repeat((~plan.fixed / own.mass).ravel(), 3) ** 0.5
    true = float(np.linalg.eigvalsh(inverse[:, None] * matrix * inverse)[-1]) ** 0.5
    bound = highest_frequency(plan.material, plan.scene.sheet)
    lock = 10**0.5 if plan.material.stiffening else 1.0
    assert true < bound < 2 * lock * true


@pytest.mark.parametrize("case", SELECTED)
def test_measures_match_arrays(case: str, device: Device) -> None:
    plan = plan_with(**CASES[case]())
    dynamics = Dynamics(plan, device)
    dynamics.advance(3 * plan.grid.steps_per_frame)
    reading = dynamics.read()
    families = list(spring_families(plan))
    ratios = []
    for family in families:
        ratio = np.sqrt(family.elongation(reading.displacement).square) / family.length
        ratios.append(ratio[family.stiffness > 0])
    assert reading.shortest_spring == pytest.approx(min(each.min() for each in ratios), rel=1e-12)
    assert reading.longest_spring == pytest.approx(max(each.max() for each in ratios), rel=1e-12)
    difference = dynamics.state().difference
    mass = assembled(plan).mass[..., None]
    kinetic = float((mass * difference**2).sum()) / plan.grid.step**2 / 2
    elastic = sum(float(family.energy(reading.displacement).sum()) for family in families)
    assert reading.energy == pytest.approx(kinetic + elastic, rel=1e-10)
