"""Shading: texture filtering and lighting of samples, then the colours and labels of pixels.

The light on wet tissue and metal is that of an endoscope: next to the main camera, and weaker with distance.

All vectors are in the camera's frame: the eye at 0, x right, y up, z toward the camera. P is the surface point of a
sample, N its normal on the camera's side, L the unit vector from P to the light, V that from P to the eye, and
M = 2 (N L) N - L the direction of ideal reflection of the light:

    diffuse  = (N L + wrap) / (1 + wrap) d0 / d
    light    = ambient + (1 - ambient) diffuse / diffuse0
    colour   = texture light + 255 gloss (M V)^shininess d0 / d

Of a picture by a camera, the light is divided by that of the same place at rest from that camera, in which the picture
was taken: the `reference light`, a picture of floating-point numbers of the texture's size after its texels.

d is the distance of P from the light, d0 that of the main camera's target, and diffuse0 the diffuse light at the
target on a sheet that faces the camera. There the colours are those of the texture. Wrapped diffuse light approximates
scattering in tissue: no side of a dent is black. An instrument shades the tissue near it: at r radii from its axis, it
removes the share uniforms.SHADE / r^2 of the light.

Mipmaps filter the texture, at 1, 1/2, 1/4, ... of its size, so that a sample of many texels is their mean.
"""

from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, dot, sample_centres, triple, undistorted_centres
from taichi_msm.render.geometry import line_of_sight, w_at
from taichi_msm.render.labels import label_channels
from taichi_msm.render.lens_kernels import texel_of
from taichi_msm.system.array_cache import cached_arrays
from taichi_msm.system.runtime import ti

# Largest ratio of the light to the reference light.
MAX_LIGHT_RATIO = 4.0


@ti.func
def locate_texels(entry, band: ti.template()):
    """Replace the points of a tile in the camera of a picture by their texels, and compute footprints and labels."""
    config, samples, uniforms = ti.static((band.config, band.samples, band.uniforms))
    plane = ti.static(config.plane)
    x, y = texel_of(samples[entry + plane.texel_x], samples[entry + plane.texel_y], uniforms, config.picture_lens)
    samples[entry + plane.texel_x], samples[entry + plane.texel_y] = x, y
    if ti.static("coordinates" in config.labels):
        width, height = band.sizes[uni.LEVELS + 1], band.sizes[uni.LEVELS + 2]
        samples[entry + plane.across] = (x + 0.5) / ti.cast(width, ti.f32)
        samples[entry + plane.down] = (y + 0.5) / ti.cast(height, ti.f32)
    if ti.static(config.tissue):
        right_x, right_y = texel_of(
            samples[entry + plane.right_x], samples[entry + plane.right_y], uniforms, config.picture_lens
        )
        below_x, below_y = texel_of(
            samples[entry + plane.below_x], samples[entry + plane.below_y], uniforms, config.picture_lens
        )
        right_x, right_y, below_x, below_y = right_x - x, right_y - y, below_x - x, below_y - y
        largest = ti.max(right_x * right_x + right_y * right_y, below_x * below_x + below_y * below_y)
        square = largest * (1.0 / (uni.FULL_RESOLUTION_TEXELS * uni.FULL_RESOLUTION_TEXELS))
        samples[entry + plane.footprint] = ti.min(square, 1e12)


@ti.func
def _shade(entry, left, top, texels: ti.template(), band: ti.template()):
    """Return the colour of a tile: the lit texture, with the mesh and the instruments drawn over it."""
    config, samples, uniforms = ti.static((band.config, band.samples, band.uniforms))
    plane = ti.static(config.plane)
    depth = samples[entry + plane.depth]
    is_covered = depth < INFINITY
    colour, slope_x, slope_y = _filter_texture(entry, is_covered, texels, band)
    if ti.static(config.headlit):
        light = samples[entry + plane.light]
        if ti.static(config.is_relit):
            light = _relative_light(light, entry, is_covered, texels, band)
        for n in ti.static(range(3)):
            colour[n] *= light
            if ti.static(config.is_relit):
                colour[n] = ti.min(colour[n], 255.0)
    x, y = undistorted_centres(left, top, entry, band)
    normal = [samples[entry + (plane.normal_x + n)] for n in ti.static(range(3 * (config.tissue or config.metal)))]
    if ti.static(config.tissue):
        column, row = sample_centres(left, top, config)
        share, gloss = _reflect(x, y, depth, normal, slope_x, slope_y, band)
        if ti.static(config.is_relit):
            share = _relative_light(ti.max(ti.min(share, 8.0), 0.0), entry, is_covered, texels, band)
        share, gloss = _attenuate(share, gloss, x, y, depth, column, row, band)
        for n in ti.static(range(3)):
            colour[n] = ti.min(colour[n] * share + gloss, 255.0)
    if ti.static(config.wireframe):
        wire = samples[entry + plane.wire]
        for n in ti.static(range(3)):
            colour[n] += (uni.WIRE_COLOUR[n] - colour[n]) * wire
    if ti.static(config.metal):
        is_metal = samples[entry + plane.instrument] > 0.0
        if ti.select(is_metal, 1.0, 0.0).max() > 0.0:
            metal = _light_metal(x, y, depth, normal, uniforms)
            for n in ti.static(range(3)):
                colour[n] = ti.select(is_metal, metal[n], colour[n])
    return [
        ti.select(is_covered, colour[n], config.float_vector(uniforms[uni.BACKGROUND + n])) for n in ti.static(range(3))
    ]


@ti.func
def _light(entry, left, top, texels: ti.template(), band: ti.template()):
    """Return the factor of the texture's colours at a tile, without vignette and instruments; -1 without a surface."""
    config, samples = ti.static((band.config, band.samples))
    plane = ti.static(config.plane)
    depth = samples[entry + plane.depth]
    light = config.float_vector(1)
    if ti.static(config.headlit):
        light = samples[entry + plane.light]
    else:
        _colour, slope_x, slope_y = _filter_texture(entry, depth < INFINITY, texels, band)
        x, y = undistorted_centres(left, top, entry, band)
        normal = triple(samples, entry + plane.normal_x)
        factor, _gloss = _reflect(x, y, depth, normal, slope_x, slope_y, band)
        light = ti.max(ti.min(factor, 8.0), 0.0)
    return ti.select(depth < INFINITY, light, -1.0)


@ti.func
def _relative_light(light, entry, is_covered, texels: ti.template(), band: ti.template()):
    """Return the ratio of light at a tile to the reference light; 1 where both are 0."""
    config, sizes, samples = ti.static((band.config, band.sizes, band.samples))
    plane = ti.static(config.plane)
    last = uni.LEVELS + uni.LEVEL_STRIDE * (sizes[uni.LEVEL_COUNT] - 1)
    first = sizes[last] + sizes[last + 1] * sizes[last + 2]
    width, height = sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2]
    x = ti.select(is_covered, samples[entry + plane.texel_x], 0.0)
    y = ti.select(is_covered, samples[entry + plane.texel_y], 0.0)
    ul, ur, ll, lr, u, v = _texels_around(
        config.integer_vector(first), config.integer_vector(width), config.integer_vector(height), x, y, config
    )
    corners = [
        config.float_vector([texels[index[lane]] for lane in ti.static(range(config.lanes))])
        for index in ti.static((ul, ur, ll, lr))
    ]
    reference = _bilinear(corners[0], corners[1], corners[2], corners[3], u, v)
    ratio = ti.min(light / ti.max(reference, 1e-20), MAX_LIGHT_RATIO)
    return ti.select((light <= 0.0) & (reference <= 0.0), 1.0, ratio)


@ti.func
def _write_light(light, left, row, end_row, lights: ti.template(), band: ti.template()):
    """Write the light of the pixels of a tile."""
    config = ti.static(band.config)
    for line in ti.static(range(config.tile_height)):
        for n in ti.static(range(config.tile_width)):
            if row + line < end_row and left + n < band.width:
                lights[(row + line) * band.width + left + n] = light[line * config.tile_width + n]


@ti.func
def _write_colours(colour: ti.template(), row, end_row, tile, colours: ti.template(), band: ti.template()):
    """Write the colours of a tile without supersampling; `tile` is its index in the row."""
    packed = ti.floor(colour[0] + 0.5) + ti.floor(colour[1] + 0.5) * 256.0 + ti.floor(colour[2] + 0.5) * 65536.0
    width = ti.static(band.config.tile_width)
    for tile_line in ti.static(range(band.config.tile_height)):
        if row + tile_line < end_row:
            pixels = [ti.cast(packed[tile_line * width + n], ti.i32) for n in ti.static(range(width))]
            word = ((row + tile_line) * band.tiles_across + tile) * 3
            if ti.static(band.config.writes_words):
                # Four pixels of three bytes fill three words.
                colours[word] = pixels[0] | (pixels[1] << 24)
                colours[word + 1] = (pixels[1] >> 8) | (pixels[2] << 16)
                colours[word + 2] = (pixels[2] >> 16) | (pixels[3] << 8)
            else:
                for n in ti.static(range(3)):
                    colours[word + n] = ti.cast((pixels[0] >> (8 * n)) & 255, ti.u8)


@ti.func
def _write_means(row, end_row, left, right, colours: ti.template(), band: ti.template()):
    """Write the colours of the pixels in columns `left` to `right`, each the mean of its samples."""
    config = ti.static(band.config)
    factor, tile_width, tile_height = ti.static((config.supersample, config.tile_width, config.tile_height))
    for y in range(row, end_row):
        for x in range(left, right):
            for n in ti.static(range(3)):
                total = 0.0
                for row_offset, column_offset in ti.static(ti.ndrange(factor, factor)):
                    line, column = (y - row) * factor + row_offset, x * factor + column_offset
                    tile = (line // tile_height) * band.tiles_across + column // tile_width
                    lane = (line % tile_height) * tile_width + column % tile_width
                    total += band.samples[band.first + tile * config.planes + config.plane.red + n][lane]
                pixel = y * band.sizes[uni.WIDTH] + x
                colours[pixel * 3 + n] = ti.cast(ti.cast(total / (factor * factor) + 0.5, ti.i32), ti.u8)


@ti.func
def _write_labels(entry, left, row, end_row, labels: ti.template(), band: ti.template()):
    """Write the labels of the pixels of a tile."""
    config, samples = ti.static((band.config, band.samples))
    plane, channels = ti.static((config.plane, label_channels(config.plane, config.labels)))
    is_covered = samples[entry + plane.depth] < INFINITY
    is_sheet = is_covered
    if ti.static(len(config.shapes) > 0):
        is_sheet = is_sheet & (samples[entry + plane.instrument] <= 0.0)
    values = [
        ti.select(
            is_sheet if ti.static(channel.label.sheet_only) else is_covered,
            samples[entry + channel.plane],
            channel.label.missing_value,
        )
        for channel in ti.static(channels)
    ]
    for line in ti.static(range(config.tile_height)):
        for n in ti.static(range(config.tile_width)):
            if row + line < end_row and left + n < band.width:
                pixel = (row + line) * band.width + left + n
                for channel, value in ti.static(zip(channels, values, strict=True)):
                    count = ti.static(len(channel.label.planes))
                    index = channel.offset * band.width * band.height + count * pixel + channel.number
                    labels[index] = value[line * config.tile_width + n]


@ti.func
def resolve(
    row, end_row, left, right, texels: ti.template(), colours: ti.template(), labels: ti.template(), band: ti.template()
):
    """Shade the samples of the pixels in columns `left` to `right` of a band; write their colours and labels."""
    config = ti.static(band.config)
    factor, tile_width, tile_height = ti.static((config.supersample, config.tile_width, config.tile_height))
    lines = ((end_row - row) * factor + tile_height - 1) // tile_height
    for tile_row in range(lines):
        for tile in range(left * factor // tile_width, (right * factor + tile_width - 1) // tile_width):
            entry = band.first + (tile_row * band.tiles_across + tile) * config.planes
            column, top = tile * tile_width, tile_row * tile_height
            if ti.static(config.is_pictured):
                locate_texels(entry, band)
            if ti.static(len(config.labels) > 0):
                _write_labels(entry, column, row + top, end_row, labels, band)
            if ti.static(config.writes_light):
                light = _light(entry, column, row + top, texels, band)
                _write_light(light, column, row + top, end_row, labels, band)
            if ti.static(config.picture and not config.writes_light):
                colour = _shade(entry, column, row * factor + top, texels, band)
                if ti.static(factor == 1):
                    _write_colours(colour, row + top, end_row, tile, colours, band)
                else:
                    for n in ti.static(range(3)):
                        band.samples[entry + config.plane.red + n] = colour[n]
    if ti.static(config.picture and factor > 1):
        _write_means(row, end_row, left, right, colours, band)


@ti.func
def _illuminate(x, y, depth, normal: ti.template(), uniforms: ti.template()):
    """Return N L, M V, d0 / d at most 4, and the upward component of the reflected line of sight."""
    offset_x, offset_y = line_of_sight(x, y, uniforms)
    w = w_at(depth, uniforms)
    right, up = offset_x * w, offset_y * w
    light = [uniforms[uni.LIGHT_X] - right, uniforms[uni.LIGHT_Y] - up, uniforms[uni.LIGHT_Z] + depth]
    eye = [right * (uniforms[uni.PINHOLE] * (-1.0)), up * (uniforms[uni.PINHOLE] * (-1.0)), w]
    # Scalar products of vectors of any length.
    n_l, n_v, l_v = dot(normal, light), dot(normal, eye), dot(light, eye)
    n_n, l_l, v_v = [ti.max(dot(vector, vector), 1e-30) for vector in ti.static((normal, light, eye))]
    inverse_n_n = 1.0 / n_n
    # One division for both lengths.
    length_l, length_v = ti.sqrt(l_l), ti.sqrt(v_v)
    inverse_both = 1.0 / (length_l * length_v)
    inverse_l, inverse_v = inverse_both * length_v, inverse_both * length_l
    return (
        n_l * ti.sqrt(inverse_n_n) * inverse_l,
        (2.0 * n_l * n_v * inverse_n_n - l_v) * inverse_both,
        ti.min(uniforms[uni.LIGHT_DISTANCE] * inverse_l, 4.0),
        (2.0 * n_v * normal[1] * inverse_n_n - eye[1]) * inverse_v,
    )


@ti.func
def _specular(mirror):
    """Return (M V)^shininess, given M V."""
    power = ti.max(ti.min(mirror, 1.0), 0.0)
    for _ in ti.static(range(uni.SHARPNESS)):
        power = power * power
    return power


@ti.func
def _light_transmission(x, y, depth, band: ti.template()):
    """Return the share of the light that is not shaded by the instruments."""
    uniforms = ti.static(band.uniforms)
    offset_x, offset_y = line_of_sight(x, y, uniforms)
    w = w_at(depth, uniforms)
    right, up = offset_x * w, offset_y * w
    transmission = band.config.float_vector(1)
    for index in range(band.instrument_count):
        base = uni.INSTRUMENTS + index * uni.INSTRUMENT_STRIDE
        tip, axis = triple(uniforms, base + uni.TIP), triple(uniforms, base + uni.AXIS)
        point = [right - tip[0], up - tip[1], depth * (-1.0) - tip[2]]
        along = ti.max(ti.min(dot(point, axis), uniforms[base + uni.LENGTH]), 0.0)
        offset = [point[n] - axis[n] * along for n in ti.static(range(3))]
        squared_radius = uniforms[base + uni.RADIUS] * uniforms[base + uni.RADIUS]
        transmission *= 1.0 - uni.SHADE * squared_radius / ti.max(dot(offset, offset), squared_radius)
    return transmission


@ti.func
def _apply_relief(normal: ti.template(), slope_x, slope_y, uniforms: ti.template()):
    """Tilt normals by the relief, in place: brighter texels are higher."""
    length = 1.0 / ti.max(ti.sqrt(dot(normal, normal)), 1e-30)
    a, b = triple(uniforms, uni.ACROSS), triple(uniforms, uni.UP)
    n = [normal[k] * length for k in ti.static(range(3))]
    relief_x, relief_y = slope_x * uniforms[uni.SLOPE_X], slope_y * uniforms[uni.SLOPE_Y]
    # Subtract from n the tangential part of the gradient, relief_x a + relief_y b.
    projection = relief_x * dot(a, n) + relief_y * dot(b, n)
    for k in ti.static(range(3)):
        normal[k] = n[k] * (projection + 1.0) - relief_x * a[k] - relief_y * b[k]


@ti.func
def _reflect(x, y, depth, normal: ti.template(), slope_x, slope_y, band: ti.template()):
    """Return the factor of the texture's colours, and the gloss that is added to the product, in grey levels."""
    config, uniforms = ti.static((band.config, band.uniforms))
    tilted = [normal[n] for n in ti.static(range(3))]
    if ti.static(config.relief):
        _apply_relief(tilted, slope_x, slope_y, uniforms)
    cosine, mirror, nearness, _ = _illuminate(x, y, depth, tilted, uniforms)
    diffuse = ti.max(cosine + uni.WRAP, 0.0) * (1.0 / (1.0 + uni.WRAP)) * nearness * uniforms[uni.LIGHT_NORMALISATION]
    factor = uniforms[uni.AMBIENT] + (1.0 - uniforms[uni.AMBIENT]) * diffuse
    return factor, _specular(mirror) * nearness * (255.0 * uniforms[uni.GLOSS])


@ti.func
def _attenuate(light, highlight, x, y, depth, column, row, band: ti.template()):
    """Return a factor and the gloss, as `_reflect`, with the shade of the instruments and the vignette.

    `column` and `row` are the distorted positions of the samples in the picture.
    """
    config, uniforms = ti.static((band.config, band.uniforms))
    factor, gloss = light, highlight
    if ti.static(len(config.shapes) > 0):
        transmission = _light_transmission(x, y, depth, band)
        factor, gloss = factor * transmission, gloss * transmission
    if ti.static(config.vignette):
        # The distance from the centre of the picture is in units of half its diagonal.
        off_x, off_y = column - uniforms[uni.MIDDLE_X], row - uniforms[uni.MIDDLE_Y]
        diagonal = uniforms[uni.MIDDLE_X] * uniforms[uni.MIDDLE_X] + uniforms[uni.MIDDLE_Y] * uniforms[uni.MIDDLE_Y]
        attenuation = 1.0 - uniforms[uni.VIGNETTE] * (off_x * off_x + off_y * off_y) / diagonal
        factor, gloss = factor * attenuation, gloss * attenuation
    # Infinite or NaN mass points have NaN normals, which these limits replace.
    return ti.max(ti.min(factor, 8.0), 0.0), ti.max(ti.min(gloss, 8.0 * 255.0), 0.0)


@ti.func
def _light_metal(x, y, depth, normal: ti.template(), uniforms: ti.template()):
    """Return the colour of metal, which reflects a room with a bright ceiling and a dark floor."""
    # Metal next to the light or behind it is lit as if at the minimum depth.
    lit_depth = ti.max(depth, uni.METAL_NEAREST * uniforms[uni.LIGHT_DISTANCE])
    cosine, mirror, _, upward = _illuminate(x, y, lit_depth, normal, uniforms)
    brightness = ti.max(upward, 0.0)
    factor = uni.METAL_AMBIENT + uni.METAL_DIFFUSE * ti.max(cosine, 0.0) + uni.METAL_MIRROR * brightness * brightness
    gloss = _specular(mirror) * (255.0 * uni.METAL_GLOSS)
    return [ti.min(factor * uni.METAL[n] + gloss, 255.0) for n in ti.static(range(3))]


def pyramid(texture: NDArray[np.uint8], *, minified: bool) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Build the mipmap levels of a texture, shape (height, width, 3), only the first unless `minified`.

    Return the texels of all levels, row by row, each red + 256 green + 65536 blue, which f32 represents exactly; and
    start, width and height of every level, shape (levels, 3); both read-only.
    """
    colours = np.ascontiguousarray(texture)
    key = "pyramid", sha256(colours.data).digest(), colours.shape, minified
    texels, levels = cached_arrays(key, lambda: _build_pyramid(colours, minified))
    return texels, levels


def _build_pyramid(texture: NDArray[np.uint8], minified: bool) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    level, texels, levels, first = texture, [], [], 0
    while True:
        height, width, _ = level.shape
        texels.append((level.astype(np.float32) @ np.array([1, 1 << 8, 1 << 16], np.float32)).ravel())
        levels.append((first, width, height))
        first += width * height
        if not minified or width == height == 1:
            return np.concatenate(texels), np.array(levels, np.int32)
        # The mean of 2 x 2 texels; an odd last row or column is repeated.
        even = np.pad(level, ((0, height % 2), (0, width % 2), (0, 0)), "edge").astype(np.uint16)
        sums = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
        level = ((sums + 2) // 4).astype(np.uint8)


@ti.func
def _to_integers(values, config: ti.template()):
    """Convert to integers, lane by lane: a cast of a vector crashes."""
    return config.integer_vector([ti.cast(values[lane], ti.i32) for lane in ti.static(range(config.lanes))])


@ti.func
def _fetch_rgb(index, texels: ti.template(), config: ti.template()):
    """Return the colours of the texels at indices, one per lane."""
    texel = config.float_vector([texels[index[lane]] for lane in ti.static(range(config.lanes))])
    blue = ti.floor(texel * (1.0 / 65536.0))
    remainder = texel - blue * 65536.0
    green = ti.floor(remainder * (1.0 / 256.0))
    return [remainder - green * 256.0, green, blue]


@ti.func
def _bilinear(upper_left, upper_right, lower_left, lower_right, u, v):
    """Interpolate bilinearly, at fractions u to the right and v down."""
    upper = upper_left + (upper_right - upper_left) * u
    lower = lower_left + (lower_right - lower_left) * u
    return upper + (lower - upper) * v


@ti.func
def _texels_around(first, width, height, x, y, config: ti.template()):
    """Return the texels around column x and row y of a level of `width` x `height` texels from `first` on.

    They are indices of the upper left and right and the lower left and right one; then the fractions right and down.
    """
    # The texture is constant beyond the centres of its outermost texels.
    texel_x = ti.max(ti.min(x, width - 1.0), 0.0)
    texel_y = ti.max(ti.min(y, height - 1.0), 0.0)
    floor_x, floor_y = ti.floor(texel_x), ti.floor(texel_y)
    left, row = _to_integers(floor_x, config), _to_integers(floor_y, config)
    right = ti.min(left + 1, width - 1)
    upper = row * width + first
    lower = ti.min(row + 1, height - 1) * width + first
    return upper + left, upper + right, lower + left, lower + right, texel_x - floor_x, texel_y - floor_y


@ti.func
def _grey(first, width, height, x, y, texels: ti.template(), config: ti.template()):
    """Interpolate the grey level of a level, as `_texels_around`, bilinearly at column x and row y."""
    ul, ur, ll, lr, u, v = _texels_around(first, width, height, x, y, config)
    corners = [_fetch_rgb(index, texels, config) for index in ti.static((ul, ur, ll, lr))]
    grey = [(corner[0] + corner[1] + corner[2]) * (1.0 / 3.0) for corner in ti.static(corners)]
    return _bilinear(grey[0], grey[1], grey[2], grey[3], u, v)


@ti.func
def _fetch(first, width, height, x, y, texels: ti.template(), config: ti.template()):
    """Interpolate a level, as `_texels_around`, bilinearly at column x and row y.

    Return the colour; with a relief, also the gradient of the grey level, to the right and down [1/texel].
    """
    upper_left, upper_right, lower_left, lower_right, u, v = _texels_around(first, width, height, x, y, config)
    ul, ur = _fetch_rgb(upper_left, texels, config), _fetch_rgb(upper_right, texels, config)
    ll, lr = _fetch_rgb(lower_left, texels, config), _fetch_rgb(lower_right, texels, config)
    slope_x, slope_y = u, v
    if ti.static(config.relief and config.is_pictured):
        # Between texels half a texel away: at the centres of texels, where the light of the picture is sampled, the
        # gradient of bilinear interpolation jumps.
        slope_x = _grey(first, width, height, x + 0.5, y, texels, config)
        slope_x = slope_x - _grey(first, width, height, x - 0.5, y, texels, config)
        slope_y = _grey(first, width, height, x, y + 0.5, texels, config)
        slope_y = slope_y - _grey(first, width, height, x, y - 0.5, texels, config)
    elif ti.static(config.relief):
        grey_ul, grey_ur = ul[0] + ul[1] + ul[2], ur[0] + ur[1] + ur[2]
        grey_ll, grey_lr = ll[0] + ll[1] + ll[2], lr[0] + lr[1] + lr[2]
        slope_x = (grey_ur - grey_ul + (grey_lr - grey_ll - (grey_ur - grey_ul)) * v) * (1.0 / 3.0)
        slope_y = (grey_ll - grey_ul + (grey_lr - grey_ur - (grey_ll - grey_ul)) * u) * (1.0 / 3.0)
    return [_bilinear(ul[n], ur[n], ll[n], lr[n], u, v) for n in ti.static(range(3))], slope_x, slope_y


@ti.func
def _filter_texture(entry, is_covered, texels: ti.template(), band: ti.template()):
    """Return the colour of the texture at the covered samples of a tile, and its gradient, as `_fetch`."""
    config, sizes, samples = ti.static((band.config, band.sizes, band.samples))
    float_vector, integer_vector, plane = ti.static((config.float_vector, config.integer_vector, config.plane))
    x = ti.select(is_covered, samples[entry + plane.texel_x], 0.0)
    y = ti.select(is_covered, samples[entry + plane.texel_y], 0.0)
    # First texel, width and height of the level of every sample, and of the next coarser level.
    fine = [integer_vector(0), integer_vector(sizes[uni.LEVELS + 1]), integer_vector(sizes[uni.LEVELS + 2])]
    coarse = [fine[n] for n in ti.static(range(3))]
    texel_size, footprint, max_footprint = float_vector(1), float_vector(0), 0.0
    if ti.static(config.tissue):
        footprint = ti.select(is_covered, samples[entry + plane.footprint], 0.0)
        max_footprint = footprint.max()
        if max_footprint > 1.0:
            # For every sample, choose the coarsest level with texels no larger than the sample; below, the colour is
            # blended with that of the next coarser level.
            last_level = sizes[uni.LEVEL_COUNT] - 1
            level, bound = 0, 1.0
            while level <= last_level and max_footprint >= bound:
                is_larger = footprint >= bound
                level_entry = uni.LEVELS + uni.LEVEL_STRIDE * level
                coarse_entry = uni.LEVELS + uni.LEVEL_STRIDE * ti.min(level + 1, last_level)
                if level > 0:
                    texel_size = ti.select(is_larger, texel_size * 2.0, texel_size)
                    for n in ti.static(range(3)):
                        fine[n] = ti.select(is_larger, sizes[level_entry + n], fine[n])
                for n in ti.static(range(3)):
                    coarse[n] = ti.select(is_larger, sizes[coarse_entry + n], coarse[n])
                bound = bound * 4.0
                level += 1
            x = (x + 0.5) / texel_size - 0.5
            y = (y + 0.5) / texel_size - 0.5
    colour, slope_x, slope_y = _fetch(fine[0], fine[1], fine[2], x, y, texels, config)
    if ti.static(config.tissue):  # noqa: SIM102  (evaluated at compile time)
        if max_footprint > 1.0:
            # The same position in the next coarser level.
            x = x * 0.5 - 0.25
            y = y * 0.5 - 0.25
            coarse_colour, coarse_slope_x, coarse_slope_y = _fetch(
                coarse[0], coarse[1], coarse[2], x, y, texels, config
            )
            coarse_weight = ti.max(ti.min(ti.sqrt(footprint) / texel_size - 1.0, 1.0), 0.0)
            for n in ti.static(range(3)):
                colour[n] += (coarse_colour[n] - colour[n]) * coarse_weight
            slope_x = (slope_x + (coarse_slope_x * 0.5 - slope_x) * coarse_weight) / texel_size
            slope_y = (slope_y + (coarse_slope_y * 0.5 - slope_y) * coarse_weight) / texel_size
    return colour, slope_x, slope_y
