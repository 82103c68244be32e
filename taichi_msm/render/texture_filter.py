"""The colour of the texture for a tile of samples, filtered over what each of them shows."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from typing import Any, NamedTuple

from taichi_msm.render import uniforms as uni
from taichi_msm.render.samples import DrawingConfig
from taichi_msm.system.runtime import ti


class Appearance(NamedTuple):
    """The picture on the sheet, and the light and the instruments that it is shaded with."""

    config: DrawingConfig
    texels: Any  # as in a `Pyramid`
    sizes: Any
    width: Any  # of the first level
    height: Any
    numbers: Any
    rod_count: Any


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
    """Filter a level bilinearly at (x, y) of its texels.

    Returns:
        Red, green and blue; and, if there is a relief, the rise of the grey from texel to texel.
    """
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
