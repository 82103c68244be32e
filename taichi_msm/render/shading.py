"""The colours of samples, from what they show; then the output for pixels: their colours and their labels."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.render import style
from taichi_msm.render.lighting import lighting
from taichi_msm.render.numbers import ACROSS, BACKGROUND, LEVEL_COUNT, LEVEL_SIZES, LEVELS, SLOPE_X, SLOPE_Y, UP
from taichi_msm.render.samples import DEPTH, INFINITY, TEXEL_X, TEXEL_Y, Code
from taichi_msm.system.runtime import ti

# No material point: the coordinate of a pixel that shows none.
NOTHING = math.nan


class Texture(NamedTuple):
    """The picture on the sheet, and the light and the instruments that it is shaded with.

    Attributes:
        texels: as in a `Pyramid`.
        sizes: of its levels, after other sizes (`numbers`).
        width, height: of the first level.
        numbers: as `view_numbers` makes them.
        rod_count: how many instruments there are.
    """

    texels: Any
    sizes: Any
    width: Any
    height: Any
    numbers: Any
    rod_count: Any


class Out(NamedTuple):
    """What the kernel writes.

    Attributes:
        colours: of the pixels, as words or bytes.
        labels: coordinates of all pixels, two each; then their depths; then 255 or 0 for an instrument.
        pixels: how many there are.
    """

    colours: Any
    labels: Any
    pixels: Any


@cache
def shading(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that shades a tile and returns red, green and blue of its samples.

    Args:
        code: what it is compiled for.
    """
    lanes, floats, integers = code.lanes, code.floats, code.integers
    tissue, metal = lighting(code)
    columns = [lane % code.tile_width + 0.5 for lane in range(lanes)]
    lines = [lane // code.tile_width + 0.5 for lane in range(lanes)]

    @ti.func
    def whole_numbers(values):
        return integers([ti.cast(values[lane], ti.i32) for lane in ti.static(range(lanes))])

    @ti.func
    def channels(texels: ti.template(), index):
        """Gather texels, and unpack their red, green and blue."""
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
    def fetch(first, width, height, x, y, texture: ti.template()):
        """Filter a level bilinearly at (x, y) of its texels.

        Returns:
            Red, green and blue; and, if there is a relief, the slope of the grey from texel to texel.
        """
        # Beyond the middle of its outermost texels the texture does not change.
        texel_x = ti.max(ti.min(x, width - 1.0), 0.0)
        texel_y = ti.max(ti.min(y, height - 1.0), 0.0)
        floor_x, floor_y = ti.floor(texel_x), ti.floor(texel_y)
        u, v = texel_x - floor_x, texel_y - floor_y
        left, row = whole_numbers(floor_x), whole_numbers(floor_y)
        right = ti.min(left + 1, width - 1)
        upper = row * width + first
        under = ti.min(row + 1, height - 1) * width + first
        red_ul, green_ul, blue_ul = channels(texture.texels, upper + left)
        red_ur, green_ur, blue_ur = channels(texture.texels, upper + right)
        red_ll, green_ll, blue_ll = channels(texture.texels, under + left)
        red_lr, green_lr, blue_lr = channels(texture.texels, under + right)
        rise_x, rise_y = u, v
        if ti.static(code.relief):
            grey_ul = red_ul + green_ul + blue_ul
            grey_ur = red_ur + green_ur + blue_ur
            grey_ll = red_ll + green_ll + blue_ll
            grey_lr = red_lr + green_lr + blue_lr
            rise_x = (grey_ur - grey_ul + (grey_lr - grey_ll - (grey_ur - grey_ul)) * v) * (1.0 / 3.0)
            rise_y = (grey_ll - grey_ul + (grey_lr - grey_ur - (grey_ll - grey_ul)) * u) * (1.0 / 3.0)
        return (
            between(red_ul, red_ur, red_ll, red_lr, u, v),
            between(green_ul, green_ur, green_ll, green_lr, u, v),
            between(blue_ul, blue_ur, blue_ll, blue_lr, u, v),
            rise_x,
            rise_y,
        )

    @ti.func
    def sample(samples: ti.template(), at, seen, texture: ti.template()):
        """Filter the texture for a tile; returns what `fetch` does."""
        x = ti.select(seen, samples[at + TEXEL_X], 0.0)
        y = ti.select(seen, samples[at + TEXEL_Y], 0.0)
        first, width, height = integers(0), integers(texture.width), integers(texture.height)
        first_far, width_far, height_far = first, width, height
        texel, footprint, most = floats(1), floats(0), 0.0
        if ti.static(code.tissue):
            footprint = ti.select(seen, samples[at + ti.static(code.layout["footprint"])], 0.0)
            most = footprint.max()
            if most > 1.0:
                # For every sample, the coarsest level whose texels are not larger than the sample is mixed with the
                # next coarser one.
                last = texture.sizes[LEVEL_COUNT] - 1
                level, bound = 0, 1.0
                while level <= last and most >= bound:
                    larger = footprint >= bound
                    here, far = LEVELS + LEVEL_SIZES * level, LEVELS + LEVEL_SIZES * ti.min(level + 1, last)
                    if level > 0:
                        texel = ti.select(larger, texel * 2.0, texel)
                        first = ti.select(larger, texture.sizes[here], first)
                        width = ti.select(larger, texture.sizes[here + 1], width)
                        height = ti.select(larger, texture.sizes[here + 2], height)
                    first_far = ti.select(larger, texture.sizes[far], first_far)
                    width_far = ti.select(larger, texture.sizes[far + 1], width_far)
                    height_far = ti.select(larger, texture.sizes[far + 2], height_far)
                    bound = bound * 4.0
                    level += 1
                x = (x + 0.5) / texel - 0.5
                y = (y + 0.5) / texel - 0.5
        red, green, blue, rise_x, rise_y = fetch(first, width, height, x, y, texture)
        if ti.static(code.tissue):  # noqa: SIM102  (decided when it is compiled)
            if most > 1.0:
                x = x * 0.5 - 0.25
                y = y * 0.5 - 0.25
                red_far, green_far, blue_far, far_x, far_y = fetch(first_far, width_far, height_far, x, y, texture)
                share = ti.max(ti.min(ti.sqrt(footprint) / texel - 1.0, 1.0), 0.0)
                red += (red_far - red) * share
                green += (green_far - green) * share
                blue += (blue_far - blue) * share
                rise_x = (rise_x + (far_x * 0.5 - rise_x) * share) / texel
                rise_y = (rise_y + (far_y * 0.5 - rise_y) * share) / texel
        return red, green, blue, rise_x, rise_y

    @ti.func
    def shade(samples: ti.template(), at, left, top, texture: ti.template()):
        """Shade a tile: light the texture, draw the mesh over it, then the instruments.

        Args:
            samples: the planes of the tiles.
            at: entry where the tile begins.
            left: its first column of samples.
            top: its first row.
            texture: the texture and the light.
        """
        seen = samples[at + DEPTH] < INFINITY
        red, green, blue, rise_x, rise_y = sample(samples, at, seen, texture)
        if ti.static(code.headlit):
            light = samples[at + ti.static(code.layout["light"])]
            red, green, blue = red * light, green * light, blue * light
        numbers = ti.static(texture.numbers)
        x = floats(columns) + ti.cast(left, ti.f32)
        y = floats(lines) + ti.cast(top, ti.f32)
        if ti.static(code.tissue):
            n_x = samples[at + ti.static(code.layout["normal_x"])]
            n_y = samples[at + ti.static(code.layout["normal_y"])]
            n_z = samples[at + ti.static(code.layout["normal_z"])]
            if ti.static(code.relief):
                length = 1.0 / ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
                n_x, n_y, n_z = n_x * length, n_y * length, n_z * length
                # Where the relief rises, the normal tilts back.
                a_x, a_y, a_z = numbers[ACROSS], numbers[ACROSS + 1], numbers[ACROSS + 2]
                b_x, b_y, b_z = numbers[UP], numbers[UP + 1], numbers[UP + 2]
                slope_x, slope_y = rise_x * numbers[SLOPE_X], rise_y * numbers[SLOPE_Y]
                along = slope_x * (a_x * n_x + a_y * n_y + a_z * n_z) + slope_y * (b_x * n_x + b_y * n_y + b_z * n_z)
                n_x = n_x * (along + 1.0) - slope_x * a_x - slope_y * b_x
                n_y = n_y * (along + 1.0) - slope_x * a_y - slope_y * b_y
                n_z = n_z * (along + 1.0) - slope_x * a_z - slope_y * b_z
            depth = samples[at + DEPTH]
            share, gloss = tissue(x, y, depth, n_x, n_y, n_z, texture.rod_count, numbers)
            red = ti.min(red * share + gloss, 255.0)
            green = ti.min(green * share + gloss, 255.0)
            blue = ti.min(blue * share + gloss, 255.0)
        if ti.static(code.wires):
            wire = samples[at + ti.static(code.layout["wire"])]
            red += (style.WIRE_COLOUR[0] - red) * wire
            green += (style.WIRE_COLOUR[1] - green) * wire
            blue += (style.WIRE_COLOUR[2] - blue) * wire
        if ti.static(code.metal):
            is_metal = samples[at + ti.static(code.layout["instrument"])] > 0.5
            if ti.select(is_metal, 1.0, 0.0).max() > 0.0:
                m_x = samples[at + ti.static(code.layout["normal_x"])]
                m_y = samples[at + ti.static(code.layout["normal_y"])]
                m_z = samples[at + ti.static(code.layout["normal_z"])]
                metal_red, metal_green, metal_blue = metal(x, y, samples[at + DEPTH], m_x, m_y, m_z, numbers)
                red = ti.select(is_metal, metal_red, red)
                green = ti.select(is_metal, metal_green, green)
                blue = ti.select(is_metal, metal_blue, blue)
        return (
            ti.select(seen, red, floats(numbers[BACKGROUND + 0])),
            ti.select(seen, green, floats(numbers[BACKGROUND + 1])),
            ti.select(seen, blue, floats(numbers[BACKGROUND + 2])),
        )

    return shade


@cache
def resolving(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that shades the samples of a band and writes its pixels.

    Args:
        code: what it is compiled for.
    """
    factor, planes = code.supersample, code.planes
    tile_width, tile_height = code.tile_width, code.tile_height
    shade = shading(code)

    @ti.func
    def give_tile(red, green, blue, row, end_row, tile, across, colours: ti.template()):
        """Write the colours of a tile whose samples are pixels."""
        colour = ti.floor(red + 0.5) + ti.floor(green + 0.5) * 256.0 + ti.floor(blue + 0.5) * 65536.0
        for line in ti.static(range(tile_height)):
            if row + line < end_row:
                pixels = [ti.cast(colour[line * tile_width + n], ti.i32) for n in ti.static(range(tile_width))]
                if ti.static(code.in_words):
                    # Four pixels, a byte for each channel, fill three words.
                    word = ((row + line) * across + tile) * 3
                    colours[word] = pixels[0] | (pixels[1] << 24)
                    colours[word + 1] = (pixels[1] >> 8) | (pixels[2] << 16)
                    colours[word + 2] = (pixels[2] >> 16) | (pixels[3] << 8)
                else:
                    for n in ti.static(range(3)):
                        colours[((row + line) * across + tile) * 3 + n] = ti.cast((pixels[0] >> (8 * n)) & 255, ti.u8)

    @ti.func
    def give_means(samples: ti.template(), first, row, end_row, left, right, across, width, colours: ti.template()):
        """Write the colours of pixels, each the mean of its samples."""
        for y in range(row, end_row):
            for x in range(left, right):
                for n in ti.static(range(3)):
                    total = 0.0
                    for v, u in ti.static(ti.ndrange(factor, factor)):
                        line, column = (y - row) * factor + v, x * factor + u
                        tile = (line // tile_height) * across + column // tile_width
                        lane = (line % tile_height) * tile_width + column % tile_width
                        total += samples[first + tile * planes + ti.static(code.layout["red"]) + n][lane]
                    colours[(y * width + x) * 3 + n] = ti.cast(ti.cast(total / (factor * factor) + 0.5, ti.i32), ti.u8)

    @ti.func
    def give_labels(samples: ti.template(), at, left, row, end_row, width, out: ti.template()):
        """Write the labels of the pixels of a tile."""
        depth = samples[at + DEPTH]
        across, down = samples[at + ti.static(code.layout["across"])], samples[at + ti.static(code.layout["down"])]
        sheet = depth < INFINITY
        if ti.static(code.instruments):
            sheet = sheet & (samples[at + ti.static(code.layout["instrument"])] < 0.5)
        across = ti.select(sheet, across, NOTHING)
        down = ti.select(sheet, down, NOTHING)
        depth = ti.select(depth < INFINITY, depth, 0.0)
        for line in ti.static(range(tile_height)):
            for n in ti.static(range(tile_width)):
                if row + line < end_row and left + n < width:
                    pixel = (row + line) * width + left + n
                    lane = ti.static(line * tile_width + n)
                    out.labels[2 * pixel] = across[lane]
                    out.labels[2 * pixel + 1] = down[lane]
                    out.labels[2 * out.pixels + pixel] = depth[lane]
                    if ti.static(code.instruments):
                        mark = samples[at + ti.static(code.layout["instrument"])][lane]
                        out.labels[3 * out.pixels + pixel] = mark * 255.0

    @ti.func
    def resolve(
        samples: ti.template(), first, row, end_row, left, right, across, width,
        texture: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Shade the samples of a band, or of a part of one, and write its pixels.

        Args:
            samples: the planes of the tiles.
            first: entry where the band begins, from the left edge of the picture.
            row: first row of pixels of the band.
            end_row: the row after its last.
            left: first column of pixels.
            right: the column after its last.
            across: tiles in a row.
            width: of the picture [px].
            texture: the texture and the light.
            out: the colours and the labels.
        """
        lines = ((end_row - row) * factor + tile_height - 1) // tile_height
        for line in range(lines):
            for tile in range(left * factor // tile_width, (right * factor + tile_width - 1) // tile_width):
                at = first + (line * across + tile) * planes
                column, top = tile * tile_width, line * tile_height
                if ti.static(code.labels):
                    give_labels(samples, at, column, row + top, end_row, width, out)
                if ti.static(code.picture):
                    red, green, blue = shade(samples, at, column, row * factor + top, texture)
                    if ti.static(factor == 1):
                        give_tile(red, green, blue, row + top, end_row, tile, across, out.colours)
                    else:
                        samples[at + ti.static(code.layout["red"])] = red
                        samples[at + ti.static(code.layout["green"])] = green
                        samples[at + ti.static(code.layout["blue"])] = blue
        if ti.static(code.picture and factor > 1):
            give_means(samples, first, row, end_row, left, right, across, width, out.colours)

    return resolve
