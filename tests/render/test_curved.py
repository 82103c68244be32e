"""Pictures, labels, tracks, flow and picking of sheets that are curved at rest: against the twin and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import place_instruments, surface_positions
from taichi_msm.render.camera import Shot, view, view_at
from taichi_msm.render.labels import LABELS, NO_FLOW
from taichi_msm.render.picking import pick, pick_at_rest
from taichi_msm.render.renderer import Renderer
from taichi_msm.render.tracking import compute_stereo
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.lenses.test_lenses import LENSES
from tests.reference import labels as twin
from tests.render.test_labels import assert_labels_match_twin, assert_tracks_match_twin, draw_labels
from tests.render.test_normals import angle
from tests.render.test_rasterizer import assert_picture_matches_twin
from tests.scenes import scene, speckle

Array = NDArray[np.float64]

TUBE: dict[str, Any] = {"tube": {"radius": 0.025, "folds": {"depth": 0.004, "spacing": 0.03}}}
DOME: dict[str, Any] = {"dome": {"radius": 0.04}}
LENS = {"intrinsics": {"fx": 34, "fy": 33, "cx": 40.2, "cy": 29.3}, "distortion": {"k1": -0.1, "k2": 0.01}}
WIDE = {"intrinsics": {"fx": 72, "fy": 70, "cx": 40.2, "cy": 29.3}}
# Along the axis of the tube, by a lens of 100 degrees; and on a dome.
ENDOSCOPE = {"eye": [0, -0.05, 0.022], "target": [0.003, 0.05, 0.025], "up": [0, 0, 1], **LENS, "outside": "background"}
CASES: dict[str, tuple[dict[str, Any], Any]] = {
    "tube-endoscope": (TUBE, ENDOSCOPE),
    "tube-top": (TUBE, "top"),
    "dome-oblique": (DOME, "oblique"),
    "dome-fisheye": (DOME, {"eye": [0.01, -0.06, 0.05], **LENSES["fisheye"], **WIDE}),
    "bowl-fit": ({"dome": {"radius": -0.05}}, "fit"),
}
# Most of the circumference of the tube.
SIZES = {"tube": [0.1, 0.12], "dome": [0.06, 0.06]}


def drawable(case: str, **render: Any) -> Scene:
    """A curved sheet with a tool on its surface, on the side of its normal."""
    surface, camera = CASES[case]
    made = scene(
        sheet={"points": [11, 17], "size": SIZES[next(iter(surface))], "mass": 1e-3, "surface": surface},
        render={"size": [80, 60], "refine": 2, "camera": camera, **render},
    )
    (normal,) = rest_of(made.sheet).normals(np.array([[0.6, 0.6]]))
    shaft = np.add(normal, [0.3, -0.4, 0]).tolist()
    tool = {"force": -1, "at": [0.6, 0.6], "instrument": {"radius": 0.003, "shaft": shaft, "length": 0.01}}
    return Scene.model_validate({**made.model_dump(exclude_none=True), "probes": [tool]})


def dented(made: Scene) -> Array:
    """Positions with a dent along the normals, and some noise."""
    rest = rest_of(made.sheet)
    assert isinstance(rest, CurvedRest)
    distance = np.linalg.norm(rest.position - rest.place(np.array([[0.45, 0.55]])), axis=-1)
    dent = 0.008 * np.exp(-((distance / 0.015) ** 2))
    return rest.position - dent[..., None] * rest.point_normals + np.random.default_rng(1).normal(0, 3e-4, (11, 17, 3))


@pytest.mark.default_cases("tube-endoscope-tissue")
@pytest.mark.parametrize("shading", ["none", "headlight", "tissue"])
@pytest.mark.parametrize("case", CASES)
def test_pictures_match_the_twin(case: str, shading: str, device: Device) -> None:
    made = drawable(case, shading=shading)
    position = dented(made)
    picture = assert_picture_matches_twin(made, position, speckle(160, 120), place_instruments(made, position, 0))
    assert (picture > 0).any(axis=-1).mean() > 0.15


@pytest.mark.default_cases("tube-endoscope")
@pytest.mark.parametrize("case", CASES)
def test_labels_match_the_twin(case: str, device: Device) -> None:
    made = drawable(case)
    position = dented(made)
    assert assert_labels_match_twin(made, position).instrument.any()
    hidden = assert_tracks_match_twin(made, position)
    assert hidden.mean() < 1
    assert hidden.any() or case in ("tube-top", "bowl-fit")
    placed = place_instruments(made, position, 0)
    normals, expected = draw_labels(made, position, LABELS).normals, twin.normals(made, position, placed)
    visible = ~np.isnan(expected[..., 0]) & ~np.isnan(normals[..., 0])
    assert (np.isnan(normals) == np.isnan(expected)).mean() > 0.997
    # As in test_normals.py.
    assert (angle(normals, expected)[visible] < 3e-4).mean() > 0.99


@pytest.mark.default_cases("tube-endoscope")
@pytest.mark.parametrize("case", ["tube-endoscope", "dome-oblique"])
def test_flow_matches_the_twin(case: str, device: Device) -> None:
    made = drawable(case)
    rest, position = rest_of(made.sheet).position, dented(made)
    labels = draw_labels(made, rest, LABELS, ())
    flow = Renderer(made).flow(labels, Shot(position, view(made)))
    on_sheet = ~np.isnan(labels.coordinates[..., 0])
    pixels, hidden = twin.project(made, labels.coordinates[on_sheet].astype(float), position)
    centres = np.argwhere(on_sheet)[:, ::-1] + 0.5
    np.testing.assert_allclose(flow.flow[on_sheet], pixels - centres, atol=1e-3)
    assert (flow.flow[~on_sheet] == NO_FLOW).all()
    # A point on a fold's outline is hidden or not by rounding.
    assert ((flow.occlusion[on_sheet] > 0) != hidden).mean() < 0.002
    assert np.abs(pixels - centres).max() > 3


def test_stereo_matches_the_twin(device: Device) -> None:
    left, right = ({"eye": [x, -0.045, 0.022], "target": [x, 0.05, 0.022], "up": [0, 0, 1]} for x in (0, 0.004))
    made = drawable("tube-endoscope")
    cameras = {"left": left, "right": {"beside": "left", "baseline": 0.004}}
    pair = scene(sheet=made.sheet, render={"size": [80, 60], "refine": 2, "cameras": cameras})
    alone = [pair.model_copy(update={"render": made.render.with_main(Camera(**each))}) for each in (left, right)]
    position, shot = dented(made), view_at(pair, 0.0, "left")
    labels = draw_labels(alone[0], position, instruments=())
    flow = compute_stereo(pair, labels, Shot(position, shot))
    on_sheet = ~np.isnan(labels.coordinates[..., 0])
    pixels, hidden = twin.project(alone[1], labels.coordinates[on_sheet].astype(float), position)
    motion = pixels - np.argwhere(on_sheet)[:, ::-1] - 0.5
    np.testing.assert_allclose(flow.flow[on_sheet], motion, atol=1e-3)
    np.testing.assert_allclose(shot.disparity(labels.depth)[on_sheet], -motion[:, 0], atol=1e-3)
    assert ((flow.occlusion[on_sheet] > 0) != hidden).mean() < 0.002
    assert hidden.mean() > 0.02


def test_depth_and_normals_of_a_tube_are_those_of_a_cylinder(device: Device) -> None:
    surface = {"tube": {"radius": 0.025}}
    camera = {"eye": [0, -0.045, 0.022], "target": [0, 0.05, 0.025], "up": [0, 0, 1], "fov": 80}
    made = scene(
        sheet={"points": [5, 129], "size": [0.1, 0.12], "mass": 1e-3, "surface": surface},
        render={"size": [80, 60], "refine": 0, "camera": camera},
        probes=[],
    )
    labels, shot = draw_labels(made, rest_of(made.sheet).position, LABELS, ()), view(made)
    y, x = np.nonzero(labels.depth)
    offset = np.stack([x + 0.5, y + 0.5], axis=1) - shot.centre
    sight = np.column_stack([offset / shot.scale, np.ones(len(x))]) @ (shot.axes * [[1], [-1], [-1]])
    points = shot.eye + labels.depth[y, x, None] * sight
    axis = np.array([0.0, 0.0, 0.025])
    radial = (points - axis) * [1, 0, 1]
    # A chord of a cell, 0.12 / 128 m wide, is its square / (8 R) inside, at most.
    np.testing.assert_allclose(np.linalg.norm(radial, axis=1), 0.025, atol=1.2 * (0.12 / 128) ** 2 / 8 / 0.025)
    across, down = labels.coordinates[y, x].T
    angles = np.arctan2(radial[:, 0], -radial[:, 2])
    # Rounding of f32 in the picture, at grazing incidence.
    np.testing.assert_allclose(across, angles * 0.025 / 0.12 + 0.5, atol=1e-3)
    np.testing.assert_allclose(down, 0.5 - points[:, 1] / 0.1, atol=1e-3)
    # N points to the axis, from where the tube is seen; a facet is tilted by half a cell's angle.
    inward = -radial / np.linalg.norm(radial, axis=1)[:, None]
    expected = inward @ (shot.axes.T * [1, -1, -1])
    assert angle(labels.normals[y, x], expected).max() < 1.1 * 0.12 / 128 / 0.025 / 2


@pytest.mark.parametrize("case", ["tube-endoscope", "dome-oblique", "tube-top"])
def test_picked_points_are_projected_there(case: str, device: Device) -> None:
    made = drawable(case)
    shot, position, count = view(made), dented(made), 0
    labels = draw_labels(made, position, LABELS, ())
    for x, y in [(x, y) for y in range(1, 60, 5) for x in range(1, 80, 5)]:
        picked = pick(position, 2, shot, (x, y))
        assert (picked is None) == np.isnan(labels.coordinates[y, x, 0])
        if picked is not None:
            count += 1
            point = surface_positions(position, 2, np.array([picked]))[0]
            assert shot.pixels(point) == pytest.approx((x + 0.5, y + 0.5), abs=1e-3)
            assert picked == pytest.approx(tuple(labels.coordinates[y, x]), abs=2e-3)
        at_rest = pick_at_rest(made.sheet, 2, shot, (x, y))
        if at_rest is not None:
            point = surface_positions(rest_of(made.sheet).position, 2, np.array([at_rest]))[0]
            assert shot.pixels(point) == pytest.approx((x + 0.5, y + 0.5), abs=1e-3)
    assert count > 60
