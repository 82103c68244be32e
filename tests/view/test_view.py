"""`taichi-msm view`: scripts, films, errors, real time."""

from __future__ import annotations

import shlex
import signal
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.runs.media import Picture
from taichi_msm.view.events import Drag, Key, Press, Release, Strength, Turn
from taichi_msm.view.script import load_script, schedule_events
from taichi_msm.view.server import MAX_DELAY_S, Pacing
from taichi_msm.view.session import Session
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import duration

SCRIPT = """\
events:
  - {t: 0.1, do: press, at: [20, 15]}
  - {t: 0.3, do: drag, at: [26, 15], seconds: 0.2}
  - {t: 0.6, do: release}
  - {t: 0.7, do: key, name: w}
"""


def test_film_of_a_script(small: Path, program: Program, message: Messages) -> None:
    Path("script.yaml").write_text(SCRIPT)
    done = program("view", "small.yaml", "--record", "films/live.gif", "--seconds", "1", "--script", "script.yaml")
    assert done.returncode == 0
    message(done.stderr, "0.7 s", "output/small-live/session-1.yaml")
    assert done.stdout == "films/live.gif\noutput/small-live/session-1.yaml\n"
    assert [path.name for path in Path("films").iterdir()] == ["live.gif"]
    with Image.open("films/live.gif") as film:
        assert film.size == (40, 30)
    assert duration("films/live.gif") == 1100, "the first picture, and ten in 1 s"
    probe = load_scene("output/small-live/session-1.yaml").probes[0]
    times, percent = np.array(probe.load).T
    assert (times[np.flatnonzero(percent)[0] - 1], times[-1]) == (0.1, pytest.approx(0.7))
    assert percent.max() == 100


@pytest.mark.parametrize(
    "arguments",
    [
        "--seconds 1",
        "--script a.yaml",
        "--port 8000 --record a.gif --seconds 1",
        "--browser --origin hub.example.org",
        "--origin https://me@hub.example.org/user",
        "--origin 'http://a b'",
        "--origin http://[::1",
        "--record a.png --seconds 1",
        "--record a.gif --seconds 0",
        "--record a.gif --seconds nan",
        "--record a.gif --seconds 1 --script no.yaml",
        "--record a.gif --seconds 1 --set probes=[]",
    ],
)
def test_invalid_arguments_of_view(
    arguments: str, small: Path, capsys: pytest.CaptureFixture[str], message: Messages
) -> None:
    assert main(["view", "small.yaml", *shlex.split(arguments)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    # click's message of a range depends on its version.
    message(output.err, hide=r"0\.0 is not.*(?= \(see)")
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"]


def test_film_without_a_scene(capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    assert main(["view", "--record", "a.gif", "--seconds", "1"]) == 2
    message(capsys.readouterr().err)


# Invalid scripts, and the locations of their faults.
FAULTS = {
    "empty": ("", "1:1"),
    "no time": ("events:\n  - {do: press, at: [1, 2]}", "2:5: events.0.t"),
    "no pixel": ("events:\n  - {t: 1, do: press}", "2:5: events.0.at"),
    "pixel of a release": ("events:\n  - {t: 1, do: release, at: [1, 2]}", "2:25: events.0.at"),
    "drag unpressed": ("events:\n  - {t: 1, do: drag, at: [1, 2]}", "2:5: events.0"),
    "outside": (
        "events:\n  - {t: 1, do: press, at: [39.4, 29.6]}\n  - {t: 2, do: pull, at: [-1, 2]}",
        "2:23: events.0.at",
        "3:22: events.1.at",
    ),
    "press with seconds": ("events:\n  - {t: 1, do: press, at: [1, 2], seconds: 1}", "2:35: events.0.seconds"),
    "unknown key": ("events:\n  - {t: 1, do: key, name: q}", "2:21: events.0.name"),
    "overlap": (
        "events:\n  - {t: 1, do: turn, by: [1, 2], seconds: 2}\n  - {t: 2, do: key, name: m}",
        "3:5: events.1",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_scripts(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    text, *locations = FAULTS[name]
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(text)
    with message.raises(SceneError, *locations):
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


def test_events_are_generated_lazily(tmp_path: Path) -> None:
    """A drag of an hour at 1e6 frames per second has 3.6e9 events."""
    text = "events: [{t: 0, do: press, at: [1, 1]}, {t: 1, do: drag, at: [9, 9], seconds: 3599}]"
    (tmp_path / "s.yaml").write_text(text)
    events = schedule_events(load_script(tmp_path / "s.yaml", (20, 20)), 1e6, (20, 20))
    assert [frame for frame, _ in islice(events, 3)] == [0, 1_000_000, 1_000_001]


def test_unwritable_film(small: Path, program: Program, message: Messages) -> None:
    Path("films").write_text("not a folder")
    Path("folder.gif").mkdir()
    for film in ("films/live.gif", "folder.gif"):
        done = program("view", "small.yaml", "--record", film, "--seconds", "1")
        assert done.returncode == 4
        message(done.stderr, film.split("/")[0], "--record")


def test_interruption_of_a_film(
    small: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    draw = Session.picture

    def interrupt(session: Session) -> Picture:
        signal.raise_signal(signal.SIGINT)
        return draw(session)

    monkeypatch.setattr(Session, "picture", interrupt)
    done = program("view", "small.yaml", "--record", "live.gif", "--seconds", "1")
    assert done.returncode == 130
    message(done.stderr, "interrupted")
    assert not Path("live.gif").exists()


FAILING = """\
events:
  - {t: 0.1, do: press, at: [0, 0]}
  - {t: 0.2, do: key, name: p}
  - {t: 5, do: release}
"""


def test_failures_of_a_script(small: Path, program: Program, message: Messages) -> None:
    Path("out").write_text("not a folder")
    Path("script.yaml").write_text(FAILING)
    options = ["--seconds", "0.5", "--script", "script.yaml", "--out", "out", "--set", "render.camera=oblique"]
    done = program("view", "small.yaml", "--record", "a.gif", *options)
    assert done.returncode == 4
    message(done.stderr, "pixel 0, 0", "0.5 s", "out")
    with Image.open("a.gif") as film:
        assert film.n_frames >= 1


class Clock:
    """A clock that is advanced by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def simulated_frames(clock: Clock, stepping: float, drawing: float, seconds: float) -> tuple[int, float]:
    """Simulate a machine with times [s] for a frame and a picture; return the number of frames, and the speed."""
    pacing, frames = Pacing(50.0, clock), 0
    while clock.now < seconds:
        clock.now += pacing.delay_s()
        for _ in pacing.due_frames():
            clock.now += stepping
            frames += 1
        clock.now += drawing
    return frames, pacing.speed()[1]


@pytest.mark.parametrize(
    ("stepping", "drawing", "frames", "speed"),
    [
        (0.002, 0.01, 500, 1.0),
        # Several frames per picture, in real time.
        (0.002, 0.07, 500, 1.0),
        # A picture per frame, slower than real time.
        (0.05, 0.01, 167, 0.33),
    ],
    ids=["fast", "slow pictures", "slow steps"],
)
def test_session_runs_in_real_time(stepping: float, drawing: float, frames: int, speed: float) -> None:
    count, measured = simulated_frames(Clock(), stepping, drawing, 10.0)
    assert count == pytest.approx(frames, rel=0.03)
    # A picture of 0.08 s more or less in the second over which the speed is measured.
    assert measured == pytest.approx(speed, abs=0.08)


def test_long_delays_are_skipped() -> None:
    clock = Clock()
    pacing = Pacing(50.0, clock)
    clock.now = 60.0
    assert len(list(pacing.due_frames())) <= MAX_DELAY_S * 50 + 1
