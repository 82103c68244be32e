"""Sessions: events, figures and saved files; the run of a recorded scene is bit-identical to its session."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene, run
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.model.tools import build_tools, overlap
from taichi_msm.system.runtime import Device
from taichi_msm.view import overlay, recording
from taichi_msm.view import session as live_session
from taichi_msm.view.events import (
    KEYS,
    Drag,
    Event,
    Hover,
    Key,
    Material,
    Press,
    Release,
    Strength,
    StrengthChange,
    Turn,
)
from taichi_msm.view.recording import Captures
from taichi_msm.view.script import record_film
from taichi_msm.view.session import Session, divide_frames
from taichi_msm.view.tools import ForceControlledTool, PositionControlledTool
from tests.golden import Messages
from tests.outputs import duration
from tests.scenes import plan_of

# small.yaml with a force that dimples it, and an oblique camera.
TILTED = {
    "sheet.points": [25, 25],
    "sheet.size": [0.3, 0.3],
    "render.size": [120, 100],
    "render.camera": "oblique",
    "probes.0.force": [0, 0, -2000],
    "probes.0.falloff": 60,
    "time.frames_per_second": 25,
}

# Rounding of positions in f32 [m].
AT_REST = 3e-8

# Saved files and their formats.
SAVED = {"film": "gif", "picture": "png", "session": "yaml"}

Begin = Callable[..., Session]


@pytest.fixture
def begin(small: Path, device: Device) -> Iterator[Begin]:
    """Begin a session of small.yaml, or of another scene; its files are saved in ./captures."""
    with ExitStack() as stack:

        def begin(overrides: dict[str, Any] | None = None, scene_file: str = "small.yaml", **options: Any) -> Session:
            scene = load_scene(scene_file, overrides or {})
            return stack.enter_context(Session(scene, Captures(Path("captures"), "small.yaml"), threads=2, **options))

        yield begin


def advance(session: Session, frames: int) -> list[np.ndarray]:
    """Advance by frames; return the positions [m] after each."""
    positions = []
    for _ in range(frames):
        session.advance()
        positions.append(session.positions().copy())
    return positions


def displacement(session: Session) -> np.ndarray:
    return np.linalg.norm(session.positions() - rest_positions(session.scene.sheet), axis=-1)


def pixel_of(session: Session, row: int, col: int) -> tuple[float, float]:
    """Return the pixel of a mass point."""
    x, y, w, _ = session.viewport.view.matrix @ [*session.positions()[row, col].astype(float), 1]
    return round(x / w - 0.5), round(y / w - 0.5)


def cell_of(session: Session) -> np.ndarray:
    """Return the column and row of the tool on a sheet of 25 x 25 mass points."""
    return np.array(session.tool.position) * 24


def test_press_dimples_the_picked_point(begin: Begin) -> None:
    session = begin(TILTED)
    for row, col, pull in [(8, 6, False), (12, 12, True), (17, 18, False)]:
        # The second and third time the sheet still oscillates, and the camera has turned.
        session.handle(Turn(col - 6, 0))
        session.handle(Press(*pixel_of(session, row, col), pull=pull))
        advance(session, 12)
        assert cell_of(session) == pytest.approx([col, row], abs=0.25), "a pixel is a fifth of a cell wide"
        height = session.positions()[..., 2] * (1 if pull else -1)
        assert height.argmax() == row * 25 + col
        assert height[row, col] > 0.003
        assert session.displacement() == pytest.approx(displacement(session)[row, col], rel=0.1)
        session.handle(Release())
        advance(session, 10)


def test_drag_moves_the_control_point(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(*pixel_of(session, 12, 6)))
    drag = Drag(*pixel_of(session, 10, 16))
    advance(session, 10)
    # A turn of the camera moves no tool, and neither does a drag after the release.
    sequences: list[list[Event]] = [[drag], [Turn(12, 4), drag, Turn(-6, 4), drag], [Release(), Drag(10, 10)]]
    for events in sequences:
        for event in events:
            session.handle(event)
        session.advance()
        assert cell_of(session) == pytest.approx([16, 10], abs=0.4)


# An instrument that is wide enough to touch several mass points.
WIDE: dict[str, Any] = {"radius": 0.03, "shaft": [0.3, -0.2, 1], "length": 0.2}
PLATE: dict[str, Any] = {**WIDE, "radius": None, "plate": 0.03}
BY_HAND = {**TILTED, "probes.0.instrument": WIDE}
# Events before the calls of `advance` with their numbers. Position control: press, drag, deeper press, grip and lift.
FORCE_EVENTS: dict[int, list[Event]] = {
    2: [Press(20, 12)],
    9: [Drag(23, 14)],
    11: [Drag(25, 15), Strength(40)],
    16: [Release(), Press(14, 16, pull=True)],
    17: [Turn(5, -3)],
    30: [Release()],
    33: [Press(22, 11), Release()],
    50: [Press(22, 18), Key("space"), Key("m")],
    52: [Key("space"), StrengthChange(15)],
}
POSITION_EVENTS: dict[int, list[Event]] = {
    1: [Hover(15, 14)],
    4: [Press(18, 14)],
    14: [Drag(22, 16), StrengthChange(10)],
    16: [Drag(25, 15)],
    20: [Release(), Hover(20, 17)],
    24: [Press(20, 17, pull=True)],
    36: [Strength(-30)],
    46: [Turn(5, -3), Release()],
    50: [Press(22, 11), Key("space")],
    52: [Key("space"), Key("m")],
}
F64 = {"time.precision": "f64", "springs.virtual_active": "always"}
FREE = {"time.step": 0.0025, "time.frames_per_second": 20, "sheet.fixed": "none"}


@pytest.mark.default_cases("force, f64")
@pytest.mark.parametrize(
    ("by_position", "overrides", "play"),
    [(False, {}, False), (False, F64, True), (False, FREE, False), (True, F64, True), (True, FREE, False)],
    ids=["force, f32", "force, f64", "force, free", "position, f64", "position, free"],
)
def test_run_is_bit_identical_to_its_session(
    by_position: bool, overrides: dict[str, Any], play: bool, begin: Begin
) -> None:
    settings = {**TILTED, "probes.0.instrument": WIDE, "time.precision": "f32", "render.size": [40, 30], **overrides}
    session = begin(settings, play=play)
    if by_position:
        session.handle(Press(20, 15))
        advance(session, 3)
        session.handle(Key("f"))
        assert (session.frame, session.tool.engaged) == (0, False), "the force-controlled part is not recorded"
    events = POSITION_EVENTS if by_position else FORCE_EVENTS
    positions = [session.positions().copy()]
    for call in range(62):
        for event in events.get(call, []):
            session.handle(event)
        before = session.frame
        session.advance()
        if session.frame > before:
            positions.append(session.positions().copy())
        if call % 10 == 0:
            session.picture()
    assert np.abs(np.array(positions) - positions[0]).max() > 0.003
    session.handle(Key("w"))
    assert session.notice == "saved captures/session-1.yaml"
    scene = load_scene("captures/session-1.yaml", {"output": ["trajectory"]})
    assert run(scene, "again", threads=2)["status"] == "complete"
    again = np.load("again/trajectory.npz")["position"]
    assert len(again) == len(positions) == session.frame + 1 == 61, "it was paused for two calls"
    np.testing.assert_array_equal(again, np.array(positions))
    assert scene.render.wireframe
    assert scene.render.camera.eye == session.recorded_scene().render.camera.eye  # type: ignore[union-attr]
    probe = scene.probes[-1]
    assert len(scene.probes) == 1 + play
    assert (probe.moved, probe.friction, len(probe.grip)) == ((True, 0.5, 1) if by_position else (False, 0.0, 0))


def test_pause_and_single_steps(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(60, 50))
    advance(session, 3)
    session.handle(Key("space"))
    assert (np.diff(advance(session, 3), axis=0) == 0).all()
    session.handle(Key("."))
    advance(session, 3)
    assert session.frame == 4
    session.handle(Key("space"))
    session.handle(Key("."))
    advance(session, 2)
    assert session.frame == 6


def test_reset(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(60, 50))
    first = advance(session, 5)
    session.handle(Key("r"))
    session.handle(Drag(70, 50))
    assert session.tool.target == (0.5, 0.5)
    assert (displacement(session) < AT_REST).all()
    assert isinstance(session.tool, ForceControlledTool)
    assert (session.frame, session.tool.percent) == (0, 0)
    session.handle(Press(60, 50))
    np.testing.assert_array_equal(advance(session, 5), first)
    assert session.recorded_scene().time.duration == pytest.approx(5 / session.frame_rate)


def test_change_of_material_keeps_positions_and_velocities(begin: Begin, message: Messages) -> None:
    changed, same = begin(TILTED), begin(TILTED)
    for session in (changed, same):
        session.handle(Press(60, 50))
        advance(session, 6)
    changed.handle(Material("springs.structural", 20.0))
    np.testing.assert_array_equal(advance(changed, 4), advance(same, 4), "the value is the same")
    before, velocity = changed.positions().copy(), changed._simulation.velocities()
    changed.handle(Material("springs.structural", 180.0))
    np.testing.assert_array_equal(changed.positions(), before)
    steps = changed._simulation._plan.grid.steps_per_frame / same._simulation._plan.grid.steps_per_frame
    assert steps > 1.5, "stiffer springs need smaller steps"
    np.testing.assert_allclose(changed._simulation.velocities(), velocity, rtol=1e-5)
    # The equilibrium is that of a sheet that has always had this material.
    expected = begin({**TILTED, "springs.structural": 180.0})
    expected.handle(Press(60, 50))
    assert advance(changed, 150)[-1] == pytest.approx(advance(expected, 160)[-1], abs=1e-4)
    changed.handle(Key("w"))
    message(changed.notice, "reset (r)")
    changed.handle(Key("r"))
    assert (displacement(changed) < AT_REST).all()
    assert changed.material()["springs.structural"] == (180.0, 20.0)


def test_strength_and_light(begin: Begin) -> None:
    session = begin({"render.shading": "tissue"})
    events: list[tuple[Event, float]] = [
        (StrengthChange(5), 100),
        (StrengthChange(-30), 70),
        (Key("up"), 75),
        (Key("down"), 70),
        (Strength(3), 3),
        (Key("down"), 0),
    ]
    for event, expected in events:
        session.handle(event)
        assert session.tool.strength == expected
    for shading in ("none", "tissue"):
        session.handle(Key("l"))
        assert session.viewport.render.shading == shading


def test_keys_of_the_display(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(60, 50))
    advance(session, 8)
    session.paused = True
    plain = session.picture()
    for key in ("t", "m", "l", "i", "h"):
        session.handle(Key(key))
        assert (session.picture() != plain).any(), key
        session.handle(Key("c" if key == "t" else key))
        np.testing.assert_array_equal(session.picture(), plain, err_msg=f"{key} and back")
    # The near side follows the pointer; dragged down, the camera rises.
    near, axis = pixel_of(session, 20, 12), session.viewport.view.axes[2, 2]
    session.handle(Turn(10, 0))
    assert pixel_of(session, 20, 12)[0] > near[0] + 2
    session.handle(Turn(0, 10))
    assert session.viewport.view.axes[2, 2] > axis
    assert (session.picture() != plain).any()
    session.handle(Key("o"))
    np.testing.assert_array_equal(session.picture(), plain, err_msg="the scene's camera is the oblique one")
    session.handle(Key("no such key"))
    np.testing.assert_array_equal(session.picture(), plain)
    tested_elsewhere = {"up", "down", "f", "c", "o", "space", ".", "r", "p", "g", "w", "q"}
    assert set(KEYS) == {"t", "m", "l", "i", "h"} | tested_elsewhere


def test_press_outside_the_sheet(begin: Begin, message: Messages) -> None:
    session = begin(TILTED)
    session.handle(Press(2, 2))
    message(session.notice, "2, 2")
    advance(session, 4)
    assert (displacement(session) < AT_REST).all()
    assert not session.tool.engaged
    session.handle(Press(60, 50))
    assert session.notice == "", "the notice is outdated"
    session.handle(Press(2, 2))
    advance(session, 200)
    assert session.notice == ""


def test_saved_files_have_free_names(begin: Begin, message: Messages) -> None:
    Path("captures").mkdir()
    Path("captures/speckle.png").write_bytes(b"another picture")
    session = begin(TILTED)
    for _ in range(2):
        session.handle(Key("p"))
        session.handle(Key("g"))
        for _ in range(5):
            session.advance()
            session.picture()
        session.handle(Key("g"))
        session.handle(Key("w"))
    saved = {path.name for path in Path("captures").iterdir()} - {"speckle.png", "speckle-2.png"}
    assert saved == {f"{name}-{n}.{kind}" for n in (1, 2) for name, kind in SAVED.items()}
    with Image.open("captures/picture-1.png") as image:
        assert image.size == (120, 100)
    scene = load_scene("captures/session-2.yaml")
    assert scene.time.duration == pytest.approx(10 / session.frame_rate)
    assert scene.image == "captures/speckle-2.png"
    assert Path("captures/speckle.png").read_bytes() == b"another picture"
    message(Path("captures/session-2.yaml").read_text().partition("\n")[0])
    Path("speckle.png").unlink()
    with message.raises(FilesError, "speckle.png"):
        session.handle(Key("w"))


def test_film_has_the_duration_of_the_session(begin: Begin) -> None:
    session = begin({**TILTED, "time.frames_per_second": 10})
    assert (session.frame_rate, session.subframes) == (60, 6)
    advance(session, 60)
    session.handle(Key("g"))
    for _ in range(6):
        # The film has two pictures of each.
        advance(session, 12)
        session.handle(StrengthChange(-5))
        session.picture()
    session.close()
    assert duration("captures/film-1.gif") == 1300, "1.2 s from the first to the last picture, which lasts 0.1 s"


def test_session_outlives_a_failing_film(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    session = begin(TILTED)
    session.handle(Key("g"))
    with monkeypatch.context() as patch:
        patch.setattr(recording.Film, "add_frame", Mock(side_effect=FilesError("full")))
        session.picture()
    assert (session.notice, session.filming) == ("full", False)
    session.handle(Key("g"))
    session.picture()
    session.handle(Key("g"))
    assert session.notice == "saved captures/film-1.gif"


def test_film_has_no_text(begin: Begin, message: Messages) -> None:
    session = begin(TILTED)
    session.handle(Key("g"))
    session.handle(Key("g"))
    message(session.notice, "film")
    assert not Path("captures").exists(), "it has no pictures"
    session.handle(Key("h"))
    session.handle(Key("g"))
    with_text = session.picture().astype(int)
    session.handle(Key("g"))
    session.handle(Key("p"))
    with Image.open("captures/picture-1.png") as image, Image.open("captures/film-1.gif") as film:
        bare, frame = np.array(image), np.array(film.convert("RGB")).astype(int)
    # The film has 256 colours.
    assert np.abs(frame - bare).mean() < 8
    assert np.abs(with_text - bare).mean() > 15


@pytest.mark.slow
def test_session_too_long_for_a_scene_file(begin: Begin, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    for module in (live_session, recording):
        monkeypatch.setattr(module, "MAX_NODES", 1100)
    session = begin(TILTED)
    session.handle(Press(60, 50))
    notices = []
    for n in range(402):
        session.handle(Drag(50 + n % 20, 50))
        session.advance()
        notices.append(session.notice)
    message(notices[200], "(w)", "(r)")
    assert sum(notice != "" for notice in notices) <= 160, "it is shown once"
    with message.raises(FilesError, "reset"):
        session.handle(Key("w"))
    assert list(Path("captures").iterdir()) == [Path("captures/speckle.png")]


def test_film_ends_at_a_divergence(begin: Begin, message: Messages) -> None:
    session = begin({**TILTED, "probes.0.force": [0, 0, -1e12]})
    notices: list[str] = []
    record_film(session, Path("a.gif"), 2.0, [(2, Press(60, 50)), (90, Key("w"))], notify=notices.append)
    assert notices[0] == session.divergence_error
    message(notices[1], "script", hide=r"0\.\d+")
    assert duration("a.gif") < 500


def test_unwritable_folder_of_captures(begin: Begin, message: Messages) -> None:
    Path("captures").write_text("no folder")
    session = begin(TILTED)
    session.handle(Press(60, 50))
    advance(session, 5)
    for key in "pgw":
        with message.raises(FilesError, "captures", "--out"):
            session.handle(Key(key))
    advance(session, 5)
    assert session.frame == 10


def test_divergence_is_reported_and_reset(begin: Begin, message: Messages) -> None:
    # The fourth frame diverges.
    session = begin({**TILTED, "probes.0.force": [0, 0, -3e6]})
    session.handle(Press(60, 50))
    advance(session, 10)
    message(session.divergence_error, "diverged", hide=r"\d\S*")
    assert session.notice == session.divergence_error
    frame = session.frame
    advance(session, 3)
    assert session.frame == frame
    session.handle(Material("springs.structural", 30.0))
    message(session.notice, "reset it (r)")
    session.handle(Key("w"))
    assert session.notice == "saved captures/session-1.yaml"
    again = run(load_scene("captures/session-1.yaml", {"output": []}), "again", threads=2)
    assert again["status"] == "diverged"
    session.handle(Key("r"))
    assert session.divergence_error == ""
    assert np.isfinite(advance(session, 3)).all()


@pytest.mark.parametrize(
    ("time", "count", "precision"),
    [
        *(({"frames_per_second": rate}, count, "f32") for rate, count in ((25, 2), (10, 6), (120, 1))),
        ({"frames_per_second": 24, "precision": "f64"}, 2, "f64"),
        # 25 steps per frame are divisible by neither 3 nor 2.
        ({"frames_per_second": 20, "step": 0.002}, 1, "f32"),
        ({"frames_per_second": 25, "motion": "quasistatic"}, 2, "f64"),
    ],
)
def test_subframes_of_a_session(time: dict[str, Any], count: int, precision: str, small: Path) -> None:
    scene = load_scene("small.yaml", {f"time.{key}": value for key, value in {"duration": 1, **time}.items()})
    live, subframes = divide_frames(plan_of(scene))
    assert (live.scene.time.frames_per_second, subframes) == (time["frames_per_second"] * count, count)
    assert live.grid.precision == precision
    assert "step" not in time or live.grid.steps_per_frame == 25


@pytest.mark.parametrize(
    ("overrides", "play", "key"),
    [
        ({"probes": []}, False, "probes"),
        ({"image": None, "output": []}, False, "image"),
        ({"probes": [{"force": [0, 0, -1]}] * 16}, True, "probes"),
    ],
    ids=["no probe", "no picture", "16 probes"],
)
def test_scenes_without_a_session(
    overrides: dict[str, Any], play: bool, key: str, begin: Begin, message: Messages
) -> None:
    with message.raises(SceneError, key):
        begin(overrides, play=play)


def test_units_of_lengths_and_forces(message: Messages) -> None:
    message(map(live_session.format_length, (0.0, 1.33e-7, 1.67e-6, 1e-5, 8.284e-4, 0.0621, 12.3)))
    message(map(live_session.format_force, (0.0, 0.514, 9.63, 123.4)))


def instrument_pixels(session: Session) -> set[tuple[int, int]]:
    """Return the pixels that show an instrument."""
    bare = session.viewport.draw(session.positions())
    session.handle(Key("i"))  # without figures
    changed = (session.picture() != bare).any(axis=-1)
    session.handle(Key("i"))
    return {(int(x), int(y)) for y, x in np.argwhere(changed)}


def test_instrument_follows_the_pointer(begin: Begin) -> None:
    thin = {"radius": 0.01, "shaft": [0.3, -0.2, 1], "length": 0.2}
    session = begin({**TILTED, "probes.0.instrument": thin})
    for event, tip in ((Hover(40, 60), (40, 60)), (Hover(80, 50), (80, 50)), (Press(60, 55), (60, 55))):
        session.handle(event)
        if isinstance(event, Press):
            session.advance()
            session.handle(Hover(20, 20))
        pixels = instrument_pixels(session)
        assert np.abs(np.array(list(pixels)) - tip).max(axis=1).min() <= 4
        assert 20 < len(pixels) < 3000


def moved(session: Session) -> PositionControlledTool:
    """Return the position-controlled tool."""
    assert isinstance(session.tool, PositionControlledTool)
    return session.tool


@pytest.mark.default_cases("capsule", "force")
@pytest.mark.parametrize(
    "probe",
    [
        {"path": [[0, 0.5, 0.5, 0.05]], "instrument": WIDE},
        {"path": [[0, 0.5, 0.5, 0.05]], "instrument": PLATE},
        {"force": [0, 0, -2000], "falloff": 60, "instrument": WIDE},
    ],
    ids=["capsule", "plate", "force"],
)
def test_idle_tool_is_clear_of_played_tools(probe: dict[str, Any], begin: Begin) -> None:
    """The session of a recorded scene with its tool, and an idle tool like it, is recorded again."""
    first = begin({**TILTED, "probes": [probe]})
    first.handle(Press(60, 50))
    advance(first, 12)
    first.handle(Key("w"))
    second = begin({}, "captures/session-1.yaml", play=True)
    advance(second, 12)
    scene = second.recorded_scene()
    tips = [solid.tip[:2] for solid in place_instruments(scene, second.positions(), scene.time.duration)]
    assert np.linalg.norm(np.subtract(*tips)) > 2 * 0.03
    assert overlap(build_tools(scene.probes, scene.sheet), scene.time.duration) is None


def test_position_control_follows_the_pointer_and_measures_forces(begin: Begin) -> None:
    session = begin(BY_HAND)
    session.handle(Key("f"))
    session.handle(Hover(*pixel_of(session, 8, 6)))
    advance(session, 5)
    assert np.array(moved(session).position) * 24 == pytest.approx([6, 8], abs=0.25)
    assert (displacement(session) < AT_REST).all()
    assert session.felt_force() == 0
    session.handle(Press(*pixel_of(session, 8, 6)))
    advance(session, 20)
    pressed = session.felt_force()
    assert pressed > 0
    assert session.positions()[8, 6, 2] == pytest.approx(-0.03, abs=0.002), "a press is a radius deep"
    session.handle(StrengthChange(20))
    advance(session, 20)
    assert session.felt_force() > 1.2 * pressed
    x_before = session.positions()[8, 8, 0]
    for _ in range(10):
        x, y = session.viewport.project(np.array([*session._coordinates(session.tool.target), 0])) or (0, 0)
        session.handle(Drag(x + 1, y))
        advance(session, 1)
    assert session.positions()[8, 8, 0] > x_before + 0.001, "friction moves the tissue"
    session.handle(Release())
    advance(session, 20)
    assert session.felt_force() == 0
    session.handle(Press(*pixel_of(session, 12, 12), pull=True))
    advance(session, 20)
    assert moved(session).gripping
    for _ in range(20):
        session.handle(Key("down"))
        advance(session, 1)
    advance(session, 5)
    assert session.positions()[12, 12, 2] > 0.02, "a grip is lifted"


def test_initial_control_is_that_of_the_first_probe(begin: Begin) -> None:
    path = {"path": [[0, 0.5, 0.5, 0.05]], "instrument": WIDE, "friction": 0.1}
    force = {"force": [0, 0, -2000], "falloff": 60}
    session = begin({**TILTED, "probes": [path, force]})
    assert moved(session).recorded_probe(0).friction == 0.1
    session.handle(Key("f"))
    assert not isinstance(session.tool, PositionControlledTool)
    session.handle(Press(60, 50))
    advance(session, 10)
    assert session.tool.percent == 100
    session.handle(Key("f"))
    assert moved(session).position == (0.5, 0.5)
    assert (displacement(session) < AT_REST).all()


FORCE: dict[str, Any] = {"force": [0, 0, -2000]}


@pytest.mark.parametrize(
    ("probe", "words"),
    [
        (FORCE, ["instrument"]),
        ({"path": [[0, 0.5, 0.5, 0.05]], "instrument": WIDE}, ["force"]),
        ({**FORCE, "instrument": {**WIDE, "shaft": [0, 0, -1]}}, ["shaft"]),
        ({**FORCE, "instrument": {**WIDE, "radius": 0.01}}, ["probes.0", "radius"]),
    ],
    ids=["no instrument", "no force", "from below", "thin"],
)
def test_unavailable_control(probe: dict[str, Any], words: list[str], begin: Begin, message: Messages) -> None:
    """A thin tool is available, with a warning."""
    session = begin({**TILTED, "probes": [probe]})
    tool = session.tool
    advance(session, 2)
    session.handle(Key("f"))
    message(session.notice, *words)
    is_available = words[0] == "probes.0"
    assert (session.tool is not tool, session.frame) == (is_available, 0 if is_available else 2)


def bar_of(picture: np.ndarray) -> float:
    """Return the filled fraction of the bar below the two lines of figures."""
    lines = [row[:, 0] for row in picture[:80] if (row[:70] == overlay.OUTLINE_GREY).all(axis=-1).any()]
    row = lines[len(lines) // 2]
    right = int(np.flatnonzero(row == overlay.OUTLINE_GREY)[-1])
    return float((row[: right + 1] == 255).sum() / (overlay.BAR_LENGTH_LETTERS * 11))


def test_force_is_shown_with_a_bar(begin: Begin, message: Messages) -> None:
    session = begin({**BY_HAND, "render.size": [240, 200]})
    session.handle(Key("f"))
    bare = session.picture()
    session.handle(Press(*pixel_of(session, 12, 12)))
    advance(session, 20)
    largest = session.felt_force()
    for percent in (100, 60):
        session.handle(Strength(percent))
        advance(session, 20)
        largest = max(largest, session.felt_force())
    (readings, *_) = session._reading_lines()
    assert readings.endswith(live_session.format_force(session.felt_force()))
    message(readings, "45 mm", hide=r"[\d.]+ N")
    bar = overlay.ValueBar(session.felt_force(), largest, "N")
    assert bar_of(session.picture()) == pytest.approx(session.felt_force() / bar.end, abs=0.02)
    session.handle(Key("r"))
    session.handle(Strength(40))
    message(session._reading_lines()[0], "30 mm", "0 N")
    assert (session.picture()[40:70, :130] == bare[40:70, :130]).all(), "without a force there is no bar"


@pytest.mark.parametrize(("largest", "end"), [(0.51, 1), (1, 1), (1.01, 2), (2.4, 5), (7, 10), (3e-4, 5e-4)])
def test_bar_ends_at_a_round_number(largest: float, end: float) -> None:
    assert overlay.ValueBar(0.1, largest, "N").end == pytest.approx(end)


def test_clamp_in_a_session(begin: Begin, message: Messages) -> None:
    """It acts whether the scene is played or not; the session needs another tool."""
    clamp = {"clamp": "right", "path": [[0, 0, 0, 0], [0.2, 0.01, 0, 0]]}
    force = {"force": [0, 0, -2000], "falloff": 60}
    scene = {**TILTED, "sheet.fixed": ["left"], "probes": [clamp, force]}
    session = begin({name: value for name, value in scene.items() if not name.startswith("probes.")})
    advance(session, 5 * session.subframes)
    assert displacement(session)[1:-1, -1] == pytest.approx(0.01, abs=AT_REST)
    assert displacement(session)[:, 0].max() < AT_REST
    session.picture()
    with message.raises(SceneError, "probes"):
        begin({"sheet.fixed": ["left"], "probes": [clamp]})
