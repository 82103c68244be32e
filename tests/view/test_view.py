"""`taichi-msm view`: scripts, films, errors; and the window, where there is an X server to be had."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pygame
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import load_scene
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.scene.scene import Scene
from taichi_msm.view.events import QUIT, Drag, Hover, Key, Press, Release, Strength, StrengthChange, Turn
from taichi_msm.view.pacing import MAX_DELAY_S, Pacing
from taichi_msm.view.script import load_script, schedule_events
from taichi_msm.view.window import InputReader, fit_picture, initial_window_size
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import duration
from tests.telling import Telling

SCRIPT = """\
events:
  - {t: 0.1, do: press, at: [20, 15]}
  - {t: 0.3, do: drag, at: [26, 15], seconds: 0.2}
  - {t: 0.6, do: release}
  - {t: 0.7, do: key, name: w}
"""


def test_a_script_is_done_and_filmed(small: Path, program: Program, message: Messages) -> None:
    Path("script.yaml").write_text(SCRIPT)
    done = program("view", "small.yaml", "--record", "films/live.gif", "--seconds", "1", "--script", "script.yaml")
    assert done.returncode == 0
    message(done.stderr, "0.7 s", "output/small-live/session-1.yaml")
    assert done.stdout == "films/live.gif\noutput/small-live/session-1.yaml\n"
    assert [path.name for path in Path("films").iterdir()] == ["live.gif"], "and nothing is left beside it"
    with Image.open("films/live.gif") as film:
        assert film.size == (40, 30)
    assert duration("films/live.gif") == 1100, "the first picture, and ten more a second"
    probe = load_scene("output/small-live/session-1.yaml").probes[0]
    times, percent = np.array(probe.load).T
    assert (times[np.flatnonzero(percent)[0] - 1], times[-1]) == (0.1, pytest.approx(0.7))
    assert percent.max() == 100


@pytest.mark.parametrize(
    "arguments",
    [
        "--seconds 1",
        "--script a.yaml",
        "--port 8000",
        "--browser --record a.gif --seconds 1",
        "--browser --origin hub.example.org",
        "--record a.png --seconds 1",
        "--record a.gif --seconds 0",
        "--record a.gif --seconds nan",
        "--record a.gif --seconds 1 --script no.yaml",
        "--record a.gif --seconds 1 --set probes=[]",
    ],
)
def test_what_view_refuses(arguments: str, small: Path, capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    assert main(["view", "small.yaml", *arguments.split()]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    # What click says of a range depends on its version.
    message(said.err, hide=r"0\.0 is not.*(?= \(see)")
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"]


def test_mp4_needs_pyav(
    small: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setattr("taichi_msm.scene.outputs.is_pyav_installed", lambda: False)
    assert main(["view", "small.yaml", "--record", "a.mp4"]) == 2
    message(capsys.readouterr().err, "--record", "pip")


# Scripts with a fault, and where it is.
FAULTS = {
    "empty": ("", "1:1"),
    "list": ("- a", "1:1"),
    "events no list": ("events: 3", "1:1"),
    "no time": ("events:\n  - {do: press, at: [1, 2]}", "2:5: events.0.t"),
    "unknown action": ("events:\n  - {t: 1, do: pres}", "2:12: events.0.do"),
    "no place": ("events:\n  - {t: 1, do: press}", "2:5: events.0.at"),
    "place of a release": ("events:\n  - {t: 1, do: release, at: [1, 2]}", "2:25: events.0.at"),
    "drag unpressed": ("events:\n  - {t: 1, do: drag, at: [1, 2]}", "2:5: events.0"),
    "released twice": (
        "events:\n  - {t: 1, do: press, at: [1, 2]}\n  - {t: 2, do: release}\n  - {t: 3, do: release}",
        "4:5: events.2",
    ),
    "outside": (
        "events:\n  - {t: 1, do: press, at: [39.4, 29.6]}\n  - {t: 2, do: pull, at: [-1, 2]}",
        "2:23: events.0.at",
        "3:22: events.1.at",
    ),
    "late": (
        "events:\n  - {t: 1.0e+9, do: turn, by: [1, 2], seconds: 1.0e+9}",
        "2:6: events.0.t",
        "2:39: events.0.seconds",
    ),
    "press with seconds": ("events:\n  - {t: 1, do: press, at: [1, 2], seconds: 1}", "2:35: events.0.seconds"),
    "unknown key": ("events:\n  - {t: 1, do: key, name: q}", "2:21: events.0.name"),
    "overlap": (
        "events:\n  - {t: 1, do: turn, by: [1, 2], seconds: 2}\n  - {t: 2, do: key, name: m}",
        "3:5: events.1",
    ),
    "two faults": ("events:\n  - {t: 1, do: percent, to: 101}\nfoo: 1", "2:25: events.0.to", "3:1: foo"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_with_a_script(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    text, *places = FAULTS[name]
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(text)
    with message.raises(SceneError, *places):
        load_script("s.yaml", (40, 30))


def test_events_of_a_script(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        """\
size: [100, 50]
events:
  - {t: 0.1, do: pull, at: [9.5, 19.5]}
  - {t: 0.2, do: drag, at: [29.5, 39.5], seconds: 0.2}
  - {t: 0.4, do: release}
  - {t: 0.5, do: turn, by: [10, 4], seconds: 0.2}
  - {t: 0.7, do: percent, to: 40}
  - {t: 0.7, do: key, name: m}
"""
    )
    assert list(schedule_events(load_script(tmp_path / "s.yaml", (200, 100)), 10.0, (200, 100))) == [
        (1, Press(19.5, 39.5, pull=True)),
        (2, Drag(39.5, 59.5)),
        (3, Drag(59.5, 79.5)),
        (4, Release()),
        (5, Turn(10.0, 4.0)),
        (6, Turn(10.0, 4.0)),
        (7, Strength(40)),
        (7, Key("m")),
    ]


def test_without_a_display_it_says_what_to_do(
    small: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    for display in ("", ":54321"):
        monkeypatch.setenv("DISPLAY", display)
        done = program("view", "small.yaml")
        assert (done.returncode, done.stdout) == (2, "")
        message(done.stderr, "DISPLAY", "--record", hide=r"(?<=SDL: )[^)]*")


def test_an_interrupted_film_leaves_the_one_that_was_there(small: Path, message: Messages) -> None:
    Path("live.gif").write_bytes(b"before")
    filming = ["view", "small.yaml", "--record", "live.gif", "--seconds", "3600"]
    with Telling(*filming, stderr=subprocess.PIPE) as process:
        process.until("film", 1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
        # On a slow machine lines of progress come first.
        message(error.splitlines()[-1], "interrupted")
    assert process.returncode == 130
    assert Path("live.gif").read_bytes() == b"before"
    assert sorted(path.name for path in small.iterdir()) == ["live.gif", "small.yaml", "speckle.png"]


def test_a_script_is_taken_event_by_event(tmp_path: Path) -> None:
    """An hour at a million frames a second has 3.6e9 of them."""
    text = "events: [{t: 0, do: press, at: [1, 1]}, {t: 1, do: drag, at: [9, 9], seconds: 3599}]"
    (tmp_path / "s.yaml").write_text(text)
    events = schedule_events(load_script(tmp_path / "s.yaml", (20, 20)), 1e6, (20, 20))
    assert [frame for frame, _ in islice(events, 3)] == [0, 1_000_000, 1_000_001]


def test_a_film_that_cannot_be_written(small: Path, program: Program, message: Messages) -> None:
    Path("films").write_text("no folder")
    Path("folder.gif").mkdir()
    for film in ("films/live.gif", "folder.gif"):
        done = program("view", "small.yaml", "--record", film, "--seconds", "1")
        assert done.returncode == 4
        message(done.stderr, film.split("/")[0], "--record")


FAILING = """\
events:
  - {t: 0.1, do: press, at: [0, 0]}
  - {t: 0.2, do: key, name: p}
  - {t: 5, do: release}
"""


def test_failures_of_a_script_are_told_and_filmed(small: Path, program: Program, message: Messages) -> None:
    Path("kept").write_text("no folder")
    Path("script.yaml").write_text(FAILING)
    options = ["--seconds", "0.5", "--script", "script.yaml", "--out", "kept", "--set", "render.camera=oblique"]
    done = program("view", "small.yaml", "--record", "a.gif", *options)
    assert done.returncode == 4
    message(done.stderr, "pixel 0, 0", "0.5 s", "kept")
    with Image.open("a.gif") as film:
        assert film.n_frames >= 1


AREA = pygame.Rect(0, 0, 400, 300)


def motion(*at: int) -> pygame.Event:
    return pygame.Event(pygame.MOUSEMOTION, pos=at)


def button(number: int, *at: int) -> pygame.Event:
    return pygame.Event(pygame.MOUSEBUTTONDOWN, pos=at, button=number)


def let_go(number: int, *at: int) -> pygame.Event:
    return pygame.Event(pygame.MOUSEBUTTONUP, pos=at, button=number)


def key(code: int, typed: str = "", place: int = 0) -> pygame.Event:
    """A key that goes down: its code, what it types, and where it is on the keyboard."""
    return pygame.Event(pygame.KEYDOWN, key=code, unicode=typed, scancode=place)


def key_up(code: int) -> pygame.Event:
    return pygame.Event(pygame.KEYUP, key=code)


def test_what_the_hand_does() -> None:
    hand = InputReader((400, 300))

    def understood(*told: pygame.Event) -> list[Any]:
        return list(hand.events(told, AREA))

    assert understood(motion(0, 0), motion(7, 8)) == [Hover(0, 0), Hover(7, 8)]
    assert understood(button(1, 0, 0)) == [Press(0, 0)]
    assert understood(motion(399, 299), motion(-20, 350)) == [Drag(399, 299), Drag(-20, 350)]
    assert understood(let_go(1, 20, 30), motion(30, 30)) == [Release(), Hover(30, 30)]
    assert understood(key(pygame.K_RSHIFT), button(1, 200, 149)) == [Press(200, 149, pull=True)]
    assert understood(key_up(pygame.K_RSHIFT), let_go(1, 0, 0), button(1, 0, 0)) == [Release(), Press(0, 0)]
    understood(let_go(1, 0, 0))
    assert understood(button(3, 100, 99), motion(110, 99), motion(115, 89), let_go(3, 115, 89), motion(300, 10)) == [
        Turn(10, 0),
        Turn(5, -10),
        Hover(300, 10),
    ]
    assert understood(button(2, 1, 1), motion(2, 2), let_go(2, 2, 2)) == [Hover(2, 2)]
    # The wheel is reported as buttons 4 and 5, too.
    wheel = button(4, 0, 0), let_go(4, 0, 0), pygame.Event(pygame.MOUSEWHEEL, x=0, y=1)
    assert understood(*wheel) == [StrengthChange(5)]
    assert understood(pygame.Event(pygame.MOUSEWHEEL, x=1, y=-2)) == [StrengthChange(-10)]
    assert understood(pygame.Event(pygame.MOUSEWHEEL, x=1, y=0)) == []
    assert understood(pygame.Event(pygame.QUIT)) == [QUIT]


TYPED: dict[str | None, list[pygame.Event]] = {
    "space": [key(pygame.K_SPACE, " ")],
    ".": [key(pygame.K_PERIOD, "."), key(pygame.K_SEMICOLON, ".", pygame.KSCAN_COMMA)],
    "up": [
        *(key(pygame.K_EQUALS, "="), key(pygame.K_KP_PLUS, "+"), key(pygame.K_UP)),
        key(pygame.K_1, "+", pygame.KSCAN_1),
    ],
    "down": [key(pygame.K_DOWN), key(pygame.K_MINUS, "-"), key(pygame.K_KP_MINUS, "-")],
    "q": [key(pygame.K_ESCAPE, "\x1b")],
    # Of a French and a Russian keyboard, too.
    "m": [
        *(key(pygame.K_m, "m"), key(pygame.K_m, "M"), key(pygame.K_m, "m", pygame.KSCAN_SEMICOLON)),
        key(0x44C, "\u044c", pygame.KSCAN_M),
    ],
    None: [
        *(key(pygame.K_c, "\x03"), key(pygame.K_TAB, "\t"), key(pygame.K_LCTRL)),
        key(0xE9, "\u00e9", pygame.KSCAN_2),
    ],
}


@pytest.mark.parametrize("name", TYPED)
def test_keys_are_what_they_type(name: str | None) -> None:
    expected = [Key(name)] if name else []
    for event in TYPED[name]:
        hand = InputReader((400, 300))
        assert list(hand.events([event, key_up(event.key)], AREA)) == expected
        assert list(hand.events([event] * 3, AREA)) == expected * (3 if name in ("up", "down") else 1), "held down"


def test_a_hand_lets_go_where_another_window_gets_the_release() -> None:
    lost = pygame.Event(pygame.WINDOWFOCUSLOST)
    pressing, turning = InputReader((400, 300)), InputReader((400, 300))
    told = [button(1, 9, 9), lost, motion(5, 5), let_go(1, 5, 5)]
    assert list(pressing.events(told, AREA)) == [Press(9, 9), Release(), Hover(5, 5)]
    assert list(turning.events([button(3, 9, 9), lost, motion(5, 5)], AREA)) == [Hover(5, 5)]


def test_a_picture_fills_its_window_and_pixels_are_found_in_it() -> None:
    assert fit_picture((400, 300), (400, 300)) == AREA
    assert fit_picture((400, 300), (1000, 600)) == pygame.Rect(100, 0, 800, 600)
    assert fit_picture((400, 300), (200, 800)) == pygame.Rect(0, 325, 200, 150)
    assert fit_picture((400, 300), (1, 1)).size == (1, 1)
    told = [motion(100, 0), motion(101, 1), motion(899, 599), motion(99, 600)]
    assert list(InputReader((400, 300)).events(told, fit_picture((400, 300), (1000, 600)))) == [
        # Every pixel takes 2 x 2; the first of them is a quarter of a pixel from its centre.
        Hover(-0.25, -0.25),
        Hover(0.25, 0.25),
        Hover(399.25, 299.25),
        Hover(-0.75, 299.75),
    ]


@pytest.mark.parametrize(
    ("screen", "size"),
    [((1920, 1080), (512, 512)), ((3840, 2160), (1024, 1024)), ((1100, 3840), (512, 512)), ((640, 480), (480, 480))],
)
def test_a_window_opens_as_large_as_its_screen_asks_for(screen: tuple[int, int], size: tuple[int, int]) -> None:
    assert initial_window_size((512, 512), screen) == size


class Clock:
    """A clock that goes when it is told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def shown(clock: Clock, stepping: float, drawing: float, seconds: float) -> tuple[int, str]:
    """Let a machine that needs so long for a frame and a picture work for some time; the frames, and what is said."""
    pacing, frames = Pacing(50.0, clock), 0
    while clock.now < seconds:
        clock.now += pacing.delay_s()
        for _ in pacing.due_frames():
            clock.now += stepping
            frames += 1
        clock.now += drawing
    return frames, pacing.status()


@pytest.mark.parametrize(
    ("stepping", "drawing", "frames"),
    [
        (0.002, 0.01, 500),
        # Pictures are slow: several frames for each, and time goes as it should.
        (0.002, 0.07, 500),
        # Stepping is slow: every frame has its picture, and time goes slower.
        (0.05, 0.01, 167),
    ],
    ids=["fast", "slow pictures", "slow steps"],
)
def test_time_goes_as_fast_as_it_does_outside(stepping: float, drawing: float, frames: int, message: Messages) -> None:
    found, words = shown(Clock(), stepping, drawing, 10.0)
    assert found == pytest.approx(frames, rel=0.03)
    message(words)


def test_what_was_missed_is_not_made_up_for() -> None:
    clock = Clock()
    pacing = Pacing(50.0, clock)
    clock.now = 60.0
    assert len(list(pacing.due_frames())) <= MAX_DELAY_S * 50 + 1


class Screen:
    """An X server of its own, without a screen, and a hand at its mouse and keyboard.

    Args:
        number: of the X server.
        folder: where the server keeps what it shows.
    """

    def __init__(self, number: str, folder: Path) -> None:
        self.environment = os.environ | {"DISPLAY": f":{number}"}
        self._folder = folder

    def hand(self, *words: str) -> str:
        """Do what xdotool calls these words."""
        return subprocess.run(
            ["xdotool", *words], env=self.environment, check=True, stdout=subprocess.PIPE, text=True
        ).stdout

    def shown(self) -> NDArray[np.uint8]:
        """What a person would see, shape (600, 800, 3)."""
        content = (self._folder / "Xvfb_screen0").read_bytes()
        # A file of xwd: a header, a table of colours of 12 bytes each, and rows of blue, green, red, unused.
        header = np.frombuffer(content, ">u4", 25)
        pixels = np.frombuffer(content, np.uint8, 600 * header[12], int(header[0] + 12 * header[19]))
        return pixels.reshape(600, -1, 4)[:, :800, 2::-1]


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[Screen]:
    if not (shutil.which("Xvfb") and shutil.which("xdotool")):
        pytest.skip("needs Xvfb and xdotool")
    folder = tmp_path / "screen"
    folder.mkdir()
    read, write = os.pipe()
    with subprocess.Popen(
        # It would begin anew, and let nobody in meanwhile, whenever its last client goes.
        ["Xvfb", "-noreset", "-displayfd", str(write), "-screen", "0", "800x600x24", "-fbdir", str(folder)],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    ) as server:
        os.close(write)
        with os.fdopen(read) as answer:
            number = answer.readline().strip()
        try:
            yield Screen(number, folder)
        finally:
            server.terminate()


class Live:
    """`taichi-msm view` in a window of 320 x 240 pixels.

    Args:
        screen: the screen.
        overrides: of the scene, as for `--set`.
    """

    def __init__(self, screen: Screen, *overrides: str) -> None:
        self._screen = screen
        size = [
            word for key in ("render.size=[320,240]", "render.camera=oblique", *overrides) for word in ("--set", key)
        ]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "taichi_msm", "view", "small.yaml", "--threads", "2", "--out", "kept", *size],
            env=screen.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._window = screen.hand("search", "--sync", "--onlyvisible", "--pid", str(self.process.pid)).split()[0]

    def hand(self, *words: str) -> None:
        """Do what xdotool calls these words."""
        self._screen.hand(*words)

    def move(self, x: int, y: int, *words: str) -> None:
        """Move the pointer to a pixel of the picture, and do what xdotool calls these words."""
        self.hand("mousemove", "--window", self._window, str(x), str(y), *words)

    def kept(self, kind: str, key: str, x: int = 160) -> Path:
        """Press the key that keeps something until it is there: the window listens when all is compiled."""
        known = set(Path("kept").glob(f"{kind}-*"))
        for n in range(300):
            self.move(x, 119 + n % 2, "key", key)
            time.sleep(0.1)
            if new := set(Path("kept").glob(f"{kind}-*")) - known:
                return new.pop()
            if self.process.poll() is not None:
                break
        self.process.kill()
        raise AssertionError(f"there is no {kind}: {self.process.communicate()}")

    def picture(self) -> NDArray[np.int64]:
        """What the key keeps as a picture."""
        with Image.open(self.kept("picture", "p")) as image:
            return np.array(image).astype(int)

    def until(self, met: Callable[[Scene], bool], x: int = 160) -> None:
        """Wait for what a session has in its scene, as long as a busy machine may need."""
        for _ in range(60):
            if met(load_scene(self.kept("session", "w", x))):
                return
        self.process.kill()
        raise AssertionError(f"never met: {self.process.communicate()}")


def percents(scene: Scene) -> list[float]:
    return [percent for _, percent in scene.probes[0].load]


def test_the_window(small: Path, screen: Screen) -> None:
    live = Live(screen)
    before = live.picture()
    live.move(160, 120, "mousedown", "1")
    live.until(lambda scene: max(percents(scene)) == 100)
    # The first place is where the tool began.
    live.until(lambda scene: np.ptp(np.array(scene.probes[0].at)[1:, 1]) > 0.05, x=200)
    # A notch of the wheel less, and pulling.
    live.hand("mouseup", "1", "click", "5", "keydown", "shift", "mousedown", "1")
    live.until(lambda scene: min(percents(scene)) == -95)
    live.hand("mouseup", "1", "keyup", "shift", "mousedown", "3")
    live.move(230, 140, "mouseup", "3")
    live.until(lambda scene: scene.render.camera not in ("top", "oblique"))
    live.hand("key", "minus", "key", "KP_Subtract", "key", "Down", "key", "Down")
    live.hand("click", "4", "key", "plus", "key", "KP_Add", "mousedown", "1")
    live.until(lambda scene: percents(scene)[-1] == 90)
    # A key that is held down repeats, here until nothing is left.
    live.hand("mouseup", "1", "keydown", "Down")
    time.sleep(2)
    live.hand("keyup", "Down", "key", "plus", "key", "plus", "key", "plus", "mousedown", "1")
    live.until(lambda scene: percents(scene)[-1] == 15)
    live.hand("mouseup", "1")
    after = live.picture()
    live.hand("key", "Escape")
    out, err = live.process.communicate(timeout=60)
    assert (live.process.returncode, err) == (0, "")
    assert out.splitlines()[-1].startswith("kept/picture-")
    assert np.abs(after - before).max() > 50


@pytest.mark.slow
def test_the_window_by_position_until_a_signal(small: Path, screen: Screen, message: Messages) -> None:
    live = Live(screen, "probes.0.instrument={radius: 0.04, shaft: [0.3, -0.2, 1], length: 0.3}")
    live.kept("picture", "p")
    live.hand("key", "f")

    def path(scene: Scene) -> NDArray[np.float64]:
        keys = scene.probes[0].path
        return np.array(keys or np.zeros((1, 4)))

    live.until(lambda scene: bool(np.ptp(path(scene)[:, 1]) > 0.01), x=200)
    live.hand("mousedown", "1")
    live.until(lambda scene: path(scene)[-1, 3] == -0.04, x=200)
    live.hand("mouseup", "1", "keydown", "shift", "mousedown", "1")
    live.until(lambda scene: scene.probes[0].grip[0][0] > 0, x=200)
    # From 53 % of the greatest depth, a quarter of the sheet's shorter side, to as much above the sheet, and more.
    live.hand("keyup", "shift", "click", "--repeat", "20", "5")
    live.until(lambda scene: path(scene)[-1, 3] > 0.03, x=200)
    live.process.send_signal(signal.SIGTERM)
    message(live.process.communicate(timeout=60)[1].splitlines()[-1], "interrupted")
    assert live.process.returncode == 143


SHOWING = """\
import sys
import numpy as np
from taichi_msm.view.window import Window
picture = np.load("picture.npy")
with Window("a", (320, 240)) as window:
    for _ in sys.stdin:
        print([*window.events()], flush=True)
        window.show(picture)
"""


def test_the_screen_shows_the_picture(tmp_path: Path, screen: Screen) -> None:
    """To the last bit, and where the window is larger, as large as fits, between black bars."""
    random = np.random.default_rng(1)
    picture = np.kron(random.integers(0, 256, (6, 8, 3), np.uint8), np.ones((40, 40, 1), np.uint8))
    picture[:4] = random.integers(0, 256, (4, 320, 3), np.uint8)
    np.save(tmp_path / "picture.npy", picture)
    with subprocess.Popen(
        [sys.executable, "-c", SHOWING],
        env=screen.environment,
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:

        def shown() -> tuple[NDArray[np.uint8], str]:
            """What is on the screen after some rounds, and the events of each."""
            assert process.stdin is not None
            assert process.stdout is not None
            told = ""
            for _ in range(20):
                process.stdin.write("show\n")
                process.stdin.flush()
                told += process.stdout.readline()
                time.sleep(0.02)
            return screen.shown(), told

        window = screen.hand("search", "--sync", "--onlyvisible", "--pid", str(process.pid)).split()[0]
        whole, _ = shown()
        np.testing.assert_array_equal(whole[180:420, 240:560], picture)
        screen.hand("windowmove", window, "0", "0", "windowsize", "--sync", window, "800", "480")
        shown()
        screen.hand("mousemove", "100", "50")
        whole, told = shown()
        assert "[Hover(x=9.75, y=24.75)]" in told
        # The middles of the fields of 80 x 80 that are whole.
        np.testing.assert_allclose(whole[39:480:80, 119:680:80], picture[19::40, 19::40], atol=1)
        assert not whole[:, :80].any()
        assert not whole[:, 720:].any()
        assert not whole[480:].any()
        process.communicate()
