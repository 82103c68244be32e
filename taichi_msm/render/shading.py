"""The colours of samples, from what they show; then the output for pixels: their colours and their labels.

The light of an endoscope on wet tissue and on metal: it comes from beside the camera and weakens with distance.

Of several cameras it is that of the main one.

All vectors are in the camera's frame: the eye at 0, x right, y up, z toward the camera. P is the point that a sample
shows, N its normal on the camera's side, L the unit vector from P to the light, V that from P to the eye, and
M = 2 (N L) N - L the direction into which light from L is reflected:

    light    = ambient + (1 - ambient) (N L + wrap) / (1 + wrap) d0 / d / the same at the middle of the picture
    colour   = texture light + 255 gloss (M V)^shininess d0 / d

d is the distance from P to the light, and d0 that from the point in the middle of the picture; there, a flat sheet that
faces the camera keeps its colours. Light wraps around the surface, as scattering in tissue makes it do, so no side of a
dent is black. An instrument shades tissue near it: at r times its radius from its axis it takes away the share
uniforms.SHADE / r^2 of the light.

Normals are lists, and may have any length.

The colour of the texture for a tile of samples, filtered over what each of them shows.

It comes from the texture at 1, 1/2, 1/4, ... of its size (mipmaps), so that a sample of many texels shows their mean.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms
from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, DrawingConfig, centres, places
from taichi_msm.render.geometry import line_of_sight, w_at
from taichi_msm.render.labels import label_channels
from taichi_msm.system.runtime import ti

pass  # REMOVED
pass  # REMOVED


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
            colour[n] += (uniforms.WIRE_COLOUR[n] - colour[n]) * wire
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


@ti.func
def illuminate(x, y, depth, normal: ti.template(), numbers: ti.template()):
    """Find how samples are lit: N L; M V; d0 / d; the upward component of the direction into which V is reflected."""
    n_x, n_y, n_z = ti.static((normal[0], normal[1], normal[2]))
    across, above = line_of_sight(x, y, numbers)
    w = w_at(depth, numbers)
    right, up = across * w, above * w
    l_x, l_y, l_z = numbers[uni.LIGHT_X] - right, numbers[uni.LIGHT_Y] - up, numbers[uni.LIGHT_Z] + depth
    v_x, v_y, v_z = right * (numbers[uni.PINHOLE] * (-1.0)), up * (numbers[uni.PINHOLE] * (-1.0)), w
    # Scalar products of vectors that are not normalised yet.
    n_l = n_x * l_x + n_y * l_y + n_z * l_z
    n_v = n_x * v_x + n_y * v_y + n_z * v_z
    l_v = l_x * v_x + l_y * v_y + l_z * v_z
    n_n = ti.max(n_x * n_x + n_y * n_y + n_z * n_z, 1e-30)
    l_l = ti.max(l_x * l_x + l_y * l_y + l_z * l_z, 1e-30)
    v_v = ti.max(v_x * v_x + v_y * v_y + v_z * v_z, 1e-30)
    to_n = 1.0 / n_n
    # One division for both roots.
    root_l, root_v = ti.sqrt(l_l), ti.sqrt(v_v)
    to_both = 1.0 / (root_l * root_v)
    to_l, to_v = to_both * root_v, to_both * root_l
    cosine = n_l * ti.sqrt(to_n) * to_l
    return (
        cosine,
        (2.0 * n_l * n_v * to_n - l_v) * to_both,
        ti.min(numbers[uni.FARNESS] * to_l, 4.0),
        (2.0 * n_v * n_y * to_n - v_y) * to_v,
    )


@ti.func
def highlight(mirror):
    """(M V)^shininess."""
    power = ti.max(ti.min(mirror, 1.0), 0.0)
    for _ in ti.static(range(uniforms.SHARPNESS)):
        power = power * power
    return power


@ti.func
def unshaded(x, y, depth, rod_count, numbers: ti.template(), config: ti.template()):
    """Share of the light that reaches samples at (x, y) past the instruments."""
    across, above = line_of_sight(x, y, numbers)
    w = w_at(depth, numbers)
    right, up = across * w, above * w
    share = config.floats(1)
    for n in range(rod_count):
        rod = uni.RODS + n * uni.ROD_NUMBERS
        tip, axis = rod + uni.TIP, rod + uni.AXIS
        p_x, p_y, p_z = right - numbers[tip], up - numbers[tip + 1], depth * (-1.0) - numbers[tip + 2]
        u_x, u_y, u_z = numbers[axis], numbers[axis + 1], numbers[axis + 2]
        foot = ti.max(ti.min(p_x * u_x + p_y * u_y + p_z * u_z, numbers[rod + uni.LENGTH]), 0.0)
        f_x, f_y, f_z = p_x - u_x * foot, p_y - u_y * foot, p_z - u_z * foot
        square = numbers[rod + uni.RADIUS] * numbers[rod + uni.RADIUS]
        share *= 1.0 - uniforms.SHADE * square / ti.max(f_x * f_x + f_y * f_y + f_z * f_z, square)
    return share


@ti.func
def tilt(normal: ti.template(), rise_x, rise_y, numbers: ti.template()):
    """Tilt normals by the relief, given the rise of the grey from texel to texel: where it rises, they tilt back."""
    n_x, n_y, n_z = ti.static((normal[0], normal[1], normal[2]))
    length = 1.0 / ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
    a = [numbers[uni.ACROSS + k] for k in ti.static(range(3))]
    b = [numbers[uni.UP + k] for k in ti.static(range(3))]
    n = [n_x * length, n_y * length, n_z * length]
    slope_x, slope_y = rise_x * numbers[uni.SLOPE_X], rise_y * numbers[uni.SLOPE_Y]
    along = slope_x * (a[0] * n[0] + a[1] * n[1] + a[2] * n[2]) + slope_y * (b[0] * n[0] + b[1] * n[1] + b[2] * n[2])
    for k in ti.static(range(3)):
        normal[k] = n[k] * (along + 1.0) - slope_x * a[k] - slope_y * b[k]


@ti.func
def light_tissue(x, y, depth, normal: ti.template(), rise_x, rise_y, column, row, appearance: ti.template()):
    """Light wet tissue, whose relief rises by so much from texel to texel: give the colours' factor and summand.

    Samples are in these columns and rows of the picture; without distortion they would be at (x, y).
    """
    config, numbers = ti.static((appearance.config, appearance.numbers))
    tilted = [normal[n] for n in ti.static(range(3))]
    if ti.static(config.relief):
        tilt(tilted, rise_x, rise_y, numbers)
    cosine, mirror, nearness, _ = illuminate(x, y, depth, tilted, numbers)
    diffuse = ti.max(cosine + uniforms.WRAP, 0.0) * (1.0 / (1.0 + uniforms.WRAP)) * nearness * numbers[uni.UNIT]
    share = numbers[uni.AMBIENT] + (1.0 - numbers[uni.AMBIENT]) * diffuse
    gloss = highlight(mirror) * nearness * (255.0 * numbers[uni.GLOSS])
    if ti.static(config.instruments):
        left = unshaded(x, y, depth, appearance.rod_count, numbers, config)
        share, gloss = share * left, gloss * left
    if ti.static(config.vignette):
        # The distance from the middle of the picture is in units of half its diagonal.
        off_x, off_y = column - numbers[uni.MIDDLE_X], row - numbers[uni.MIDDLE_Y]
        diagonal = numbers[uni.MIDDLE_X] * numbers[uni.MIDDLE_X] + numbers[uni.MIDDLE_Y] * numbers[uni.MIDDLE_Y]
        rim = 1.0 - numbers[uni.VIGNETTE] * (off_x * off_x + off_y * off_y) / diagonal
        share, gloss = share * rim, gloss * rim
    # Where a point is infinite or NaN, so is its normal.
    return ti.max(ti.min(share, 8.0), 0.0), ti.max(ti.min(gloss, 8.0 * 255.0), 0.0)


@ti.func
def light_metal(x, y, depth, normal: ti.template(), numbers: ti.template()):
    """Light metal, which reflects a room that is bright above and dark below: give red, green and blue."""
    # What reaches to the light or beyond it is lit as if it ended before.
    below = ti.max(depth, uniforms.METAL_NEAREST * numbers[uni.FARNESS])
    cosine, mirror, _, upward = illuminate(x, y, below, normal, numbers)
    bright = ti.max(upward, 0.0)
    share = (
        uniforms.METAL_AMBIENT + uniforms.METAL_DIFFUSE * ti.max(cosine, 0.0) + uniforms.METAL_MIRROR * bright * bright
    )
    gloss = highlight(mirror) * (255.0 * uniforms.METAL_GLOSS)
    return [ti.min(share * uniforms.METAL[n] + gloss, 255.0) for n in ti.static(range(3))]


class Appearance(NamedTuple):
    """The picture on the sheet, and the light and the instruments that it is shaded with."""

    config: DrawingConfig
    texels: Any  # as `pyramid` gives them
    sizes: Any
    width: Any  # of the first level
    height: Any
    numbers: Any
    rod_count: Any


def packed(colours: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pack each colour into one number, red + 256 green + 65536 blue, which f32 holds exactly."""
    return colours.astype(np.float32) @ np.array([1, 1 << 8, 1 << 16], np.float32)


def pyramid(texture: NDArray[np.uint8], *, minified: bool) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Make the levels of a texture, shape (height, width, 3); the last has one texel. Not `minified`: the first alone.

    Returns:
        The texels of all levels, packed, one row after another; for every level where it begins there, its width and
        its height, shape (levels, 3).
    """
    level, texels, levels, first = texture, [], [], 0
    while True:
        height, width, _ = level.shape
        texels.append(packed(level).ravel())
        levels.append((first, width, height))
        first += width * height
        if not minified or width == height == 1:
            return np.concatenate(texels), np.array(levels, np.int32)
        level = halved(level)


def halved(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average blocks of 2 x 2 texels; where their number is odd, the last row or column counts twice."""
    height, width, _ = colours.shape
    even = np.pad(colours, ((0, height % 2), (0, width % 2), (0, 0)), "edge").astype(np.uint16)
    sums = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    return ((sums + 2) // 4).astype(np.uint8)


@ti.func
def whole_numbers(values, config: ti.template()):
    """Cast to integers, lane by lane: casting a vector crashes."""
    return config.integers([ti.cast(values[lane], ti.i32) for lane in ti.static(range(config.lanes))])


@ti.func
def channels(index, appearance: ti.template()):
    """Gather texels, and unpack their red, green and blue."""
    config, texels = ti.static((appearance.config, appearance.texels))
    texel = config.floats([texels[index[lane]] for lane in ti.static(range(config.lanes))])
    blue = ti.floor(texel * (1.0 / 65536.0))
    rest = texel - blue * 65536.0
    green = ti.floor(rest * (1.0 / 256.0))
    return [rest - green * 256.0, green, blue]


@ti.func
def between(upper_left, upper_right, lower_left, lower_right, u, v):
    """Interpolate bilinearly."""
    up = upper_left + (upper_right - upper_left) * u
    low = lower_left + (lower_right - lower_left) * u
    return up + (low - up) * v


@ti.func
def fetch(first, width, height, x, y, appearance: ti.template()):
    """Filter a level bilinearly at (x, y) of its texels: its colour and, for a relief, the grey's rise a texel."""
    config = ti.static(appearance.config)
    # Beyond the middle of its outermost texels the texture does not change.
    texel_x = ti.max(ti.min(x, width - 1.0), 0.0)
    texel_y = ti.max(ti.min(y, height - 1.0), 0.0)
    floor_x, floor_y = ti.floor(texel_x), ti.floor(texel_y)
    u, v = texel_x - floor_x, texel_y - floor_y
    left, row = whole_numbers(floor_x, config), whole_numbers(floor_y, config)
    right = ti.min(left + 1, width - 1)
    upper = row * width + first
    under = ti.min(row + 1, height - 1) * width + first
    ul, ur = channels(upper + left, appearance), channels(upper + right, appearance)
    ll, lr = channels(under + left, appearance), channels(under + right, appearance)
    rise_x, rise_y = u, v
    if ti.static(config.relief):
        grey_ul, grey_ur = ul[0] + ul[1] + ul[2], ur[0] + ur[1] + ur[2]
        grey_ll, grey_lr = ll[0] + ll[1] + ll[2], lr[0] + lr[1] + lr[2]
        rise_x = (grey_ur - grey_ul + (grey_lr - grey_ll - (grey_ur - grey_ul)) * v) * (1.0 / 3.0)
        rise_y = (grey_ll - grey_ul + (grey_lr - grey_ur - (grey_ll - grey_ul)) * u) * (1.0 / 3.0)
    return [between(ul[n], ur[n], ll[n], lr[n], u, v) for n in ti.static(range(3))], rise_x, rise_y


@ti.func
def filtered(at, seen, samples: ti.template(), appearance: ti.template()):
    """Filter the texture for a tile; returns what `fetch` does."""
    config, sizes = ti.static((appearance.config, appearance.sizes))
    floats, integers, plane = ti.static((config.floats, config.integers, config.plane))
    x = ti.select(seen, samples[at + plane.texel_x], 0.0)
    y = ti.select(seen, samples[at + plane.texel_y], 0.0)
    first, width, height = integers(0), integers(appearance.width), integers(appearance.height)
    first_far, width_far, height_far = first, width, height
    texel, footprint, most = floats(1), floats(0), 0.0
    if ti.static(config.tissue):
        footprint = ti.select(seen, samples[at + plane.footprint], 0.0)
        most = footprint.max()
        if most > 1.0:
            # For every sample, the coarsest level whose texels are not larger than the sample is mixed with the next
            # coarser one.
            last = sizes[uni.LEVEL_COUNT] - 1
            level, bound = 0, 1.0
            while level <= last and most >= bound:
                larger = footprint >= bound
                here = uni.LEVELS + uni.LEVEL_SIZES * level
                far = uni.LEVELS + uni.LEVEL_SIZES * ti.min(level + 1, last)
                if level > 0:
                    texel = ti.select(larger, texel * 2.0, texel)
                    first = ti.select(larger, sizes[here], first)
                    width = ti.select(larger, sizes[here + 1], width)
                    height = ti.select(larger, sizes[here + 2], height)
                first_far = ti.select(larger, sizes[far], first_far)
                width_far = ti.select(larger, sizes[far + 1], width_far)
                height_far = ti.select(larger, sizes[far + 2], height_far)
                bound = bound * 4.0
                level += 1
            x = (x + 0.5) / texel - 0.5
            y = (y + 0.5) / texel - 0.5
    colour, rise_x, rise_y = fetch(first, width, height, x, y, appearance)
    if ti.static(config.tissue):  # noqa: SIM102  (decided when it is compiled)
        if most > 1.0:
            x = x * 0.5 - 0.25
            y = y * 0.5 - 0.25
            colour_far, far_x, far_y = fetch(first_far, width_far, height_far, x, y, appearance)
            share = ti.max(ti.min(ti.sqrt(footprint) / texel - 1.0, 1.0), 0.0)
            for n in ti.static(range(3)):
                colour[n] += (colour_far[n] - colour[n]) * share
            rise_x = (rise_x + (far_x * 0.5 - rise_x) * share) / texel
            rise_y = (rise_y + (far_y * 0.5 - rise_y) * share) / texel
    return colour, rise_x, rise_y
