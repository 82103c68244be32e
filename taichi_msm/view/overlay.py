"""Overlay of a session's picture: readings, help texts, and a ring around the tool."""

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

# Length of a bar [letter heights].
BAR_LENGTH_LETTERS = 10

OUTLINE_GREY = 140


class ValueBar(NamedTuple):
    """Bar of a value; the full bar is the largest value so far, rounded up."""

    value: float  # [unit]
    largest: float  # largest value so far, above 0 [unit]
    unit: str

    @property
    def end(self) -> float:
        """Value of a full bar: 1, 2 or 5 times a power of ten [unit]."""
        power = 10.0 ** math.floor(math.log10(self.largest))
        return next(digit * power for digit in (1, 2, 5, 10) if self.largest <= digit * power * (1 + 1e-9))


def write_text(
    picture: Picture,
    above: Sequence[str],
    below: str = "",
    table: Mapping[str, str] | None = None,
    bar: ValueBar | None = None,
) -> None:
    """Write text on dark panels over a picture, shape (height, width, 3), in place.

    The lines `above`, the bar and the table of two columns are in the upper left corner, one under another; the text
    `below` is at the bottom, wrapped to the width.
    """
    height, width = picture.shape[:2]
    # Height of letters [px].
    size = int(min(22, max(11, height * (1 / 36))))
    top = edge = size // 2
    bar_panel = (
        _bar(size, round(BAR_LENGTH_LETTERS * size * bar.value / bar.end), f"{bar.end:g} {bar.unit}") if bar else None
    )
    for panel in (_panel(size, *above), bar_panel, _columns(tuple((table or {}).items()), size)):
        if panel is not None and len(panel):
            _blend(picture, panel, edge, top)
            top += len(panel) + edge
    # The average width of a letter is at most 0.56 of its height.
    panel = _panel(size, *textwrap.wrap(below, max(1, int((width - 4 * edge) / (0.56 * size)))))
    _blend(picture, panel, edge, height - len(panel) - edge)


def mark_tool(picture: Picture, pixel: tuple[float, float], *, pulls: bool) -> None:
    """Draw a ring around a pixel (x, y) into a picture, shape (height, width, 3), in place; yellow for a pull."""
    radius = picture.shape[0] * (1 / 50)
    reach = int(radius) + 4
    left, top = max(0, int(pixel[0]) - reach), max(0, int(pixel[1]) - reach)
    # A copy of this region is much faster than one of the whole picture.
    region = picture[top : max(0, int(pixel[1]) + reach), left : max(0, int(pixel[0]) + reach)]
    if region.size == 0:
        return
    image = Image.fromarray(region)
    x, y = pixel[0] - left, pixel[1] - top
    colour = (255, 214, 90) if pulls else (255, 255, 255)
    for ring_radius, outline, line_width in ((radius + 1, (0, 0, 0), 3), (radius, colour, 1)):
        box = x - ring_radius, y - ring_radius, x + ring_radius, y + ring_radius
        ImageDraw.Draw(image).ellipse(box, outline=outline, width=line_width)
    region[:] = np.asarray(image)


def _blend(picture: Picture, panel: NDArray[np.uint8], left: int, top: int) -> None:
    """Blend a panel over a darkened region of the picture, clipped to the picture."""
    left, top = max(0, left), max(0, top)
    region = picture[top : top + panel.shape[0], left : left + panel.shape[1]]
    region[:] = np.maximum(region // 3, panel[: region.shape[0], : region.shape[1], None])


def _panel(size: int, *lines: str) -> NDArray[np.uint8]:
    return _columns(tuple((line, "") for line in lines), size)


@lru_cache(maxsize=64)
def _columns(rows: tuple[tuple[str, str], ...], size: int) -> NDArray[np.uint8]:
    """Draw rows of two columns of text in grey, shape (height, width); (0, 0) without rows."""
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
    """Draw a bar, filled to a length [px], and the label `end` to its right in grey, shape (height, width)."""
    edge, height, width = size // 2, round(0.6 * size), BAR_LENGTH_LETTERS * size
    label = _panel(size, end)
    panel = np.zeros((len(label), edge + width + label.shape[1]), np.uint8)
    panel[:, edge + width :] = label
    top = (len(label) - height) // 2
    panel[top : top + height, edge : edge + width] = OUTLINE_GREY
    panel[top + 1 : top + height - 1, edge + 1 : edge + width - 1] = 0
    panel[top : top + height, edge : edge + min(filled, width)] = 255
    return panel
