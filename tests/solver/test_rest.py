"""Quasi-static equilibrium: against SciPy's minimum of the twin's energy, buckling, contact and divergence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import DivergedError
from taichi_msm.model.loads import evaluate_frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.tools import path_warnings, solid_tools
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.solver import rest as rest_module
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.rest import FORCE_TOLERANCE, STABILITY_TOLERANCE, QuasiStatics
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.scenes import plan_of, scene, speckle
from tests.terms.test_contact import moved

Array = NDArray[np.float64]

SHEET = {"points": [9, 11], "size": [0.3, 0.4]}
TISSUE = {"young": 1e3, "thickness": 0.01, "foundation": 3e3}
PUSH = {"total": [0.3, 0.2, -1], "radius": 0.03, "falloff": 30, "at": [0.4, 0.6]}


def at_rest(probes: list[dict[str, Any]], **sections: Any) -> Scene:
    """A quasi-static scene of tissue with one frame after the first."""
    given = {"sheet": SHEET, "tissue": TISSUE, "springs": None, "damping": 0, "probes": probes, **sections}
    time = {"motion": "quasistatic", "duration": 1, "frames_per_second": 1, "precision": "auto"}
    return scene(**{**given, "time": {**time, **sections.get("time", {})}})


def tissue(probe: dict[str, Any] = PUSH, sheet: dict[str, Any] | None = None, **keys: Any) -> Scene:
    return at_rest([probe], sheet={**SHEET, **(sheet or {})}, tissue={**TISSUE, **keys})


def shape_of(plan: Plan, device: Device, frames: int = 1, layout: SheetLayout | None = None) -> Array:
    """Displacements at the last of some frames [m]."""
    rest = QuasiStatics(plan, device, layout)
    rest.advance(frames)
    assert rest.residual <= FORCE_TOLERANCE
    u = rest.displacement()
    rest.close()
    return u


def nearly_flat(plan: Plan) -> Array:
    """A random start out of the plane for SciPy [m], shape (rows, cols, 3)."""
    return 1e-9 * np.random.default_rng(0).standard_normal((*plan.fixed.shape, 3)) * ~plan.fixed[..., None]


def assert_close(u: Array, twin: Array) -> None:
    np.testing.assert_allclose(u, twin, rtol=0, atol=2e-6 * float(np.abs(twin).max()))


def assert_reaction(rest: QuasiStatics, frame: int, points: NDArray[np.bool_]) -> None:
    """In equilibrium a tool carries the sum of all other forces on the mass points that it touches."""
    plan, loads = rest.plan, evaluate_frame_loads(rest.plan, frame)
    force = reference.force(plan.scene, rest.displacement(), loads, 0)[points].sum(axis=0)
    np.testing.assert_allclose(rest.tool_forces()[0], -force, rtol=0, atol=1e-6 * np.abs(force).max())


SPRINGY = {"structural": 20, "shear": 10, "virtual": 0.5}
POINTED = {"force": [0.1, 0.2, -1], "falloff": 20, "offset": 0}


def springy(sheet: dict[str, Any] | None = None, **keys: Any) -> Scene:
    return at_rest([POINTED], sheet={**SHEET, **(sheet or {})}, tissue=None, springs={**SPRINGY, **keys})


MAP = {"image": "grey.png", "range": [1, 6]}

# The first three have every term, and most ways to fix a sheet.
CASES = {
    "springs, side": springy({"fixed": ["left"]}, virtual=5),
    "plate, map": tissue(bending=1e-3, pretension=1, map=MAP),
    "moving": tissue({**PUSH, "at": [[0, 0.2, 0.2], [2, 0.8, 0.6]]}),
    "springs, map": springy(map=MAP),
    "pulled": tissue({**PUSH, "total": [0, 0, 2]}, foundation_active="always"),
    "tension": tissue(pretension=2, foundation=0),
    "corners": tissue(sheet={"fixed": "corners"}),
    "nothing fixed": tissue({**PUSH, "total": [0.05, 0.02, -0.3]}, {"fixed": "none"}),
    "side, map": tissue(sheet={"fixed": ["top"]}, map=MAP),
}


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in list(CASES)[3:]]


@pytest.mark.default_cases("plate, map")
@pytest.mark.parametrize("name", [*list(CASES)[:3], *SLOW])
def test_equilibrium_matches_scipy(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    monkeypatch.chdir(tmp_path)
    Image.fromarray(speckle(6, 7)[..., 0]).save("grey.png")
    plan = plan_of(CASES[name])
    u = shape_of(plan, device)
    twin = reference.equilibrium(plan, evaluate_frame_loads(plan, 1), nearly_flat(plan))
    assert np.abs(twin).max() > 0.003
    assert_close(u, twin)


PRESSED = moved([0, 0.5, 0.5, 0.001], [1, 0.52, 0.45, -0.03])


def test_contact_matches_scipy(device: Device) -> None:
    plan = plan_of(at_rest([PRESSED], tissue={**TISSUE, "pretension": 2}))
    rest = QuasiStatics(plan, device)
    rest.advance(1)
    twin = reference.equilibrium_outside_tool(plan, evaluate_frame_loads(plan, 1), 1.0, 0.01)
    assert (reference.clearance(plan, twin, 1.0) < 1e-9).sum() >= 3
    assert_close(rest.displacement(), twin)
    assert_reaction(rest, 1, ~plan.fixed)


def test_grip_matches_scipy(device: Device) -> None:
    """A grip holds the mass points near the tip at the frame before it begins."""
    tool = moved([0, 0.5, 0.4, 0.0], [1, 0.5, 0.4, -0.02], [2, 0.45, 0.6, 0.04], grip=[[1.5, 2.5]])
    plan = plan_of(at_rest([tool], time={"duration": 3}))
    rest = QuasiStatics(plan, device)
    rest.advance(1)
    before, tip = rest.displacement(), solid_tools(plan.tools)[0]
    rest.advance(1)
    u, middle = rest.displacement(), tip.path_at(np.array([1.0, 2.0]))
    held = np.linalg.norm(rest_positions(plan.scene.sheet) + before - middle[0], axis=-1) <= 1.5 * tip.radius
    assert held.sum() > 4
    moved_by = np.where(held[..., None], before + middle[1] - middle[0], 0)
    np.testing.assert_allclose(u[held], moved_by[held], rtol=0, atol=1e-15)
    start, loads = moved_by + nearly_flat(plan) * ~held[..., None], evaluate_frame_loads(plan, 2)
    assert_close(u, reference.equilibrium(plan, loads, start, held))
    assert_reaction(rest, 2, ~plan.fixed)
    # At the first frame after the grip the sheet is flat below the tip.
    rest.advance(1)
    assert not rest.displacement().any()
    assert not rest.tool_forces().any()


@pytest.mark.slow
def test_contact_with_few_and_many_frames(device: Device) -> None:
    """The centre of the tip ends below the flat sheet; without intermediate shapes it would push the sheet aside."""
    made = at_rest([moved([0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.06])])
    u = shape_of(plan_of(made), device)
    assert u[..., 2].min() < -0.059
    assert_close(u, shape_of(plan_of(with_rate(made, 20)), device, 20))


@pytest.mark.parametrize("frames", [1, 10])
def test_horizontal_capsule(frames: int, device: Device) -> None:
    """It ends below the flat sheet, which therefore must not be tried as its shape."""
    rod = {"radius": 0.005, "shaft": [1, 0, 0], "length": 0.03}
    made = at_rest(
        [moved([0, 0.5, 0.5, 0], [1, 0.5, 0.5, -0.015], instrument=rod)],
        sheet={"points": [31, 31], "size": [0.1, 0.1]},
        tissue={"young": 3e4, "thickness": 3e-3, "foundation": 3e5, "pretension": 25},
    )
    u = shape_of(plan_of(with_rate(made, frames)), device, frames)
    assert u[..., 2].min() == pytest.approx(-0.015, rel=0.01)


def with_rate(made: Scene, rate: float) -> Scene:
    return made.model_copy(update={"time": made.time.model_copy(update={"frames_per_second": rate})})


def test_damped_motion_ends_in_equilibrium(device: Device) -> None:
    made = tissue(pretension=2, density=1000, damping=20, foundation_active="always")
    dynamic = made.model_copy(update={"time": made.time.model_copy(update={"motion": "dynamic", "duration": 4})})
    stepped = Dynamics(plan_of(dynamic).with_grid(precision="f64"), device)
    stepped.advance(stepped.plan.grid.steps)
    assert_close(shape_of(plan_of(made), device), stepped.displacement())


SQUEEZE = {"total": [1.5, 0, 0], "radius": 0.03, "falloff": 30, "at": [0.3, 0.5]}
LIFT = {"total": [0, 0, 0.05], "radius": 0.03, "falloff": 30, "at": [0.6, 0.5], "load": [[0, 100], [2, 100], [2, 0]]}


def test_buckling_of_a_flat_sheet(device: Device) -> None:
    plan = plan_of(tissue(SQUEEZE, foundation=100))
    u, loads = shape_of(plan, device), evaluate_frame_loads(plan, 1)
    flat = np.zeros_like(u)
    in_plane = reference.equilibrium(plan, loads, flat)
    assert not in_plane[..., 2].any(), "a second equilibrium, in the plane"
    assert np.abs(u[..., 2]).max() > 0.01
    assert reference.potential(plan.scene, u, loads) < reference.potential(plan.scene, in_plane, loads)
    assert softest(plan, in_plane, 1) < 0 < softest(plan, u, 1)


# At the critical force the softest mode of the flat sheet has no stiffness; found by bisection with `softest`.
@pytest.mark.parametrize(
    ("keys", "critical"), [({"foundation": 3e3}, 2.0314), ({"foundation": 100, "bending": "plate"}, 0.24046)]
)
def test_buckling_at_the_critical_load(keys: dict[str, Any], critical: float, device: Device) -> None:
    for share, buckles in ((0.99, False), (1.03, True)):
        squeeze = {**SQUEEZE, "total": [share * critical, 0, 0]}
        plan = plan_of(tissue(squeeze, foundation_active="always", **keys))
        u = shape_of(plan, device)
        assert (np.abs(u[..., 2]).max() > 1e-3) == buckles
        assert softest(plan, u, 1) > 0


def softest(plan: Plan, u: Array, frame: int) -> float:
    """The smallest eigenvalue of the stiffness of the mass points that move [N/m]."""
    free = np.flatnonzero(np.repeat(~plan.fixed, 3))
    matrix = reference.stiffness(plan.scene, u, evaluate_frame_loads(plan, frame).active[0])[free][:, free]
    return float(np.linalg.eigvalsh(matrix.toarray()).min())


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
def test_buckled_sheet_stays_on_its_branch(side: int, device: Device) -> None:
    lift = {**LIFT, "total": [0, 0, side * 0.05]}
    plan = plan_of(
        at_rest(
            [{**SQUEEZE, "load": [[1, 0], [2, 100]]}, lift], tissue={**TISSUE, "foundation": 100}, time={"duration": 3}
        )
    )
    u = shape_of(plan, device, 3)
    largest = np.abs(u[..., 2]).max()
    assert largest > 0.01
    assert (side * u[..., 2]).max() == largest


def test_loads_at_a_frame(device: Device) -> None:
    jump = {**PUSH, "load": [[0, 50], [1, 100], [1, -20], [2, 0], [2.0000005, 70], [3, 0]]}
    plan = plan_of(at_rest([jump], time={"duration": 4}))
    percents = [evaluate_frame_loads(plan, frame).strength[0, 0, 2] for frame in range(5)]
    full = evaluate_frame_loads(plan_of(at_rest([PUSH])), 1).strength[0, 0, 2]
    # A keyframe within a millionth of a frame counts as at the frame; of several the last one counts.
    np.testing.assert_allclose(percents, full * np.array([0.5, -0.2, 0.7, 0, 0]), rtol=1e-12)
    assert [evaluate_frame_loads(plan, frame).active[0] for frame in range(5)] == [1, 1, 1, 0, 0]
    path = plan_of(at_rest([moved([1, 0.5, 0.5, 0.001], [2, 0.5, 0.5, 0.1])], time={"duration": 3}))
    assert [evaluate_frame_loads(path, frame).active[0] for frame in range(4)] == [0, 1, 1, 0]


def test_flat_without_load_and_cost_of_a_constant_load(device: Device) -> None:
    # Neither tension nor a foundation would move it back.
    made = tissue({**PUSH, "load": [[0, 0], [1, 100], [2, 100], [2.5, 0]]}, foundation=0)
    rest, shapes, evaluations = QuasiStatics(plan_of(made), device), [], []
    for frame in range(5):
        rest.advance(min(frame, 1))
        shapes.append(rest.displacement())
        evaluations.append(rest.evaluations)
    assert not shapes[0].any()
    assert shapes[1].tobytes() == shapes[2].tobytes()
    assert not shapes[3].any()
    assert evaluations[2:] == [1, 1, 1]


def test_mass_damping_and_step_are_ignored(device: Device) -> None:
    made = springy({"mass": 3.0})
    changed = made.model_copy(update={"damping": 0.3, "time": made.time.model_copy(update={"step": 0.7})})
    assert shape_of(plan_of(changed), device).tobytes() == shape_of(plan_of(springy()), device).tobytes()


NEVER = {"sheet": {**SHEET, "fixed": "none"}, "tissue": {**TISSUE, "foundation": 0}}


def test_divergence_without_support(device: Device, message: Messages) -> None:
    with Simulation(at_rest([{**PUSH, "load": [[0, 0], [1, 100]]}], **NEVER), threads=device.threads) as simulation:
        with message.raises(DivergedError, "frame 1", "nothing holds", hide=r"\d[\d.e-]+(?= of| N| m)"):
            simulation.advance()
        assert simulation.frame == 0
        assert (simulation.positions() == rest_positions(simulation.scene.sheet)).all()
        assert "nothing holds" in simulation.diagnose().message


@pytest.mark.parametrize("tools", [1, 2])
def test_divergence_of_a_held_sheet(
    tools: int, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Two tools that press on one point are named."""
    monkeypatch.setattr("taichi_msm.solver.rest.MAX_EVALUATIONS", 2)
    rest = QuasiStatics(plan_of(at_rest([PRESSED] * tools)), device)
    with message.raises(DivergedError, "frame 1", hide=r"\d[\d.e-]+(?= of)|(?<=point )\(\d, \d\)"):
        rest.advance(1)


def test_warning_of_a_grip_between_frames(message: Messages) -> None:
    plan = plan_of(at_rest([moved([0, 0.5, 0.5, 0.001], grip=[[0.2, 0.8], [0.9, 1.5]])]))
    message((note for note in path_warnings(plan.scene, plan.tools) if "grip" in note), "probes.0.grip from 0.2 ")


def test_convergence_before_the_limit_of_evaluations(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shape within the tolerance is an equilibrium, although its stability is still being examined at the limit."""
    plan = plan_of(at_rest([PRESSED]))
    rest = QuasiStatics(plan, device)
    rest.advance(1)
    assert rest.residual <= STABILITY_TOLERANCE  # It was examined.
    monkeypatch.setattr(rest_module, "MAX_EVALUATIONS", round(0.7 * rest.evaluations / max(plan.fixed.shape)))
    shape_of(plan, device)


def test_convergence_of_a_law_that_locks_steeply(device: Device) -> None:
    """With the fictitious masses of a strip 900 times as stiff, FIRE takes up to 30 times the evaluations."""
    pull = {"total": [-0.116, -0.231, 0.022], "radius": 0.004, "falloff": 430, "at": [0.68, 0.35]}
    strip = {"points": [17, 5], "size": [0.054, 0.0135], "fixed": ["left"]}
    stiffening = {"lock": 0.026, "factor": 900}
    shape_of(plan_of(tissue(pull, strip, young=4e5, thickness=4e-3, foundation=3e4, stiffening=stiffening)), device)
