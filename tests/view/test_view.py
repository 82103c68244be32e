"""`taichi-msm view`: scripts, films, errors, real time."""

from __future__ import annotations

import signal
import subprocess
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.view.events import Drag, Key, Press, Release, Strength, Turn
from taichi_msm.view.script import load_script, schedule_events
from taichi_msm.view.server import MAX_DELAY_S, Pacing
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import duration
from tests.reporting_process import ReportingProcess

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
        "--port 8000 --record a.gif --seconds 1",
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
    "no time": ("events:\n  - {do: press, at: [1, 2]}", "2:5: events.0.t"),
    "unknown action": ("events:\n  - {t: 1, do: pres}", "2:12: events.0.do"),
    "no place": ("events:\n  - {t: 1, do: press}", "2:5: events.0.at"),
    "place of a release": ("events:\n  - {t: 1, do: release, at: [1, 2]}", "2:25: events.0.at"),
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


@pytest.mark.slow
def test_an_interrupted_film_leaves_the_one_that_was_there(small: Path, message: Messages) -> None:
    Path("live.gif").write_bytes(b"before")
    filming = ["view", "small.yaml", "--record", "live.gif", "--seconds", "3600"]
    with ReportingProcess(*filming, stderr=subprocess.PIPE) as process:
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
