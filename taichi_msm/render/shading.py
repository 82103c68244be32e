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
uni.SHADE / r^2 of the light.

Normals are lists, and may have any length.

The colour of the texture for a tile of samples, filtered over what each of them shows.

It comes from the texture at 1, 1/2, 1/4, ... of its size (mipmaps), so that a sample of many texels shows their mean.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, DrawingConfig, sample_centres, undistorted_centres
from taichi_msm.render.geometry import line_of_sight, w_at
from taichi_msm.render.labels import label_channels
from taichi_msm.system.runtime import ti


class PixelArrays(NamedTuple):
    """What the kernel writes."""

    colours: Any  # of the pixels, as words or bytes
    labels: Any  # those of all pixels, one label after the other (labels.py)
    pixels: Any  # how many there are


@ti.func
def shade(entry, left, top, place, samples: ti.template(), appearance: ti.template()):
    """Shade the tile whose first sample is at (left, top): light the texture, then draw the mesh and the instruments.

    `place` is the entry of its places, if there is a lens.

    Returns:
        Red, green and blue.
    """
    config, uniforms = ti.static((appearance.config, appearance.uniforms))
    plane = ti.static(config.plane)
    depth = samples[entry + plane.depth]
    seen = depth < INFINITY
    colour, rise_x, rise_y = filter_texture(entry, seen, samples, appearance)
    if ti.static(config.headlit):
        for n in ti.static(range(3)):
            colour[n] *= samples[entry + plane.light]
    x, y = undistorted_centres(left, top, place, samples, config)
    normal = [samples[entry + (plane.normal_x + n)] for n in ti.static(range(3 * (config.tissue or config.metal)))]
    if ti.static(config.tissue):
        column, row = sample_centres(left, top, config)
        share, gloss = light_tissue(x, y, depth, normal, rise_x, rise_y, column, row, appearance)
        for n in ti.static(range(3)):
            colour[n] = ti.min(colour[n] * share + gloss, 255.0)
    if ti.static(config.wireframe):
        wire = samples[entry + plane.wire]
        for n in ti.static(range(3)):
            colour[n] += (uni.WIRE_COLOUR[n] - colour[n]) * wire
    if ti.static(config.metal):
        is_metal = samples[entry + plane.instrument] > 0.0
        if ti.select(is_metal, 1.0, 0.0).max() > 0.0:
            metal = light_metal(x, y, depth, normal, uniforms)
            for n in ti.static(range(3)):
                colour[n] = ti.select(is_metal, metal[n], colour[n])
    return [ti.select(seen, colour[n], config.float_vector(uniforms[uni.BACKGROUND + n])) for n in ti.static(range(3))]


@ti.func
def write_colours(colour: ti.template(), row, end_row, tile, across, colours: ti.template(), config: ti.template()):
    """Write the colours of a tile whose samples are pixels."""
    pack_rgb = ti.floor(colour[0] + 0.5) + ti.floor(colour[1] + 0.5) * 256.0 + ti.floor(colour[2] + 0.5) * 65536.0
    width = ti.static(config.tile_width)
    for line in ti.static(range(config.tile_height)):
        if row + line < end_row:
            pixels = [ti.cast(pack_rgb[line * width + n], ti.i32) for n in ti.static(range(width))]
            if ti.static(config.writes_words):
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
    entry, left, row, end_row, width, samples: ti.template(), output: ti.template(), config: ti.template()
):  # fmt: skip
    """Write the labels of the pixels of a tile."""
    plane, fetch_rgb = ti.static((config.plane, label_channels(config.plane)))
    seen = samples[entry + plane.depth] < INFINITY
    sheet = seen
    if ti.static(config.instruments):
        sheet = sheet & (samples[entry + plane.instrument] <= 0.0)
    values = [
        ti.select(sheet if ti.static(label.of_sheet) else seen, samples[entry + offset], label.nothing)
        for entry, _number, _count_cells, label in ti.static(fetch_rgb)
    ]
    for line in ti.static(range(config.tile_height)):
        for n in ti.static(range(config.tile_width)):
            if row + line < end_row and left + n < width:
                pixel = (row + line) * width + left + n
                for channel, value in ti.static(zip(fetch_rgb, values, strict=True)):
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
            entry = first + (line * across + tile) * config.planes
            column, top = tile * tile_width, line * tile_height
            if ti.static(config.labels):
                write_labels(entry, column, row + top, end_row, width, samples, output, config)
            if ti.static(config.picture):
                place = placed + (line * across + tile) * config.map_planes
                colour = shade(entry, column, row * factor + top, place, samples, appearance)
                if ti.static(factor == 1):
                    write_colours(colour, row + top, end_row, tile, across, output.colours, config)
                else:
                    for n in ti.static(range(3)):
                        samples[entry + config.plane.red + n] = colour[n]
    if ti.static(config.picture and factor > 1):
        write_means(first, row, end_row, left, right, across, width, samples, output.colours, config)


@ti.func
def illuminate(x, y, depth, normal: ti.template(), uniforms: ti.template()):
    """Find how samples are lit: N L; M V; d0 / d; the upward component of the direction into which V is reflected."""
    n_x, n_y, n_z = ti.static((normal[0], normal[1], normal[2]))
    across, above = line_of_sight(x, y, uniforms)
    w = w_at(depth, uniforms)
    right, up = across * w, above * w
    l_x, l_y, l_z = uniforms[uni.LIGHT_X] - right, uniforms[uni.LIGHT_Y] - up, uniforms[uni.LIGHT_Z] + depth
    v_x, v_y, v_z = right * (uniforms[uni.PINHOLE] * (-1.0)), up * (uniforms[uni.PINHOLE] * (-1.0)), w
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
        ti.min(uniforms[uni.LIGHT_DISTANCE] * to_l, 4.0),
        (2.0 * n_v * n_y * to_n - v_y) * to_v,
    )


@ti.func
def specular(mirror):
    """(M V)^shininess."""
    power = ti.max(ti.min(mirror, 1.0), 0.0)
    for _ in ti.static(range(uni.SHARPNESS)):
        power = power * power
    return power


@ti.func
def light_transmission(x, y, depth, capsule_count, uniforms: ti.template(), config: ti.template()):
    """Share of the light that reaches samples at (x, y) past the instruments."""
    across, above = line_of_sight(x, y, uniforms)
    w = w_at(depth, uniforms)
    right, up = across * w, above * w
    share = config.float_vector(1)
    for n in range(capsule_count):
        rod = uni.CAPSULES + n * uni.CAPSULE_STRIDE
        tip, axis = rod + uni.TIP, rod + uni.AXIS
        p_x, p_y, p_z = right - uniforms[tip], up - uniforms[tip + 1], depth * (-1.0) - uniforms[tip + 2]
        u_x, u_y, u_z = uniforms[axis], uniforms[axis + 1], uniforms[axis + 2]
        foot = ti.max(ti.min(p_x * u_x + p_y * u_y + p_z * u_z, uniforms[rod + uni.LENGTH]), 0.0)
        f_x, f_y, f_z = p_x - u_x * foot, p_y - u_y * foot, p_z - u_z * foot
        square = uniforms[rod + uni.RADIUS] * uniforms[rod + uni.RADIUS]
        share *= 1.0 - uni.SHADE * square / ti.max(f_x * f_x + f_y * f_y + f_z * f_z, square)
    return share


@ti.func
def apply_relief(normal: ti.template(), rise_x, rise_y, uniforms: ti.template()):
    """Tilt normals by the relief, given the rise of the grey from texel to texel: where it rises, they tilt back."""
    n_x, n_y, n_z = ti.static((normal[0], normal[1], normal[2]))
    length = 1.0 / ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
    a = [uniforms[uni.ACROSS + k] for k in ti.static(range(3))]
    b = [uniforms[uni.UP + k] for k in ti.static(range(3))]
    n = [n_x * length, n_y * length, n_z * length]
    slope_x, slope_y = rise_x * uniforms[uni.SLOPE_X], rise_y * uniforms[uni.SLOPE_Y]
    along = slope_x * (a[0] * n[0] + a[1] * n[1] + a[2] * n[2]) + slope_y * (b[0] * n[0] + b[1] * n[1] + b[2] * n[2])
    for k in ti.static(range(3)):
        normal[k] = n[k] * (along + 1.0) - slope_x * a[k] - slope_y * b[k]


@ti.func
def light_tissue(x, y, depth, normal: ti.template(), rise_x, rise_y, column, row, appearance: ti.template()):
    """Light wet tissue, whose relief rises by so much from texel to texel: give the colours' factor and summand.

    Samples are in these columns and rows of the picture; without distortion they would be at (x, y).
    """
    config, uniforms = ti.static((appearance.config, appearance.uniforms))
    tilted = [normal[n] for n in ti.static(range(3))]
    if ti.static(config.relief):
        apply_relief(tilted, rise_x, rise_y, uniforms)
    cosine, mirror, nearness, _ = illuminate(x, y, depth, tilted, uniforms)
    diffuse = ti.max(cosine + uni.WRAP, 0.0) * (1.0 / (1.0 + uni.WRAP)) * nearness * uniforms[uni.LIGHT_NORMALISATION]
    share = uniforms[uni.AMBIENT] + (1.0 - uniforms[uni.AMBIENT]) * diffuse
    gloss = specular(mirror) * nearness * (255.0 * uniforms[uni.GLOSS])
    if ti.static(config.instruments):
        left = light_transmission(x, y, depth, appearance.capsule_count, uniforms, config)
        share, gloss = share * left, gloss * left
    if ti.static(config.vignette):
        # The distance from the middle of the picture is in units of half its diagonal.
        off_x, off_y = column - uniforms[uni.MIDDLE_X], row - uniforms[uni.MIDDLE_Y]
        diagonal = uniforms[uni.MIDDLE_X] * uniforms[uni.MIDDLE_X] + uniforms[uni.MIDDLE_Y] * uniforms[uni.MIDDLE_Y]
        rim = 1.0 - uniforms[uni.VIGNETTE] * (off_x * off_x + off_y * off_y) / diagonal
        share, gloss = share * rim, gloss * rim
    # Where a point is infinite or NaN, so is its normal.
    return ti.max(ti.min(share, 8.0), 0.0), ti.max(ti.min(gloss, 8.0 * 255.0), 0.0)


@ti.func
def light_metal(x, y, depth, normal: ti.template(), uniforms: ti.template()):
    """Light metal, which reflects a room that is bright above and dark below: give red, green and blue."""
    # What reaches to the light or beyond it is lit as if it ended before.
    below = ti.max(depth, uni.METAL_NEAREST * uniforms[uni.LIGHT_DISTANCE])
    cosine, mirror, _, upward = illuminate(x, y, below, normal, uniforms)
    bright = ti.max(upward, 0.0)
    share = uni.METAL_AMBIENT + uni.METAL_DIFFUSE * ti.max(cosine, 0.0) + uni.METAL_MIRROR * bright * bright
    gloss = specular(mirror) * (255.0 * uni.METAL_GLOSS)
    return [ti.min(share * uni.METAL[n] + gloss, 255.0) for n in ti.static(range(3))]


class Appearance(NamedTuple):
    """The picture on the sheet, and the light and the instruments that it is shaded with."""

    config: DrawingConfig
    texels: Any  # as `pyramid` gives them
    sizes: Any
    width: Any  # of the first level
    height: Any
    uniforms: Any
    capsule_count: Any


def pack_rgb(colours: NDArray[np.uint8]) -> NDArray[np.float32]:
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
        texels.append(pack_rgb(level).ravel())
        levels.append((first, width, height))
        first += width * height
        if not minified or width == height == 1:
            return np.concatenate(texels), np.array(levels, np.int32)
        level = downsample(level)


def downsample(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average blocks of 2 x 2 texels; where their number is odd, the last row or column counts twice."""
    height, width, _ = colours.shape
    even = np.pad(colours, ((0, height % 2), (0, width % 2), (0, 0)), "edge").astype(np.uint16)
    sums = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    return ((sums + 2) // 4).astype(np.uint8)


@ti.func
def to_integers(values, config: ti.template()):
    """Cast to integers, lane by lane: casting a vector crashes."""
    return config.integer_vector([ti.cast(values[lane], ti.i32) for lane in ti.static(range(config.lanes))])


@ti.func
def fetch_rgb(index, appearance: ti.template()):
    """Gather texels, and unpack their red, green and blue."""
    config, texels = ti.static((appearance.config, appearance.texels))
    texel = config.float_vector([texels[index[lane]] for lane in ti.static(range(config.lanes))])
    blue = ti.floor(texel * (1.0 / 65536.0))
    rest = texel - blue * 65536.0
    green = ti.floor(rest * (1.0 / 256.0))
    return [rest - green * 256.0, green, blue]


@ti.func
def bilinear(upper_left, upper_right, lower_left, lower_right, u, v):
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
    left, row = to_integers(floor_x, config), to_integers(floor_y, config)
    right = ti.min(left + 1, width - 1)
    upper = row * width + first
    under = ti.min(row + 1, height - 1) * width + first
    ul, ur = fetch_rgb(upper + left, appearance), fetch_rgb(upper + right, appearance)
    ll, lr = fetch_rgb(under + left, appearance), fetch_rgb(under + right, appearance)
    rise_x, rise_y = u, v
    if ti.static(config.relief):
        grey_ul, grey_ur = ul[0] + ul[1] + ul[2], ur[0] + ur[1] + ur[2]
        grey_ll, grey_lr = ll[0] + ll[1] + ll[2], lr[0] + lr[1] + lr[2]
        rise_x = (grey_ur - grey_ul + (grey_lr - grey_ll - (grey_ur - grey_ul)) * v) * (1.0 / 3.0)
        rise_y = (grey_ll - grey_ul + (grey_lr - grey_ur - (grey_ll - grey_ul)) * u) * (1.0 / 3.0)
    return [bilinear(ul[n], ur[n], ll[n], lr[n], u, v) for n in ti.static(range(3))], rise_x, rise_y


@ti.func
def filter_texture(entry, seen, samples: ti.template(), appearance: ti.template()):
    """Filter the texture for a tile; returns what `fetch` does."""
    config, sizes = ti.static((appearance.config, appearance.sizes))
    float_vector, integer_vector, plane = ti.static((config.float_vector, config.integer_vector, config.plane))
    x = ti.select(seen, samples[entry + plane.texel_x], 0.0)
    y = ti.select(seen, samples[entry + plane.texel_y], 0.0)
    first, width, height = integer_vector(0), integer_vector(appearance.width), integer_vector(appearance.height)
    first_far, width_far, height_far = first, width, height
    texel, footprint, most = float_vector(1), float_vector(0), 0.0
    if ti.static(config.tissue):
        footprint = ti.select(seen, samples[entry + plane.footprint], 0.0)
        most = footprint.max()
        if most > 1.0:
            # For every sample, the coarsest level whose texels are not larger than the sample is mixed with the next
            # coarser one.
            last = sizes[uni.LEVEL_COUNT] - 1
            level, bound = 0, 1.0
            while level <= last and most >= bound:
                larger = footprint >= bound
                here = uni.LEVELS + uni.LEVEL_STRIDE * level
                far = uni.LEVELS + uni.LEVEL_STRIDE * ti.min(level + 1, last)
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
