"""Scripts of input events in YAML, and films of sessions that they drive without a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, field_validator, model_validator

from taichi_msm.errors import FilesError, Problem, SceneError, writing
from taichi_msm.load.check import parse_model
from taichi_msm.load.scene_file import Draft, read_file
from taichi_msm.scene.section import MAX_PIXELS, NotNegative, Number, Pixels, Section, key, scene_fault
from taichi_msm.view.events import KEYS, Drag, Event, Key, Press, Release, Strength, Turn
from taichi_msm.view.recording import Film

if TYPE_CHECKING:
    from taichi_msm.view.session import Session

OPTION = "--record"

MAX_SCRIPT_S = 3600.0

Pair = tuple[Number, Number]
Seconds = Annotated[NotNegative, Field(le=MAX_SCRIPT_S)]
SECONDS = f"a number from 0 to {MAX_SCRIPT_S:g}, in seconds"

# Required key of each kind of event, in addition to its time.
REQUIRED_KEYS = {"press": "at", "pull": "at", "drag": "at", "release": "", "turn": "by", "percent": "to", "key": "name"}

# A script cannot quit: the duration of the film is an option.
SCRIPT_KEYS = tuple(name for name in KEYS if name != "q")


class ScriptEvent(Section):
    """An event of a script."""

    t: Seconds = key(..., "time of the event, or of its beginning [s]", SECONDS)
    do: Literal["press", "pull", "drag", "release", "turn", "percent", "key"] = key(
        ..., "action", "press, pull, drag, release, turn, percent or key"
    )
    at: Pair | None = key(None, "pixel of the event", "for press, pull and drag [x, y] in pixels from the top left")
    by: Pair | None = key(None, "turn of the picture", "for turn [right, down] in pixels")
    to: Annotated[Number, Field(ge=-100, le=100)] | None = key(
        None, "strength [% of the full force or depth]", "for percent a number from -100 to 100"
    )
    name: str | None = key(None, "a key of the page", "for key the name of one")
    seconds: Seconds = key(0.0, "duration [s]", SECONDS)

    @model_validator(mode="after")
    def _complete(self) -> ScriptEvent:
        for name in ("at", "by", "to", "name"):
            given, required = getattr(self, name) is not None, REQUIRED_KEYS[self.do] == name
            if given != required:
                fault = f"missing; {self.do} needs it" if required else f"{self.do} takes none; remove it"
                raise scene_fault(fault, name)
        if self.name is not None and self.name not in SCRIPT_KEYS:
            raise scene_fault(f"there is no key '{self.name}' here; expected one of: {', '.join(SCRIPT_KEYS)}", "name")
        if self.seconds > 0 and self.do not in ("drag", "turn"):
            raise scene_fault(f"{self.do} takes no time; remove it", "seconds")
        return self


class Script(Section):
    """Content of a script."""

    size: tuple[Pixels, Pixels] | None = key(
        None,
        "size of the picture to which pixels refer, width and height [px]; default: the session's",
        f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels",
    )
    events: tuple[ScriptEvent, ...] = key(..., "actions, in order", "a list of mappings with t and do")

    @field_validator("events", mode="after")
    @classmethod
    def _in_order(cls, events: tuple[ScriptEvent, ...]) -> tuple[ScriptEvent, ...]:
        presses, end = False, 0.0
        for n, entry in enumerate(events):
            if entry.do in ("drag", "release") and not presses:
                raise scene_fault(f"{entry.do} when nothing is pressed; put a press or a pull before it", n)
            if entry.t < end:
                fault = f"begins at {entry.t:g} s, before the previous event ends at {end:g} s"
                raise scene_fault(f"{fault}; take a later t", n)
            presses, end = entry.do in ("press", "pull") or (presses and entry.do != "release"), entry.t + entry.seconds
        return events


def load_script(path: str | Path, size: tuple[int, int]) -> Script:
    """Read and check a script for a picture of a width and height [px], in which all presses must be."""
    draft = Draft(read_file(str(path), "script", "events"))
    script, problems = parse_model(Script, draft.data)
    draft.report(problems)
    draft.report(_outside(script, script.size or size) if script is not None else ())
    if script is None or draft.problems:
        raise SceneError(draft.lines())
    return script


def _outside(script: Script, size: tuple[int, int]) -> Iterator[Problem]:
    width, height = size
    for n, entry in enumerate(script.events):
        if entry.do in ("press", "pull") and entry.at is not None:
            x, y = entry.at
            if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
                message = f"[{x:g}, {y:g}] is outside of the picture, which has {width} x {height} pixels"
                yield Problem(("events", n, "at"), message)


def schedule_events(script: Script, rate: float, size: tuple[int, int]) -> Iterator[tuple[int, Event]]:
    """Yield the events of a script with the frame before which each is handled, in order of frames.

    `rate` is frames per second, and `size` width and height [px] of the session's picture.
    """
    scale = [actual / assumed for actual, assumed in zip(size, script.size or size, strict=True)]
    x = y = 0.0
    for entry in script.events:
        first = round(entry.t * rate)
        frames = max(1, round(entry.seconds * rate))
        begin_x, begin_y = x, y
        if entry.at:
            x, y = ((pixel + 0.5) * factor - 0.5 for pixel, factor in zip(entry.at, scale, strict=True))
        for n in range(1, frames + 1):
            fraction, frame = n / frames, first + n - 1
            match entry.do:
                case "press" | "pull":
                    yield frame, Press(x, y, entry.do == "pull")
                case "drag":
                    yield frame, Drag(begin_x + fraction * (x - begin_x), begin_y + fraction * (y - begin_y))
                case "release":
                    yield frame, Release()
                case "turn":
                    right, down = entry.by or (0.0, 0.0)
                    yield frame, Turn(right * scale[0] / frames, down * scale[1] / frames)
                case "percent":
                    yield frame, Strength(entry.to or 0.0)
                case "key":
                    yield frame, Key(entry.name or "")


def record_film(
    session: Session,
    path: Path,
    seconds: float,
    events: Iterable[tuple[int, Event]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    notify: Callable[[str], None] = lambda notice: None,
) -> None:
    """Run a new session for some seconds without a page, and film it; the finished film replaces an existing file.

    `events` are those of `schedule_events`, consumed lazily; `notify` receives every notice of the session. If an event
    could not save a file, the FilesError comes after the film is written.
    """
    frames = round(seconds * session.frame_rate)
    events = iter(events)
    upcoming = next(events, None)
    failures: list[FilesError] = []
    notice = ""
    with closing(Film(path, OPTION, session.scene.render, session.frame_rate, session.subframes, 0)) as film:
        for frame in range(frames + 1):
            progress(frame, frames)
            while upcoming is not None and upcoming[0] <= frame:
                try:
                    session.handle(upcoming[1])
                except FilesError as error:
                    failures.append(error)
                if session.notice not in ("", notice):
                    notify(f"{frame / session.frame_rate:g} s: {session.notice}")
                notice = session.notice
                upcoming = next(events, None)
            if frame % session.subframes == 0:
                film.add_frame(session.picture(), frame)
            if frame < frames:
                session.advance()
            if session.divergence_error:
                notify(session.divergence_error)
                break
        if upcoming is not None:
            notify(f"the film ends at {frame / session.frame_rate:g} s, before some of the script's events")
        with writing(path, OPTION):
            film.finish().replace(path)
    if failures:
        raise failures[0]
