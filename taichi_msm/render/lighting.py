"""The light of an endoscope on wet tissue and on metal: it comes from beside the camera and weakens with distance.

All vectors are in the camera's frame: the eye at 0, x right, y up, z toward the camera. P is the point that a sample
shows, N its unit normal on the camera's side, L the unit vector from P to the light, V that from P to the eye, and
M = 2 (N L) N - L the direction into which light from L is reflected:

    light    = ambient + (1 - ambient) (N L + wrap) / (1 + wrap) d0 / d / the same at the middle of the picture
    colour   = texture light + 255 gloss (M V)^shininess d0 / d

d is the distance from P to the light, and d0 that from the point in the middle of the picture; there, a flat sheet that
faces the camera keeps its colours. Light wraps around the surface, as scattering in tissue makes it do, so no side of a
dent is black. An instrument shades tissue near it: at r times its radius from its axis it takes away the share
style.SHADE / r^2 of the light.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

from taichi_msm.render import style
from taichi_msm.render.numbers import (
    AMBIENT,
    AXIS,
    CENTRE_X,
    CENTRE_Y,
    FARNESS,
    GLOSS,
    LENGTH,
    LIGHT_X,
    LIGHT_Y,
    PINHOLE,
    RADIUS,
    ROD_NUMBERS,
    RODS,
    SPREAD,
    TIP,
    UNIT,
    VIGNETTE,
)
from taichi_msm.render.samples import Code
from taichi_msm.system.runtime import ti


@cache
def lighting(code: Code) -> tuple[Callable[..., Any], ...]:
    """Make Taichi's functions that light a tile.

    Args:
        code: what it is compiled for.

    Returns:
        `tissue`, which gives the factor of colours and what is then added to them; `metal`, which gives red, green and
        blue.
    """
    floats = code.floats

    @ti.func
    def illuminate(x, y, depth, n_x, n_y, n_z, numbers: ti.template()):
        """Find how samples are lit; normals may have any length.

        Returns:
            N L; M V; d0 / d; and the upward component of the direction into which V is reflected.
        """
        w = depth * numbers[PINHOLE] + (1.0 - numbers[PINHOLE])
        right = (x - numbers[CENTRE_X]) * numbers[SPREAD] * w
        up = (numbers[CENTRE_Y] - y) * numbers[SPREAD] * w
        l_x, l_y = numbers[LIGHT_X] - right, numbers[LIGHT_Y] - up
        v_x, v_y, v_z = right * (numbers[PINHOLE] * (-1.0)), up * (numbers[PINHOLE] * (-1.0)), w
        # Scalar products of vectors that are not normalised yet.
        n_l = n_x * l_x + n_y * l_y + n_z * depth
        n_v = n_x * v_x + n_y * v_y + n_z * v_z
        l_v = l_x * v_x + l_y * v_y + depth * v_z
        n_n = ti.max(n_x * n_x + n_y * n_y + n_z * n_z, 1e-30)
        l_l = ti.max(l_x * l_x + l_y * l_y + depth * depth, 1e-30)
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
            ti.min(numbers[FARNESS] * to_l, 4.0),
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
    def shaded(x, y, depth, rod_count, numbers: ti.template()):
        """Share of the light that reaches samples at (x, y) past the instruments."""
        w = depth * numbers[PINHOLE] + (1.0 - numbers[PINHOLE])
        right = (x - numbers[CENTRE_X]) * numbers[SPREAD] * w
        up = (numbers[CENTRE_Y] - y) * numbers[SPREAD] * w
        share = floats(1)
        for n in range(rod_count):
            rod = RODS + n * ROD_NUMBERS
            tip, axis = rod + TIP, rod + AXIS
            p_x, p_y, p_z = right - numbers[tip], up - numbers[tip + 1], depth * (-1.0) - numbers[tip + 2]
            u_x, u_y, u_z = numbers[axis], numbers[axis + 1], numbers[axis + 2]
            foot = ti.max(ti.min(p_x * u_x + p_y * u_y + p_z * u_z, numbers[rod + LENGTH]), 0.0)
            f_x, f_y, f_z = p_x - u_x * foot, p_y - u_y * foot, p_z - u_z * foot
            square = numbers[rod + RADIUS] * numbers[rod + RADIUS]
            share *= 1.0 - style.SHADE * square / ti.max(f_x * f_x + f_y * f_y + f_z * f_z, square)
        return share

    @ti.func
    def tissue(
        x, y, depth, n_x, n_y, n_z, rod_count, numbers: ti.template()
    ):  # fmt: skip
        """Light wet tissue."""
        cosine, mirror, nearness, _ = illuminate(x, y, depth, n_x, n_y, n_z, numbers)
        diffuse = ti.max(cosine + style.WRAP, 0.0) * (1.0 / (1.0 + style.WRAP)) * nearness * numbers[UNIT]
        share = numbers[AMBIENT] + (1.0 - numbers[AMBIENT]) * diffuse
        gloss = highlight(mirror) * nearness * (255.0 * numbers[GLOSS])
        if ti.static(code.instruments):
            left = shaded(x, y, depth, rod_count, numbers)
            share, gloss = share * left, gloss * left
        if ti.static(code.vignette):
            # The distance from the middle of the picture is in units of half its diagonal.
            off_x, off_y = x - numbers[CENTRE_X], y - numbers[CENTRE_Y]
            diagonal = numbers[CENTRE_X] * numbers[CENTRE_X] + numbers[CENTRE_Y] * numbers[CENTRE_Y]
            rim = 1.0 - numbers[VIGNETTE] * (off_x * off_x + off_y * off_y) / diagonal
            share, gloss = share * rim, gloss * rim
        # Where a point is infinite or NaN, so is its normal.
        return ti.max(ti.min(share, 8.0), 0.0), ti.max(ti.min(gloss, 8.0 * 255.0), 0.0)

    @ti.func
    def metal(x, y, depth, n_x, n_y, n_z, numbers: ti.template()):
        """Light metal, which reflects a room that is bright above and dark below."""
        # What reaches to the light or beyond it is lit as if it ended before.
        below = ti.max(depth, style.METAL_NEAREST * numbers[FARNESS])
        cosine, mirror, _, upward = illuminate(x, y, below, n_x, n_y, n_z, numbers)
        bright = ti.max(upward, 0.0)
        share = style.METAL_AMBIENT + style.METAL_DIFFUSE * ti.max(cosine, 0.0) + style.METAL_MIRROR * bright * bright
        gloss = highlight(mirror) * (255.0 * style.METAL_GLOSS)
        return (
            ti.min(share * style.METAL[0] + gloss, floats(255.0)),
            ti.min(share * style.METAL[1] + gloss, floats(255.0)),
            ti.min(share * style.METAL[2] + gloss, floats(255.0)),
        )

    return tissue, metal
