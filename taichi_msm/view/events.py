"""What a person does, as events for the session. Pixels count from the picture's top-left one, x right and y down."""

from __future__ import annotations

from typing import NamedTuple


class Hover(NamedTuple):
    """The pointer is over a pixel, and no button is pressed."""

    x: float
    y: float


class Press(NamedTuple):
    """The tool touches the tissue at a pixel; `pull` reverses its force, or makes a tool held by position grip."""

    x: float
    y: float
    pull: bool = False


class Drag(NamedTuple):
    """The tool is dragged to another pixel."""

    x: float
    y: float


class Release(NamedTuple):
    """The tool leaves the tissue."""


class Turn(NamedTuple):
    """The picture is turned as if its nearest side were pushed by this many pixels."""

    right: float
    down: float


class Percent(NamedTuple):
    """The strength is set to another percentage of the full force or depth; below 0, a grip lifts."""

    percent: float


class Harder(NamedTuple):
    """The strength grows by this many percent of the full force or depth; below 0 it falls."""

    percent: float


class Key(NamedTuple):
    """A key of `KEYS` was pressed."""

    name: str


Event = Hover | Press | Drag | Release | Turn | Percent | Harder | Key

# How much a notch of the wheel, or the up or down key, changes the strength [percent of the full force or depth].
NOTCH = 5.0

# What the pointer does.
POINTER = {
    "left button": "press; dragged, the tool moves",
    "shift + left button": "the opposite force, such as pull; by position: grip",
    "wheel": f"press harder or deeper, by {NOTCH:g} %; lift what is gripped",
    "right button": "dragged, turn the picture",
}

# Every key, and what it does.
KEYS = {
    "up": f"press harder or deeper, by {NOTCH:g} %; so does +",
    "down": f"press less, by {NOTCH:g} %; so does -",
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
    "w": "save what was done as a scene, which run repeats",
    "i": "the figures on and off",
    "h": "the keys on and off",
    "q": "quit; so does Escape",
}
