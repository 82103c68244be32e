"""What a session writes over its picture: figures, keys, and where the tool is."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from taichi_msm.gif import Picture

# Heights of letters [px]: this share of the picture's, within limits.
LETTER = 1 / 34
SMALLEST, LARGEST = 12, 22

# A letter is so wide, as a share of its height, in most texts at most.
LETTER_WIDTH = 0.56

TEXT = (255, 255, 255)
SHADE = (0, 0, 0)
PUSH = (255, 255, 255)
PULL = (255, 214, 90)

# Radius of the ring around the tool, as a share of the picture's height.
RING = 1 / 50


def write(picture: Picture, above: Sequence[str], below: str = "", table: Mapping[str, str] | None = None) -> None:
    """Write text over a picture, as large as its height asks for.

    Args:
        picture: colours, shape (height, width, 3); changed.
        above: lines for its top left corner.
        below: a text for its bottom left corner, in as many lines as it needs.
        table: two columns, under the first lines.
    """
    height, width = picture.shape[:2]
    size = int(min(LARGEST, max(SMALLEST, height * LETTER)))
    line = round(1.35 * size)
    margin = line // 2
    right = margin + size + max((_length(name, size) for name in table or ()), default=0)
    texts = [(margin, margin + n * line, text) for n, text in enumerate(above)]
    for n, (name, meaning) in enumerate((table or {}).items()):
        y = 2 * margin + (len(above) + n) * line
        texts += [(margin, y, name), (right, y, meaning)]
    lines = textwrap.wrap(below, max(1, int((width - 2 * margin) / (LETTER_WIDTH * size))))
    texts += [(margin, height - margin - (len(lines) - n) * line, text) for n, text in enumerate(lines)]
    for x, y, text in texts:
        with _part(picture, (x, y, x + _length(text, size) + 2, y + line)) as draw:
            # A shadow, and no outline, which would fill the spaces between small words.
            for offset, colour in ((1, SHADE), (0, TEXT)):
                draw.text((offset, offset), text, fill=colour, font=_font(size))


def mark(picture: Picture, tool: tuple[float, float], *, pulls: bool) -> None:
    """Draw a ring around the place of the tool.

    Args:
        picture: colours, shape (height, width, 3); changed.
        tool: the pixel that the tool is seen at.
        pulls: whether it pulls.
    """
    radius = picture.shape[0] * RING
    reach = int(radius) + 4
    x, y = int(tool[0]), int(tool[1])
    with _part(picture, (x - reach, y - reach, x + reach, y + reach)) as draw:
        across, down = tool[0] - max(0, x - reach), tool[1] - max(0, y - reach)
        for r, colour, width in ((radius + 1, SHADE, 3), (radius, PULL if pulls else PUSH, 1)):
            draw.ellipse((across - r, down - r, across + r, down + r), outline=colour, width=width)


@contextmanager
def _part(picture: Picture, box: tuple[int, int, int, int]) -> Iterator[ImageDraw.ImageDraw]:
    """Draw on a part of a picture (left, top, right, bottom), as far as it has one: to copy the whole takes longer."""
    left, top, right, bottom = (max(0, edge) for edge in box)
    part = picture[top:bottom, left:right]
    # Where nothing is left of it, what is drawn goes nowhere.
    image = Image.fromarray(part) if part.size else Image.new("RGB", (1, 1))
    yield ImageDraw.Draw(image)
    if part.size:
        part[:] = np.asarray(image)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _length(text: str, size: int) -> int:
    return int(_font(size).getlength(text)) + 1
