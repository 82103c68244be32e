"""A script of events, read from a YAML file: what a person would do. With it a session without a window is filmed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from taichi_msm.errors import FilesError, Problem, SceneError, writing
from taichi_msm.load.check import parse_model
from taichi_msm.load.scene_file import Draft, FileKind, read_file
from taichi_msm.scene.section import MAX_PIXELS, SCENE_FAULT, NotNegative, Number, Pixels, Section, key
from taichi_msm.view.events import KEYS, Drag, Event, Key, Percent, Press, Release, Turn
from taichi_msm.view.recording import Film

if TYPE_CHECKING:
    from taichi_msm.view.session import Session

OPTION = "--record"

LONGEST = 3600.0

Pair = tuple[Number, Number]
Seconds = Annotated[NotNegative, Field(le=LONGEST)]
SECONDS = f"a number from 0 to {LONGEST:g}, in seconds"

# The key that every kind of entry needs besides its time.
NEEDS = {"press": "at", "pull": "at", "drag": "at", "release": "", "turn": "by", "percent": "to", "key": "name"}
*KINDS, LAST_KIND = NEEDS

# The kinds that may last; such an entry is spread over the frames of its duration.
LASTING = ("drag", "turn")

# A script may not quit: the session ends at its given time.
PRESSABLE = tuple(name for name in KEYS if name != "q")

_SCRIPT = FileKind("script", "events")


class ScriptEvent(Section):
    """One entry of a script."""

    t: Seconds = key(..., description="when, or when it begins [s]", expects=SECONDS)
    do: Literal["press", "pull", "drag", "release", "turn", "percent", "key"] = key(
        ..., description="what is done", expects=f"{', '.join(KINDS)} or {LAST_KIND}"
    )
    at: Pair | None = key(
        None, description="the pixel", expects="for press, pull and drag [x, y] in pixels from the top left"
    )
    by: Pair | None = key(None, description="how far the picture is turned", expects="for turn [right, down] in pixels")
    to: Annotated[Number, Field(ge=-100, le=100)] | None = key(
        None,
        description="percent of the full force, or of the greatest depth",
        expects="for percent a number from -100 to 100",
    )
    name: str | None = key(None, description="a key of the window", expects="for key the name of one")
    seconds: Seconds = key(0.0, description="how long it takes [s]", expects=SECONDS)

    @model_validator(mode="after")
    def _complete(self) -> ScriptEvent:
        for name in ("at", "by", "to", "name"):
            given, needed = getattr(self, name) is not None, NEEDS[self.do] == name
            if given != needed:
                message = "missing; {do} needs it" if needed else "{do} takes none; remove it"
                raise _refused(name, message, do=self.do)
        if self.name is not None and self.name not in PRESSABLE:
            message = "there is no key '{name}' here; expected one of: {keys}"
            raise _refused("name", message, name=self.name, keys=", ".join(PRESSABLE))
        if self.seconds > 0 and self.do not in LASTING:
            raise _refused("seconds", "{do} takes no time; remove it", do=self.do)
        return self


class Script(Section):
    """The file."""

    size: tuple[Pixels, Pixels] | None = key(
        None,
        description=(
            "width, height of the picture that the pixels are of [px]; others are scaled; default: the session's"
        ),
        expects=f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels",
    )
    events: tuple[ScriptEvent, ...] = key(
        ..., description="what is done, in order", expects="a list of mappings with t and do"
    )

    @field_validator("events", mode="after")
    @classmethod
    def _in_order(cls, events: tuple[ScriptEvent, ...]) -> tuple[ScriptEvent, ...]:
        presses, end = False, 0.0
        for n, entry in enumerate(events):
            if entry.do in ("drag", "release") and not presses:
                raise _refused(n, "{do} when nothing is pressed; put a press or a pull before it", do=entry.do)
            if entry.t < end:
                message = "begins at {t} s, before the one above ends at {end} s; let them follow each other"
                raise _refused(n, message, t=f"{entry.t:g}", end=f"{end:g}")
            presses, end = entry.do in ("press", "pull") or (presses and entry.do != "release"), entry.t + entry.seconds
        return events


def _refused(key: str | int, message: str, **values: str) -> PydanticCustomError:
    """Make the error of a key."""
    return PydanticCustomError(SCENE_FAULT, message, {"below": (key,), **values})


def load_script(path: str | Path, size: tuple[int, int]) -> Script:
    """Read a script for a picture of a width and height [px]; raises a SceneError with all faults, in their order."""
    draft = Draft(read_file(str(path), _SCRIPT))
    script, problems = parse_model(Script, draft.data)
    draft.report(problems)
    draft.report(_outside(script, script.size or size) if script is not None else ())
    if script is None or draft.problems:
        raise SceneError(draft.lines())
    return script


def _outside(script: Script, size: tuple[int, int]) -> Iterator[Problem]:
    """Find the entries that point outside the picture."""
    width, height = size
    for n, entry in enumerate(script.events):
        if entry.do in ("press", "pull") and entry.at is not None:
            x, y = entry.at
            if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
                message = f"[{x:g}, {y:g}] is outside of the picture, which has {width} x {height} pixels"
                yield Problem(("events", n, "at"), message)


def timed(script: Script, rate: float, size: tuple[int, int]) -> Iterator[tuple[int, Event]]:
    """Give the events of a script, in order, each with the frame before which it happens.

    There are `rate` frames per second, and the picture that is shown has this width and height [px].
    """
    scale = [shown / meant for shown, meant in zip(size, script.size or size, strict=True)]
    x = y = 0.0
    for entry in script.events:
        first = round(entry.t * rate)
        frames = max(1, round(entry.seconds * rate))
        begin_x, begin_y = x, y
        if entry.at:
            x, y = ((n + 0.5) * factor - 0.5 for n, factor in zip(entry.at, scale, strict=True))
        for n in range(1, frames + 1):
            share, frame = n / frames, first + n - 1
            match entry.do:
                case "press" | "pull":
                    yield frame, Press(x, y, entry.do == "pull")
                case "drag":
                    yield frame, Drag(begin_x + share * (x - begin_x), begin_y + share * (y - begin_y))
                case "release":
                    yield frame, Release()
                case "turn":
                    right, down = entry.by or (0.0, 0.0)
                    yield frame, Turn(right * scale[0] / frames, down * scale[1] / frames)
                case "percent":
                    yield frame, Percent(entry.to or 0.0)
                case "key":
                    yield frame, Key(entry.name or "")


def film(
    session: Session,
    path: Path,
    seconds: float,
    events: Iterable[tuple[int, Event]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda notice: None,
) -> None:
    """Run a session for some time and film it as a GIF, which replaces an earlier one when it is whole.

    Args:
        session: it has no window.
        path: the GIF.
        seconds: how long.
        events: as from `timed`, read one at a time.
        progress: called often, with the frames done and the frames in all; what it raises stops the session there.
        say: called with what the person should know.

    Raises:
        FilesError: when the film cannot be written; or, after it was written, when a file that an event was to save
            could not be.
    """
    if path.is_dir():
        raise FilesError(f"{path}: a directory; choose another {OPTION}")
    frames = round(seconds * session.rate)
    events = iter(events)
    upcoming = next(events, None)
    failures: list[FilesError] = []
    notice = ""
    rate, parts = session.rate / session.parts, session.parts
    with closing(Film(path.parent, session.scene.render, rate, parts, option=OPTION)) as gif:
        for frame in range(frames + 1):
            progress(frame, frames)
            while upcoming is not None and upcoming[0] <= frame:
                try:
                    session.handle(upcoming[1])
                except FilesError as error:
                    failures.append(error)
                if session.notice not in ("", notice):
                    say(f"{frame / session.rate:g} s: {session.notice}")
                notice = session.notice
                upcoming = next(events, None)
            if frame % parts == 0:
                gif.show(session.picture(), frame, partial(progress, frame, frames))
            if frame < frames:
                session.advance()
            if session.fault:
                say(session.fault)
                break
        if upcoming is not None:
            say(f"the film ends at {frame / session.rate:g} s, before some of the script's events")
        with writing(path, OPTION):
            gif.encoded(partial(progress, frames, frames)).replace(path)
    if failures:
        raise failures[0]
