"""Clamps, which hold and move sides of the sheet: against the twin, SciPy and a closed form; invalid clamps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import Simulation, run
from taichi_msm.accuracy.mesh import mesh_companion_plan
from taichi_msm.errors import SceneError
from taichi_msm.gradients.gradient import require_differentiable
from taichi_msm.load.check import check_scene
from taichi_msm.model.loads import evaluate_frame_loads
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.model.tools import Clamp, overlap, path_warnings
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import try_plan
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.motion import assert_steered_like
from tests.runs.test_forces import expected_forces
from tests.scenes import plan_of, speckle
from tests.solver.test_dynamics import assert_like_twin
from tests.solver.test_rest import assert_reaction, at_rest, nearly_flat
from tests.terms.test_contact import moved, touching

RIGHT = {"clamp": "right", "path": [[0, 0, 0, 0], [0.2, 0.01, 0.004, 0.02], [0.4, 0.02, 0, -0.01]]}
TOP = {"clamp": "top", "path": [[0, 0, 0, 0], [0.1, 0, 0.006, 0], [0.4, -0.004, 0.006, 0.01]]}
# The tip comes near the right side and would grip mass points of it.
HOOK = moved([0, 0.9, 0.5, 0.001], [0.1, 0.95, 0.5, -0.02], [0.4, 0.8, 0.4, 0.03], grip=[[0, 0.3]], friction=0.3)

LEFT = {"points": [9, 11], "size": [0.3, 0.4], "fixed": ["left"]}
HELD = {"points": [9, 11], "size": [0.3, 0.4], "fixed": ["left", "bottom"]}
TENSE = {"young": 1e3, "thickness": 0.01, "density": 1000, "pretension": 1, "bending": 3e-4, "damping": 5}

CASES: dict[str, Scene] = {
    "side": touching([RIGHT], sheet=LEFT),
    "common corner": touching([TOP, RIGHT], sheet=LEFT),
    "fixed corner": touching([RIGHT], sheet=HELD),
    "with a tool": touching([HOOK, RIGHT], sheet=HELD),
    "nothing fixed": touching([RIGHT], sheet={**LEFT, "fixed": "none"}),
    "tension and bending": touching([TOP, RIGHT], sheet=HELD, tissue=TENSE),
    "backward damping": touching([TOP], sheet=LEFT, time={"precision": "f32", "damping_difference": "backward"}),
}


@pytest.mark.parametrize("case", CASES)
def test_clamps_match_twin(case: str, device: Device) -> None:
    assert_like_twin(CASES[case], device)


@pytest.mark.parametrize("case", ["common corner", "tension and bending", "with a tool"])
def test_forces_of_clamps_match_twin(case: str, device: Device) -> None:
    """The tip of a clamp is the mean position of the mass points that it holds."""
    made, expected = CASES[case], expected_forces(CASES[case])
    with Simulation(made, threads=device.threads) as simulation:
        for at_frame in expected:
            simulation.advance()
            forces = np.array([felt.force for felt in simulation.forces()])
            assert np.abs(forces - at_frame).max() < 1e-11 * np.abs(expected).max()
        for tool, felt in zip(plan_of(made).tools, simulation.forces(), strict=True):
            if isinstance(tool, Clamp):
                assert felt.tip == pytest.approx(simulation.positions()[tool.points].mean(axis=0))


def test_mass_points_of_clamps(device: Device) -> None:
    """A fixed corner stays fixed; the first of two clamps holds their common corner."""
    made = touching([TOP, RIGHT], sheet=HELD)
    top, right = plan_of(made).tools
    with Simulation(made, threads=device.threads) as simulation:
        for frame in range(10):
            u = simulation.positions() - rest_positions(made.sheet)
            for clamp, points, keys in ((top, np.s_[0, 1:], TOP), (right, np.s_[1:-1, -1], RIGHT)):
                times, *coordinates = np.array(keys["path"]).T
                target = [np.interp(frame / 25, times, values) for values in coordinates]
                np.testing.assert_allclose(u[points], np.broadcast_to(target, u[points].shape), rtol=0, atol=1e-15)
                assert isinstance(clamp, Clamp)
                assert clamp.points.sum() == len(u[points])
            assert not u[:, 0].any()
            assert not u[-1].any()
            simulation.advance()


# Equilibrium.

PULL = {"clamp": "right", "path": [[0, 0, 0, 0], [1, 0.02, 0.005, 0.01], [2, 0, 0, 0]]}


def test_clamp_matches_scipy(device: Device) -> None:
    plan = plan_of(at_rest([PULL], sheet={**LEFT, "points": [7, 9]}))
    rest, clamp = QuasiStatics(plan, device), plan.tools[0]
    assert isinstance(clamp, Clamp)
    rest.advance(1)
    u, loads = rest.displacement(), evaluate_frame_loads(plan, 1)
    np.testing.assert_allclose(u[clamp.points], np.tile([0.02, 0.005, 0.01], (7, 1)), rtol=0, atol=1e-15)
    start = nearly_flat(plan)
    start[clamp.points] = [0.02, 0.005, 0.01]
    twin = reference.equilibrium(plan, loads, start, clamp.points)
    np.testing.assert_allclose(u, twin, rtol=0, atol=2e-6 * 0.02)
    assert_reaction(rest, 1, clamp.points)


@pytest.mark.default_cases("True")
@pytest.mark.parametrize("mapped", [False, True])
def test_force_and_energy_under_tension(
    mapped: bool, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Image.fromarray(speckle(6, 7)[..., 0]).save("grey.png")
    maps = {"map": {"image": "grey.png", "range": [1, 3]}} if mapped else {}
    sides = [{**PULL, "clamp": "top"}, PULL]
    plan = plan_of(at_rest(sides, sheet={**HELD, "points": [6, 8]}, tissue={**TENSE, **maps}))
    rest = QuasiStatics(plan, device)
    rest.advance(1)
    u, loads = rest.displacement(), evaluate_frame_loads(plan, 1)
    force = reference.force(plan.scene, u, loads, 0)
    expected = [-force[clamp.points].sum(axis=0) for clamp in plan.tools if isinstance(clamp, Clamp)]
    np.testing.assert_allclose(rest.tool_forces(), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert rest.read().energy == pytest.approx(reference.energy(plan.scene, u), rel=1e-9)


def test_flat_sheet_after_return(device: Device) -> None:
    rest = QuasiStatics(plan_of(at_rest([PULL], sheet=LEFT, time={"duration": 2})), device)
    rest.advance(2)
    assert not rest.displacement().any()
    assert not rest.tool_forces().any()


def test_intermediate_shapes() -> None:
    """A clamp advances by half the shortest spring at most; rows are 37.5 mm apart, columns 40 mm."""
    (clamp,) = plan_of(at_rest([PULL], sheet=LEFT)).tools
    fast = replace(clamp, path=np.array([[0, 0, 0], [0.1, 0, 0], [0, 0, 0]]))
    assert len(clamp.substep_times(0, 1)) == 2 - (np.hypot(0.02, np.hypot(0.005, 0.01)) <= 0.0375 / 2)
    assert len(fast.substep_times(0, 1)) == 6


def strip(length: float, *, strain: float = 1e-4, cells: int = 4, **sections: Any) -> Scene:
    """A strip 20 mm wide with free long edges under quasi-static tension."""
    sheet = {"points": [cells + 1, round(cells * length / 0.02) + 1], "size": [0.02, length], "fixed": ["left"]}
    pull = {"clamp": "right", "path": [[0, 0, 0, 0], [1, strain * length, 0, 0]]}
    return at_rest([pull], sheet=sheet, tissue={"young": 3e4, "thickness": 2e-3}, **sections)


def test_stiffness_of_a_strip(device: Device) -> None:
    """In plane stress with free long edges, F = E t w strain.

    The ends cannot narrow, which reduces the compliance by the same amount for any length. The compliances of two
    strips therefore differ by the difference of their lengths over E t w, up to the square of the strain.
    """
    stiffness, compliance = 3e4 * 2e-3 * 0.02, []
    for length in (0.06, 0.10):
        with Simulation(strip(length), threads=device.threads) as simulation:
            simulation.advance()
            force, *across = simulation.forces()[0].force
        np.testing.assert_allclose(across, 0, atol=1e-6 * force)
        assert 1 < force / (stiffness * 1e-4) < 1.05
        compliance.append(1e-4 * length / force)
    assert compliance[1] - compliance[0] == pytest.approx((0.10 - 0.06) / stiffness, rel=1e-3)


# Runs, warnings and problems.


def test_error_estimates_of_forces(tmp_path: Path) -> None:
    record = run(strip(0.06, cells=8), tmp_path / "pulled", estimate_error=True)
    estimate: Any = record["error_estimate"]
    assert 0 < estimate["mesh_error"] < 0.05
    assert 0 < estimate["force_error"] < 0.05
    assert not [note for note in record["notes"] if "instrument" in note or "tip" in note]
    estimate = run(strip(0.06, strain=0.0, cells=8), tmp_path / "still", estimate_error=True)["error_estimate"]
    assert estimate["force_error"] == 0
    coarse: Any = mesh_companion_plan(plan_of(strip(0.06, cells=8)))
    assert coarse.scene.sheet.points == (5, 13)
    assert coarse.tools[0].points.sum() == 5


def test_clamps_have_no_shape() -> None:
    made = touching([RIGHT, TOP], sheet=LEFT)
    plan = plan_of(made)
    assert not place_instruments(made, rest_positions(made.sheet), 0.2)
    assert not made.shapes
    assert not plan.has_contact
    assert overlap(plan.tools, 0.4) is None
    assert not list(path_warnings(made, plan.tools))


def test_warnings_of_implausible_paths(message: Messages) -> None:
    made = touching([{"clamp": "right", "path": [[0, 0, 0, 0], [300, 12, 0, 0]]}], sheet=LEFT)
    message(path_warnings(made, plan_of(made).tools), "12 m", "ends at 300 s")


def test_serialisation_of_a_long_path() -> None:
    made = touching([{"clamp": "right", "path": [[0, 0, 0, 0], [0.4, 3, -5, 0]]}], sheet=LEFT)
    assert Scene.model_validate(made.model_dump()) == made
    assert set(made.model_dump()["probes"][0]) == {"clamp", "path"}
    assert "clamp" not in touching([HOOK]).model_dump()["probes"][0]


def test_tension_and_bending_require_fixed_or_clamped_sides(message: Messages) -> None:
    assert not try_plan(CASES["tension and bending"])[1]
    message(map(str, try_plan(touching([TOP], sheet=HELD, tissue=TENSE))[1]), "pretension", "bending")


INVALID: dict[str, dict[str, Any]] = {
    "instrument": {**RIGHT, "instrument": HOOK["instrument"]},
    "grip": {**RIGHT, "grip": [[0, 1]]},
    "total": {**RIGHT, "total": [0, 0, -1]},
    "path": {"clamp": "right"},
    "clamp": {**RIGHT, "clamp": "rihgt"},
    "path.0": {"clamp": "right", "path": [[0, 0, 0.001, 0]]},
    "path.1": {"clamp": "right", "path": [[0, 0, 0, 0], [0, 0.001, 0, 0]]},
}


def test_invalid_clamps(message: Messages) -> None:
    keys = {"sheet": LEFT, "tissue": {"young": 1e3, "thickness": 0.01, "density": 1000}, "time": {"duration": 0.4}}
    for key, probe in INVALID.items():
        with message.raises(SceneError, f"probes.0.{key}: "):
            check_scene({**keys, "output": [], "probes": [probe]})
    problems = [
        problem
        for probes, fixed in (([RIGHT], "border"), ([RIGHT, RIGHT], ["left"]))
        for problem in try_plan(touching(probes, sheet={**LEFT, "fixed": fixed}))[1]
    ]
    message(map(str, problems), "probes.0.clamp: ", "probes.1.clamp: ")


def test_clamps_have_no_gradient(message: Messages) -> None:
    with message.raises(SceneError, "probes.0.path"):
        require_differentiable(plan_of(CASES["side"]))


@pytest.mark.parametrize("motion", ["dynamic", "quasistatic"])
def test_steering_of_a_clamp(motion: str, device: Device, message: Messages) -> None:
    time = {"motion": motion, "precision": "auto"}
    path = [[frame / 25, 0.002 * frame, 0.001 * frame**2, 0.001 * frame] for frame in range(6)]
    made = touching([{"clamp": "right", "path": path}], sheet=LEFT, time=time)
    short = touching([{"clamp": "right", "path": path[:1]}], sheet=LEFT, time=time)
    assert_steered_like(made, short, device)
    with Simulation(short, threads=device.threads) as steered, message.raises(SceneError, "probes.0.clamp"):
        steered.steer([{"clamp": "top", "path": [[1, 0, 0, 0]]}])
