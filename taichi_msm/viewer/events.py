"""What a person does, as the session is told it. Pixels count from the picture's top-left one, x right and y down."""

from __future__ import annotations

from typing import NamedTuple


class Point(NamedTuple):
    """The pointer is over a pixel, and nothing is pressed."""

    x: float
    y: float


class Press(NamedTuple):
    """The tool touches the tissue at a pixel; `pull` turns its force around."""

    x: float
    y: float
    pull: bool = False


class Drag(NamedTuple):
    """The tool goes to another pixel."""

    x: float
    y: float


class Release(NamedTuple):
    """The tool leaves the tissue."""


class Turn(NamedTuple):
    """The picture is turned, as if its nearest side were pushed by so many pixels."""

    right: float
    down: float


class Percent(NamedTuple):
    """Press with another share of the full force."""

    percent: float


class Harder(NamedTuple):
    """Press harder, by so many percent of the full force; or less hard."""

    percent: float


class Key(NamedTuple):
    """A key of `KEYS` was pressed."""

    name: str


Event = Point | Press | Drag | Release | Turn | Percent | Harder | Key

# What a notch of the wheel and the keys up and down change [percent].
NOTCH = 5.0

# What the pointer does.
POINTER = {
    "left button": "press with the scene's force; dragged, the tool moves",
    "shift + left button": "the opposite force: pull, where the scene's pushes",
    "wheel": f"press harder or less hard, by {NOTCH:g} % of the full force",
    "right button": "dragged, turn the picture",
}

# Every key, and what it does.
KEYS = {
    "up": f"press harder, by {NOTCH:g} %; so does +",
    "down": f"press less hard, by {NOTCH:g} %; so does -",
    "c": "the scene's own camera",
    "t": "look from the top",
    "o": "look from the side, from above",
    "m": "mesh on and off",
    "l": "light on and off",
    "space": "pause, and go on",
    ".": "one frame further, when paused",
    "r": "reset: tissue at rest, and what was done forgotten",
    "p": "save the tissue as PNG",
    "g": "start and stop a film, a GIF",
    "w": "write what was done as a scene, which run repeats",
    "i": "the figures on and off",
    "h": "the keys on and off",
    "q": "quit; so does Escape",
}
