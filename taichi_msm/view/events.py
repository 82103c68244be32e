"""Input events of a session, in pixels from the upper left corner of the picture, x to the right and y down."""

from __future__ import annotations

from typing import NamedTuple


class Hover(NamedTuple):
    """The pointer moves to a pixel, without a pressed button."""

    x: float
    y: float


class Press(NamedTuple):
    """The tool presses at a pixel; with `pull` it pulls, or grips if it is position-controlled."""

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
    """The camera orbits, as if the near side of the tissue were dragged by this distance [px]."""

    right: float
    down: float


class Strength(NamedTuple):
    """The strength is set [% of the full force or depth]; negative values lift a grip."""

    percent: float


class StrengthChange(NamedTuple):
    """The strength changes by an increment [% of the full force or depth]."""

    percent: float


class Key(NamedTuple):
    """A key of `KEYS` was pressed."""

    name: str


class Material(NamedTuple):
    """A key of `material.MATERIAL` gets another value; the tissue keeps its shape."""

    key: str
    value: float


Event = Hover | Press | Drag | Release | Turn | Strength | StrengthChange | Key | Material

QUIT = Key("q")

# Switching the tool may compile another kernel.
SWITCH_TOOL = Key("f")
COMPILING = "one moment: compiling"

# Increment of the strength per notch of the wheel or press of a key [% of the full force or depth].
STRENGTH_STEP = 5.0

# Pointer actions and their help texts.
POINTER = {
    "left button": "press; dragged, the tool moves",
    "shift + left button": "the opposite force, such as pull; by position: grip",
    "wheel": f"press harder or deeper, by {STRENGTH_STEP:g} %; lift the gripped tissue",
    "right button": "dragged, turn the picture",
}

# Keys and their help texts.
KEYS = {
    "up": f"press harder or deeper, by {STRENGTH_STEP:g} %; so does +",
    "down": f"press less, by {STRENGTH_STEP:g} %; so does -",
    "f": "reset, and hold the tool by position or by force",
    "c": "the scene's own camera",
    "t": "look from the top",
    "o": "look from the side, from above",
    "m": "mesh on and off",
    "l": "light on and off",
    "space": "pause and go on",
    ".": "while paused: one frame further",
    "r": "reset: put the tissue at rest, forget the session so far",
    "p": "save the tissue as PNG",
    "g": "start and stop a film (GIF)",
    "w": "save the session as a scene, which run repeats",
    "i": "the figures on and off",
    "h": "the keys on and off",
    "q": "quit",
}
