"""Rough tools in quasi-static scenes: closed forms, the twin, release, grips, and invalid keys."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.accuracy.contact_warnings import tool_contact_warnings
from taichi_msm.errors import SceneError
from taichi_msm.load.check import check_scene
from taichi_msm.runs.run import run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.rest import FORCE_TOLERANCE, QuasiStatics
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.reference.rough import rough_frames
from tests.scenes import plan_of
from tests.solver.test_rest import TISSUE, at_rest, nearly_flat
from tests.terms.test_contact import moved, touching

Array = NDArray[np.float64]

# A ball of eight mass points per radius on a foundation [N/m3], with a sheet of negligible stiffness or a soft one. All
# sheets are under tension, so they share kernels.
RADIUS, MODULUS = 5e-3, 1e6
ALONE = {"young": 1e-3, "thickness": 1e-3, "foundation": MODULUS, "foundation_active": "always", "pretension": 1e-7}
SOFT = {**ALONE, "young": 3e4, "thickness": 3e-3, "pretension": 20}
SHEET = {"points": [27, 27], "size": [3.25 * RADIUS, 3.25 * RADIUS]}
SMALL = {"points": [13, 13], "size": [3 * RADIUS, 3 * RADIUS]}


def ball(*keys: list[float], **changes: Any) -> dict[str, Any]:
    rod = {"radius": RADIUS, "shaft": [0, 0, 1], "length": 0.1}
    return {"path": list(keys), "instrument": rod, "friction": "rough", **changes}


def indented(depth: float, frames: int, tissue: dict[str, Any], **sections: Any) -> Scene:
    """A ball that reaches a depth in a second."""
    time = {"frames_per_second": frames}
    return at_rest([ball([0, 0.5, 0.5, 0], [1, 0.5, 0.5, -depth])], sheet=SHEET, tissue=tissue, time=time, **sections)


def forces_of(made: Scene, device: Device) -> Array:
    """The forces of the first tool at all frames except the first [N], shape (frames, 3)."""
    plan = plan_of(made)
    rest, forces = QuasiStatics(plan, device), []
    for _ in range(plan.grid.frames):
        rest.advance(1)
        assert rest.residual <= FORCE_TOLERANCE
        forces.append(rest.tool_forces()[0])
    rest.close()
    return np.array(forces)


@pytest.mark.parametrize(("share", "frames"), [(0.5, 1), (1.0, 4)])
def test_indentation_of_a_foundation(share: float, frames: int, device: Device) -> None:
    """The force is the modulus times the displaced volume."""
    depth = share * RADIUS
    volume = math.pi * depth**2 * (RADIUS - depth / 3)
    force = forces_of(indented(depth, frames, ALONE), device)[-1]
    np.testing.assert_allclose(force, [0, 0, -MODULUS * volume], rtol=0.03, atol=1e-6 * MODULUS * volume)


@pytest.mark.slow
def test_stiffening_and_relaxation(device: Device) -> None:
    """The force on each stuck mass point depends on its own history, so the sum relaxes like each of them."""
    lock, branches = 9e-3, [{"share": 0.6, "time": 0.3}, {"share": 0.2, "time": 4.0}]
    foundation = {"young": MODULUS * 0.015, "depth": 0.015, "lock": lock, "factor": 10}
    tissue = {**ALONE, "foundation": foundation, "relaxation": branches, "stiffening": {"lock": 0.5}}
    forces = forces_of(indented(RADIUS, 4, tissue), device)[:, 2]
    r = (np.arange(2000) + 0.5) / 2000 * RADIUS
    depth = np.clip(np.arange(1, 5)[:, None] / 4 * RADIUS - RADIUS + np.sqrt(RADIUS**2 - r**2), 0, None)
    pressure = MODULUS * depth / (1 - depth / lock)
    elastic = (pressure * 2 * math.pi * r * RADIUS / 2000).sum(axis=1)
    s, expected = np.zeros(2), []
    share, time = (np.array([branch[key] for branch in branches]) for key in ("share", "time"))
    decrease = -np.expm1(-0.25 / time)
    phi = decrease / (0.25 / time)
    for f in elastic:
        expected.append((1 - share.sum()) * f + (s + share * phi * f).sum())
        s = (1 - decrease) * s - share * phi * decrease * f
    np.testing.assert_allclose(forces, -np.array(expected), rtol=0.03)
    assert abs(forces[-1]) < 0.7 * elastic[-1]


def test_dependence_on_the_frame_rate(device: Device) -> None:
    """Down and then sideways: none on a foundation alone, below 1 % in soft tissue with twice the frames."""
    path = [0, 0.45, 0.5, 0], [0.375, 0.45, 0.5, -0.4 * RADIUS], [1, 0.55, 0.5, -0.5 * RADIUS]

    def forces(frames: int, tissue: dict[str, Any]) -> Array:
        return forces_of(at_rest([ball(*path)], sheet=SMALL, tissue=tissue, time={"frames_per_second": frames}), device)

    coarse, fine = forces(1, ALONE), forces(8, ALONE)
    np.testing.assert_allclose(coarse[-1], fine[-1], rtol=0, atol=2e-5 * np.abs(fine).max())
    assert coarse[0, 0] > 0.3 * abs(coarse[0, 2])
    coarse, fine = forces(4, SOFT), forces(8, SOFT)[1::2]
    assert np.abs(coarse - fine).max() < 0.01 * np.abs(fine).max()


def test_dependence_on_intermediate_shapes(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is of order 2 in the stride; for mass points that do not move until they stick it would be 14 %."""
    made = indented(0.8 * RADIUS, 1, {**SOFT, "pretension": 1})
    fine = forces_of(made, device)[-1]
    monkeypatch.setattr("taichi_msm.model.tools.ROUGH_STRIDE_RADII", 1 / 8)
    np.testing.assert_allclose(forces_of(made, device)[-1], fine, rtol=0, atol=0.01 * np.abs(fine).max())


TILTED = {"radius": 0.1, "shaft": [0.3, -0.2, 1]}
ASIDE = [0, 0.48, 0.53, 0], [1, 0.48, 0.53, -0.006], [2, 0.485, 0.53, -0.003]


def test_rough_contact_matches_twin(device: Device) -> None:
    """Mass points stick, and are released while the tool rises and moves sideways."""
    rod = moved(*ASIDE, friction="rough", instrument=TILTED)
    sheet, tissue = {"points": [8, 8], "size": [0.12, 0.12]}, {**TISSUE, "pretension": 2}
    plan = plan_of(at_rest([rod], sheet=sheet, tissue=tissue, time={"duration": 2}))
    rest, counts = QuasiStatics(plan, device), []
    for u, force, stuck in rough_frames(plan, nearly_flat(plan)):
        rest.advance(1)
        # Shapes without further contact have residuals of up to 1e-3.
        np.testing.assert_allclose(rest.displacement(), u, rtol=0, atol=2e-3 * np.abs(u).max())
        np.testing.assert_allclose(rest.tool_forces()[0], force, rtol=0, atol=2e-3 * np.abs(force).max())
        counts.append(stuck.sum())
    assert counts[0] > counts[1] > 0


def lifted(**sections: Any) -> Scene:
    """A ball that is pressed in twice, and above the sheet in between and at the end."""
    heights = [0.001, -RADIUS / 2, 0.001, -RADIUS / 2, 0.001]
    probe = ball(*([t, 0.5, 0.5, height] for t, height in enumerate(heights)))
    time = {"duration": 4, "frames_per_second": 2}
    return at_rest([probe], **{"sheet": SMALL, "tissue": SOFT, "time": time, **sections})


def test_release_and_second_contact(device: Device) -> None:
    force = forces_of(lifted(), device)
    assert not force[[3, 7]].any(), "above the flat sheet"
    np.testing.assert_allclose(force[4:], force[:4], rtol=0, atol=1e-5 * np.abs(force).max())
    assert (force[[0, 1, 2], 2] < 0).all()


def test_warnings_of_a_rough_tool(device: Device, tmp_path: Path, message: Messages) -> None:
    """History by definition is not path dependence, and a rough tip does not slide."""
    record = run(lifted(output=[]), tmp_path / "out", threads=device.threads, estimate_error=False)
    assert not [note for note in record["notes"] if "path-dependent" in note or "slides off" in note]
    made = indented(RADIUS, 1, ALONE)
    smooth = made.model_copy(update={"probes": [made.probes[0].model_copy(update={"friction": 0.0})]})
    message(tool_contact_warnings(plan_of(smooth), RunProgress()), "friction: rough")


def test_grip_of_stuck_mass_points(device: Device) -> None:
    """A grip lifts the tissue; at its end the mass points that would be pulled are released."""
    path = [0, 0.5, 0.5, 0], [1, 0.5, 0.5, -RADIUS / 2], [2, 0.5, 0.5, 0.001]
    made = at_rest([ball(*path, grip=[[2, 3]])], sheet=SMALL, tissue=SOFT, time={"duration": 3})
    pressed, gripped, released = forces_of(made, device)
    assert pressed[2] < 0 < gripped[2]
    assert not released.any()


INVALID: dict[str, tuple[str, Any]] = {
    "in motion": ("probes.0.friction", lambda: touching([moved([0, 0.5, 0.5, 0], friction="rough")])),
    "typo": ("friction", lambda: Probe(**ball([0, 0.5, 0.5, 0], friction="ruogh"))),
    "force": ("friction", lambda: Probe(**{"total": (0, 0, -1), "friction": "rough"})),
}


def test_invalid_rough_tools(message: Messages) -> None:
    for key, make in INVALID.values():
        with message.raises(SceneError, key):
            check_scene(make())


def test_steering_to_coulomb_friction(device: Device, message: Messages) -> None:
    made, path = at_rest([ball([0, 0.5, 0.5, 0.001])], sheet=SMALL, tissue=SOFT), [[0.5, 0.5, 0.5, 0.002]]
    with Simulation(made, threads=device.threads) as simulation:
        simulation.steer([{"path": path, "friction": 0.0}])
        with message.raises(SceneError, "probes.0.friction"):
            simulation.steer([{"path": path, "friction": 0.3}])
