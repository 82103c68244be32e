"""What a session writes over its picture: figures, keys, and where the tool is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from taichi_msm.gif import Picture

# Heights of letters [px]: this share of the picture's, within limits.
LETTER = 1 / 34
SMALLEST, LARGEST = 11, 22

TEXT = (255, 255, 255)
SHADE = (0, 0, 0)
PUSH = (255, 255, 255)
PULL = (255, 214, 90)


def write(
    picture: Picture,
    above: Sequence[str],
    below: str = "",
    *,
    table: Mapping[str, str] | None = None,
    tool: tuple[float, float] | None = None,
    pulls: bool = False,
) -> Picture:
    """Write over a picture.

    Args:
        picture: colours, shape (height, width, 3).
        above: lines for its top left corner.
        below: a line for its bottom left corner.
        table: two columns, under the first lines.
        tool: the pixel that the tool is seen at.
        pulls: whether it pulls.

    Returns:
        Another picture, of the same shape.
    """
    if not (above or below or table or tool):
        return picture
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    if tool is not None:
        _ring(draw, tool, picture.shape[0] / 50, PULL if pulls else PUSH)
    size = int(min(LARGEST, max(SMALLEST, picture.shape[0] * LETTER)))
    line = round(1.35 * size)
    left = top = line // 2
    for text in above:
        _text(draw, (left, top), text, size)
        top += line
    top += left
    right = left + max((_font(size).getlength(name) for name in table or ()), default=0) + size
    for name, meaning in (table or {}).items():
        _text(draw, (left, top), name, size)
        _text(draw, (right, top), meaning, size)
        top += line
    _text(draw, (left, picture.shape[0] - line - left), below, size)
    return np.asarray(image)


def _text(draw: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int) -> None:
    draw.text(at, text, fill=TEXT, font=_font(size), stroke_width=1, stroke_fill=SHADE)


def _ring(draw: ImageDraw.ImageDraw, centre: tuple[float, float], radius: float, colour: tuple[int, int, int]) -> None:
    x, y = centre
    for grow, fill, width in ((1, SHADE, 3), (0, colour, 1)):
        r = radius + grow
        draw.ellipse((x - r, y - r, x + r, y + r), outline=fill, width=width)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
