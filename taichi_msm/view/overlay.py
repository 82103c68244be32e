"""What a session writes over its picture: figures, keys, and where the tool is."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from taichi_msm.runs.media import Picture

# Height of letters: this share of the picture's height, within limits [px].
LETTER = 1 / 36
SMALLEST, LARGEST = 11, 22

# Width of a letter as a share of its height, at most on average.
LETTER_WIDTH = 0.56

# How many times darker the picture is behind text.
DARKER = 3

# Width of a bar, in heights of letters.
BAR = 10

SHADE = (0, 0, 0)
OUTLINE = 140
PUSH = (255, 255, 255)
PULL = (255, 214, 90)

# Radius of the ring around the tool, as a share of the picture's height.
RING = 1 / 50


class Bar(NamedTuple):
    """A value as a bar, whose end is the next round number at or above the largest value so far."""

    value: float
    largest: float  # above 0
    unit: str

    @property
    def end(self) -> float:
        """The value at its end: 1, 2 or 5 times a power of ten."""
        power = 10.0 ** math.floor(math.log10(self.largest))
        return next(digit * power for digit in (1, 2, 5, 10) if self.largest <= digit * power * (1 + 1e-9))


def write(
    picture: Picture,
    above: Sequence[str],
    below: str = "",
    table: Mapping[str, str] | None = None,
    bar: Bar | None = None,
) -> None:
    """Write text over a picture, shape (height, width, 3), which is changed, on darker panels.

    Lines go `above`, into the top left corner, a bar and a table of two columns under them; the text `below` is
    wrapped.
    """
    height, width = picture.shape[:2]
    size = _letter_size(picture)
    top = edge = size // 2
    drawn = _bar(size, round(BAR * size * bar.value / bar.end), f"{bar.end:g} {bar.unit}") if bar else _panel(size)
    for panel in (_panel(size, *above), drawn, _columns(tuple((table or {}).items()), size)):
        _lay(picture, panel, edge, top)
        top += len(panel) + edge if len(panel) else 0
    panel = _panel(size, *textwrap.wrap(below, max(1, int((width - 4 * edge) / (LETTER_WIDTH * size)))))
    _lay(picture, panel, edge, height - len(panel) - edge)


def announce(picture: Picture, text: str) -> None:
    """Write a text over the middle of a picture, shape (height, width, 3), which is changed."""
    panel = _panel(_letter_size(picture), text)
    _lay(picture, panel, (picture.shape[1] - panel.shape[1]) // 2, (len(picture) - len(panel)) // 2)


def mark(picture: Picture, tool: tuple[float, float], *, pulls: bool) -> None:
    """Draw a ring around the pixel at which the tool is seen; changes the picture, shape (height, width, 3)."""
    radius = picture.shape[0] * RING
    reach = int(radius) + 4
    left, top = max(0, int(tool[0]) - reach), max(0, int(tool[1]) - reach)
    # Only this part is copied: copying the whole picture would take longer than all else here.
    part = picture[top : max(0, int(tool[1]) + reach), left : max(0, int(tool[0]) + reach)]
    if part.size == 0:
        return
    image = Image.fromarray(part)
    x, y = tool[0] - left, tool[1] - top
    for r, colour, line in ((radius + 1, SHADE, 3), (radius, PULL if pulls else PUSH, 1)):
        ImageDraw.Draw(image).ellipse((x - r, y - r, x + r, y + r), outline=colour, width=line)
    part[:] = np.asarray(image)


def _lay(picture: Picture, panel: NDArray[np.uint8], left: int, top: int) -> None:
    """Lay a panel of white letters over a picture; what does not fit is cut off."""
    left, top = max(0, left), max(0, top)
    part = picture[top : top + panel.shape[0], left : left + panel.shape[1]]
    part[:] = np.maximum(part // DARKER, panel[: part.shape[0], : part.shape[1], None])


def _panel(size: int, *lines: str) -> NDArray[np.uint8]:
    """Make the panel of some lines."""
    return _columns(tuple((line, "") for line in lines), size)


@lru_cache(maxsize=64)
def _columns(rows: tuple[tuple[str, str], ...], size: int) -> NDArray[np.uint8]:
    """Make the panel of two columns, shape (height, width); without rows it is empty."""
    if not rows:
        return np.zeros((0, 0), np.uint8)
    font, line, edge = ImageFont.load_default(size), round(1.4 * size), size // 2
    first, second = (max(int(font.getlength(row[n])) + 1 for row in rows) for n in (0, 1))
    right = edge + first + size
    width = right + second + edge if any(row[1] for row in rows) else first + 2 * edge
    image = Image.new("L", (width, line * len(rows) + edge))
    for n, (name, meaning) in enumerate(rows):
        ImageDraw.Draw(image).text((edge, edge // 2 + n * line), name, fill=255, font=font)
        ImageDraw.Draw(image).text((right, edge // 2 + n * line), meaning, fill=255, font=font)
    return np.asarray(image)


@lru_cache(maxsize=64)
def _bar(size: int, filled: int, end: str) -> NDArray[np.uint8]:
    """Make the panel of a bar that is filled so far [px], with the value at its end; shape (height, width)."""
    edge, high, long = size // 2, round(0.6 * size), BAR * size
    words = _panel(size, end)
    drawn = np.zeros((len(words), edge + long + words.shape[1]), np.uint8)
    drawn[:, edge + long :] = words
    top = (len(words) - high) // 2
    drawn[top : top + high, edge : edge + long] = OUTLINE
    drawn[top + 1 : top + high - 1, edge + 1 : edge + long - 1] = 0
    drawn[top : top + high, edge : edge + min(filled, long)] = 255
    return drawn


def _letter_size(picture: Picture) -> int:
    return int(min(LARGEST, max(SMALLEST, picture.shape[0] * LETTER)))
