"""What every sample of the picture shows: the nearest point of the surface, and where on the sheet it is.

Vertices are not stored. For a sample inside the outline of a cell, the two equations of geometry.py give the small
quad; the side of the quad's diagonal that the sample is on gives the triangle; and the two linear equations of the
triangle give the place on it. A cell that is folded or reaches behind the camera is drawn triangle by triangle instead.

The samples that show an instrument.

A rod is all that lies within its radius of the line segment from the middle A of its tip to A + U length, its other
end. The line of sight through a sample is P = O + D t, where t is the depth. On the side of the rod the component of
P - A perpendicular to U has the radius as its length, which is a quadratic equation for t. Where its solution lies
beyond an end of the segment, the line of sight is intersected with the sphere around that end instead.

What is kept of the point of the sheet that a sample shows. A new output per pixel is a few lines of `store_surface`.
"""

from typing import Any, NamedTuple

from taichi_msm.render import geometry
from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import (
    INFINITY,
    clip,
    map_entry,
    map_steps,
    sample_centres,
    store_visible,
    store_visible_unit,
    tile_box,
    tile_range,
    undistorted_centres,
)
from taichi_msm.render.geometry import NODE_STRIDE, facet, line_of_sight, on_triangle, w_at
from taichi_msm.render.lens_kernels import DISTORTED_STRIDE
from taichi_msm.render.lens_table import INVALID_COORDINATE
from taichi_msm.system.runtime import ti


class Part(NamedTuple):
    """A part of a cell, for a thread of a GPU."""

    invertible: Any  # whether the cell is drawn as a whole; then the part is all of it
    first: Any  # else, its first triangle
    end: Any  # and that after its last


@ti.func
def max_edge(p_x, p_y, q_x, q_y, box: ti.template(), facing):
    """The largest `edge` of samples within a box, its left, right, top and bottom.

    It is rounded as `edge` is, so that no tile with a sample inside is left out.
    """
    left, right, top, bottom = ti.static(box)
    x = ti.select((q_y - p_y) * facing > 0.0, left, right)
    y = ti.select((q_x - p_x) * facing > 0.0, bottom, top)
    return geometry.edge(p_x, p_y, q_x, q_y, x, y, facing)


@ti.func
def may_cover(box: ti.template(), facing, outline: ti.template()):
    """Tell whether a cell may cover samples within a box."""
    p, q = ti.static((outline.x, outline.y))
    return (
        max_edge(p[0], q[0], p[2], q[2], box, -facing) >= 0.0
        and max_edge(p[1], q[1], p[3], q[3], box, facing) > 0.0
        and max_edge(p[0], q[0], p[1], q[1], box, facing) >= 0.0
        and max_edge(p[2], q[2], p[3], q[3], box, -facing) > 0.0
    )


@ti.func
def cover_tile(
    entry, x, y, inside, column, line, lower, enlargement,
    cell: ti.template(), sheet: ti.template(), band: ti.template(),
):  # fmt: skip
    """Cover a tile of samples with the small quads (column, line) of a cell.

    The cell covers those `inside`. If it is drawn triangle by triangle, this is the `lower` or upper one, enlarged by
    the fraction `enlargement` of its side.
    """
    config = ti.static(band.config)
    plane = ti.static(config.plane)
    below_diagonal = config.float_vector(ti.cast(lower, ti.f32)) > 0.5
    triangle = ti.static(geometry.triangle_at(x, y, column, line, 1.0 / sheet.parts, below_diagonal, cell.patch))
    s, t = geometry.on_triangle(x, y, triangle)
    if not cell.patch.invertible:
        inside = inside & geometry.is_within(s, t, enlargement, band.near, triangle)
    z = geometry.depth_at(s, t, triangle)
    visible = inside & (z < band.samples[entry + plane.depth])
    if ti.static(config.unordered):
        # Of points that are equally far, that of the cell or triangle is seen which comes first.
        number = cell.i * cell.across + cell.j
        piece = (line * sheet.parts + column) * 2.0 + ti.select(triangle.below, 0.0, 1.0)
        kept, kept_piece = band.samples[entry + plane.cell], band.samples[entry + plane.triangle]
        before = (number < kept) | ((number == kept) & (piece < kept_piece))
        visible = visible | (inside & (z == band.samples[entry + plane.depth]) & before)
        store_visible(entry + plane.cell, visible, number, band.samples)
        store_visible(entry + plane.triangle, visible, piece, band.samples)
    store_visible(entry + plane.depth, visible, z, band.samples)
    store_surface(entry, visible, x, y, s, t, column, line, triangle, cell, sheet, band)


@ti.func
def cover_cell(i, j, drawn: ti.template(), sheet: ti.template(), band: ti.template()):
    """Cover the samples of a band with the cell to the right and below of mass point (i, j).

    Where cells are unordered, `drawn` is the part of it that is drawn.
    """
    config, float_vector = ti.static((band.config, band.config.float_vector))
    corner = (i * sheet.cols + j) * geometry.NODE_STRIDE
    outline = ti.static(geometry.cell_outline(corner, sheet.cols, band.near, sheet.nodes))
    invertible = geometry.is_invertible(outline)
    if ti.static(config.unordered):
        invertible = drawn.invertible
    patch = ti.static(geometry.cell_patch(corner, sheet.cols, outline.facing, invertible, sheet.nodes, False))
    cell = ti.static(cell_at(i, j, patch, sheet))
    count = ti.cast(sheet.parts, ti.i32)
    first, end = 0, ti.select(invertible, 1, 2 * count * count)
    if ti.static(config.unordered):
        first, end = drawn.first, drawn.end
    for piece in range(first, end):
        # For a triangle that is drawn by itself: its quad, and whether it is below the diagonal.
        quad = piece // 2
        quad_s = ti.cast(quad % count, ti.f32)
        quad_t = ti.cast(quad // count, ti.f32)
        lower = piece % 2 == 0
        low_x, high_x, low_y, high_y = outline.left, outline.right, outline.top, outline.bottom
        enlargement = geometry.ENLARGEMENT
        if not invertible:
            low_x, high_x, low_y, high_y, enlargement = geometry.triangle_bounds(
                quad_s, quad_t, lower, 1.0 / sheet.parts, band.near, band.width, band.height,
                patch, band.uniforms, config.lens,
            )  # fmt: skip
        elif ti.static(config.has_distortion):
            bent = sheet.bent + (i * sheet.cols + j) * DISTORTED_STRIDE
            low_x, high_x, low_y, high_y = geometry.distorted_cell_bounds(
                bent, sheet.cols, outline, band.uniforms, sheet.nodes
            )
        first_column, end_column, first_row, end_row = clip(low_x - 0.5, high_x + 0.5, low_y - 0.5, high_y + 0.5, band)
        first_tile, end_tile, first_line, end_line = tile_range(first_column, end_column, first_row, end_row, band)
        tiles = ti.max(end_line - first_line, 0) * ti.max(end_tile - first_tile, 0)
        tile, tile_line = first_tile, first_line
        # A tile is covered after the small quads of the next one are found: neither needs the other, so the
        # processor works on both at once. `held` is the entry of the tile that waits to be covered; -1: none does.
        held = -1
        held_x, held_y, held_inside = float_vector(0), float_vector(0), float_vector(0)
        held_column, held_line = float_vector(0), float_vector(0)
        for n in range(tiles + 1):
            tile_x = ti.cast(tile * config.tile_width, ti.f32)
            tile_y = ti.cast(band.top + tile_line * config.tile_height, ti.f32)
            entry = band.first + (tile_line * band.across + tile) * config.planes
            x, y = sample_centres(tile_x, tile_y, config)
            inside = float_vector(1) > 0.0
            column, line = float_vector(quad_s), float_vector(quad_t)
            # The last round only covers the tile that still waits.
            reached = True
            if n < tiles:
                if ti.static(config.has_distortion):
                    x, y = undistorted_centres(tile_x, tile_y, map_entry(entry, band), band.samples, config)
                if invertible:
                    reached = may_cover(tile_box(entry, tile_x, tile_y, band), outline.facing, outline)
                    if reached:
                        # Left and upper edges belong to a cell, right and lower ones do not.
                        of_left, of_right, of_top, of_bottom = geometry.edges(x, y, outline.facing, outline)
                        inside = (of_left >= 0.0) & (of_right > 0.0) & (of_top >= 0.0) & (of_bottom > 0.0)
                        if ti.static(config.refined):
                            column, line = geometry.find_quads(x, y, inside, sheet.parts, patch)
                else:
                    # Outside its bounds rounding would decide, in samples that depend on the tiles' shape.
                    column_x, row_y = sample_centres(tile_x, tile_y, config)
                    inside = (
                        (column_x > ti.cast(first_column, ti.f32))
                        & (column_x < ti.cast(end_column, ti.f32))
                        & (row_y > ti.cast(first_row, ti.f32))
                        & (row_y < ti.cast(end_row, ti.f32))
                    )
                    if ti.static(config.has_distortion):
                        inside = inside & (x < INVALID_COORDINATE)
            if reached:
                if held >= 0:
                    cover_tile(
                        held, held_x, held_y, held_inside > 0.0, held_column, held_line, lower, enlargement,
                        cell, sheet, band,
                    )  # fmt: skip
                held = entry
                held_x, held_y, held_inside = x, y, ti.select(inside, 1.0, 0.0)
                held_column, held_line = column, line
            tile += 1
            if tile == end_tile:
                tile = first_tile
                tile_line += 1


@ti.func
def dot(a_x, a_y, a_z, b_x, b_y, b_z):
    """Give the scalar product of two vectors."""
    return a_x * b_x + a_y * b_y + a_z * b_z


@ti.func
def intersect_capsule(x, y, n, uniforms: ti.template()):
    """Find where lines of sight meet rod n first: the depth, INFINITY where they miss; the normal times the radius."""
    rod = uni.CAPSULES + n * uni.CAPSULE_STRIDE
    tip, axis = rod + uni.TIP, rod + uni.AXIS
    u_x, u_y, u_z = uniforms[axis], uniforms[axis + 1], uniforms[axis + 2]
    length, radius = uniforms[rod + uni.LENGTH], uniforms[rod + uni.RADIUS]
    # The line of sight P = O + D t; here t is counted from the depth of the tip, and the tip is at 0.
    start = uniforms[tip + 2] * (-1.0)
    across, up = line_of_sight(x, y, uniforms)
    d_x, d_y, d_z = across * uniforms[uni.PINHOLE], up * uniforms[uni.PINHOLE], -1.0
    w = w_at(start, uniforms)
    o_x, o_y, o_z = across * w - uniforms[tip], up * w - uniforms[tip + 1], 0.0
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
def cover_tile_with_capsule(entry, x, y, n, band: ti.template()):
    """Cover a tile of samples with rod n."""
    plane, samples = ti.static((band.config.plane, band.samples))
    depth, n_x, n_y, n_z = intersect_capsule(x, y, n, band.uniforms)
    visible = (w_at(depth, band.uniforms) > band.near) & (depth < samples[entry + plane.depth])
    if ti.static(band.config.has_distortion):
        visible = visible & (x < INVALID_COORDINATE)
    store_visible(entry + plane.depth, visible, depth, samples)
    store_visible(entry + plane.instrument, visible, 255.0, samples)
    if ti.static(band.config.metal):
        store_visible(entry + plane.normal_x, visible, n_x, samples)
        store_visible(entry + plane.normal_y, visible, n_y, samples)
        store_visible(entry + plane.normal_z, visible, n_z, samples)
    if ti.static(band.config.normals):
        # In OpenCV's axes.
        store_visible_unit(entry + plane.facet_x, visible, [n_x, n_y * (-1.0), n_z * (-1.0)], samples)


@ti.func
def cover_capsules(count, band: ti.template()):
    """Cover a band with its `count` instruments."""
    config, uniforms = ti.static((band.config, band.uniforms))
    for n in range(count):
        rod = uni.CAPSULES + n * uni.CAPSULE_STRIDE
        left, right = uniforms[rod + uni.LEFT], uniforms[rod + uni.RIGHT]
        top, bottom = uniforms[rod + uni.TOP], uniforms[rod + uni.BOTTOM]
        low_x, high_x, low_y, high_y = left, right, top, bottom
        if ti.static(config.has_distortion):
            # Which tiles show what is within these bounds is known of each tile alone.
            low_x, high_x, low_y, high_y = band.left, band.right, band.top, band.bottom
        if low_y < band.bottom and high_y > band.top:
            first_column, end_column, first_row, end_row = clip(low_x, high_x, low_y, high_y, band)
            first_tile, end_tile, first_line, end_line = tile_range(first_column, end_column, first_row, end_row, band)
            for line in range(first_line, end_line):
                for tile in range(first_tile, end_tile):
                    entry = band.first + (line * band.across + tile) * config.planes
                    tile_x, tile_y = tile * config.tile_width, band.top + line * config.tile_height
                    reached = True
                    if ti.static(config.has_distortion):
                        box = ti.static(tile_box(entry, tile_x, tile_y, band))
                        reached = box[0] <= right and box[1] >= left and box[2] <= bottom and box[3] >= top
                    if reached:
                        x, y = undistorted_centres(tile_x, tile_y, map_entry(entry, band), band.samples, config)
                        cover_tile_with_capsule(entry, x, y, n, band)


# The numbers of the unit normal at a mass point; normals are stored after the other numbers of all mass points.
NORMAL_STRIDE = 3

# A footprint of this size covers any texture [texels squared].
MAX_FOOTPRINT = 1e12


class DrawnSheet(NamedTuple):
    """The mass points, and the size of what is between them."""

    nodes: Any  # the numbers of every mass point, then the normals
    rows: Any
    cols: Any
    parts: Any  # small quads along a side of a cell
    texture_width: Any  # [texels]
    texture_height: Any
    bent: Any  # entry of `nodes` where what `store_distorted` stored begins, if there is a lens


class Cell(NamedTuple):
    """A cell and its place on the sheet and on the texture."""

    patch: Any
    i: Any  # its row and column
    j: Any
    down: Any  # cells of the sheet
    across: Any
    texel_x: Any  # whole texels to its upper left mass point
    texel_y: Any
    fraction_x: Any  # the fraction of a texel that remains
    fraction_y: Any
    texels_across: Any  # texels of the cell
    texels_down: Any
    normal: Any  # entry of the normal at its upper left mass point


@ti.func
def cell_at(i, j, patch: ti.template(), sheet: ti.template()):
    """Find the place of the cell to the right and below of mass point (i, j)."""
    # In f64, so that it is exact to a fraction of a texel on any sheet.
    texel_x = ti.cast(j, ti.f64) * sheet.texture_width / (sheet.cols - 1) - 0.5
    texel_y = ti.cast(i, ti.f64) * sheet.texture_height / (sheet.rows - 1) - 0.5
    whole_x, whole_y = ti.floor(texel_x), ti.floor(texel_y)
    first_x, first_y = ti.cast(whole_x, ti.f32), ti.cast(whole_y, ti.f32)
    fraction_x, fraction_y = ti.cast(texel_x - whole_x, ti.f32), ti.cast(texel_y - whole_y, ti.f32)
    texels_across = ti.cast(sheet.texture_width, ti.f32) / (sheet.cols - 1)
    texels_down = ti.cast(sheet.texture_height, ti.f32) / (sheet.rows - 1)
    row, column = ti.cast(i, ti.f32), ti.cast(j, ti.f32)
    down, across = ti.cast(sheet.rows - 1, ti.f32), ti.cast(sheet.cols - 1, ti.f32)
    normal = sheet.rows * sheet.cols * NODE_STRIDE + (i * sheet.cols + j) * NORMAL_STRIDE
    return ti.static(
        Cell(
            patch,
            row,
            column,
            down,
            across,
            first_x,
            first_y,
            fraction_x,
            fraction_y,
            texels_across,
            texels_down,
            normal,
        )
    )


@ti.func
def store_normal(
    position: ti.template(), i, j, rows, cols, config: ti.template(), uniforms: ti.template(), nodes: ti.template()
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
        here = rows * cols * NODE_STRIDE + (i * cols + j) * NORMAL_STRIDE
        for n in ti.static(range(3)):
            axis = uni.AXES + 3 * n
            nodes[here + n] = (
                uniforms[axis] * normal[0] + uniforms[axis + 1] * normal[1] + uniforms[axis + 2] * normal[2]
                if ti.static(config.tissue)
                else normal[n]
            )


@ti.func
def normal_at(across, along, cell: ti.template(), sheet: ti.template()):
    """Interpolate the normals of the mass points; the result, a list, is not normalised."""
    below = cell.normal + sheet.cols * NORMAL_STRIDE
    a = [sheet.nodes[cell.normal + n] for n in ti.static(range(3))]
    b = [sheet.nodes[cell.normal + NORMAL_STRIDE + n] for n in ti.static(range(3))]
    c = [sheet.nodes[below + n] for n in ti.static(range(3))]
    d = [sheet.nodes[below + NORMAL_STRIDE + n] for n in ti.static(range(3))]
    return [
        a[n] + (b[n] - a[n]) * across + (c[n] - a[n] + (d[n] - b[n] - (c[n] - a[n])) * across) * along
        for n in ti.static(range(3))
    ]


@ti.func
def absolute(values):
    """Give absolute values; ti.abs of a vector crashes."""
    return ti.max(values, values * (-1.0))


@ti.func
def headlight(normal: ti.template(), uniforms: ti.template()):
    """Share of the headlight that is reflected: the cosine between the normal and the direction to the light."""
    length = ti.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    toward = uni.HEADLIGHT
    cosine = absolute(
        normal[0] * uniforms[toward] + normal[1] * uniforms[toward + 1] + normal[2] * uniforms[toward + 2]
    )
    cosine = cosine / ti.max(length, 1e-30)
    # Where a point is infinite or NaN, so is its normal.
    return ti.max(ti.min(cosine, 1.0), 0.0)


@ti.func
def footprint(entry, x, y, s, t, texels_x, texels_y, triangle: ti.template(), band: ti.template()):
    """Square of the larger of a sample's width and height on the texture, in units of uni.SHARP texels.

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
    if ti.static(band.config.map_has_steps):
        step = map_steps(entry, band)
        d_2, d_1 = d_2 * step[0] - d_1 * step[1], d_1 * step[3] - d_2 * step[2]
        r_2, r_1 = r_2 * step[0] - r_1 * step[1], r_1 * step[3] - r_2 * step[2]
    across_1, across_2, down_1, down_2 = d_1 * texels_x, d_2 * texels_x, r_1 * texels_y, r_2 * texels_y
    largest = ti.max(across_1 * across_1 + down_1 * down_1, across_2 * across_2 + down_2 * down_2)
    square = largest * (scale * scale) * (1.0 / (uni.SHARP * uni.SHARP))
    return ti.min(square, MAX_FOOTPRINT), ti.select(scale < 0.0, -1.0, 1.0)


@ti.func
def distance_to_line(place, right, below):
    """Distance of samples from the nearest line of the mesh [samples], given their distance from its first [cells].

    `right` and `below` are those distances of what their neighbours show of the same triangle.
    """
    to_right, to_below = right - place, below - place
    slope = ti.sqrt(to_right * to_right + to_below * to_below)
    return absolute(place - ti.round(place)) / ti.max(slope, 1e-12)


@ti.func
def store_surface(
    entry, visible, x, y, s, t, column, line,
    triangle: ti.template(), cell: ti.template(), sheet: ti.template(), band: ti.template(),
):  # fmt: skip
    """Keep what the visible samples of a tile show: (s, t) of a triangle of a cell's small quad (column, line)."""
    config, samples = ti.static((band.config, band.samples))
    plane = ti.static(config.plane)
    part = 1.0 / sheet.parts
    across = (column + s) * part
    along = (line + t) * part
    store_visible(entry + plane.texel_x, visible, cell.fraction_x + across * cell.texels_across + cell.texel_x, samples)
    store_visible(entry + plane.texel_y, visible, cell.fraction_y + along * cell.texels_down + cell.texel_y, samples)
    if ti.static(config.labels):
        store_visible(entry + plane.across, visible, (cell.j + across) / cell.across, samples)
        store_visible(entry + plane.down, visible, (cell.i + along) / cell.down, samples)
    if ti.static(config.normals):
        store_visible_unit(entry + plane.facet_x, visible, facet(x, y, triangle, band.uniforms), samples)
    if ti.static(config.headlit):
        normal = normal_at(across, along, cell, sheet)
        store_visible(entry + plane.light, visible, headlight(normal, band.uniforms), samples)
    if ti.static(config.tissue):
        size, front = footprint(entry, x, y, s, t, cell.texels_across * part, cell.texels_down * part, triangle, band)
        # On the side that is seen of the triangle: at a fold, the interpolated normal may lean the other way.
        normal = normal_at(across, along, cell, sheet)
        store_visible(entry + plane.normal_x, visible, normal[0] * front, samples)
        store_visible(entry + plane.normal_y, visible, normal[1] * front, samples)
        store_visible(entry + plane.normal_z, visible, normal[2] * front, samples)
        store_visible(entry + plane.footprint, visible, size, samples)
    if ti.static(config.wireframe):
        right_x, right_y, below_x, below_y = x + 1.0, y, x, y + 1.0
        if ti.static(config.map_has_steps):
            step = map_steps(entry, band)
            right_x, right_y, below_x, below_y = x + step[0], y + step[1], x + step[2], y + step[3]
        s_right, t_right = on_triangle(right_x, right_y, triangle)
        s_below, t_below = on_triangle(below_x, below_y, triangle)
        distance = ti.min(
            distance_to_line(across, (column + s_right) * part, (column + s_below) * part),
            distance_to_line(along, (line + t_right) * part, (line + t_below) * part),
        )
        reach = uni.WIRE_WIDTH / 2 * config.supersample + 0.5
        store_visible(
            entry + plane.wire, visible, uni.WIRE_OPACITY * ti.max(ti.min(reach - distance, 1.0), 0.0), samples
        )
