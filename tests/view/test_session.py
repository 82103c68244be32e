"""A session: events in, tissue and picture out; and what it writes, run repeats to the bit."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene, run
from taichi_msm.errors import FilesError, SceneError
from taichi_msm.model.sheet import rest_positions
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
from taichi_msm.view.tools import PositionControlledTool
from tests.golden import Messages
from tests.outputs import duration
from tests.scenes import plan_of

# small.yaml with a force that dimples it as tissue, and a camera that sees it tilted.
TILTED = {
    "sheet.points": [25, 25],
    "sheet.size": [0.3, 0.3],
    "render.size": [120, 100],
    "render.camera": "oblique",
    "probes.0.force": [0, 0, -2000],
    "probes.0.falloff": 60,
    "time.frames_per_second": 25,
}

# What f32 makes of places [m].
AT_REST = 3e-8

Begin = Callable[..., Session]


@pytest.fixture
def begin(small: Path, device: Device) -> Iterator[Begin]:
    """Begin a session with small.yaml; what it keeps goes to ./captures."""
    with ExitStack() as stack:

        def begin(overrides: dict[str, Any] | None = None, **options: Any) -> Session:
            scene = load_scene("small.yaml", overrides or {})
            return stack.enter_context(Session(scene, Captures(Path("captures"), "small.yaml"), threads=2, **options))

        yield begin


def advance(session: Session, frames: int) -> list[np.ndarray]:
    """Let some frames pass; the positions after each."""
    found = []
    for _ in range(frames):
        session.advance()
        found.append(session.positions().copy())
    return found


def played(session: Session, events: dict[int, list[Event]], beats: int) -> Iterator[np.ndarray]:
    """Give the positions at every frame of a session in which these events happen, each before the beat of its key."""
    yield session.positions().copy()
    for beat in range(beats):
        for event in events.get(beat, []):
            session.handle(event)
        before = session.frame
        session.advance()
        if session.frame > before:
            yield session.positions().copy()


def displacement(session: Session) -> np.ndarray:
    return np.linalg.norm(session.positions() - rest_positions(session.scene.sheet), axis=-1)


def pixel_of(session: Session, row: int, col: int) -> tuple[float, float]:
    """The pixel at which a mass point is seen now."""
    x, y, w, _ = session.viewport.view.matrix @ [*session.positions()[row, col].astype(float), 1]
    return round(x / w - 0.5), round(y / w - 0.5)


def test_a_press_at_a_pixel_dimples_what_is_seen_there(begin: Begin) -> None:
    session = begin(TILTED)
    rows, cols = session.scene.sheet.points
    for row, col, pull in [(8, 6, False), (12, 12, True), (17, 18, False)]:
        # The second and third time the sheet still swings, and the camera is elsewhere.
        session.handle(Turn(col - 6, 0))
        session.handle(Press(*pixel_of(session, row, col), pull=pull))
        advance(session, 12)
        cell = np.array(session.tool.position) * [cols - 1, rows - 1]
        assert cell == pytest.approx([col, row], abs=0.25), "a pixel is a fifth of a cell wide"
        height = session.positions()[..., 2] * (1 if pull else -1)
        assert height.argmax() == row * cols + col
        assert height[row, col] > 0.003
        assert session.displacement() == pytest.approx(displacement(session)[row, col], rel=0.1)
        session.handle(Release())
        advance(session, 10)


def test_a_drag_moves_the_control_point_with_the_pointer(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(*pixel_of(session, 12, 6)))
    there = pixel_of(session, 10, 16)
    advance(session, 10)
    session.handle(Drag(*there))
    session.advance()
    assert np.array(session.tool.position) * 24 == pytest.approx([16, 10], abs=0.4)
    session.handle(Turn(12, 4))
    session.handle(Drag(there[0], there[1]))
    session.handle(Turn(-6, 4))
    session.handle(Drag(there[0], there[1]))
    session.advance()
    assert np.array(session.tool.position) * 24 == pytest.approx([16, 10], abs=0.4), (
        "the camera moved, and not the pointer"
    )
    session.handle(Release())
    session.handle(Drag(10, 10))
    session.advance()
    assert np.array(session.tool.position) * 24 == pytest.approx([16, 10], abs=0.4), "the tool is not there any more"


@pytest.mark.default_cases("f64 with the scene's probes")
@pytest.mark.parametrize(
    ("overrides", "play"),
    [
        ({}, False),
        ({"time.precision": "f64", "springs.virtual_active": "always"}, True),
        ({"time.step": 0.0025, "sheet.fixed": "none"}, False),
    ],
    ids=["f32", "f64 with the scene's probes", "free, given step"],
)
def test_run_repeats_a_session_to_the_bit(overrides: dict[str, Any], play: bool, begin: Begin) -> None:
    session = begin({**TILTED, "render.size": [40, 30], **overrides}, play=play)
    rng = np.random.default_rng(4)
    found: list[np.ndarray] = []
    events: dict[int, list[Event]] = {
        2: [Press(20, 12)],
        9: [Drag(23, 14)],
        11: [Drag(25, 15), Strength(40)],
        16: [Release(), Press(14, 16, pull=True)],
        17: [Turn(5, -3)],
        30: [Release()],
        33: [Press(22, 11), Release()],
        36: [Press(22, 18), Key("space"), Key("m")],
        38: [Key("space"), StrengthChange(15)],
    }
    for position in played(session, events, 50):
        found.append(position)
        if rng.random() < 0.1:
            session.picture()
    assert session.frame == 48, "paused for two"
    session.handle(Key("w"))
    written = Path("captures/session-1.yaml")
    assert session.notice == f"saved {written}"
    record = run(load_scene(written, {"output": ["trajectory"]}), "again", threads=2)
    assert record["status"] == "complete"
    again = np.load("again/trajectory.npz")["position"]
    assert len(again) == len(found) == 49
    assert np.abs(np.array(found) - found[0]).max() > 0.003
    np.testing.assert_array_equal(again, np.array(found))
    # Seen as it was seen at the end.
    assert load_scene(written).render.wireframe
    assert load_scene(written).render.camera.eye == session.recorded_scene().render.camera.eye  # type: ignore[union-attr]


def test_time_stands_still_when_paused_and_goes_on_frame_by_frame(begin: Begin) -> None:
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
    assert session.frame == 6, "going on, a frame is a frame"


def test_reset_begins_anew(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(60, 50))
    first = advance(session, 5)
    session.handle(Key("r"))
    session.handle(Drag(70, 50))
    assert session.tool.target == (0.5, 0.5), "nothing is held any more"
    assert (displacement(session) < AT_REST).all()
    assert (session.frame, session.tool.percent) == (0, 0)
    session.handle(Press(60, 50))
    np.testing.assert_array_equal(advance(session, 5), first)
    assert session.recorded_scene().time.duration == pytest.approx(5 / session.frame_rate)


def test_a_change_of_the_material_keeps_shape_and_motion(begin: Begin) -> None:
    changed, same = begin(TILTED), begin(TILTED)
    for session in (changed, same):
        session.handle(Press(60, 50))
        advance(session, 6)
    changed.handle(Material("springs.structural", 20.0))
    np.testing.assert_array_equal(advance(changed, 4), advance(same, 4), "the same material")
    before, velocity = changed.positions().copy(), changed._simulation.velocities()
    changed.handle(Material("springs.structural", 180.0))
    np.testing.assert_array_equal(changed.positions(), before)
    steps = changed._simulation._plan.grid.steps_per_frame / same._simulation._plan.grid.steps_per_frame
    assert steps > 1.5, "stiffer springs need smaller steps"
    np.testing.assert_allclose(changed._simulation.velocities(), velocity, rtol=1e-5)
    # It comes to the same rest as a sheet of this material.
    other = begin({**TILTED, "springs.structural": 180.0})
    other.handle(Press(60, 50))
    assert advance(changed, 150)[-1] == pytest.approx(advance(other, 160)[-1], abs=1e-4)
    changed.handle(Key("r"))
    assert (displacement(changed) < AT_REST).all()
    assert changed.material()["springs.structural"] == (180.0, 20.0)


def test_percent_by_wheel_and_keys_stays_between_nothing_and_all(begin: Begin) -> None:
    session = begin()
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


def test_the_light_goes_back_to_that_of_the_scene(begin: Begin) -> None:
    session = begin({"render.shading": "tissue"})
    shadings = []
    for _ in range(2):
        session.handle(Key("l"))
        shadings.append(session.viewport.render.shading)
    assert shadings == ["none", "tissue"]


def test_every_key_changes_what_it_says(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Press(60, 50))
    advance(session, 8)
    session.paused = True
    plain = session.picture()
    for key in ("t", "m", "l", "i", "h"):
        session.handle(Key(key))
        changed = session.picture()
        assert (changed != plain).any(), key
        session.handle(Key("c" if key == "t" else key))
        np.testing.assert_array_equal(session.picture(), plain, err_msg=f"{key} and back")
    # The side near the eye goes with the pointer; pushed down, the sheet shows more of its face.
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
    others = {"up", "down", "f", "c", "o", "space", ".", "r", "p", "g", "w", "q"}
    assert set(KEYS) == {"t", "m", "l", "i", "h"} | others, "a key that no test presses"


def test_a_press_beside_the_sheet_says_so(begin: Begin, message: Messages) -> None:
    session = begin(TILTED)
    session.handle(Press(2, 2))
    message(session.notice, "2, 2")
    advance(session, 4)
    assert (displacement(session) < AT_REST).all()
    assert not session.tool.engaged
    session.handle(Press(60, 50))
    assert session.notice == "", "what was said is no longer so"
    session.handle(Press(2, 2))
    advance(session, 200)
    assert session.notice == ""


def test_what_is_kept_has_a_name_of_its_own(begin: Begin) -> None:
    session = begin(TILTED)
    for _ in range(2):
        session.handle(Key("p"))
        session.handle(Key("g"))
        for _ in range(5):
            session.advance()
            session.picture()
        session.handle(Key("g"))
        session.handle(Key("w"))
    kept = sorted(path.name for path in Path("captures").iterdir())
    assert kept == [
        *("film-1.gif", "film-2.gif", "picture-1.png", "picture-2.png", "session-1.yaml", "session-2.yaml"),
        "speckle.png",
    ]
    with Image.open("captures/picture-1.png") as image:
        assert image.size == (120, 100)
    assert load_scene("captures/session-2.yaml").time.duration == pytest.approx(10 / session.frame_rate)


def test_another_picture_of_the_same_name_stays(begin: Begin) -> None:
    Path("captures").mkdir()
    Path("captures/speckle.png").write_bytes(b"mine")
    session = begin()
    session.handle(Key("w"))
    assert Path("captures/speckle.png").read_bytes() == b"mine"
    assert load_scene("captures/session-1.yaml").image == "captures/speckle-2.png"


def test_a_film_shows_as_much_time_as_went_by_since_it_began(begin: Begin) -> None:
    session = begin({**TILTED, "time.frames_per_second": 10})
    assert (session.frame_rate, session.subframes) == (60, 6)
    advance(session, 60)
    session.handle(Key("g"))
    for _ in range(6):
        # Slower than the film: every picture is of two of its frames.
        advance(session, 12)
        session.handle(StrengthChange(-5))
        session.picture()
    session.close()
    assert duration("captures/film-1.gif") == 1300, (
        "from the first picture, 1.2 s to the last one, and that one's tenth"
    )


def test_a_film_without_a_picture_is_none(begin: Begin, message: Messages) -> None:
    session = begin(TILTED)
    session.handle(Key("g"))
    session.handle(Key("g"))
    message(session.notice, "film")
    assert not Path("captures").exists()


def test_a_film_that_cannot_go_on_ends_and_the_session_goes_on(begin: Begin, message: Messages) -> None:
    session = begin(TILTED)
    session.handle(Key("g"))
    session.picture()
    subprocess.run(["pkill", "-KILL", "-P", str(os.getpid())], check=True)
    while not session.notice:
        session.advance()
        session.picture()
    message(session.notice, "captures")
    assert not Path("captures").exists()
    session.handle(Key("g"))
    session.picture()
    session.handle(Key("g"))
    assert session.notice == "saved captures/film-1.gif"


def test_a_film_shows_the_tissue_alone(begin: Begin) -> None:
    session = begin(TILTED)
    session.handle(Key("h"))
    session.handle(Key("g"))
    shown = session.picture()
    session.handle(Key("g"))
    session.handle(Key("p"))
    with Image.open("captures/picture-1.png") as image:
        alone = np.array(image)
    assert (shown != alone).any()
    with Image.open("captures/film-1.gif") as film:
        # As near as 256 colours are.
        assert np.abs(np.array(film.convert("RGB")).astype(int) - alone).mean() < 8
    assert np.abs(shown.astype(int) - alone).mean() > 15


@pytest.mark.slow
def test_a_session_too_long_for_a_file_says_so_before(
    begin: Begin, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    for module in (live_session, recording):
        monkeypatch.setattr(module, "MAX_NODES", 1100)
    session = begin(TILTED)
    session.handle(Press(60, 50))
    told = []
    for n in range(402):
        session.handle(Drag(50 + n % 20, 50))
        session.advance()
        told.append(session.notice)
    message(told[200], "(w)", "(r)")
    assert sum(notice != "" for notice in told) <= 160, "once"
    with message.raises(FilesError, "reset"):
        session.handle(Key("w"))
    assert list(Path("captures").iterdir()) == [Path("captures/speckle.png")]
    session.handle(Key("r"))
    session.handle(Key("w"))
    assert load_scene("captures/session-1.yaml").time.duration == pytest.approx(1 / session.frame_rate)


def test_a_film_ends_where_the_session_diverges(begin: Begin, message: Messages) -> None:
    session = begin({**TILTED, "probes.0.force": [0, 0, -1e12]})
    said: list[str] = []
    record_film(session, Path("a.gif"), 2.0, [(2, Press(60, 50)), (90, Key("w"))], notify=said.append)
    assert said[0] == session.divergence_error
    message(said[1], "script", hide=r"0\.\d+")
    assert duration("a.gif") < 500


def test_a_name_of_two_lines_is_one_in_the_comment(small: Path) -> None:
    keeper = Captures(Path("captures"), "a\nb: [.yaml")
    assert load_scene(keeper.save_scene(load_scene("small.yaml"))).sheet == load_scene("small.yaml").sheet


@pytest.mark.slow
def test_a_sheet_that_nothing_holds_may_fly_after_a_press(begin: Begin) -> None:
    # It flies on when the force is gone, farther than a sheet that was never pressed could.
    session = begin({**TILTED, "sheet.fixed": "none", "springs.virtual": 0.0, "probes.0.falloff": 0.0, "damping": 0.0})
    session.handle(Press(60, 50))
    advance(session, 15)
    session.handle(Strength(1))
    advance(session, 20)
    session.handle(Release())
    advance(session, 400)
    assert session.divergence_error == ""
    assert displacement(session).max() > 10 * 0.3


def test_what_cannot_be_kept_is_told_and_nothing_is_lost(begin: Begin, message: Messages) -> None:
    Path("captures").write_text("no folder")
    session = begin(TILTED)
    session.handle(Press(60, 50))
    advance(session, 5)
    for key in "pgw":
        with message.raises(FilesError, "captures", "--out"):
            session.handle(Key(key))
    advance(session, 5)
    assert session.frame == 10


def test_a_session_that_diverged_says_so_and_can_be_reset(begin: Begin, message: Messages) -> None:
    # Strong enough to go wrong in the fourth frame, and not before.
    session = begin({**TILTED, "probes.0.force": [0, 0, -3e6]})
    session.handle(Press(60, 50))
    advance(session, 10)
    message(session.divergence_error, "diverged", hide=r"\d\S*")
    assert session.notice == session.divergence_error
    frame = session.frame
    advance(session, 3)
    assert session.frame == frame
    session.handle(Key("w"))
    assert session.notice == "saved captures/session-1.yaml"
    again = run(load_scene("captures/session-1.yaml", {"output": []}), "again", threads=2)
    assert again["status"] == "diverged", "what goes wrong goes wrong again"
    session.handle(Key("r"))
    assert session.divergence_error == ""
    assert np.isfinite(advance(session, 3)).all()


@pytest.mark.parametrize(
    ("time", "parts", "precision"),
    [
        *(({"frames_per_second": rate}, parts, "f32") for rate, parts in ((25, 2), (60, 1), (10, 6), (120, 1))),
        ({"frames_per_second": 24, "precision": "f64"}, 2, "f64"),
        # 25 steps a frame cannot be cut into three frames, nor two.
        ({"frames_per_second": 20, "step": 0.002}, 1, "f32"),
    ],
)
def test_a_session_has_as_many_frames_as_a_screen_shows(
    time: dict[str, Any], parts: int, precision: str, small: Path
) -> None:
    scene = load_scene("small.yaml", {f"time.{key}": value for key, value in {"duration": 1, **time}.items()})
    live, found = divide_frames(plan_of(scene))
    assert (live.scene.time.frames_per_second, found) == (time["frames_per_second"] * parts, parts)
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
def test_scenes_that_nobody_can_press(
    overrides: dict[str, Any], play: bool, key: str, begin: Begin, message: Messages
) -> None:
    with message.raises(SceneError, key):
        begin(overrides, play=play)


def test_legible_units(message: Messages) -> None:
    message(map(live_session.length, (0.0, 2.5e-9, 1.33e-7, 8.284e-4, 0.0621, 12.3)))
    message(map(live_session.newtons, (0.0, 0.514, 9.63, 123.4)))


ROD = {"probes.0.instrument": {"radius": 0.01, "shaft": [0.3, -0.2, 1], "length": 0.2}}


def rod_pixels(session: Session) -> set[tuple[int, int]]:
    """The pixels that an instrument changes."""
    bare = session.viewport.draw(session.positions())
    session.handle(Key("i"))  # no figures
    changed = (session.picture() != bare).any(axis=-1)
    session.handle(Key("i"))
    return {(int(x), int(y)) for y, x in np.argwhere(changed)}


def test_the_instrument_is_under_the_pointer(begin: Begin) -> None:
    session = begin({**TILTED, **ROD})
    for x, y in ((40, 60), (80, 50)):
        session.handle(Hover(x, y))
        pixels = rod_pixels(session)
        assert any(abs(column - x) <= 3 and abs(row - y) <= 3 for column, row in pixels), "the tip is there"
        assert 20 < len(pixels) < 3000
    session.handle(Press(60, 55))
    session.advance()
    session.handle(Hover(20, 20))
    held = rod_pixels(session)
    assert any(abs(column - 60) <= 4 and abs(row - 55) <= 4 for column, row in held), "while it presses it stays"


# A tool that can be held by position, as its instrument is wide enough to touch several points.
WIDE = {"radius": 0.03, "shaft": [0.3, -0.2, 1], "length": 0.2}
BY_HAND = {**TILTED, "probes.0.instrument": WIDE}
# Events of a session by position: it presses, drags, goes deeper, grips and lifts, and presses elsewhere.
EVENTS: dict[int, list[Event]] = {
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


def moved(session: Session) -> PositionControlledTool:
    """The tool, which is held by position."""
    assert isinstance(session.tool, PositionControlledTool)
    return session.tool


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "play"),
    [
        ({}, False),
        ({"time.precision": "f64", "springs.virtual_active": "always"}, True),
        pytest.param(
            *({"time.step": 0.0025, "time.frames_per_second": 20, "sheet.fixed": "none"}, False), marks=pytest.mark.slow
        ),
    ],
    ids=["f32", "f64 with the scene's probes", "free, given step"],
)
def test_run_repeats_a_session_by_position_to_the_bit(overrides: dict[str, Any], play: bool, begin: Begin) -> None:
    session = begin({**BY_HAND, "time.precision": "f32", "render.size": [40, 30], **overrides}, play=play)
    session.handle(Press(20, 15))
    advance(session, 3)
    session.handle(Key("f"))
    assert (session.frame, session.tool.engaged) == (0, False), "what was done by force is no part of the record"
    found: list[np.ndarray] = []
    gripped, felt = False, 0.0
    for position in played(session, EVENTS, 62):
        found.append(position)
        gripped, felt = gripped or moved(session).gripping, max(felt, session.felt_force())
    assert gripped
    assert felt > 0
    session.handle(Key("w"))
    written = load_scene("captures/session-1.yaml", {"output": ["trajectory"]})
    probe = written.probes[-1]
    assert probe.path is not None
    assert (probe.friction, len(probe.grip), len(written.probes)) == (0.5, 1, 1 + play)
    assert run(written, "again", threads=2)["status"] == "complete"
    again = np.load("again/trajectory.npz")["position"]
    assert len(again) == len(found) == 61
    np.testing.assert_array_equal(again, np.array(found))


def test_by_position_the_tip_follows_the_pointer_and_feels_what_it_touches(begin: Begin) -> None:
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
    beside = session.positions()[8, 8, 0]
    for _ in range(10):
        x, y = session.viewport.project(np.array([*session._rest_point(session.tool.target), 0])) or (0, 0)
        session.handle(Drag(x + 1, y))
        advance(session, 1)
    assert session.positions()[8, 8, 0] > beside + 0.001, "friction drags the tissue along"
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
    assert session.positions()[12, 12, 2] > 0.02, "the wheel lifts what is gripped"


def test_a_tool_that_the_scene_moves_is_held_by_position_from_the_start(begin: Begin) -> None:
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
    ("probe", "word"),
    [
        (FORCE, "instrument"),
        ({"path": [[0, 0.5, 0.5, 0.05]], "instrument": WIDE}, "force"),
        ({**FORCE, "instrument": {**WIDE, "shaft": [0, 0, -1]}}, "shaft"),
    ],
    ids=["no instrument", "no force", "from below"],
)
def test_a_tool_that_cannot_be_held_otherwise(
    probe: dict[str, Any], word: str, begin: Begin, message: Messages
) -> None:
    session = begin({**TILTED, "probes": [probe]})
    tool = session.tool
    advance(session, 2)
    session.handle(Key("f"))
    message(session.notice, word)
    assert (session.tool, session.frame) == (tool, 2)


def test_a_tool_too_thin_for_the_points_says_so(begin: Begin, message: Messages) -> None:
    session = begin({**TILTED, "probes.0.instrument": {**WIDE, "radius": 0.01}})
    session.handle(Key("f"))
    message(session.notice, "probes.0", "radius")


def bar_of(picture: np.ndarray) -> float:
    """How much of the bar under the two lines of figures is filled."""
    lines = [row[:, 0] for row in picture[:80] if (row[:70] == overlay.OUTLINE_GREY).all(axis=-1).any()]
    row = lines[len(lines) // 2]
    right = int(np.flatnonzero(row == overlay.OUTLINE_GREY)[-1])
    return float((row[: right + 1] == 255).sum() / (overlay.BAR_LENGTH_LETTERS * 11))


def test_the_force_felt_is_shown_with_a_bar(begin: Begin, message: Messages) -> None:
    session = begin({**BY_HAND, "render.size": [240, 200]})
    session.handle(Key("f"))
    bare = session.picture()
    session.handle(Press(*pixel_of(session, 12, 12)))
    advance(session, 20)
    hardest = session.felt_force()
    for percent in (100, 60):
        session.handle(Strength(percent))
        advance(session, 20)
        hardest = max(hardest, session.felt_force())
    (figures, *_) = session._figure_lines()
    assert figures.endswith(live_session.newtons(session.felt_force()))
    message(figures, "45 mm", hide=r"[\d.]+ N")
    bar = overlay.ValueBar(session.felt_force(), hardest, "N")
    assert bar_of(session.picture()) == pytest.approx(session.felt_force() / bar.end, abs=0.02)
    session.handle(Key("r"))
    session.handle(Strength(40))
    message(session._figure_lines()[0], "30 mm", "0 N")
    session.handle(Key("i"))
    session.handle(Key("i"))
    assert (session.picture()[40:70, :130] == bare[40:70, :130]).all(), "no bar any more"


@pytest.mark.parametrize(("largest", "end"), [(0.51, 1), (1, 1), (1.01, 2), (2.4, 5), (7, 10), (3e-4, 5e-4)])
def test_a_bar_ends_at_a_round_number(largest: float, end: float) -> None:
    assert overlay.ValueBar(0.1, largest, "N").end == pytest.approx(end)


def test_a_clamp_holds_its_side_in_a_session(begin: Begin, message: Messages) -> None:
    """It is no tool of the session, which needs another one, and acts whether the scene is played or not."""
    clamp = {"clamp": "right", "path": [[0, 0, 0, 0], [0.2, 0.01, 0, 0]]}
    force = {"force": [0, 0, -2000], "falloff": 60}
    held = {**TILTED, "sheet.fixed": ["left"], "probes": [clamp, force]}
    session = begin({name: value for name, value in held.items() if not name.startswith("probes.")})
    advance(session, 5 * session.subframes)
    assert displacement(session)[1:-1, -1] == pytest.approx(0.01, abs=AT_REST)
    assert displacement(session)[:, 0].max() < AT_REST
    session.picture()
    with message.raises(SceneError, "probes"):
        begin({"sheet.fixed": ["left"], "probes": [clamp]})
