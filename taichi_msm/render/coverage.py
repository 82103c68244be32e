"""Coverage: the nearest surface at every sample, of the sheet and of the instruments.

For a sample inside the outline of a cell:

1. Solve the two equations of geometry.py for the sub-quad.
2. Choose its triangle by the side of the diagonal.
3. Solve two linear equations for the point on the triangle.

So the refined surface is not stored. A cell that is folded or extends behind the camera is drawn triangle by triangle.

For an instrument, intersect its shape (`taichi_msm.shapes`) with the line of sight.

To add an output per pixel, add its planes in labels.py or config.py and its values in `_store_surface`.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.render import geometry
from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import (
    INFINITY,
    clip,
    cross,
    dot,
    is_present,
    map_steps,
    sample_centres,
    store_visible,
    store_visible_unit,
    tile_box,
    tile_range,
    triple,
    undistorted_centres,
)
from taichi_msm.render.lens_kernels import distorted_point
from taichi_msm.render.undistortion import INVALID_COORDINATE
from taichi_msm.shapes import SHAPES
from taichi_msm.system.kernel_operations import KERNEL
from taichi_msm.system.runtime import ti


class Cell(NamedTuple):
    """Cell with its position on the sheet and on the texture."""

    patch: Any
    i: Any  # row
    j: Any  # column
    rows: Any  # of cells of the sheet
    cols: Any
    texel_x: Any  # integer parts of the texture coordinates of the upper left mass point [texels]
    texel_y: Any
    fraction_x: Any  # fractional parts
    fraction_y: Any
    texels_across: Any  # width and height of the cell [texels]
    texels_down: Any
    normal: Any  # entry of the normal at the upper left mass point
    source: Any  # entry of the upper left mass point in the camera of a picture


@ti.func
def _max_edge(p_x, p_y, q_x, q_y, box: ti.template(), facing):
    """Return the largest `geometry.edge` in a box: left, right, top and bottom [samples]."""
    left, right, top, bottom = ti.static(box)
    x = ti.select((q_y - p_y) * facing > 0.0, left, right)
    y = ti.select((q_x - p_x) * facing > 0.0, bottom, top)
    return geometry.edge(p_x, p_y, q_x, q_y, x, y, facing)


@ti.func
def _may_cover(box: ti.template(), facing, outline: ti.template()):
    """Return whether a cell may cover samples in a box."""
    p, q = ti.static((outline.x, outline.y))
    return (
        _max_edge(p[0], q[0], p[2], q[2], box, -facing) >= 0.0
        and _max_edge(p[1], q[1], p[3], q[3], box, facing) > 0.0
        and _max_edge(p[0], q[0], p[1], q[1], box, facing) >= 0.0
        and _max_edge(p[2], q[2], p[3], q[3], box, -facing) > 0.0
    )


@ti.func
def _cover_tile(
    entry, x, y, inside, quad_column, quad_row, lower, enlargement, cell: ti.template(), band: ti.template()
):
    """Cover a tile of samples with sub-quads of a cell, one per sample."""
    config = ti.static(band.config)
    plane = ti.static(config.plane)
    below_diagonal = config.float_vector(ti.cast(lower, ti.f32)) > 0.5
    quad_side = 1.0 / band.subdivisions
    triangle = ti.static(geometry.triangle_at(x, y, quad_column, quad_row, quad_side, below_diagonal, cell.patch))
    s, t = geometry.on_triangle(x, y, triangle)
    if not cell.patch.invertible:
        inside = inside & geometry.is_within(s, t, enlargement, band.near, triangle)
    depth = geometry.depth_at(s, t, triangle)
    visible = inside & (depth < band.samples[entry + plane.depth])
    if ti.static(config.unordered):
        # At equal depth the first cell and triangle are visible, in any order of processing.
        cell_index = cell.i * cell.cols + cell.j
        piece = (quad_row * band.subdivisions + quad_column) * 2.0 + ti.select(triangle.below, 0.0, 1.0)
        stored_cell, stored_piece = band.samples[entry + plane.cell], band.samples[entry + plane.triangle]
        is_first = (cell_index < stored_cell) | ((cell_index == stored_cell) & (piece < stored_piece))
        visible = visible | (inside & (depth == band.samples[entry + plane.depth]) & is_first)
        store_visible(entry + plane.cell, visible, cell_index, band.samples)
        store_visible(entry + plane.triangle, visible, piece, band.samples)
    store_visible(entry + plane.depth, visible, depth, band.samples)
    _store_surface(entry, visible, x, y, s, t, quad_column, quad_row, triangle, cell, band)


@ti.func
def cover_cell(i, j, invertible, first, end, outline: ti.template(), band: ti.template()):
    """Cover the samples of a band with triangles `first` to `end` of a cell; 0 to 1 for an invertible cell."""
    config, float_vector = ti.static((band.config, band.config.float_vector))
    corner, normal_entry, distorted_entry = geometry.point_entries(i * band.cols + j, band)
    patch = ti.static(geometry.cell_patch(corner, band.cols, outline.facing, invertible, band.nodes, False))
    cell = ti.static(_cell_at(i, j, normal_entry, patch, band))
    subdivisions = ti.cast(band.subdivisions, ti.i32)
    for piece in range(first, end):
        # Two triangles per sub-quad.
        quad = piece // 2
        quad_s = ti.cast(quad % subdivisions, ti.f32)
        quad_t = ti.cast(quad // subdivisions, ti.f32)
        lower = piece % 2 == 0
        low_x, high_x, low_y, high_y = outline.left, outline.right, outline.top, outline.bottom
        enlargement = geometry.ENLARGEMENT
        if not invertible:
            low_x, high_x, low_y, high_y, enlargement = geometry.triangle_bounds(
                quad_s, quad_t, lower, 1.0 / band.subdivisions, band.near, band.width, band.height,
                patch, band.uniforms, config.lens,
            )  # fmt: skip
        elif ti.static(config.has_distortion):
            low_x, high_x, low_y, high_y = geometry.distorted_cell_bounds(
                distorted_entry, band.cols, outline, band.uniforms, band.nodes
            )
        clipped = clip(low_x - 0.5, high_x + 0.5, low_y - 0.5, high_y + 0.5, band)
        first_tile, end_tile, first_tile_row, end_tile_row = tile_range(clipped, band)
        tiles = ti.max(end_tile_row - first_tile_row, 0) * ti.max(end_tile - first_tile, 0)
        tile, tile_row = first_tile, first_tile_row
        # Software pipelining: find the sub-quads of a tile, then cover the previous tile. The two are independent, so
        # the processor overlaps them. `pending` is the entry of the previous tile, or -1.
        pending = -1
        pending_x, pending_y, pending_inside = float_vector(0), float_vector(0), float_vector(0)
        pending_column, pending_row = float_vector(0), float_vector(0)
        for n in range(tiles + 1):
            tile_x = ti.cast(tile * config.tile_width, ti.f32)
            tile_y = ti.cast(band.top + tile_row * config.tile_height, ti.f32)
            entry = band.first + (tile_row * band.tiles_across + tile) * config.planes
            x, y = sample_centres(tile_x, tile_y, config)
            inside = float_vector(1) > 0.0
            quad_column, quad_row = float_vector(quad_s), float_vector(quad_t)
            # The last iteration only covers the pending tile.
            overlaps = True
            if n < tiles:
                if ti.static(config.has_distortion):
                    x, y = undistorted_centres(tile_x, tile_y, entry, band)
                if invertible:
                    overlaps = _may_cover(tile_box(entry, tile_x, tile_y, band), outline.facing, outline)
                    if overlaps:
                        # Left and upper edges belong to a cell, right and lower ones to its neighbours.
                        left_edge, right_edge, top_edge, bottom_edge = geometry.edges(x, y, outline.facing, outline)
                        inside = (left_edge >= 0.0) & (right_edge > 0.0) & (top_edge >= 0.0) & (bottom_edge > 0.0)
                        if ti.static(config.refined):
                            quad_column, quad_row = geometry.find_quads(x, y, inside, band.subdivisions, patch)
                else:
                    # Samples beyond the bounds are left out: rounding could cover them, depending on the tile shape.
                    sample_x, sample_y = sample_centres(tile_x, tile_y, config)
                    inside = (
                        (sample_x > ti.cast(clipped[0], ti.f32))
                        & (sample_x < ti.cast(clipped[1], ti.f32))
                        & (sample_y > ti.cast(clipped[2], ti.f32))
                        & (sample_y < ti.cast(clipped[3], ti.f32))
                    )
                    if ti.static(config.has_distortion):
                        inside = inside & (x < INVALID_COORDINATE)
            if overlaps:
                if pending >= 0:
                    _cover_tile(
                        pending, pending_x, pending_y, pending_inside > 0.0, pending_column, pending_row, lower,
                        enlargement, cell, band,
                    )  # fmt: skip
                pending = entry
                pending_x, pending_y, pending_inside = x, y, ti.select(inside, 1.0, 0.0)
                pending_column, pending_row = quad_column, quad_row
            tile += 1
            if tile == end_tile:
                tile = first_tile
                tile_row += 1


@cache
def _compile_ray(shape: str) -> Callable[..., Any]:
    """Return `Shape.build_ray` of a shape as a Taichi function."""
    return ti.func(SHAPES[shape].build_ray(KERNEL))


@ti.func
def intersect_instrument(x, y, index, uniforms: ti.template(), shapes: ti.template()):
    """Intersect lines of sight with an instrument; `shapes` are the names of the shapes of all instruments.

    Return the depth of the first intersection [m], INFINITY without one, and three components of the outward normal
    there, in the camera's frame and of any length.
    """
    base = uni.INSTRUMENTS + index * uni.INSTRUMENT_STRIDE
    tip, axis = base + uni.TIP, base + uni.AXIS
    # Relative to the tip, the line of sight is O + D t, with t the depth.
    start = uniforms[tip + 2] * (-1.0)
    across, up = geometry.line_of_sight(x, y, uniforms)
    w = geometry.w_at(start, uniforms)
    o_x, o_y = across * w - uniforms[tip], up * w - uniforms[tip + 1]
    d_x, d_y = across * uniforms[uni.PINHOLE], up * uniforms[uni.PINHOLE]
    a_x, a_y, a_z = triple(uniforms, axis)
    length, radius = uniforms[base + uni.LENGTH], uniforms[base + uni.RADIUS]
    # Scalar products of O, D and the axis A.
    d_d, d_a = d_x * d_x + d_y * d_y + 1.0, d_x * a_x + d_y * a_y - a_z
    o_a, o_d, o_o = o_x * a_x + o_y * a_y, o_x * d_x + o_y * d_y, o_x * o_x + o_y * o_y
    intersect_first = ti.static(_compile_ray(shapes[0]))
    t, is_hit, foot, end = intersect_first(d_d, d_a, o_a, o_d, o_o, length, radius)
    for shape in ti.static(shapes[1:]):
        if uniforms[base + uni.KIND] == ti.static(uni.KINDS[shape]):
            intersect = ti.static(_compile_ray(shape))
            t, is_hit, foot, end = intersect(d_d, d_a, o_a, o_d, o_o, length, radius)
    is_side = end == 0.0
    return (
        ti.select(is_hit, start + t, INFINITY),
        ti.select(is_side, o_x + d_x * t - a_x * foot, end * a_x * radius),
        ti.select(is_side, o_y + d_y * t - a_y * foot, end * a_y * radius),
        ti.select(is_side, t * (-1.0) - a_z * foot, end * a_z * radius),
    )


@ti.func
def _cover_tile_with_instrument(entry, x, y, index, band: ti.template()):
    plane, samples = ti.static((band.config.plane, band.samples))
    depth, n_x, n_y, n_z = intersect_instrument(x, y, index, band.uniforms, band.config.shapes)
    visible = (geometry.w_at(depth, band.uniforms) > band.near) & (depth < samples[entry + plane.depth])
    if ti.static(band.config.has_distortion):
        visible = visible & (x < INVALID_COORDINATE)
    store_visible(entry + plane.depth, visible, depth, samples)
    store_visible(entry + plane.instrument, visible, 255.0, samples)
    if ti.static(band.config.metal):
        store_visible(entry + plane.normal_x, visible, n_x, samples)
        store_visible(entry + plane.normal_y, visible, n_y, samples)
        store_visible(entry + plane.normal_z, visible, n_z, samples)
    if ti.static("normals" in band.config.labels):
        # In OpenCV's axes.
        store_visible_unit(entry + plane.facet_x, visible, [n_x, n_y * (-1.0), n_z * (-1.0)], samples)


@ti.func
def cover_instruments(band: ti.template()):
    """Cover a band with the instruments."""
    config, uniforms = ti.static((band.config, band.uniforms))
    for index in range(band.instrument_count):
        base = uni.INSTRUMENTS + index * uni.INSTRUMENT_STRIDE
        left, right = uniforms[base + uni.LEFT], uniforms[base + uni.RIGHT]
        top, bottom = uniforms[base + uni.TOP], uniforms[base + uni.BOTTOM]
        low_x, high_x, low_y, high_y = left, right, top, bottom
        if ti.static(config.has_distortion):
            # Tiles are selected below, by their undistorted boxes.
            low_x, high_x, low_y, high_y = band.left, band.right, band.top, band.bottom
        if low_y < band.bottom and high_y > band.top:
            clipped = clip(low_x, high_x, low_y, high_y, band)
            first_tile, end_tile, first_tile_row, end_tile_row = tile_range(clipped, band)
            for tile_row in range(first_tile_row, end_tile_row):
                for tile in range(first_tile, end_tile):
                    entry = band.first + (tile_row * band.tiles_across + tile) * config.planes
                    tile_x, tile_y = tile * config.tile_width, band.top + tile_row * config.tile_height
                    overlaps = True
                    if ti.static(config.has_distortion):
                        box = ti.static(tile_box(entry, tile_x, tile_y, band))
                        overlaps = box[0] <= right and box[1] >= left and box[2] <= bottom and box[3] >= top
                    if overlaps:
                        x, y = undistorted_centres(tile_x, tile_y, entry, band)
                        _cover_tile_with_instrument(entry, x, y, index, band)


@ti.func
def _cell_at(i, j, normal_entry, patch: ti.template(), band: ti.template()):
    """Return the `Cell` with a mass point as its upper left corner."""
    rows, cols = band.rows - 1, band.cols - 1
    texture_width, texture_height = band.sizes[uni.LEVELS + 1], band.sizes[uni.LEVELS + 2]
    # In f64, so that the fraction of a texel is accurate for any number of cells and texels.
    texel_x = ti.cast(j, ti.f64) * texture_width / cols - 0.5
    texel_y = ti.cast(i, ti.f64) * texture_height / rows - 0.5
    whole_x, whole_y = ti.floor(texel_x), ti.floor(texel_y)
    first_x, first_y = ti.cast(whole_x, ti.f32), ti.cast(whole_y, ti.f32)
    fraction_x, fraction_y = ti.cast(texel_x - whole_x, ti.f32), ti.cast(texel_y - whole_y, ti.f32)
    texels_across, texels_down = ti.cast(texture_width, ti.f32) / cols, ti.cast(texture_height, ti.f32) / rows
    row, column = ti.cast(i, ti.f32), ti.cast(j, ti.f32)
    cell_rows, cell_cols = ti.cast(rows, ti.f32), ti.cast(cols, ti.f32)
    source = geometry.picture_entry(i * band.cols + j, band)
    return ti.static(
        Cell(
            patch, row, column, cell_rows, cell_cols, first_x, first_y, fraction_x, fraction_y,
            texels_across, texels_down, normal_entry, source,
        )
    )  # fmt: skip


@ti.func
def _source_at(s, t, quad_column, quad_row, below, cell: ti.template(), band: ti.template()):
    """Return a and b of points on a triangle, interpolated from the cell's corners as positions are."""
    quad_side = 1.0 / band.subdivisions
    across, along = (quad_column + s) * quad_side, (quad_row + t) * quad_side
    # In the sub-quad, the product s t is replaced by a function that is linear on each side of the diagonal.
    twist = quad_column * quad_row + s * quad_row + quad_column * t + ti.select(below, s, t)
    twist = twist * (quad_side * quad_side)
    corners = ti.static(geometry.corner_entries(cell.source, band.cols, band.config.picture_stride))
    p, right, down, opposite = [triple(band.nodes, entry) for entry in corners]
    h = [
        p[n]
        + (right[n] - p[n]) * across
        + (down[n] - p[n]) * along
        + (opposite[n] - right[n] - (down[n] - p[n])) * twist
        for n in ti.static(range(3))
    ]
    # Behind the camera the texels are at the picture's edge.
    depth = ti.max(h[2], 1e-9)
    return h[0] / depth, h[1] / depth


@ti.func
def _neighbours(i, j, band: ti.template()):
    """Return the rows and columns of the neighbours of a mass point, its own where no cell lies between."""
    i0, i1 = ti.max(i - 1, 0), ti.min(i + 1, band.rows - 1)
    j0, j1 = ti.max(j - 1, 0), ti.min(j + 1, band.cols - 1)
    if ti.static(band.config.masked):
        # At the rectangle's edge, the cell on the other side stands for the missing one.
        cols = band.cols - 1
        above, below = ti.max(i - 1, 0) * cols, ti.min(i, band.rows - 2) * cols
        left, right = ti.max(j - 1, 0), ti.min(j, cols - 1)
        upper_left, upper_right = is_present(above + left, band.sizes), is_present(above + right, band.sizes)
        lower_left, lower_right = is_present(below + left, band.sizes), is_present(below + right, band.sizes)
        i0 = ti.select(upper_left or upper_right, i0, i)
        i1 = ti.select(lower_left or lower_right, i1, i)
        j0 = ti.select(upper_left or lower_left, j0, j)
        j1 = ti.select(upper_right or lower_right, j1, j)
    return i0, i1, j0, j1


@ti.func
def store_point(position: ti.template(), i, j, band: ti.template()):
    """Store the projection of a mass point; as configured, also its distorted position and its normal.

    Normals for tissue are in the camera's frame, those for the headlight in the world's.
    """
    config = ti.static(band.config)
    geometry.project(position, i, j, band.cols, band.uniforms, band.nodes, False)
    entry, normal_entry, distorted_entry = geometry.point_entries(i * band.cols + j, band)
    if ti.static(config.has_distortion):
        screen = entry + geometry.SCREEN
        x, y, is_valid = distorted_point(band.nodes[screen], band.nodes[screen + 1], band.uniforms, config.lens)
        band.nodes[distorted_entry], band.nodes[distorted_entry + 1] = x, y
        band.nodes[distorted_entry + 2] = ti.cast(is_valid and band.nodes[entry + 2] > band.near, ti.f32)
    if ti.static(config.headlit or config.tissue):
        i0, i1, j0, j1 = _neighbours(i, j, band)
        right = [position[i, j1, n] - position[i, j0, n] for n in ti.static(range(3))]
        up = [position[i0, j, n] - position[i1, j, n] for n in ti.static(range(3))]
        area = cross(right, up)
        length = ti.sqrt(dot(area, area))
        normal = [area[n] / ti.max(length, 1e-30) for n in ti.static(range(3))]
        for n in ti.static(range(3)):
            band.nodes[normal_entry + n] = normal[n]
            if ti.static(config.tissue):
                band.nodes[normal_entry + n] = dot(triple(band.uniforms, uni.AXES + 3 * n), normal)
    if ti.static(config.is_pictured):
        source_entry = geometry.picture_entry(i * band.cols + j, band)
        for n in ti.static(range(config.picture_stride)):
            band.nodes[source_entry + n] = position[i, j, 3 + n]


@ti.func
def _normal_at(across, along, cell: ti.template(), band: ti.template()):
    """Interpolate the normals of the mass points bilinearly; return normals of any length."""
    corners = ti.static(geometry.corner_entries(cell.normal, band.cols, geometry.NORMAL_STRIDE))
    a, b, c, d = [triple(band.nodes, entry) for entry in corners]
    return [
        a[n] + (b[n] - a[n]) * across + (c[n] - a[n] + (d[n] - b[n] - (c[n] - a[n])) * across) * along
        for n in ti.static(range(3))
    ]


@ti.func
def _absolute(values):
    """Return absolute values; `ti.abs` of a vector crashes."""
    return ti.max(values, values * (-1.0))


@ti.func
def _headlight(normal: ti.template(), uniforms: ti.template()):
    """Return the reflected share of the headlight: the absolute cosine between normal and direction to the light."""
    cosine = _absolute(dot(normal, triple(uniforms, uni.HEADLIGHT))) / ti.max(ti.sqrt(dot(normal, normal)), 1e-30)
    # Infinite or NaN mass points have NaN normals, which these limits replace.
    return ti.max(ti.min(cosine, 1.0), 0.0)


@ti.func
def _footprint(entry, x, y, s, t, texels_x, texels_y, triangle: ti.template(), band: ti.template()):
    """Return the squared size of samples on the texture, and 1 where the front of the triangle is visible, else -1.

    The size is the larger of width and height, in units of FULL_RESOLUTION_TEXELS. As x = X / w, the Jacobian of (x, y)
    with respect to (s, t) is (R_1, D_1; R_2, D_2) / w, with R_1 = R_x - x R_w and so on. Its inverse maps a sample to
    the triangle; `texels_x` and `texels_y`, the sides of the sub-quad [texels], scale the triangle to the texture.
    """
    p, r, d = ti.static((triangle.p, triangle.r, triangle.d))
    r_1 = r[0] - x * r[2]
    d_1 = d[0] - x * d[2]
    r_2 = r[1] - y * r[2]
    d_2 = d[1] - y * d[2]
    # The same expression as in `on_triangle`, which the compiler computes once.
    inverse_determinant = 1.0 / (r_1 * d_2 - r_2 * d_1)
    scale = (p[2] + r[2] * s + d[2] * t) * inverse_determinant
    if ti.static(band.config.map_has_steps):
        map_step = map_steps(entry, band)
        d_2, d_1 = d_2 * map_step[0] - d_1 * map_step[1], d_1 * map_step[3] - d_2 * map_step[2]
        r_2, r_1 = r_2 * map_step[0] - r_1 * map_step[1], r_1 * map_step[3] - r_2 * map_step[2]
    across_1, across_2, down_1, down_2 = d_1 * texels_x, d_2 * texels_x, r_1 * texels_y, r_2 * texels_y
    largest = ti.max(across_1 * across_1 + down_1 * down_1, across_2 * across_2 + down_2 * down_2)
    square = largest * (scale * scale) * (1.0 / (uni.FULL_RESOLUTION_TEXELS * uni.FULL_RESOLUTION_TEXELS))
    # 1e12 exceeds the squared size on any texture.
    return ti.min(square, 1e12), ti.select(scale < 0.0, -1.0, 1.0)


@ti.func
def _next_samples(entry, x, y, triangle: ti.template(), band: ti.template()):
    """Return s and t on a triangle of the next samples on the right, then of those below."""
    right_x, right_y, below_x, below_y = x + 1.0, y, x, y + 1.0
    if ti.static(band.config.map_has_steps):
        map_step = map_steps(entry, band)
        right_x, right_y, below_x, below_y = x + map_step[0], y + map_step[1], x + map_step[2], y + map_step[3]
    s_right, t_right = geometry.on_triangle(right_x, right_y, triangle)
    s_below, t_below = geometry.on_triangle(below_x, below_y, triangle)
    return s_right, t_right, s_below, t_below


@ti.func
def _distance_to_line(coordinate, right_coordinate, lower_coordinate):
    """Return the distance of samples from the nearest mesh line of one direction [samples].

    `coordinate` is that of the samples across the lines [cells]; the others are those of the next samples on the right
    and below.
    """
    step_right, step_down = right_coordinate - coordinate, lower_coordinate - coordinate
    slope = ti.sqrt(step_right * step_right + step_down * step_down)
    return _absolute(coordinate - ti.round(coordinate)) / ti.max(slope, 1e-12)


@ti.func
def _store_surface(
    entry, visible, x, y, s, t, quad_column, quad_row,
    triangle: ti.template(), cell: ti.template(), band: ti.template(),
):  # fmt: skip
    """Store the attributes of the visible samples of a tile."""
    config, samples = ti.static((band.config, band.samples))
    plane = ti.static(config.plane)
    quad_side = 1.0 / band.subdivisions
    across = (quad_column + s) * quad_side
    along = (quad_row + t) * quad_side
    texel_x = cell.fraction_x + across * cell.texels_across + cell.texel_x
    texel_y = cell.fraction_y + along * cell.texels_down + cell.texel_y
    if ti.static(config.is_pictured):
        # Until `shading.locate_texels`.
        texel_x, texel_y = _source_at(s, t, quad_column, quad_row, triangle.below, cell, band)
    store_visible(entry + plane.texel_x, visible, texel_x, samples)
    store_visible(entry + plane.texel_y, visible, texel_y, samples)
    if ti.static("coordinates" in config.labels and not config.is_pictured):
        store_visible(entry + plane.across, visible, (cell.j + across) / cell.cols, samples)
        store_visible(entry + plane.down, visible, (cell.i + along) / cell.rows, samples)
    if ti.static("mesh" in config.labels):
        store_visible(entry + plane.mesh_across, visible, (cell.j + across) / cell.cols, samples)
        store_visible(entry + plane.mesh_down, visible, (cell.i + along) / cell.rows, samples)
    if ti.static("normals" in config.labels):
        store_visible_unit(entry + plane.facet_x, visible, geometry.facet(x, y, triangle, band.uniforms), samples)
    if ti.static(config.headlit):
        normal = _normal_at(across, along, cell, band)
        store_visible(entry + plane.light, visible, _headlight(normal, band.uniforms), samples)
    if ti.static(config.tissue):
        texels_x, texels_y = cell.texels_across * quad_side, cell.texels_down * quad_side
        size, side = _footprint(entry, x, y, s, t, texels_x, texels_y, triangle, band)
        # At a fold the interpolated normal may point away from the camera; `side` flips it.
        normal = _normal_at(across, along, cell, band)
        for n in ti.static(range(3)):
            store_visible(entry + (plane.normal_x + n), visible, normal[n] * side, samples)
        store_visible(entry + plane.footprint, visible, size, samples)
    if ti.static(config.tissue and config.is_pictured):
        s_right, t_right, s_below, t_below = _next_samples(entry, x, y, triangle, band)
        texel_x, texel_y = _source_at(s_right, t_right, quad_column, quad_row, triangle.below, cell, band)
        store_visible(entry + plane.right_x, visible, texel_x, samples)
        store_visible(entry + plane.right_y, visible, texel_y, samples)
        texel_x, texel_y = _source_at(s_below, t_below, quad_column, quad_row, triangle.below, cell, band)
        store_visible(entry + plane.below_x, visible, texel_x, samples)
        store_visible(entry + plane.below_y, visible, texel_y, samples)
    if ti.static(config.wireframe):
        s_right, t_right, s_below, t_below = _next_samples(entry, x, y, triangle, band)
        distance = ti.min(
            _distance_to_line(across, (quad_column + s_right) * quad_side, (quad_column + s_below) * quad_side),
            _distance_to_line(along, (quad_row + t_right) * quad_side, (quad_row + t_below) * quad_side),
        )
        half_width = uni.WIRE_WIDTH / 2 * config.supersample + 0.5
        opacity = uni.WIRE_OPACITY * ti.max(ti.min(half_width - distance, 1.0), 0.0)
        store_visible(entry + plane.wire, visible, opacity, samples)
