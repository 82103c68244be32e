"""What every sample of the picture shows: the nearest point of the surface, and where on the sheet it is.

Vertices are not stored. For a sample inside the outline of a cell, the two equations of patch.py give the small quad;
the side of the quad's diagonal that the sample is on gives the triangle; and the two linear equations of the triangle
give the place on it. A cell that is folded or reaches behind the camera is drawn triangle by triangle instead.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.render import style
from taichi_msm.render.numbers import AXES
from taichi_msm.render.patch import Plane, edge, on_triangle, seen_side, small_quad
from taichi_msm.render.samples import DEPTH, INFINITY, TEXEL_X, TEXEL_Y, Code
from taichi_msm.system.runtime import ti

# A triangle that is drawn by itself is enlarged a little, so that no gap is left beside it: by this fraction of its
# side, and by this fraction of the picture's, which is what f32 resolves.
OVERSTEP = 1e-5
OVERSTEP_OF_PICTURE = 2e-6

# A cell is drawn as a whole only if its outline stays within this distance, at which f32 still resolves it [samples].
FARTHEST = float(1 << 16)

# The numbers of a mass point: (X, Y, w, depth), its place in the picture [samples], its unit normal.
SEEN, NORMAL, POINT_NUMBERS = 4, 6, 9

# A footprint of this size covers any texture [texels squared].
LARGEST_FOOTPRINT = 1e12

vec4 = ti.types.vector(4, ti.f32)


class Surface(NamedTuple):
    """What is drawn.

    Attributes:
        point: the POINT_NUMBERS of every mass point.
        rows, cols: mass points.
        parts: small quads along a side of a cell.
        texture_width, texture_height: of the texture [texels].
    """

    point: Any
    rows: Any
    cols: Any
    parts: Any
    texture_width: Any
    texture_height: Any


class Band(NamedTuple):
    """A band of the picture, or a part of one, and the view.

    Attributes:
        samples: the planes of all tiles that are kept.
        first: entry of `samples` where the band begins, from the left edge of the picture.
        across: tiles in a row.
        left, right: first column of samples, and the column after the last.
        top, bottom: first row of samples, and the row after the last.
        width, height: of the picture [samples].
        near: only what is farther than this is drawn.
        numbers: as `view_numbers` makes them.
    """

    samples: Any
    first: Any
    across: Any
    left: Any
    right: Any
    top: Any
    bottom: Any
    width: Any
    height: Any
    near: Any
    numbers: Any


class Part(NamedTuple):
    """A part of a cell, for a thread of a GPU.

    Attributes:
        whole: whether the cell is drawn as a whole; then the part is all of it.
        first, end: else, its first triangle, and that after its last.
    """

    whole: Any
    first: Any
    end: Any


class Cell(NamedTuple):
    """The surface between four mass points: P = A + B s + C t + D s t.

    Attributes:
        a, b, c, d: coefficients, each (X, Y, w, depth).
        whole: whether it is drawn as a whole, and not triangle by triangle.
        side: 1 where its front is seen, -1 where its back is, 0 if it is folded.
        corner: entry of its upper left mass point.
        texel_x, texel_y: whole texels to that point.
        rest_x, rest_y: the fraction of a texel that remains.
        step_x, step_y: texels of the cell.
        i, j: its row and column.
        cells_down, cells_across: cells of the sheet.
    """

    a: Any
    b: Any
    c: Any
    d: Any
    whole: Any
    side: Any
    corner: Any
    texel_x: Any
    texel_y: Any
    rest_x: Any
    rest_y: Any
    step_x: Any
    step_y: Any
    i: Any
    j: Any
    cells_down: Any
    cells_across: Any


@ti.func
def corners(corner, cols, point: ti.template()):
    """Give (X, Y, w, depth) of a cell's mass points: upper left and right, lower left and right."""
    below = corner + cols * POINT_NUMBERS
    return (
        vec4([point[corner + n] for n in ti.static(range(4))]),
        vec4([point[corner + POINT_NUMBERS + n] for n in ti.static(range(4))]),
        vec4([point[below + n] for n in ti.static(range(4))]),
        vec4([point[below + POINT_NUMBERS + n] for n in ti.static(range(4))]),
    )


@ti.func
def triangle_bounds(
    quad_s, quad_t, lower, part, near, width, height,
    a: ti.template(), b: ti.template(), c: ti.template(), d: ti.template(),
):  # fmt: skip
    """Find the bounds of a small triangle in the picture.

    Args:
        quad_s: column of its small quad in the cell.
        quad_t: its line.
        lower: whether it is the one below the diagonal.
        part: side of a small quad, as a fraction of the cell's.
        near: only what is farther than this is drawn.
        width: of the picture [samples].
        height: likewise.
        a: coefficient A of the cell.
        b: likewise B.
        c: likewise C.
        d: likewise D.

    Returns:
        Least and largest x, least and largest y; and by what fraction of its side it is enlarged.
    """
    low_x, high_x, low_y, high_y = 0.0, ti.cast(width, ti.f32), -INFINITY, INFINITY
    overstep = OVERSTEP
    s0, t0 = quad_s * part, quad_t * part
    s1, t1 = (quad_s + 1) * part, (quad_t + 1) * part
    one = a + b * s0 + (c + d * s0) * t0
    two = a + b * s1 + (c + d * s1) * t1
    three = a + b * s0 + (c + d * s0) * t1
    if not lower:
        three = a + b * s1 + (c + d * s1) * t0
    if one[2] > near and two[2] > near and three[2] > near:
        low_x = ti.min(one[0] / one[2], two[0] / two[2], three[0] / three[2])
        high_x = ti.max(one[0] / one[2], two[0] / two[2], three[0] / three[2])
        low_y = ti.min(one[1] / one[2], two[1] / two[2], three[1] / three[2])
        high_y = ti.max(one[1] / one[2], two[1] / two[2], three[1] / three[2])
        extent = ti.max(high_x - low_x, high_y - low_y, 1e-3)
        overstep += OVERSTEP_OF_PICTURE * (width + height) / extent
    elif one[2] <= near and two[2] <= near and three[2] <= near:
        high_x = -1.0
    return low_x, high_x, low_y, high_y, overstep


@cache
def covering(code: Code) -> Callable[..., Any]:
    """Make Taichi's function that covers the samples of a band with one cell.

    Args:
        code: what it is compiled for.
    """
    lanes, floats, planes = code.lanes, code.floats, code.planes
    columns = [lane % code.tile_width + 0.5 for lane in range(lanes)]
    lines = [lane // code.tile_width + 0.5 for lane in range(lanes)]

    @ti.func
    def absolute(values):
        return ti.max(values, values * (-1.0))

    @ti.func
    def largest_edge(p_x, p_y, q_x, q_y, x, y, side):
        """The largest `edge` of the samples of a tile whose upper left sample is at (x, y).

        It is rounded as `edge` is, so that no tile with a sample inside is left out.
        """
        x += ti.select((q_y - p_y) * side > 0.0, 0.0, code.tile_width - 1.0)
        y += ti.select((q_x - p_x) * side > 0.0, code.tile_height - 1.0, 0.0)
        return edge(p_x, p_y, q_x, q_y, x, y, side)

    @ti.func
    def normal_at(surface: ti.template(), cell: ti.template(), across, along):
        """Interpolate the normals of the mass points; the result is not normalised."""
        normal = [floats(0) for _ in ti.static(range(3))]
        corner = cell.corner + NORMAL
        below = corner + surface.cols * POINT_NUMBERS
        for n in ti.static(range(3)):
            n_a, n_b = surface.point[corner + n], surface.point[corner + POINT_NUMBERS + n]
            n_c, n_d = surface.point[below + n], surface.point[below + POINT_NUMBERS + n]
            normal[n] = n_a + (n_b - n_a) * across + (n_c - n_a + (n_d - n_b - (n_c - n_a)) * across) * along
        return normal[0], normal[1], normal[2]

    @ti.func
    def light(surface: ti.template(), cell: ti.template(), numbers: ti.template(), across, along):
        """Share of the headlight that is reflected: the cosine between the normal and the direction to the light."""
        n_x, n_y, n_z = normal_at(surface, cell, across, along)
        length = ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
        toward = AXES + 6
        cosine = absolute(n_x * numbers[toward] + n_y * numbers[toward + 1] + n_z * numbers[toward + 2])
        cosine = cosine / ti.max(length, 1e-30)
        # Where a point is infinite or NaN, so is its normal.
        return ti.max(ti.min(cosine, 1.0), 0.0)

    @ti.func
    def footprint(x, y, s, t, texels_x, texels_y, plane: ti.template()):
        """Square of the larger of a sample's width and height on the texture, in units of style.SHARP texels.

        With x = X / w the derivatives of (x, y) with respect to (s, t) are (R_1, D_1; R_2, D_2) / w, where
        R_1 = R_x - x R_w and so on; those of (s, t) with respect to (x, y) are the inverse.

        Returns:
            The square; and 1 where the front of the triangle is seen, else -1.
        """
        r_1 = plane.r_x - x * plane.r_w
        d_1 = plane.d_x - x * plane.d_w
        r_2 = plane.r_y - y * plane.r_w
        d_2 = plane.d_y - y * plane.d_w
        # Written as in `on_triangle`, so that the compiler computes it once.
        share = 1.0 / (r_1 * d_2 - r_2 * d_1)
        scale = (plane.p_w + plane.r_w * s + plane.d_w * t) * share
        across_1, across_2, down_1, down_2 = d_1 * texels_x, d_2 * texels_x, r_1 * texels_y, r_2 * texels_y
        largest = ti.max(across_1 * across_1 + down_1 * down_1, across_2 * across_2 + down_2 * down_2)
        square = largest * (scale * scale) * (1.0 / (style.SHARP * style.SHARP))
        return ti.min(square, LARGEST_FOOTPRINT), ti.select(scale < 0.0, floats(-1.0), floats(1.0))

    @ti.func
    def wire_share(across, down, right_across, right_down, below_across, below_down):
        """Share of the mesh lines in a sample's colour, from its place on the mesh and those of its neighbours.

        See `tests/reference/drawing.py`.
        """
        to_right, to_below = right_across - across, below_across - across
        slope = ti.sqrt(to_right * to_right + to_below * to_below)
        distance = absolute(across - ti.round(across)) / ti.max(slope, 1e-12)
        to_right, to_below = right_down - down, below_down - down
        slope = ti.sqrt(to_right * to_right + to_below * to_below)
        distance = ti.min(distance, absolute(down - ti.round(down)) / ti.max(slope, 1e-12))
        reach = style.WIRE_WIDTH / 2 * code.supersample + 0.5
        return style.WIRE_OPACITY * ti.max(ti.min(reach - distance, 1.0), 0.0)

    @ti.func
    def keep(at, visible, value, samples: ti.template()):
        samples[at] = ti.select(visible, value, samples[at])

    @ti.func
    def cover_tile(
        at, x, y, inside, column, line, lower, overstep,
        cell: ti.template(), surface: ti.template(), band: ti.template(),
    ):  # fmt: skip
        """Cover a tile of samples with the small quads (column, line) of a cell."""
        # The small quad: P = A + B s + C t + D s t again.
        a, b, c, d = ti.static((cell.a, cell.b, cell.c, cell.d))
        part = 1.0 / surface.parts
        s0 = column * part
        t0 = line * part
        p_x = a[0] + b[0] * s0 + (c[0] + d[0] * s0) * t0
        p_y = a[1] + b[1] * s0 + (c[1] + d[1] * s0) * t0
        p_w = a[2] + b[2] * s0 + (c[2] + d[2] * s0) * t0
        p_z = a[3] + b[3] * s0 + (c[3] + d[3] * s0) * t0
        r_x = (b[0] + d[0] * t0) * part
        r_y = (b[1] + d[1] * t0) * part
        r_w = (b[2] + d[2] * t0) * part
        r_z = (b[3] + d[3] * t0) * part
        d_x = (c[0] + d[0] * s0) * part
        d_y = (c[1] + d[1] * s0) * part
        d_w = (c[2] + d[2] * s0) * part
        d_z = (c[3] + d[3] * s0) * part
        twist = d * (part * part)
        # Its triangles share the diagonal from P to F; the lower one has t > s.
        f_w = p_w + r_w + d_w + twist[2]
        below = (
            (p_x - x * p_w) * (p_y + r_y + d_y + twist[1] - y * f_w)
            - (p_y - y * p_w) * (p_x + r_x + d_x + twist[0] - x * f_w)
        ) * cell.side >= 0.0
        if not cell.whole:
            below = floats(ti.cast(lower, ti.f32)) > 0.5
        r_x = ti.select(below, r_x + twist[0], r_x)
        r_y = ti.select(below, r_y + twist[1], r_y)
        r_w = ti.select(below, r_w + twist[2], r_w)
        r_z = ti.select(below, r_z + twist[3], r_z)
        d_x = ti.select(below, d_x, d_x + twist[0])
        d_y = ti.select(below, d_y, d_y + twist[1])
        d_w = ti.select(below, d_w, d_w + twist[2])
        d_z = ti.select(below, d_z, d_z + twist[3])
        plane = ti.static(Plane(p_x, p_y, p_w, r_x, r_y, r_w, d_x, d_y, d_w))
        s, t = on_triangle(x, y, plane)
        if not cell.whole:
            upper_limit = ti.select(below, t, s)
            lower_limit = ti.select(below, s, t)
            inside = (
                inside
                & (lower_limit >= -overstep)
                & (upper_limit <= 1.0 + overstep)
                & (lower_limit <= upper_limit + overstep)
                & (p_w + r_w * s + d_w * t > band.near)
            )
        z = p_z + r_z * s + d_z * t
        visible = inside & (z < band.samples[at + DEPTH])
        if ti.static(code.unordered):
            # Of points that are equally far, that of the cell or triangle is seen which comes first.
            number = cell.i * cell.cells_across + cell.j
            triangle = (line * surface.parts + column) * 2.0 + ti.select(below, 0.0, 1.0)
            at_cell, at_triangle = at + ti.static(code.layout["cell"]), at + ti.static(code.layout["triangle"])
            kept, kept_triangle = band.samples[at_cell], band.samples[at_triangle]
            before = (number < kept) | ((number == kept) & (triangle < kept_triangle))
            visible = visible | (inside & (z == band.samples[at + DEPTH]) & before)
            keep(at_cell, visible, number, band.samples)
            keep(at_triangle, visible, triangle, band.samples)
        across = (column + s) * part
        along = (line + t) * part
        keep(at + DEPTH, visible, z, band.samples)
        keep(at + TEXEL_X, visible, cell.rest_x + across * cell.step_x + cell.texel_x, band.samples)
        keep(at + TEXEL_Y, visible, cell.rest_y + along * cell.step_y + cell.texel_y, band.samples)
        if ti.static(code.labels):
            keep(at + code.layout["across"], visible, (cell.j + across) / cell.cells_across, band.samples)
            keep(at + code.layout["down"], visible, (cell.i + along) / cell.cells_down, band.samples)
        if ti.static(code.headlit):
            keep(at + code.layout["light"], visible, light(surface, cell, band.numbers, across, along), band.samples)
        if ti.static(code.tissue):
            size, front = footprint(x, y, s, t, cell.step_x * part, cell.step_y * part, plane)
            # On the side that is seen of the triangle: at a fold, the interpolated normal may lean the other way.
            n_x, n_y, n_z = normal_at(surface, cell, across, along)
            keep(at + code.layout["normal_x"], visible, n_x * front, band.samples)
            keep(at + code.layout["normal_y"], visible, n_y * front, band.samples)
            keep(at + code.layout["normal_z"], visible, n_z * front, band.samples)
            keep(at + code.layout["footprint"], visible, size, band.samples)
        if ti.static(code.wires):
            s_right, t_right = on_triangle(x + 1.0, y, plane)
            s_below, t_below = on_triangle(x, y + 1.0, plane)
            wire = wire_share(
                across, along,
                (column + s_right) * part, (line + t_right) * part,
                (column + s_below) * part, (line + t_below) * part,
            )  # fmt: skip
            keep(at + code.layout["wire"], visible, wire, band.samples)

    @ti.func
    def cover(i, j, drawn: ti.template(), surface: ti.template(), band: ti.template()):
        """Cover the samples of a band with the cell to the right and below of mass point (i, j).

        Args:
            i: row of the mass point.
            j: its column.
            drawn: the part of the cell that is drawn, where cells are unordered.
            surface: the surface.
            band: the band.
        """
        point, near = ti.static((surface.point, band.near))
        corner = (i * surface.cols + j) * POINT_NUMBERS
        corner_b, corner_c = corner + POINT_NUMBERS, corner + surface.cols * POINT_NUMBERS
        corner_d = corner_c + POINT_NUMBERS
        a_x, a_y = point[corner + SEEN], point[corner + SEEN + 1]
        b_x, b_y = point[corner_b + SEEN], point[corner_b + SEEN + 1]
        c_x, c_y = point[corner_c + SEEN], point[corner_c + SEEN + 1]
        d_x, d_y = point[corner_d + SEEN], point[corner_d + SEEN + 1]
        a, right, down, far = corners(corner, surface.cols, point)
        b = right - a
        c = down - a
        d = far - right - c
        before = a[2] > near and right[2] > near and down[2] > near and far[2] > near
        side = seen_side(a_x, a_y, b_x, b_y, c_x, c_y, d_x, d_y)
        left_end, right_end = ti.min(a_x, b_x, c_x, d_x), ti.max(a_x, b_x, c_x, d_x)
        upper_end, lower_end = ti.min(a_y, b_y, c_y, d_y), ti.max(a_y, b_y, c_y, d_y)
        whole = (
            before
            and side != 0
            and ti.max(-left_end, right_end) < FARTHEST
            and ti.max(-upper_end, lower_end) < FARTHEST
        )
        if ti.static(code.unordered):
            whole = drawn.whole
        # The cell's place on the texture in texels; in f64, so that it is exact to a fraction of one on any sheet.
        texel_x = ti.cast(j, ti.f64) * surface.texture_width / (surface.cols - 1) - 0.5
        texel_y = ti.cast(i, ti.f64) * surface.texture_height / (surface.rows - 1) - 0.5
        whole_x, whole_y = ti.floor(texel_x), ti.floor(texel_y)
        first_x, first_y = ti.cast(whole_x, ti.f32), ti.cast(whole_y, ti.f32)
        rest_x, rest_y = ti.cast(texel_x - whole_x, ti.f32), ti.cast(texel_y - whole_y, ti.f32)
        step_x = ti.cast(surface.texture_width, ti.f32) / (surface.cols - 1)
        step_y = ti.cast(surface.texture_height, ti.f32) / (surface.rows - 1)
        cells_down, cells_across = ti.cast(surface.rows - 1, ti.f32), ti.cast(surface.cols - 1, ti.f32)
        cell_i, cell_j = ti.cast(i, ti.f32), ti.cast(j, ti.f32)
        cell = ti.static(
            Cell(
                a, b, c, d, whole, side, corner, first_x, first_y, rest_x, rest_y, step_x, step_y,
                cell_i, cell_j, cells_down, cells_across,
            )
        )  # fmt: skip
        count = ti.cast(surface.parts, ti.i32)
        part = 1.0 / surface.parts

        first, end = 0, ti.select(whole, 1, 2 * count * count)
        if ti.static(code.unordered):
            first, end = drawn.first, drawn.end
        for piece in range(first, end):
            # For a triangle that is drawn by itself: its quad, and whether it is below the diagonal.
            quad = piece // 2
            quad_s = ti.cast(quad % count, ti.f32)
            quad_t = ti.cast(quad // count, ti.f32)
            lower = piece % 2 == 0
            low_x, high_x, low_y, high_y, overstep = left_end, right_end, upper_end, lower_end, OVERSTEP
            if not whole:
                low_x, high_x, low_y, high_y, overstep = triangle_bounds(
                    quad_s, quad_t, lower, part, near, band.width, band.height, a, b, c, d
                )
            first_row = ti.cast(ti.math.clamp(ti.floor(low_y - 0.5), band.top, band.bottom), ti.i32)
            end_row = ti.cast(ti.math.clamp(ti.ceil(high_y + 0.5), band.top, band.bottom), ti.i32)
            first_column = ti.cast(ti.math.clamp(ti.floor(low_x - 0.5), band.left, band.right), ti.i32)
            end_column = ti.cast(ti.math.clamp(ti.ceil(high_x + 0.5), band.left, band.right), ti.i32)
            first_line = (first_row - band.top) // code.tile_height
            end_line = (end_row - band.top + (code.tile_height - 1)) // code.tile_height
            first_tile = first_column // code.tile_width
            end_tile = (end_column + (code.tile_width - 1)) // code.tile_width
            tiles = ti.max(end_line - first_line, 0) * ti.max(end_tile - first_tile, 0)
            tile, tile_line = first_tile, first_line
            # A tile is covered after the small quads of the next one are found: neither needs the other, so the
            # processor works on both at once. `held` is the entry of the tile that waits to be covered; -1: none does.
            held = -1
            held_x, held_y, held_inside = floats(0), floats(0), floats(0)
            held_column, held_line = floats(0), floats(0)
            for n in range(tiles + 1):
                tile_x = ti.cast(tile * code.tile_width, ti.f32)
                tile_y = ti.cast(band.top + tile_line * code.tile_height, ti.f32)
                x = floats(columns) + tile_x
                y = floats(lines) + tile_y
                inside = floats(1) > 0.0
                column, line = floats(quad_s), floats(quad_t)
                # The last round only covers the tile that still waits.
                reached = True
                if n < tiles:
                    if whole:
                        upper_x, upper_y = tile_x + 0.5, tile_y + 0.5
                        reached = (
                            largest_edge(a_x, a_y, c_x, c_y, upper_x, upper_y, -side) >= 0.0
                            and largest_edge(b_x, b_y, d_x, d_y, upper_x, upper_y, side) > 0.0
                            and largest_edge(a_x, a_y, b_x, b_y, upper_x, upper_y, side) >= 0.0
                            and largest_edge(c_x, c_y, d_x, d_y, upper_x, upper_y, -side) > 0.0
                        )
                        if reached:
                            # Left and upper edges belong to a cell, right and lower ones do not.
                            inside = (
                                (edge(a_x, a_y, c_x, c_y, x, y, -side) >= 0.0)
                                & (edge(b_x, b_y, d_x, d_y, x, y, side) > 0.0)
                                & (edge(a_x, a_y, b_x, b_y, x, y, side) >= 0.0)
                                & (edge(c_x, c_y, d_x, d_y, x, y, -side) > 0.0)
                            )
                            if ti.static(code.refined):
                                column, line = small_quad(
                                    x, y, inside, surface.parts, cell.side, cell.a, cell.b, cell.c, cell.d
                                )
                    else:
                        # Outside its bounds rounding would decide, in samples that depend on the tiles' shape.
                        inside = (
                            (x > ti.cast(first_column, ti.f32))
                            & (x < ti.cast(end_column, ti.f32))
                            & (y > ti.cast(first_row, ti.f32))
                            & (y < ti.cast(end_row, ti.f32))
                        )
                if reached:
                    if held >= 0:
                        cover_tile(
                            held, held_x, held_y, held_inside > 0.0, held_column, held_line,
                            lower, overstep, cell, surface, band,
                        )  # fmt: skip
                    held = band.first + (tile_line * band.across + tile) * planes
                    held_x, held_y, held_inside = x, y, ti.select(inside, 1.0, 0.0)
                    held_column, held_line = column, line
                tile += 1
                if tile == end_tile:
                    tile = first_tile
                    tile_line += 1

    return cover
