"""What is kept of the point of the sheet that a sample shows. A new output per pixel is a few lines of `store`."""

from typing import Any, NamedTuple

from taichi_msm.render import style
from taichi_msm.render import uniforms as uni
from taichi_msm.render.geometry import POINT_NUMBERS, facet, on_triangle
from taichi_msm.render.samples import keep, keep_unit, steps
from taichi_msm.system.runtime import ti

# The numbers of the unit normal at a mass point; normals are stored after the other numbers of all mass points.
NORMAL_NUMBERS = 3

# A footprint of this size covers any texture [texels squared].
LARGEST_FOOTPRINT = 1e12


class DrawnSheet(NamedTuple):
    """The mass points, and the size of what is between them."""

    point: Any  # the numbers of every mass point, then the normals
    rows: Any
    cols: Any
    parts: Any  # small quads along a side of a cell
    texture_width: Any  # [texels]
    texture_height: Any
    bent: Any  # entry of `point` where what `store_bent` stored begins, if there is a lens


class Cell(NamedTuple):
    """A cell and its place on the sheet and on the texture."""

    patch: Any
    i: Any  # its row and column
    j: Any
    down: Any  # cells of the sheet
    across: Any
    texel_x: Any  # whole texels to its upper left mass point
    texel_y: Any
    rest_x: Any  # the fraction of a texel that remains
    rest_y: Any
    step_x: Any  # texels of the cell
    step_y: Any
    normal: Any  # entry of the normal at its upper left mass point


@ti.func
def cell_at(i, j, patch: ti.template(), sheet: ti.template()):
    """Find the place of the cell to the right and below of mass point (i, j)."""
    # In f64, so that it is exact to a fraction of a texel on any sheet.
    texel_x = ti.cast(j, ti.f64) * sheet.texture_width / (sheet.cols - 1) - 0.5
    texel_y = ti.cast(i, ti.f64) * sheet.texture_height / (sheet.rows - 1) - 0.5
    whole_x, whole_y = ti.floor(texel_x), ti.floor(texel_y)
    first_x, first_y = ti.cast(whole_x, ti.f32), ti.cast(whole_y, ti.f32)
    rest_x, rest_y = ti.cast(texel_x - whole_x, ti.f32), ti.cast(texel_y - whole_y, ti.f32)
    step_x = ti.cast(sheet.texture_width, ti.f32) / (sheet.cols - 1)
    step_y = ti.cast(sheet.texture_height, ti.f32) / (sheet.rows - 1)
    row, column = ti.cast(i, ti.f32), ti.cast(j, ti.f32)
    down, across = ti.cast(sheet.rows - 1, ti.f32), ti.cast(sheet.cols - 1, ti.f32)
    normal = sheet.rows * sheet.cols * POINT_NUMBERS + (i * sheet.cols + j) * NORMAL_NUMBERS
    return ti.static(Cell(patch, row, column, down, across, first_x, first_y, rest_x, rest_y, step_x, step_y, normal))


@ti.func
def store_normal(
    position: ti.template(), i, j, rows, cols, config: ti.template(), numbers: ti.template(), point: ti.template()
):
    """Store the normal of the sheet at mass point (i, j), if it is shaded; for tissue, in the camera's frame."""
    if ti.static(config.headlit or config.tissue):
        i0, i1 = ti.max(i - 1, 0), ti.min(i + 1, rows - 1)
        j0, j1 = ti.max(j - 1, 0), ti.min(j + 1, cols - 1)
        r = [position[i, j1, n] - position[i, j0, n] for n in ti.static(range(3))]
        u = [position[i0, j, n] - position[i1, j, n] for n in ti.static(range(3))]
        across = [r[1] * u[2] - r[2] * u[1], r[2] * u[0] - r[0] * u[2], r[0] * u[1] - r[1] * u[0]]
        length = ti.sqrt(across[0] * across[0] + across[1] * across[1] + across[2] * across[2])
        normal = [across[n] / ti.max(length, 1e-30) for n in ti.static(range(3))]
        here = rows * cols * POINT_NUMBERS + (i * cols + j) * NORMAL_NUMBERS
        for n in ti.static(range(3)):
            axis = uni.AXES + 3 * n
            point[here + n] = (
                numbers[axis] * normal[0] + numbers[axis + 1] * normal[1] + numbers[axis + 2] * normal[2]
                if ti.static(config.tissue)
                else normal[n]
            )


@ti.func
def normal_at(across, along, cell: ti.template(), sheet: ti.template()):
    """Interpolate the normals of the mass points; the result, a list, is not normalised."""
    below = cell.normal + sheet.cols * NORMAL_NUMBERS
    a = [sheet.point[cell.normal + n] for n in ti.static(range(3))]
    b = [sheet.point[cell.normal + NORMAL_NUMBERS + n] for n in ti.static(range(3))]
    c = [sheet.point[below + n] for n in ti.static(range(3))]
    d = [sheet.point[below + NORMAL_NUMBERS + n] for n in ti.static(range(3))]
    return [
        a[n] + (b[n] - a[n]) * across + (c[n] - a[n] + (d[n] - b[n] - (c[n] - a[n])) * across) * along
        for n in ti.static(range(3))
    ]


@ti.func
def absolute(values):
    """Give absolute values; ti.abs of a vector crashes."""
    return ti.max(values, values * (-1.0))


@ti.func
def headlight(normal: ti.template(), numbers: ti.template()):
    """Share of the headlight that is reflected: the cosine between the normal and the direction to the light."""
    length = ti.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    toward = uni.HEADLIGHT
    cosine = absolute(normal[0] * numbers[toward] + normal[1] * numbers[toward + 1] + normal[2] * numbers[toward + 2])
    cosine = cosine / ti.max(length, 1e-30)
    # Where a point is infinite or NaN, so is its normal.
    return ti.max(ti.min(cosine, 1.0), 0.0)


@ti.func
def footprint(at, x, y, s, t, texels_x, texels_y, triangle: ti.template(), band: ti.template()):
    """Square of the larger of a sample's width and height on the texture, in units of style.SHARP texels.

    With x = X / w the derivatives of (x, y) with respect to (s, t) are (R_1, D_1; R_2, D_2) / w, where
    R_1 = R_x - x R_w and so on; those of (s, t) with respect to (x, y) are the inverse. Also gives 1 where the front of
    the triangle is seen, else -1.
    """
    p, r, d = ti.static((triangle.p, triangle.r, triangle.d))
    r_1 = r[0] - x * r[2]
    d_1 = d[0] - x * d[2]
    r_2 = r[1] - y * r[2]
    d_2 = d[1] - y * d[2]
    # Written as in `on_triangle`, so that the compiler computes it once.
    share = 1.0 / (r_1 * d_2 - r_2 * d_1)
    scale = (p[2] + r[2] * s + d[2] * t) * share
    if ti.static(band.config.place_steps):
        step = steps(at, band)
        d_2, d_1 = d_2 * step[0] - d_1 * step[1], d_1 * step[3] - d_2 * step[2]
        r_2, r_1 = r_2 * step[0] - r_1 * step[1], r_1 * step[3] - r_2 * step[2]
    across_1, across_2, down_1, down_2 = d_1 * texels_x, d_2 * texels_x, r_1 * texels_y, r_2 * texels_y
    largest = ti.max(across_1 * across_1 + down_1 * down_1, across_2 * across_2 + down_2 * down_2)
    square = largest * (scale * scale) * (1.0 / (style.SHARP * style.SHARP))
    return ti.min(square, LARGEST_FOOTPRINT), ti.select(scale < 0.0, -1.0, 1.0)


@ti.func
def distance_to_line(place, right, below):
    """Distance of samples from the nearest line of the mesh [samples], given their distance from its first [cells].

    `right` and `below` are those distances of what their neighbours show of the same triangle.
    """
    to_right, to_below = right - place, below - place
    slope = ti.sqrt(to_right * to_right + to_below * to_below)
    return absolute(place - ti.round(place)) / ti.max(slope, 1e-12)


@ti.func
def store(
    at, visible, x, y, s, t, column, line,
    triangle: ti.template(), cell: ti.template(), sheet: ti.template(), band: ti.template(),
):  # fmt: skip
    """Keep what the visible samples of a tile show: (s, t) of a triangle of a cell's small quad (column, line)."""
    config, samples = ti.static((band.config, band.samples))
    plane = ti.static(config.plane)
    part = 1.0 / sheet.parts
    across = (column + s) * part
    along = (line + t) * part
    keep(at + plane.texel_x, visible, cell.rest_x + across * cell.step_x + cell.texel_x, samples)
    keep(at + plane.texel_y, visible, cell.rest_y + along * cell.step_y + cell.texel_y, samples)
    if ti.static(config.labels):
        keep(at + plane.across, visible, (cell.j + across) / cell.across, samples)
        keep(at + plane.down, visible, (cell.i + along) / cell.down, samples)
    if ti.static(config.normals):
        keep_unit(at + plane.facet_x, visible, facet(x, y, triangle, band.numbers), samples)
    if ti.static(config.headlit):
        normal = normal_at(across, along, cell, sheet)
        keep(at + plane.light, visible, headlight(normal, band.numbers), samples)
    if ti.static(config.tissue):
        size, front = footprint(at, x, y, s, t, cell.step_x * part, cell.step_y * part, triangle, band)
        # On the side that is seen of the triangle: at a fold, the interpolated normal may lean the other way.
        normal = normal_at(across, along, cell, sheet)
        keep(at + plane.normal_x, visible, normal[0] * front, samples)
        keep(at + plane.normal_y, visible, normal[1] * front, samples)
        keep(at + plane.normal_z, visible, normal[2] * front, samples)
        keep(at + plane.footprint, visible, size, samples)
    if ti.static(config.wireframe):
        right_x, right_y, below_x, below_y = x + 1.0, y, x, y + 1.0
        if ti.static(config.place_steps):
            step = steps(at, band)
            right_x, right_y, below_x, below_y = x + step[0], y + step[1], x + step[2], y + step[3]
        s_right, t_right = on_triangle(right_x, right_y, triangle)
        s_below, t_below = on_triangle(below_x, below_y, triangle)
        distance = ti.min(
            distance_to_line(across, (column + s_right) * part, (column + s_below) * part),
            distance_to_line(along, (line + t_right) * part, (line + t_below) * part),
        )
        reach = style.WIRE_WIDTH / 2 * config.supersample + 0.5
        keep(at + plane.wire, visible, style.WIRE_OPACITY * ti.max(ti.min(reach - distance, 1.0), 0.0), samples)
