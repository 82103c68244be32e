"""The samples that show an instrument.

A rod is all that lies within its radius of the line segment from the middle A of its tip to A + U length, its other
end. The line of sight through a sample is P = O + D t, where t is the depth. On the side of the rod the component of
P - A perpendicular to U has the radius as its length, which is a quadratic equation for t. Where its solution lies
beyond an end of the segment, the line of sight is intersected with the sphere around that end instead.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

from taichi_msm.render.numbers import (
    AXIS,
    BOTTOM,
    CENTRE_X,
    CENTRE_Y,
    LEFT,
    LENGTH,
    PINHOLE,
    RADIUS,
    RIGHT,
    ROD_NUMBERS,
    RODS,
    SPREAD,
    TIP,
    TOP,
)
from taichi_msm.render.samples import DEPTH, INFINITY, Code
from taichi_msm.system.runtime import ti


@ti.func
def dot(a_x, a_y, a_z, b_x, b_y, b_z):
    """Give the scalar product of two vectors."""
    return a_x * b_x + a_y * b_y + a_z * b_z


@ti.func
def meet(x, y, n, numbers: ti.template()):
    """Find where lines of sight meet rod n first.

    Args:
        x: column of the samples.
        y: their row.
        n: number of the rod.
        numbers: as `view_numbers` makes them.

    Returns:
        The depth, INFINITY where they miss the rod, and the normal times the radius.
    """
    rod = RODS + n * ROD_NUMBERS
    tip, axis = rod + TIP, rod + AXIS
    u_x, u_y, u_z = numbers[axis], numbers[axis + 1], numbers[axis + 2]
    length, radius = numbers[rod + LENGTH], numbers[rod + RADIUS]
    # The line of sight P = O + D t; here t is counted from the depth of the tip, and the tip is at 0.
    start = numbers[tip + 2] * (-1.0)
    across = (x - numbers[CENTRE_X]) * numbers[SPREAD]
    up = (numbers[CENTRE_Y] - y) * numbers[SPREAD]
    d_x, d_y, d_z = across * numbers[PINHOLE], up * numbers[PINHOLE], -1.0
    w = start * numbers[PINHOLE] + (1.0 - numbers[PINHOLE])
    o_x, o_y, o_z = across * w - numbers[tip], up * w - numbers[tip + 1], 0.0
    # The side of the rod: a t^2 + 2 b t + c = 0.
    d_d = dot(d_x, d_y, d_z, d_x, d_y, d_z)
    d_u = dot(d_x, d_y, d_z, u_x, u_y, u_z)
    o_u = dot(o_x, o_y, o_z, u_x, u_y, u_z)
    o_d = dot(o_x, o_y, o_z, d_x, d_y, d_z)
    o_o = dot(o_x, o_y, o_z, o_x, o_y, o_z)
    a = ti.max(d_d - d_u * d_u, 1e-12)
    b = o_d - o_u * d_u
    c = o_o - o_u * o_u - radius * radius
    inner = b * b - a * c
    t_side = (ti.sqrt(ti.max(inner, 0.0)) + b) * (-1.0) / a
    along = o_u + t_side * d_u
    # The sphere around the end beyond which the solution lies.
    end = ti.select(along < length * 0.5, 0.0, length)
    b_end = o_d - end * d_u
    c_end = o_o - 2.0 * end * o_u + end * end - radius * radius
    inner_end = b_end * b_end - d_d * c_end
    t_end = (ti.sqrt(ti.max(inner_end, 0.0)) + b_end) * (-1.0) / d_d
    on_side = (along >= 0.0) & (along <= length)
    t = ti.select(on_side, t_side, t_end)
    met = (inner >= 0.0) & (on_side | (inner_end >= 0.0))
    foot = ti.max(ti.min(o_u + t * d_u, length), 0.0)
    return (
        ti.select(met, start + t, INFINITY),
        o_x + d_x * t - u_x * foot,
        o_y + d_y * t - u_y * foot,
        d_z * t - u_z * foot,
    )


@cache
def instruments(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that covers the samples of a band with the instruments.

    Args:
        code: what it is compiled for.
    """
    floats = code.floats
    columns = [lane % code.tile_width + 0.5 for lane in range(code.lanes)]
    lines = [lane // code.tile_width + 0.5 for lane in range(code.lanes)]

    @ti.func
    def cover_tile(at, x, y, n, band: ti.template()):
        """Cover a tile of samples with rod n."""
        depth, n_x, n_y, n_z = meet(x, y, n, band.numbers)
        samples = ti.static(band.samples)
        in_front = depth * band.numbers[PINHOLE] + (1.0 - band.numbers[PINHOLE]) > band.near
        visible = in_front & (depth < samples[at + DEPTH])
        samples[at + DEPTH] = ti.select(visible, depth, samples[at + DEPTH])
        mask = at + ti.static(code.layout["instrument"])
        samples[mask] = ti.select(visible, 1.0, samples[mask])
        if ti.static(code.metal):
            for name, value in ti.static((("normal_x", n_x), ("normal_y", n_y), ("normal_z", n_z))):
                plane = at + ti.static(code.layout[name])
                samples[plane] = ti.select(visible, value, samples[plane])

    @ti.func
    def cover(count, band: ti.template()):
        """Cover a band with the instruments.

        Args:
            count: how many there are.
            band: the band.
        """
        numbers = ti.static(band.numbers)
        for n in range(count):
            rod = RODS + n * ROD_NUMBERS
            if numbers[rod + TOP] < band.bottom and numbers[rod + BOTTOM] > band.top:
                first_row = ti.cast(ti.max(ti.floor(numbers[rod + TOP]), band.top), ti.i32)
                end_row = ti.cast(ti.min(ti.ceil(numbers[rod + BOTTOM]), band.bottom), ti.i32)
                first_line = (first_row - band.top) // code.tile_height
                end_line = (end_row - band.top + (code.tile_height - 1)) // code.tile_height
                first_column = ti.cast(ti.max(ti.floor(numbers[rod + LEFT]), band.left), ti.i32)
                end_column = ti.cast(ti.min(ti.ceil(numbers[rod + RIGHT]), band.right), ti.i32)
                first_tile = first_column // code.tile_width
                end_tile = (end_column + (code.tile_width - 1)) // code.tile_width
                for line in range(first_line, end_line):
                    for tile in range(first_tile, end_tile):
                        x = floats(columns) + ti.cast(tile * code.tile_width, ti.f32)
                        y = floats(lines) + ti.cast(band.top + line * code.tile_height, ti.f32)
                        cover_tile(band.first + (line * band.across + tile) * code.planes, x, y, n, band)

    return cover
