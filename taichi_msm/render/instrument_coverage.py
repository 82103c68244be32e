"""The samples that show an instrument.

A rod is all that lies within its radius of the line segment from the middle A of its tip to A + U length, its other
end. The line of sight through a sample is P = O + D t, where t is the depth. On the side of the rod the component of
P - A perpendicular to U has the radius as its length, which is a quadratic equation for t. Where its solution lies
beyond an end of the segment, the line of sight is intersected with the sphere around that end instead.
"""

from taichi_msm.render import uniforms as uni
from taichi_msm.render.geometry import line_of_sight, w_at
from taichi_msm.render.places import BEYOND
from taichi_msm.render.samples import INFINITY, box_of, clip, keep, keep_unit, places, places_of, tiles_of
from taichi_msm.system.runtime import ti


@ti.func
def dot(a_x, a_y, a_z, b_x, b_y, b_z):
    """Give the scalar product of two vectors."""
    return a_x * b_x + a_y * b_y + a_z * b_z


@ti.func
def meet(x, y, n, numbers: ti.template()):
    """Find where lines of sight meet rod n first: the depth, INFINITY where they miss; the normal times the radius."""
    rod = uni.RODS + n * uni.ROD_NUMBERS
    tip, axis = rod + uni.TIP, rod + uni.AXIS
    u_x, u_y, u_z = numbers[axis], numbers[axis + 1], numbers[axis + 2]
    length, radius = numbers[rod + uni.LENGTH], numbers[rod + uni.RADIUS]
    # The line of sight P = O + D t; here t is counted from the depth of the tip, and the tip is at 0.
    start = numbers[tip + 2] * (-1.0)
    across, up = line_of_sight(x, y, numbers)
    d_x, d_y, d_z = across * numbers[uni.PINHOLE], up * numbers[uni.PINHOLE], -1.0
    w = w_at(start, numbers)
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


@ti.func
def cover_tile_with_rod(at, x, y, n, band: ti.template()):
    """Cover a tile of samples with rod n."""
    plane, samples = ti.static((band.config.plane, band.samples))
    depth, n_x, n_y, n_z = meet(x, y, n, band.numbers)
    visible = (w_at(depth, band.numbers) > band.near) & (depth < samples[at + plane.depth])
    if ti.static(band.config.bends):
        visible = visible & (x < BEYOND)
    keep(at + plane.depth, visible, depth, samples)
    keep(at + plane.instrument, visible, 255.0, samples)
    if ti.static(band.config.metal):
        keep(at + plane.normal_x, visible, n_x, samples)
        keep(at + plane.normal_y, visible, n_y, samples)
        keep(at + plane.normal_z, visible, n_z, samples)
    if ti.static(band.config.normals):
        # In OpenCV's axes.
        keep_unit(at + plane.facet_x, visible, [n_x, n_y * (-1.0), n_z * (-1.0)], samples)


@ti.func
def cover_with_rods(count, band: ti.template()):
    """Cover a band with its `count` instruments."""
    config, numbers = ti.static((band.config, band.numbers))
    for n in range(count):
        rod = uni.RODS + n * uni.ROD_NUMBERS
        left, right = numbers[rod + uni.LEFT], numbers[rod + uni.RIGHT]
        top, bottom = numbers[rod + uni.TOP], numbers[rod + uni.BOTTOM]
        low_x, high_x, low_y, high_y = left, right, top, bottom
        if ti.static(config.bends):
            # Which tiles show what is within these bounds is known of each tile alone.
            low_x, high_x, low_y, high_y = band.left, band.right, band.top, band.bottom
        if low_y < band.bottom and high_y > band.top:
            first_column, end_column, first_row, end_row = clip(low_x, high_x, low_y, high_y, band)
            first_tile, end_tile, first_line, end_line = tiles_of(first_column, end_column, first_row, end_row, band)
            for line in range(first_line, end_line):
                for tile in range(first_tile, end_tile):
                    at = band.first + (line * band.across + tile) * config.planes
                    tile_x, tile_y = tile * config.tile_width, band.top + line * config.tile_height
                    reached = True
                    if ti.static(config.bends):
                        box = ti.static(box_of(at, tile_x, tile_y, band))
                        reached = box[0] <= right and box[1] >= left and box[2] <= bottom and box[3] >= top
                    if reached:
                        x, y = places(tile_x, tile_y, places_of(at, band), band.samples, config)
                        cover_tile_with_rod(at, x, y, n, band)
