"""Sheets that are curved at rest against the twin: motion, contact, loads and equilibrium."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.cells import Cells, isotropy_errors
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tools import solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from taichi_msm.terms.contact_rest import touched_points
from taichi_msm.terms.springs import assemble_springs
from tests import reference
from tests.reference import surface
from tests.reference.contact import centre
from tests.reference.loads import frame_loads
from tests.reference.sheet import highest_frequency as twin_frequency

POINTS = [9, 11]
TISSUE = {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 1e5, "damping": 30}
LOCK: Any = {"stiffening": {"lock": 0.3}, "foundation": {"young": 2e4, "depth": 0.2, "lock": 0.002}}
TUBE = {"tube": {"radius": 0.03, "folds": {"depth": 0.004, "spacing": 0.03}}}
DOME = {"dome": {"radius": 0.08}}
LOADS: Any = [
    {"at": [0.4, 0.6], "total": -0.4, "radius": 0.01, "load": [[0, 0], [0.05, 100]]},
    {"at": [[0, 0.1, 0.2], [0.1, 0.9, 0.7]], "total": 0.2, "radius": 0.005, "load": [[0, 100]]},
    {"at": [1.1, 0.5], "total": [0.1, 0, 0.1], "radius": 0.01},
]
BALL: Any = {
    "path": [[0, 0.5, 0.5, 0.002], [0.04, 0.5, 0.5, -0.002], [0.1, 0.7, 0.4, -0.003]],
    "instrument": {"radius": 0.008, "shaft": [0.3, 0, 1], "length": 0.02},
}
PLATE: Any = {
    "path": [[0, 0.3, 0.3, 0.006], [0.05, 0.3, 0.35, -0.001]],
    "instrument": {"plate": 0.006, "shaft": [0.3, 0.1, 1], "length": 0.02},
}

CASES: dict[str, Any] = {
    "tube, loads": {"surface": TUBE, "probes": LOADS},
    "dome, locking": {"surface": DOME, "tissue": LOCK, "probes": LOADS[:1]},
    "bowl, tense, relaxing": {
        "surface": {"dome": {"radius": -0.08}},
        "tissue": {"pretension": 3, "foundation_active": "always", "relaxation": [{"share": 0.4, "time": 0.05}]},
        "probes": LOADS[:2],
        "fixed": "border",
    },
    "tube, friction": {"surface": TUBE, "probes": [{**BALL, "friction": 0.4}, LOADS[0]]},
    "dome, grip": {"surface": DOME, "probes": [{**BALL, "grip": [[0.05, 0.2]]}]},
    "tube, clamp": {
        "surface": TUBE,
        "tissue": {"relaxation": [{"share": 0.3, "time": 0.1}], "foundation_active": "always"},
        "probes": [{"clamp": "right", "path": [[0, 0, 0, 0], [0.06, 0.003, 0.002, -0.004]]}, BALL],
    },
    "tube from outside": {"surface": {"tube": {"radius": -0.03}}, "probes": [BALL]},
    "springs": {"surface": DOME, "springs": {"structural": 20, "shear": 10, "virtual": 2}, "probes": [BALL]},
}


def scene_of(case: str, **time: Any) -> Scene:
    """Scene of a case, free except on the left."""
    keys = CASES[case]
    material = (
        {"tissue": {**TISSUE, **keys.get("tissue", {})}} if "springs" not in keys else {"springs": keys["springs"]}
    )
    mass = {"mass": 1e-4} if "springs" in keys else {}
    return Scene(
        output=[],
        sheet={
            "points": POINTS, "size": [0.08, 0.1], "fixed": keys.get("fixed", ["left"]),
            "surface": keys["surface"], **mass,
        },
        probes=keys["probes"],
        time={"duration": 0.1, "frames_per_second": 50, "precision": "f64", **time},
        **material,
    )  # fmt: skip


def frames(scene: Scene, device: Device, layout: SheetLayout | None = None) -> NDArray[Any]:
    plan = make_plan(scene)
    dynamics, displacements = Dynamics(plan, device, layout), []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        displacements.append(dynamics.displacement())
    return np.array(displacements)


@pytest.mark.parametrize("case", CASES)
def test_motion_matches_twin(case: str, device: Device) -> None:
    scene = scene_of(case)
    plan = make_plan(scene)
    twin = [u for u, _ in reference.steps(plan)]
    expected = np.array(twin[plan.grid.steps_per_frame :: plan.grid.steps_per_frame])
    assert np.abs(expected).max() > 1e-3
    # A rounding per step, amplified by the number of steps.
    atol = 1e-13 * np.abs(expected).max() * plan.grid.steps
    np.testing.assert_allclose(frames(scene, device), expected, rtol=0, atol=atol)


@pytest.mark.parametrize("case", ["tube, loads", "tube, friction"])
def test_bands_and_gathering_have_equal_bits(case: str, device: Device) -> None:
    scene = scene_of(case)
    layout = choose_layout(make_plan(scene), device)
    one = frames(scene, device, replace(layout, workers=1))
    assert frames(scene, device, replace(layout, workers=2, depth=3)).tobytes() == one.tobytes()
    gathered = replace(layout, workers=0, config=replace(layout.config, lanes=1))
    assert frames(scene, device, gathered).tobytes() == one.tobytes()


@pytest.mark.parametrize("case", ["tube, loads", "dome, locking", "tube from outside"])
def test_equilibrium_has_no_force(case: str, device: Device) -> None:
    scene = scene_of(case, motion="quasistatic")
    rest = QuasiStatics(make_plan(scene), device)
    rest.advance(5)
    u = rest.displacement()
    assert np.abs(u).max() > 1e-3
    free = ~rest.plan.fixed & ~touched_points(len(rest.plan.tools), rest.state().memory).any(axis=0)
    # The criterion is 1e-7 of the largest force of a spring.
    assert reference.residual(scene, u, frame_loads(rest.plan, 5), free) < 2e-7


def test_plate_follows_surface() -> None:
    scene = scene_of("tube, loads").model_copy(update={"probes": [PLATE]})
    (tool,), twin = make_plan(scene).tools, reference.sheet(scene)
    for time in (0.0, 0.02, 0.03, 0.06):
        np.testing.assert_allclose(tool.path_at(np.array([time]))[0], centre(scene, tool, time, twin), atol=1e-16)


@pytest.mark.parametrize("case", CASES)
def test_material_matches_twin(case: str) -> None:
    scene = scene_of(case)
    plan, twin, rest = make_plan(scene), reference.sheet(scene), rest_of(scene.sheet)
    assert isinstance(rest, CurvedRest)
    scale = np.abs(rest.position).max()
    np.testing.assert_allclose(rest.position, twin.rest, rtol=0, atol=1e-15 * scale)
    np.testing.assert_allclose(rest.point_normals, twin.normal, rtol=0, atol=1e-13)
    for k, own in zip(assemble_springs(plan.material, scene.sheet).stiffness, twin.springs, strict=True):
        np.testing.assert_allclose(k, own.stiffness, rtol=1e-12)
    frequency = highest_frequency(plan.material, scene.sheet)
    assert frequency == pytest.approx(twin_frequency(scene), rel=1e-12)


def test_isotropy_errors_match_twin() -> None:
    rng, (i, j) = np.random.default_rng(1), np.mgrid[:12, :9]
    noise = rng.random((3, *i.shape))
    position = np.stack([j + 0.3 * noise[0], -0.8 * i - 0.2 * noise[1], 0.3 * noise[2]], axis=-1)
    expected = surface.isotropy_error(surface.cells(position))
    assert expected.max() > 0.3
    np.testing.assert_allclose(isotropy_errors(Cells.of(position)), expected, rtol=0, atol=1e-13)


def test_motion_in_f32(device: Device) -> None:
    """A load and a ball that move along a tube: positions are rounded at 1e-7 of the sheet, 4e-6 of a displacement."""
    single, double = (frames(scene_of("tube, friction", precision=precision), device) for precision in ("f32", "f64"))
    np.testing.assert_allclose(single, double, rtol=0, atol=1e-4 * np.abs(double).max())


def test_spacing_is_that_under_the_path(tmp_path: Path) -> None:
    """The columns under the ball are 1 mm apart, those at the far side 1.5 mm."""
    x = np.cumsum([0.0] + [0.001] * 12 + [0.0015] * 6)
    np.save(tmp_path / "grid.npy", np.stack(np.broadcast_arrays(x, -0.001 * np.arange(9)[:, None], 0.0), axis=-1))
    path = [[0, 0.2, 0.5, 0.001], [1, 0.4, 0.5, 0.001]]
    scene = scene_of("tube, loads").model_copy(
        update={
            "sheet": {"surface": {"points": {"file": str(tmp_path / "grid.npy"), "unit": "m"}}},
            "probes": [{**BALL, "path": path}],
        }
    )
    (tool,) = solid_tools(make_plan(scene).tools).values()
    assert tool.point_spacing(scene.sheet) == pytest.approx(0.001)
    assert rest_of(scene.sheet).longest_side == pytest.approx(0.0015)
