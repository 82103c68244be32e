"""Messages of a page: input events of the session, and messages for the server.

A page sends a message as a JSON list of its name and its values, such as `["press", 256, 250, false]` or `["shown"]`.
Positions are in pixels of the scene's picture: x right, y down, (0, 0) at the centre of the upper left pixel.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple, get_args

from pydantic import ConfigDict, TypeAdapter, ValidationError

from taichi_msm.view.material import MATERIAL

# Limits of a message of a page: its size [bytes], and the absolute value of its numbers.
MAX_BYTES = 512
MAX_VALUE = 1e12


class Hover(NamedTuple):
    """The pointer moves to a pixel, no button pressed."""

    x: float
    y: float


class Press(NamedTuple):
    """The tool presses at a pixel; with `pull`, it pulls if force-controlled and grips if position-controlled."""

    x: float
    y: float
    pull: bool = False


class Drag(NamedTuple):
    """The pressed tool moves to another pixel."""

    x: float
    y: float


class Release(NamedTuple):
    """The tool releases the tissue."""


class Turn(NamedTuple):
    """The camera orbits as if the near side of the tissue were dragged by this distance [px]."""

    right: float
    down: float


class Strength(NamedTuple):
    """The strength is set [% of the full force or depth]; below 0, gripped tissue is lifted."""

    percent: float


class StrengthChange(NamedTuple):
    """The strength changes by an increment [% of the full force or depth]."""

    percent: float


class Key(NamedTuple):
    """A key of `KEYS` was pressed."""

    name: str


class Material(NamedTuple):
    """A key of `MATERIAL` gets another value; the tissue keeps its shape and motion."""

    key: str
    value: float


Event = Hover | Press | Drag | Release | Turn | Strength | StrengthChange | Key | Material


class Shown(NamedTuple):
    """The page has shown a picture."""


class Width(NamedTuple):
    """The page shows the picture with this width [px of its screen]."""

    pixels: float


class TakeOver(NamedTuple):
    """A watching page asks to steer."""


class Answer(NamedTuple):
    """The steering page gives the tool to the page that asks, or refuses."""

    gives: bool


class Scenes(NamedTuple):
    """The page leaves the session for the list of scenes."""


# Messages for the server.
Request = Shown | Width | TakeOver | Answer | Scenes

QUIT = Key("q")

# Switching the tool may compile another kernel.
SWITCH_TOOL = Key("f")
COMPILING = "one moment: compiling"

# Increment of the strength per wheel notch or keystroke [% of the full force or depth].
STRENGTH_STEP = 5.0

# Pointer actions and their help texts.
POINTER = {
    "left button": "press; drag to move the tool",
    "shift + left button": "pull, the opposite force; by position: grip",
    "wheel": f"press harder or deeper, by {STRENGTH_STEP:g} %; lift the gripped tissue",
    "right button": "drag to turn the picture",
}

# Keys and their help texts.
KEYS = {
    "up": f"press harder or deeper, by {STRENGTH_STEP:g} %; also +",
    "down": f"press less, by {STRENGTH_STEP:g} %; also -",
    "f": "reset, and hold the tool by position or by force",
    "c": "the scene's own camera",
    "t": "look from the top",
    "o": "look from the side, from above",
    "m": "mesh on and off",
    "l": "light on and off",
    "space": "pause and go on",
    ".": "while paused: advance by a frame",
    "r": "reset: put the tissue at rest, discard the session so far",
    "p": "save the tissue as PNG",
    "g": "start and stop a film (GIF)",
    "w": "save the session as a scene; run repeats it",
    "i": "readings on and off",
    "h": "list of keys on and off",
    "q": "quit",
}

_EVENTS: dict[str, TypeAdapter[Event | Request]] = {
    kind.__name__.lower(): TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))
    for kind in (*get_args(Event), *get_args(Request))
}


def parse_message(message: str | bytes) -> Event | Request:
    """Parse a message of a page; the ValueError of an invalid one has its name and the reason."""
    values: Any = json.loads(message)
    if not (isinstance(values, list) and values and isinstance(values[0], str) and values[0] in _EVENTS):
        raise ValueError(f"not a list of a message's name and its values; the names are {', '.join(_EVENTS)}")
    if any(isinstance(value, (int, float)) and not abs(value) <= MAX_VALUE for value in values):
        raise ValueError(f"{values[0]}: a value is not from {-MAX_VALUE:g} to {MAX_VALUE:g}")
    try:
        event = _EVENTS[values[0]].validate_python(tuple(values[1:]))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ValueError(f"{values[0]}: {first['msg']}") from None
    if isinstance(event, Key) and event.name not in KEYS:
        raise ValueError(f"key: no such key; the keys are {' '.join(KEYS)}")
    if isinstance(event, Material) and event.key not in MATERIAL:
        raise ValueError(f"material: no such key; the keys are {', '.join(MATERIAL)}")
    return event
