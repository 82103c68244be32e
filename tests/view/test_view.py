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
from taichi_msm.view.events import Drag, Hover, Key, Press, Release, Strength, StrengthChange, Turn
from taichi_msm.view.script import load_script, schedule_events
from taichi_msm.view.window import MAX_DELAY_S, QUIT, InputReader, Pacing, fit_picture, initial_window_size
from tests.conftest import Program
from tests.outputs import duration
from tests.telling import Telling

SCRIPT = """\
events:
  - {t: 0.1, do: press, at: [20, 15]}
  - {t: 0.3, do: drag, at: [26, 15], seconds: 0.2}
  - {t: 0.6, do: release}
  - {t: 0.7, do: key, name: w}
"""


def test_a_script_is_done_and_filmed(small: Path, program: Program) -> None:
    Path("script.yaml").write_text(SCRIPT)
    done = program("view", "small.yaml", "--record", "films/live.gif", "--seconds", "1", "--script", "script.yaml")
    assert (done.returncode, done.stderr) == (0, "0.7 s: saved output/small-live/session-1.yaml\n")
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
    ("arguments", "expected"),
    [
        (["--record", "a.gif"], "taichi-msm: --record FILE.gif and --seconds N go together (see taichi-msm --help)"),
        (["--seconds", "2"], "taichi-msm: --record FILE.gif and --seconds N go together (see taichi-msm --help)"),
        (
            ["--script", "a.yaml"],
            "taichi-msm: --script needs --record; in the window you press with the mouse (see taichi-msm --help)",
        ),
        (
            ["--record", "a.png", "--seconds", "1"],
            "taichi-msm: Invalid value for --record: a.png is not the name of a GIF; let it end in .gif "
            "(see taichi-msm --help)",
        ),
        (
            ["--record", "a.gif", "--seconds", "0"],
            "taichi-msm: Invalid value for '--seconds': 0.0 is not in the range 0<x<=3600. (see taichi-msm --help)",
        ),
        (
            ["--record", "a.gif", "--seconds", "nan"],
            "taichi-msm: Invalid value for --seconds: nan is not a number of seconds (see taichi-msm --help)",
        ),
        (["--record", "a.gif", "--seconds", "1", "--script", "no.yaml"], "no.yaml: no such file or directory"),
        (
            ["--record", "a.gif", "--seconds", "1", "--set", "probes=[]"],
            "small.yaml: probes: empty; the tool takes its force from the first probe, add one",
        ),
    ],
)
def test_what_view_refuses(
    arguments: list[str], expected: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "small.yaml", *arguments]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", expected + "\n")
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["s.yaml:1:1: no keys; a script needs at least events"]),
        ("- a", ['s.yaml:1:1: ["a"] is not a script; expected keys such as events']),
        ("events: 3", ["s.yaml:1:1: events: 3 is not allowed; expected a list of mappings with t and do"]),
        (
            "events:\n  - {do: press, at: [1, 2]}",
            ["s.yaml:2:5: events.0.t: missing; expected a number from 0 to 3600, in seconds"],
        ),
        (
            "events:\n  - {t: 1, do: pres}",
            [
                's.yaml:2:12: events.0.do: "pres" is not allowed; '
                "expected press, pull, drag, release, turn, percent or key; did you mean 'press'?"
            ],
        ),
        ("events:\n  - {t: 1, do: press}", ["s.yaml:2:5: events.0.at: missing; press needs it"]),
        ("events:\n  - {t: 1, do: release, at: [1, 2]}", ["s.yaml:2:25: events.0.at: release takes none; remove it"]),
        (
            "events:\n  - {t: 1, do: drag, at: [1, 2]}",
            ["s.yaml:2:5: events.0: drag when nothing is pressed; put a press or a pull before it"],
        ),
        (
            "events:\n  - {t: 1, do: press, at: [1, 2]}\n  - {t: 2, do: release}\n  - {t: 3, do: release}",
            ["s.yaml:4:5: events.2: release when nothing is pressed; put a press or a pull before it"],
        ),
        (
            "events:\n  - {t: 1, do: press, at: [39.4, 29.6]}\n  - {t: 2, do: pull, at: [-1, 2]}",
            [
                "s.yaml:2:23: events.0.at: [39.4, 29.6] is outside of the picture, which has 40 x 30 pixels",
                "s.yaml:3:22: events.1.at: [-1, 2] is outside of the picture, which has 40 x 30 pixels",
            ],
        ),
        (
            "events:\n  - {t: 1.0e+9, do: turn, by: [1, 2], seconds: 1.0e+9}",
            [
                "s.yaml:2:6: events.0.t: 1000000000.0 is not allowed; expected a number from 0 to 3600, in seconds",
                "s.yaml:2:39: events.0.seconds: 1000000000.0 is not allowed; "
                "expected a number from 0 to 3600, in seconds",
            ],
        ),
        (
            "events:\n  - {t: 1, do: press, at: [1, 2], seconds: 1}",
            ["s.yaml:2:35: events.0.seconds: press takes no time; remove it"],
        ),
        (
            "events:\n  - {t: 1, do: key, name: q}",
            [
                "s.yaml:2:21: events.0.name: there is no key 'q' here; expected one of: up, down, f, c, t, o, m, "
                "l, space, ., r, p, g, w, i, h"
            ],
        ),
        (
            "events:\n  - {t: 1, do: turn, by: [1, 2], seconds: 2}\n  - {t: 2, do: key, name: m}",
            ["s.yaml:3:5: events.1: begins at 2 s, before the one above ends at 3 s; let them follow each other"],
        ),
        (
            "events:\n  - {t: 1, do: percent, to: 101}\nfoo: 1",
            [
                "s.yaml:2:25: events.0.to: 101 is not allowed; expected for percent a number from -100 to 100",
                "s.yaml:3:1: foo: unknown key; allowed: size, events",
            ],
        ),
    ],
)
def test_what_is_wrong_with_a_script(
    text: str, expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(text)
    with pytest.raises(SceneError) as caught:
        load_script("s.yaml", (40, 30))
    assert list(caught.value.lines) == expected


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


def test_without_a_display_it_says_what_to_do(small: Path, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    for display in ("", ":54321"):
        monkeypatch.setenv("DISPLAY", display)
        done = program("view", "small.yaml")
        expected = (
            "no window can be opened (SDL: x11,wayland not available); set DISPLAY (or WAYLAND_DISPLAY), or film "
            "without one: --record FILE.gif --seconds N"
        )
        assert (done.returncode, done.stdout, done.stderr) == (2, "", expected + "\n")


def test_an_interrupted_film_leaves_the_one_that_was_there(small: Path) -> None:
    Path("live.gif").write_bytes(b"before")
    filming = ["view", "small.yaml", "--record", "live.gif", "--seconds", "3600"]
    with Telling(*filming, stderr=subprocess.PIPE) as process:
        process.until("film", 1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
        # On a slow machine lines of progress come first.
        assert error.splitlines()[-1] == "interrupted; no film was written"
    assert process.returncode == 130
    assert Path("live.gif").read_bytes() == b"before"
    assert sorted(path.name for path in small.iterdir()) == ["live.gif", "small.yaml", "speckle.png"]


def test_a_script_is_taken_event_by_event(tmp_path: Path) -> None:
    """An hour at a million frames a second has 3.6e9 of them."""
    text = "events: [{t: 0, do: press, at: [1, 1]}, {t: 1, do: drag, at: [9, 9], seconds: 3599}]"
    (tmp_path / "s.yaml").write_text(text)
    events = schedule_events(load_script(tmp_path / "s.yaml", (20, 20)), 1e6, (20, 20))
    assert [frame for frame, _ in islice(events, 3)] == [0, 1_000_000, 1_000_001]


def test_a_film_that_cannot_be_written(small: Path, program: Program) -> None:
    Path("films").write_text("no folder")
    done = program("view", "small.yaml", "--record", "films/live.gif", "--seconds", "1")
    assert (done.returncode, done.stderr) == (4, "films: cannot write: Not a directory; choose another --record\n")
    Path("folder.gif").mkdir()
    done = program("view", "small.yaml", "--record", "folder.gif", "--seconds", "1")
    assert (done.returncode, done.stderr) == (4, "folder.gif: a directory; choose another --record\n")


def test_what_goes_wrong_in_a_script_is_told_and_filmed(small: Path, program: Program) -> None:
    Path("kept").write_text("no folder")
    Path("script.yaml").write_text(
        """\
events:
  - {t: 0.1, do: press, at: [0, 0]}
  - {t: 0.2, do: key, name: p}
  - {t: 5, do: release}
"""
    )
    size = ["--set", "render.camera=oblique"]
    done = program(
        "view", "small.yaml", "--record", "a.gif", "--seconds", "0.5", "--script", "script.yaml", "--out", "kept", *size
    )
    assert done.returncode == 4
    assert done.stderr.splitlines() == [
        "0.1 s: no tissue at pixel 0, 0",
        "the film ends at 0.5 s, before some of the script's events",
        "kept: cannot write: Not a directory; choose another --out",
    ]
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


@pytest.mark.parametrize(
    ("event", "name"),
    [
        (key(pygame.K_SPACE, " "), "space"),
        (key(pygame.K_PERIOD, "."), "."),
        (key(pygame.K_m, "m"), "m"),
        (key(pygame.K_m, "M"), "m"),
        (key(pygame.K_EQUALS, "="), "up"),
        (key(pygame.K_KP_PLUS, "+"), "up"),
        (key(pygame.K_UP), "up"),
        (key(pygame.K_DOWN), "down"),
        (key(pygame.K_MINUS, "-"), "down"),
        (key(pygame.K_KP_MINUS, "-"), "down"),
        (key(pygame.K_ESCAPE, "\x1b"), "q"),
        # A French, a Swiss, and a Russian keyboard.
        (key(pygame.K_SEMICOLON, ".", pygame.KSCAN_COMMA), "."),
        (key(pygame.K_m, "m", pygame.KSCAN_SEMICOLON), "m"),
        (key(pygame.K_1, "+", pygame.KSCAN_1), "up"),
        (key(0x44C, "\u044c", pygame.KSCAN_M), "m"),
        (key(pygame.K_c, "\x03"), None),
        (key(pygame.K_TAB, "\t"), None),
        (key(pygame.K_LCTRL), None),
        (key(0xE9, "\u00e9", pygame.KSCAN_2), None),
    ],
)
def test_keys_are_what_they_type(event: pygame.Event, name: str | None) -> None:
    hand = InputReader((400, 300))
    expected = [Key(name)] if name else []
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
    ("stepping", "drawing", "frames", "said"),
    [
        (0.002, 0.01, 500, "50 pictures/s"),
        # Pictures are slow: several frames for each, and time goes as it should.
        (0.002, 0.07, 500, "13 pictures/s"),
        # Stepping is slow: no picture waits for more than it must, and time goes slower.
        (0.05, 0.01, 190, "9 pictures/s  ·  too slow: 0.36 x real time"),
    ],
    ids=["fast", "slow pictures", "slow steps"],
)
def test_time_goes_as_fast_as_it_does_outside(stepping: float, drawing: float, frames: int, said: str) -> None:
    found, words = shown(Clock(), stepping, drawing, 10.0)
    assert found == pytest.approx(frames, rel=0.03)
    assert words == said


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


def test_the_window_by_position(small: Path, screen: Screen) -> None:
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
    live.hand("mouseup", "1", "key", "q")
    assert live.process.communicate(timeout=60)[1] == ""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_close_the_window(small: Path, screen: Screen, number: int, code: int) -> None:
    live = Live(screen)
    live.kept("picture", "p")
    live.process.send_signal(number)
    assert live.process.communicate(timeout=60)[1].splitlines()[-1] == "interrupted"
    assert live.process.returncode == code


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
