"""The light of an endoscope on wet tissue and on metal: it comes from beside the camera and weakens with distance.

Of several cameras it is that of the main one.

All vectors are in the camera's frame: the eye at 0, x right, y up, z toward the camera. P is the point that a sample
shows, N its normal on the camera's side, L the unit vector from P to the light, V that from P to the eye, and
M = 2 (N L) N - L the direction into which light from L is reflected:

    light    = ambient + (1 - ambient) (N L + wrap) / (1 + wrap) d0 / d / the same at the middle of the picture
    colour   = texture light + 255 gloss (M V)^shininess d0 / d

d is the distance from P to the light, and d0 that from the point in the middle of the picture; there, a flat sheet that
faces the camera keeps its colours. Light wraps around the surface, as scattering in tissue makes it do, so no side of a
dent is black. An instrument shades tissue near it: at r times its radius from its axis it takes away the share
style.SHADE / r^2 of the light.

Normals are lists, and may have any length.
"""

from taichi_msm.render import style
from taichi_msm.render import uniforms as uni
from taichi_msm.render.geometry import line_of_sight, w_at
from taichi_msm.system.runtime import ti


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
    for _ in ti.static(range(style.SHARPNESS)):
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
        share *= 1.0 - style.SHADE * square / ti.max(f_x * f_x + f_y * f_y + f_z * f_z, square)
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
    diffuse = ti.max(cosine + style.WRAP, 0.0) * (1.0 / (1.0 + style.WRAP)) * nearness * numbers[uni.UNIT]
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
    below = ti.max(depth, style.METAL_NEAREST * numbers[uni.FARNESS])
    cosine, mirror, _, upward = illuminate(x, y, below, normal, numbers)
    bright = ti.max(upward, 0.0)
    share = style.METAL_AMBIENT + style.METAL_DIFFUSE * ti.max(cosine, 0.0) + style.METAL_MIRROR * bright * bright
    gloss = highlight(mirror) * (255.0 * style.METAL_GLOSS)
    return [ti.min(share * style.METAL[n] + gloss, 255.0) for n in ti.static(range(3))]
