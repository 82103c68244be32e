"""Sessions of curved sheets: heights along the normal, places on the surface, records with equal bits."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import load_scene, run
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.system.runtime import Device
from taichi_msm.view.events import Drag, Event, Hover, Key, Press, Release, Strength, Turn
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from taichi_msm.view.tools import HOVER_HEIGHT_RADII, PositionControlledTool

RADIUS = 0.008
WIDE: dict[str, Any] = {"radius": RADIUS, "shaft": [0.2, 0, 1], "length": 0.1}
TUBE = {"tube": {"radius": 0.06}}
DOME = {"dome": {"radius": 0.09}}
# Seen from above: the opened side of a quarter of a tube, or a dome.
SCENE: dict[str, Any] = {
    "image": "speckle.png",
    "sheet": {"points": [17, 17], "size": [0.1, 0.1], "fixed": "border"},
    "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 4e4, "damping": 30},
    "probes": [{"total": -1, "radius": 0.004, "instrument": WIDE}],
    "render": {"size": [96, 80], "refine": 2},
    "time": {"duration": 1, "frames_per_second": 30, "precision": "f64"},
}
SURFACES = pytest.mark.parametrize("surface", [TUBE, DOME], ids=["tube", "dome"])

Begin = Callable[..., Session]


@pytest.fixture
def begin(small: Path, device: Device) -> Iterator[Begin]:
    """Begin a session of a curved sheet; its files are saved in ./captures."""
    with ExitStack() as stack:

        def begin(surface: dict[str, Any], **overrides: Any) -> Session:
            Path("curved.yaml").write_text(json.dumps(SCENE))
            scene = load_scene("curved.yaml", {"sheet.surface": surface, **overrides})
            return stack.enter_context(Session(scene, Captures(Path("captures"), "curved.yaml"), threads=2))

        yield begin


def advance(session: Session, frames: int) -> None:
    for _ in range(frames):
        session.advance()


def pixel_of(session: Session, row: int, col: int) -> tuple[float, float]:
    """Return the pixel of a mass point at rest."""
    x, y = session.viewport.view.pixels(rest_of(session.scene.sheet).position[row, col])
    return float(x) - 0.5, float(y) - 0.5


def position_tool(session: Session) -> PositionControlledTool:
    assert isinstance(session.tool, PositionControlledTool)
    return session.tool


def height_and_place(session: Session) -> tuple[float, NDArray[np.float64]]:
    """Return the height of the tool's lowest point, and the point of the sheet at rest below it [m]."""
    rest = rest_of(session.scene.sheet)
    assert isinstance(rest, CurvedRest)
    at = np.array(session.tool.position)[None]
    place, normal = rest.place(at)[0], rest.normals(at)[0]
    (solid,) = place_instruments(session._simulation.scene, session.positions(), session._simulation.time)
    offset = solid.tip - place
    # The tip lies on the normal.
    assert np.linalg.norm(offset - (offset @ normal) * normal) < 1e-12
    return float(offset @ normal) - RADIUS, place


@SURFACES
def test_tool_hovers_and_presses_along_the_normal(surface: dict[str, Any], begin: Begin) -> None:
    session = begin(surface)
    session.handle(Key("f"))
    for row, col in ((8, 3), (4, 13)):
        pixel = pixel_of(session, row, col)
        session.handle(Hover(*pixel))
        advance(session, 6)
        height, place = height_and_place(session)
        assert height == pytest.approx(HOVER_HEIGHT_RADII * RADIUS)
        # The pointer is at the mass point.
        np.testing.assert_allclose(place, rest_of(session.scene.sheet).position[row, col], atol=1e-6)
        session.handle(Press(*pixel))
        advance(session, 20)
        height, _ = height_and_place(session)
        assert height == pytest.approx(-position_tool(session).depth)
        assert session.felt_force() > 0
        # The tissue is pressed along the normal, not along z: to the depth of the tip, except beside its lowest point.
        assert session.depth() == pytest.approx(-height, rel=0.1)
        assert session.depth() <= session.displacement()
        session.handle(Release())
        advance(session, 8)


@SURFACES
def test_force_tool_presses_along_the_normal(surface: dict[str, Any], begin: Begin) -> None:
    session = begin(surface)
    row, col = 8, 3
    session.handle(Press(*pixel_of(session, row, col)))
    assert not session._pulls
    advance(session, 40)
    motion = session.positions()[row, col] - rest_positions(session.scene.sheet)[row, col]
    rest = rest_of(session.scene.sheet)
    normal = rest.normals(np.array([[col / 16, row / 16]]))[0]
    # The sheet is nearly symmetric about the control point.
    assert -motion @ normal > 0.9 * np.linalg.norm(motion) > 1e-4
    assert session.depth() == pytest.approx(-motion @ normal, rel=0.02)
    assert session.displacement() == pytest.approx(np.linalg.norm(motion), rel=0.02)


@SURFACES
def test_drag_follows_the_surface(surface: dict[str, Any], begin: Begin) -> None:
    session = begin(surface)
    session.handle(Press(*pixel_of(session, 8, 3)))
    drag = Drag(*pixel_of(session, 6, 12))
    advance(session, 10)
    turns: list[Event] = [Turn(6, 4), drag, Turn(-6, 2)]
    for events in ([drag], turns, [Drag(-500, 0)]):
        for event in events:
            session.handle(event)
        session.advance()
        # A pointer beyond the sheet does not move the tool. The control point was picked on the deformed sheet, which
        # hides the difference of a cell at most.
        assert np.array(session.tool.position) * 16 == pytest.approx([12, 6], abs=0.5)


def test_tip_moves_at_most_by_its_stride_on_a_dome(begin: Begin) -> None:
    # The tip is above the dome, so it moves farther than its place on the sheet.
    session = begin(DOME, **{"tissue.young": 200, "tissue.foundation": 400, "time.step": 1 / 60 / 2})
    session.handle(Key("f"))
    tool = position_tool(session)
    tool.move((1.0, 1.0))
    advance(session, 30)
    assert tool.position == (1.0, 1.0)
    recorded = session.recorded_scene()
    (path,) = (probe.path for probe in recorded.probes)
    assert path is not None
    assert len(path) > 3, "it moved as fast as it may"
    # A run of the record refuses steps that are too long.
    assert run(recorded.model_copy(update={"output": ()}), "again", threads=2)["status"] == "complete"


def test_orbit_is_about_the_middle_of_the_surface(begin: Begin) -> None:
    cameras: list[Any] = ["top", {"eye": [0.02, -0.1, 0.15]}]
    for camera in cameras:
        session = begin({"tube": {"radius": 0.04}}, **{"render.camera": camera})
        rest = rest_of(session.scene.sheet)
        middle = rest.place(np.array([[0.5, 0.5]]))[0]
        for right, down in ((0, 0), (30, -12), (-7, 20)):
            session.handle(Turn(right, down))
            assert session.viewport.project(middle) == pytest.approx((48, 40), abs=1e-6)


EVENTS: dict[int, list[Event]] = {
    1: [Hover(30, 40)],
    4: [Press(35, 40)],
    14: [Drag(50, 36)],
    16: [Strength(30)],
    20: [Release(), Hover(60, 30)],
    24: [Press(60, 30, pull=True)],
    34: [Strength(-30)],
    44: [Turn(5, -3), Release()],
}


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("by_position", [False, True], ids=["force", "position"])
def test_run_is_bit_identical_to_its_session(by_position: bool, precision: str, begin: Begin) -> None:
    session = begin(
        {"tube": {"radius": 0.06, "folds": {"depth": 0.004, "spacing": 0.04}}}, **{"time.precision": precision}
    )
    if by_position:
        session.handle(Key("f"))
    positions = [session.positions().copy()]
    for call in range(54):
        for event in EVENTS.get(call, []):
            session.handle(event)
        session.advance()
        positions.append(session.positions().copy())
    assert np.abs(np.array(positions) - positions[0]).max() > 1e-3
    session.handle(Key("w"))
    recorded = load_scene("captures/session-1.yaml", {"output": ["trajectory"]})
    assert run(recorded, "again", threads=2)["status"] == "complete"
    again = np.load("again/trajectory.npz")["position"]
    np.testing.assert_array_equal(again, np.array(positions))
