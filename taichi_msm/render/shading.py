"""The colours of samples, from what they show; then the output for pixels: their colours and their labels."""

from typing import Any, NamedTuple

from taichi_msm.render import style
from taichi_msm.render import uniforms as uni
from taichi_msm.render.labels import label_channels
from taichi_msm.render.lighting import light_metal, light_tissue
from taichi_msm.render.samples import INFINITY, centres, places
from taichi_msm.render.texture_filter import filtered
from taichi_msm.system.runtime import ti


class PixelArrays(NamedTuple):
    """What the kernel writes."""

    colours: Any  # of the pixels, as words or bytes
    labels: Any  # those of all pixels, one label after the other (labels.py)
    pixels: Any  # how many there are


@ti.func
def shade(at, left, top, place, samples: ti.template(), appearance: ti.template()):
    """Shade the tile whose first sample is at (left, top): light the texture, then draw the mesh and the instruments.

    `place` is the entry of its places, if there is a lens.

    Returns:
        Red, green and blue.
    """
    config, numbers = ti.static((appearance.config, appearance.numbers))
    plane = ti.static(config.plane)
    depth = samples[at + plane.depth]
    seen = depth < INFINITY
    colour, rise_x, rise_y = filtered(at, seen, samples, appearance)
    if ti.static(config.headlit):
        for n in ti.static(range(3)):
            colour[n] *= samples[at + plane.light]
    x, y = places(left, top, place, samples, config)
    normal = [samples[at + (plane.normal_x + n)] for n in ti.static(range(3 * (config.tissue or config.metal)))]
    if ti.static(config.tissue):
        column, row = centres(left, top, config)
        share, gloss = light_tissue(x, y, depth, normal, rise_x, rise_y, column, row, appearance)
        for n in ti.static(range(3)):
            colour[n] = ti.min(colour[n] * share + gloss, 255.0)
    if ti.static(config.wireframe):
        wire = samples[at + plane.wire]
        for n in ti.static(range(3)):
            colour[n] += (style.WIRE_COLOUR[n] - colour[n]) * wire
    if ti.static(config.metal):
        is_metal = samples[at + plane.instrument] > 0.0
        if ti.select(is_metal, 1.0, 0.0).max() > 0.0:
            metal = light_metal(x, y, depth, normal, numbers)
            for n in ti.static(range(3)):
                colour[n] = ti.select(is_metal, metal[n], colour[n])
    return [ti.select(seen, colour[n], config.floats(numbers[uni.BACKGROUND + n])) for n in ti.static(range(3))]


@ti.func
def write_colours(colour: ti.template(), row, end_row, tile, across, colours: ti.template(), config: ti.template()):
    """Write the colours of a tile whose samples are pixels."""
    packed = ti.floor(colour[0] + 0.5) + ti.floor(colour[1] + 0.5) * 256.0 + ti.floor(colour[2] + 0.5) * 65536.0
    width = ti.static(config.tile_width)
    for line in ti.static(range(config.tile_height)):
        if row + line < end_row:
            pixels = [ti.cast(packed[line * width + n], ti.i32) for n in ti.static(range(width))]
            if ti.static(config.in_words):
                # Four pixels, a byte for each channel, fill three words.
                word = ((row + line) * across + tile) * 3
                colours[word] = pixels[0] | (pixels[1] << 24)
                colours[word + 1] = (pixels[1] >> 8) | (pixels[2] << 16)
                colours[word + 2] = (pixels[2] >> 16) | (pixels[3] << 8)
            else:
                for n in ti.static(range(3)):
                    colours[((row + line) * across + tile) * 3 + n] = ti.cast((pixels[0] >> (8 * n)) & 255, ti.u8)


@ti.func
def write_means(
    first, row, end_row, left, right, across, width,
    samples: ti.template(), colours: ti.template(), config: ti.template(),
):  # fmt: skip
    """Write the colours of pixels, each the mean of its samples; arguments as for `resolve`."""
    factor, tile_width, tile_height = ti.static((config.supersample, config.tile_width, config.tile_height))
    for y in range(row, end_row):
        for x in range(left, right):
            for n in ti.static(range(3)):
                total = 0.0
                for v, u in ti.static(ti.ndrange(factor, factor)):
                    line, column = (y - row) * factor + v, x * factor + u
                    tile = (line // tile_height) * across + column // tile_width
                    lane = (line % tile_height) * tile_width + column % tile_width
                    total += samples[first + tile * config.planes + config.plane.red + n][lane]
                colours[(y * width + x) * 3 + n] = ti.cast(ti.cast(total / (factor * factor) + 0.5, ti.i32), ti.u8)


@ti.func
def write_labels(
    at, left, row, end_row, width, samples: ti.template(), output: ti.template(), config: ti.template()
):  # fmt: skip
    """Write the labels of the pixels of a tile."""
    plane, channels = ti.static((config.plane, label_channels(config.plane)))
    seen = samples[at + plane.depth] < INFINITY
    sheet = seen
    if ti.static(config.instruments):
        sheet = sheet & (samples[at + plane.instrument] <= 0.0)
    values = [
        ti.select(sheet if ti.static(label.of_sheet) else seen, samples[at + entry], label.nothing)
        for entry, _number, _count, label in ti.static(channels)
    ]
    for line in ti.static(range(config.tile_height)):
        for n in ti.static(range(config.tile_width)):
            if row + line < end_row and left + n < width:
                pixel = (row + line) * width + left + n
                for channel, value in ti.static(zip(channels, values, strict=True)):
                    _, number, count, label = ti.static(channel)
                    place = label.first * output.pixels + count * pixel + number
                    output.labels[place] = value[line * config.tile_width + n]


@ti.func
def resolve(
    first, row, end_row, left, right, across, width, placed,
    samples: ti.template(), appearance: ti.template(), output: ti.template(),
):  # fmt: skip
    """Shade the samples of a band, or of a part of one, and write its pixels.

    The band begins at entry `first`, its places at entry `placed` if there is a lens, both from the left edge of the
    picture, and it has `across` tiles in a row. The pixels are
    those in columns `left` to `right` of rows `row` to `end_row`, without the latter, of a picture of this `width`.
    """
    config = ti.static(appearance.config)
    factor, tile_width, tile_height = ti.static((config.supersample, config.tile_width, config.tile_height))
    lines = ((end_row - row) * factor + tile_height - 1) // tile_height
    for line in range(lines):
        for tile in range(left * factor // tile_width, (right * factor + tile_width - 1) // tile_width):
            at = first + (line * across + tile) * config.planes
            column, top = tile * tile_width, line * tile_height
            if ti.static(config.labels):
                write_labels(at, column, row + top, end_row, width, samples, output, config)
            if ti.static(config.picture):
                place = placed + (line * across + tile) * config.place_planes
                colour = shade(at, column, row * factor + top, place, samples, appearance)
                if ti.static(factor == 1):
                    write_colours(colour, row + top, end_row, tile, across, output.colours, config)
                else:
                    for n in ti.static(range(3)):
                        samples[at + config.plane.red + n] = colour[n]
    if ti.static(config.picture and factor > 1):
        write_means(first, row, end_row, left, right, across, width, samples, output.colours, config)
