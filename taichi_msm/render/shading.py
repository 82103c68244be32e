"""The colours of samples, from what they show, and the colours of pixels, which are given out."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import style
from taichi_msm.render.samples import DEPTH, INFINITY, TEXEL_X, TEXEL_Y, Code
from taichi_msm.system.runtime import ti


class Texture(NamedTuple):
    """The picture on the sheet.

    Attributes:
        texels: as `packed` makes them, row after row.
        width, height: number of them.
        background: red, green and blue of samples that show nothing.
    """

    texels: Any
    width: Any
    height: Any
    background: Any


def packed(colours: NDArray[Any]) -> NDArray[np.float32]:
    """Make one number of each colour, red + 256 green + 65536 blue, for which f32 has places."""
    return colours.astype(np.float32) @ np.array([1, 1 << 8, 1 << 16], np.float32)


@cache
def shading(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that shades a tile and returns red, green and blue of its samples.

    Args:
        code: what it is compiled for.
    """
    lanes, floats, integers = code.lanes, code.floats, code.integers

    @ti.func
    def whole_numbers(values):
        return integers([ti.cast(values[lane], ti.i32) for lane in ti.static(range(lanes))])

    @ti.func
    def channels(texels: ti.template(), index):
        """Gather texels, and take them apart."""
        texel = floats([texels[index[lane]] for lane in ti.static(range(lanes))])
        blue = ti.floor(texel * (1.0 / 65536.0))
        rest = texel - blue * 65536.0
        green = ti.floor(rest * (1.0 / 256.0))
        return rest - green * 256.0, green, blue

    @ti.func
    def between(upper_left, upper_right, lower_left, lower_right, u, v):
        up = upper_left + (upper_right - upper_left) * u
        low = lower_left + (lower_right - lower_left) * u
        return up + (low - up) * v

    @ti.func
    def shade(samples: ti.template(), at, texture: ti.template()):
        """Shade a tile: the texture, lit, and the mesh drawn over it.

        Args:
            samples: what is kept of the tiles.
            at: entry where the tile begins.
            texture: the texture.
        """
        seen = samples[at + DEPTH] < INFINITY
        # Beyond the middle of its outermost texels the texture does not change.
        texel_x = ti.max(ti.min(ti.select(seen, samples[at + TEXEL_X], 0.0), texture.width - 1.0), 0.0)
        texel_y = ti.max(ti.min(ti.select(seen, samples[at + TEXEL_Y], 0.0), texture.height - 1.0), 0.0)
        floor_x, floor_y = ti.floor(texel_x), ti.floor(texel_y)
        u, v = texel_x - floor_x, texel_y - floor_y
        left, row = whole_numbers(floor_x), whole_numbers(floor_y)
        right = ti.min(left + 1, texture.width - 1)
        upper = row * texture.width
        under = ti.min(row + 1, texture.height - 1) * texture.width
        red_ul, green_ul, blue_ul = channels(texture.texels, upper + left)
        red_ur, green_ur, blue_ur = channels(texture.texels, upper + right)
        red_ll, green_ll, blue_ll = channels(texture.texels, under + left)
        red_lr, green_lr, blue_lr = channels(texture.texels, under + right)
        red = between(red_ul, red_ur, red_ll, red_lr, u, v)
        green = between(green_ul, green_ur, green_ll, green_lr, u, v)
        blue = between(blue_ul, blue_ur, blue_ll, blue_lr, u, v)
        if ti.static(code.lit):
            light = samples[at + code.light]
            red, green, blue = red * light, green * light, blue * light
        if ti.static(code.wireframe):
            wire = samples[at + code.wire]
            red += (style.WIRE_COLOUR[0] - red) * wire
            green += (style.WIRE_COLOUR[1] - green) * wire
            blue += (style.WIRE_COLOUR[2] - blue) * wire
        return (
            ti.select(seen, red, floats(texture.background[0])),
            ti.select(seen, green, floats(texture.background[1])),
            ti.select(seen, blue, floats(texture.background[2])),
        )

    return shade


@cache
def resolving(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that shades the samples of a band and gives out the colours of its pixels.

    Args:
        code: what it is compiled for.
    """
    factor, planes = code.supersample, code.planes
    tile_width, tile_height = code.tile_width, code.tile_height
    shade = shading(code)

    @ti.func
    def give_tile(red, green, blue, row, end_row, tile, across, out: ti.template()):
        """Give out the colours of a tile whose samples are pixels."""
        colour = ti.floor(red + 0.5) + ti.floor(green + 0.5) * 256.0 + ti.floor(blue + 0.5) * 65536.0
        for line in ti.static(range(tile_height)):
            if row + line < end_row:
                pixels = [ti.cast(colour[line * tile_width + n], ti.i32) for n in ti.static(range(tile_width))]
                if ti.static(code.in_words):
                    # Four pixels, a byte for each channel, fill three words.
                    word = ((row + line) * across + tile) * 3
                    out[word] = pixels[0] | (pixels[1] << 24)
                    out[word + 1] = (pixels[1] >> 8) | (pixels[2] << 16)
                    out[word + 2] = (pixels[2] >> 16) | (pixels[3] << 8)
                else:
                    for n in ti.static(range(3)):
                        out[((row + line) * across + tile) * 3 + n] = ti.cast((pixels[0] >> (8 * n)) & 255, ti.u8)

    @ti.func
    def give_means(samples: ti.template(), first, row, end_row, across, width, out: ti.template()):
        """Give out the colours of pixels, each the mean of its samples."""
        for y in range(row, end_row):
            for x in range(width):
                for n in ti.static(range(3)):
                    total = 0.0
                    for v, u in ti.static(ti.ndrange(factor, factor)):
                        line, column = (y - row) * factor + v, x * factor + u
                        tile = (line // tile_height) * across + column // tile_width
                        lane = (line % tile_height) * tile_width + column % tile_width
                        total += samples[first + tile * planes + code.colour + n][lane]
                    out[(y * width + x) * 3 + n] = ti.cast(ti.cast(total / (factor * factor) + 0.5, ti.i32), ti.u8)

    @ti.func
    def resolve(samples: ti.template(), first, row, end_row, across, width, texture: ti.template(), out: ti.template()):
        """Shade the samples of a band and give out its pixels.

        Args:
            samples: what is kept of the tiles.
            first: entry where the band begins.
            row: first row of pixels of the band.
            end_row: the row after its last.
            across: tiles of a row of them.
            width: of the picture [px].
            texture: the texture.
            out: the picture.
        """
        lines = ((end_row - row) * factor + tile_height - 1) // tile_height
        for line in range(lines):
            for tile in range(across):
                at = first + (line * across + tile) * planes
                red, green, blue = shade(samples, at, texture)
                if ti.static(factor == 1):
                    give_tile(red, green, blue, row + line * tile_height, end_row, tile, across, out)
                else:
                    samples[at + code.colour] = red
                    samples[at + code.colour + 1] = green
                    samples[at + code.colour + 2] = blue
        if ti.static(factor > 1):
            give_means(samples, first, row, end_row, across, width, out)

    return resolve
