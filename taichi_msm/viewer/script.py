"""A script of events: what a person would do, read from a YAML file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from taichi_msm.errors import Problem, SceneError
from taichi_msm.faults import REFUSED
from taichi_msm.scene import MAX_PIXELS, NotNegative, Number, Pixels, Section, key
from taichi_msm.scenefile.load import Draft, Kind
from taichi_msm.scenefile.validation import parse
from taichi_msm.viewer.events import KEYS, Drag, Event, Key, Percent, Press, Release, Turn

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

_SCRIPT = Kind("script", "events")


class Entry(Section):
    """One entry of a script."""

    t: Seconds = key(..., means="when, or when it begins [s]", expects=SECONDS)
    do: Literal["press", "pull", "drag", "release", "turn", "percent", "key"] = key(
        ..., means="what is done", expects=f"{', '.join(KINDS)} or {LAST_KIND}"
    )
    at: Pair | None = key(
        None, means="the pixel", expects="for press, pull and drag [x, y] in pixels from the top left"
    )
    by: Pair | None = key(None, means="how far the picture is turned", expects="for turn [right, down] in pixels")
    to: Annotated[NotNegative, Field(le=100)] | None = key(
        None, means="percent of the full force", expects="for percent a number from 0 to 100"
    )
    name: str | None = key(None, means="a key of the window", expects="for key the name of one")
    seconds: Seconds = key(0.0, means="how long it takes [s]", expects=SECONDS)

    @model_validator(mode="after")
    def _complete(self) -> Entry:
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
        means="width, height of the picture that the pixels are of [px]; others are scaled; default: the session's",
        expects=f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels",
    )
    events: tuple[Entry, ...] = key(..., means="what is done, in order", expects="a list of mappings with t and do")

    @field_validator("events", mode="after")
    @classmethod
    def _in_order(cls, events: tuple[Entry, ...]) -> tuple[Entry, ...]:
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
    return PydanticCustomError(REFUSED, message, {"key": key, **values})


def load_script(path: str | Path, size: tuple[int, int]) -> Script:
    """Read a script for a picture of a width and height [px].

    Raises:
        SceneError: with all faults, one line each, in the order of the file.
    """
    draft = Draft(str(path), _SCRIPT)
    script, problems = parse(Script, draft.data)
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
    """Give the events of a script, each with the frame before which it happens.

    Args:
        script: the script.
        rate: frames per second.
        size: width and height of the picture that is shown [px].
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
