"""Light on wet tissue and on metal, as an endoscope gives it: from beside the camera, weaker with distance.

All is in the camera's frame, the eye at 0: x right, y up, z toward the camera. With P the point that a sample shows, N
its unit normal turned to the camera, L from P to the light and V from P to the eye, both of length 1, H between them:

    light    = ambient + (1 - ambient) (N L + wrap) / (1 + wrap) d0 / d / the same at the middle of the picture
    colour   = texture light + 255 gloss (N H)^shininess d0 / d

d is the distance to the light and d0 that from the middle; a flat sheet that faces the camera keeps its colours there.
Light wraps around the surface as it does in tissue, through which it is scattered; so no side of a dent is black. An
instrument keeps light from tissue near it: at r times its radius from its axis, the share style.SHADE / r^2.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import style
from taichi_msm.render.camera import View
from taichi_msm.render.samples import Code
from taichi_msm.scene import Light
from taichi_msm.system.runtime import ti

# Numbers of the light: the middle of the picture [samples]; metres of a sample at w = 1; 1 for a pinhole, else 0; the
# light's place [m]; d0 [m]; what makes the light 1 at the middle; the scene's numbers; the sheet's axes to the right
# and up; and the slope that a step of one grey from texel to texel is.
CENTRE_X, CENTRE_Y, SPREAD, PINHOLE, LIGHT_X, LIGHT_Y, FARNESS, UNIT = range(8)
AMBIENT, GLOSS, VIGNETTE = 8, 9, 10
ACROSS, UP, SLOPE_X, SLOPE_Y, NUMBERS = 11, 14, 17, 18, 19


def light_numbers(
    view: View, light: Light, factor: int, sheet: tuple[float, float], texture: tuple[int, int]
) -> NDArray[np.float64]:
    """Put together what the kernel knows of the camera and the light.

    Args:
        view: the camera.
        light: the scene's.
        factor: samples of a pixel along each axis.
        sheet: its height and width [m].
        texture: its width and height [texels].
    """
    numbers = np.zeros(NUMBERS)
    x, y = style.LIGHT_RIGHT * view.distance, style.LIGHT_UP * view.distance
    far = math.hypot(x, y, view.distance)
    numbers[[CENTRE_X, CENTRE_Y]] = view.centre * factor
    numbers[SPREAD] = 1 / (view.scale * factor)
    numbers[[PINHOLE, LIGHT_X, LIGHT_Y, FARNESS]] = view.pinhole, x, y, far
    numbers[UNIT] = (1 + style.WRAP) / (view.distance / far + style.WRAP)
    numbers[[AMBIENT, GLOSS, VIGNETTE]] = light.ambient, light.gloss, light.vignette
    numbers[ACROSS : ACROSS + 3], numbers[UP : UP + 3] = view.axes[:, 0], view.axes[:, 1]
    height = light.relief / 100 / 255 * max(sheet)
    numbers[[SLOPE_X, SLOPE_Y]] = height * texture[0] / sheet[1], -height * texture[1] / sheet[0]
    return numbers


# Numbers of a rod: the middle of its tip and its axis in the camera's frame; length, radius; and its bounds in the
# picture [samples].
AXIS, LENGTH, RADIUS, LEFT, TOP, RIGHT, BOTTOM, ROD_NUMBERS = 3, 6, 7, 8, 9, 10, 11, 12


class Ray(NamedTuple):
    """What lights a tile of samples: N, L, V of length 1, and d0 / d."""

    n_x: Any
    n_y: Any
    n_z: Any
    l_x: Any
    l_y: Any
    l_z: Any
    v_x: Any
    v_y: Any
    v_z: Any
    nearness: Any


@cache
def lighting(code: Code) -> tuple[Callable[..., Any], ...]:
    """Make Taichi's functions that light a tile.

    Args:
        code: what it is compiled for.

    Returns:
        `rays`, which gives the numbers of a `Ray`; `shaded`, which gives the light that instruments leave; `tissue`,
        which gives what a colour is multiplied by and what is added to it; `metal`, which gives a colour.
    """
    floats = code.floats

    @ti.func
    def rays(x, y, depth, normal_x, normal_y, normal_z, light: ti.template()):
        """Find what lights the samples at (x, y), given depths and normals of any length to either side."""
        w = depth * light[PINHOLE] + (1.0 - light[PINHOLE])
        right = (x - light[CENTRE_X]) * light[SPREAD] * w
        up = (light[CENTRE_Y] - y) * light[SPREAD] * w
        l_x, l_y = light[LIGHT_X] - right, light[LIGHT_Y] - up
        square = ti.max(l_x * l_x + l_y * l_y + depth * depth, 1e-30)
        to_light = 1.0 / ti.sqrt(square)
        v_x, v_y = right * (-light[PINHOLE]), up * (-light[PINHOLE])
        v_z = depth * light[PINHOLE] + (1.0 - light[PINHOLE])
        to_eye = 1.0 / ti.sqrt(ti.max(v_x * v_x + v_y * v_y + v_z * v_z, 1e-30))
        toward = normal_x * v_x + normal_y * v_y + normal_z * v_z
        length = ti.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
        unit = ti.select(toward < 0.0, -1.0, 1.0) / ti.max(length, 1e-30)
        return (
            normal_x * unit, normal_y * unit, normal_z * unit,
            l_x * to_light, l_y * to_light, depth * to_light,
            v_x * to_eye, v_y * to_eye, v_z * to_eye,
            ti.min(light[FARNESS] * to_light, 4.0),
        )  # fmt: skip

    @ti.func
    def highlight(ray: ti.template()):
        """(N H)^shininess."""
        h_x, h_y, h_z = ray.l_x + ray.v_x, ray.l_y + ray.v_y, ray.l_z + ray.v_z
        length = ti.sqrt(ti.max(h_x * h_x + h_y * h_y + h_z * h_z, 1e-30))
        power = ti.max(ti.min((ray.n_x * h_x + ray.n_y * h_y + ray.n_z * h_z) / length, 1.0), 0.0)
        for _ in ti.static(range(style.SHARPNESS)):
            power = power * power
        return power

    @ti.func
    def shaded(x, y, depth, rod_count, rods: ti.template(), light: ti.template()):
        """Share of the light that instruments leave to samples at (x, y)."""
        w = depth * light[PINHOLE] + (1.0 - light[PINHOLE])
        right = (x - light[CENTRE_X]) * light[SPREAD] * w
        up = (light[CENTRE_Y] - y) * light[SPREAD] * w
        share = floats(1)
        for n in range(rod_count):
            p_x, p_y, p_z = right - rods[n, 0], up - rods[n, 1], depth * (-1.0) - rods[n, 2]
            u_x, u_y, u_z = rods[n, AXIS], rods[n, AXIS + 1], rods[n, AXIS + 2]
            foot = ti.max(ti.min(p_x * u_x + p_y * u_y + p_z * u_z, rods[n, LENGTH]), 0.0)
            f_x, f_y, f_z = p_x - u_x * foot, p_y - u_y * foot, p_z - u_z * foot
            square = rods[n, RADIUS] * rods[n, RADIUS]
            share *= 1.0 - style.SHADE * square / ti.max(f_x * f_x + f_y * f_y + f_z * f_z, square)
        return share

    @ti.func
    def tissue(x, y, ray: ti.template(), light: ti.template()):
        """Light wet tissue."""
        cosine = ray.n_x * ray.l_x + ray.n_y * ray.l_y + ray.n_z * ray.l_z
        diffuse = ti.max(cosine + style.WRAP, 0.0) * (1.0 / (1.0 + style.WRAP)) * ray.nearness * light[UNIT]
        share = light[AMBIENT] + (1.0 - light[AMBIENT]) * diffuse
        gloss = highlight(ray) * ray.nearness * (255.0 * light[GLOSS])
        # From the middle of the picture, by half its diagonal.
        off_x, off_y = x - light[CENTRE_X], y - light[CENTRE_Y]
        diagonal = light[CENTRE_X] * light[CENTRE_X] + light[CENTRE_Y] * light[CENTRE_Y]
        rim = 1.0 - light[VIGNETTE] * (off_x * off_x + off_y * off_y) / diagonal
        return share * rim, gloss * rim

    @ti.func
    def metal(ray: ti.template()):
        """Light metal, which mirrors a room that is bright above and dark below."""
        cosine = ti.max(ray.n_x * ray.l_x + ray.n_y * ray.l_y + ray.n_z * ray.l_z, 0.0)
        toward = ray.n_x * ray.v_x + ray.n_y * ray.v_y + ray.n_z * ray.v_z
        mirrored = ti.max(2.0 * toward * ray.n_y - ray.v_y, 0.0)
        share = style.METAL_AMBIENT + style.METAL_DIFFUSE * cosine + style.METAL_MIRROR * mirrored * mirrored
        gloss = highlight(ray) * (255.0 * style.METAL_GLOSS)
        return (
            ti.min(share * style.METAL[0] + gloss, floats(255.0)),
            ti.min(share * style.METAL[1] + gloss, floats(255.0)),
            ti.min(share * style.METAL[2] + gloss, floats(255.0)),
        )

    return rays, shaded, tissue, metal
