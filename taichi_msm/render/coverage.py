"""What every sample of the picture shows: the nearest point of the surface, and where on the sheet it is.

Vertices are not stored. For a sample inside the outline of a cell, the two equations of geometry.py give the small
quad; the side of the quad's diagonal that the sample is on gives the triangle; and the two linear equations of the
triangle give the place on it. A cell that is folded or reaches behind the camera is drawn triangle by triangle instead.
"""

from typing import Any, NamedTuple

from taichi_msm.render import geometry
from taichi_msm.render.attributes import cell_at, store
from taichi_msm.render.bending import BENT_NUMBERS
from taichi_msm.render.places import BEYOND
from taichi_msm.render.samples import box_of, centres, clip, keep, places, places_of, tiles_of
from taichi_msm.system.runtime import ti


class Part(NamedTuple):
    """A part of a cell, for a thread of a GPU."""

    whole: Any  # whether the cell is drawn as a whole; then the part is all of it
    first: Any  # else, its first triangle
    end: Any  # and that after its last


@ti.func
def largest_edge(p_x, p_y, q_x, q_y, box: ti.template(), side):
    """The largest `edge` of samples within a box, its left, right, top and bottom.

    It is rounded as `edge` is, so that no tile with a sample inside is left out.
    """
    left, right, top, bottom = ti.static(box)
    x = ti.select((q_y - p_y) * side > 0.0, left, right)
    y = ti.select((q_x - p_x) * side > 0.0, bottom, top)
    return geometry.edge(p_x, p_y, q_x, q_y, x, y, side)


@ti.func
def reaches(box: ti.template(), side, outline: ti.template()):
    """Tell whether a cell may cover samples within a box."""
    p, q = ti.static((outline.x, outline.y))
    return (
        largest_edge(p[0], q[0], p[2], q[2], box, -side) >= 0.0
        and largest_edge(p[1], q[1], p[3], q[3], box, side) > 0.0
        and largest_edge(p[0], q[0], p[1], q[1], box, side) >= 0.0
        and largest_edge(p[2], q[2], p[3], q[3], box, -side) > 0.0
    )


@ti.func
def cover_tile(
    at, x, y, inside, column, line, lower, overstep,
    cell: ti.template(), sheet: ti.template(), band: ti.template(),
):  # fmt: skip
    """Cover a tile of samples with the small quads (column, line) of a cell.

    The cell covers those `inside`. If it is drawn triangle by triangle, this is the `lower` or upper one, enlarged by
    the fraction `overstep` of its side.
    """
    config = ti.static(band.config)
    plane = ti.static(config.plane)
    below_diagonal = config.floats(ti.cast(lower, ti.f32)) > 0.5
    triangle = ti.static(geometry.triangle_at(x, y, column, line, 1.0 / sheet.parts, below_diagonal, cell.patch))
    s, t = geometry.on_triangle(x, y, triangle)
    if not cell.patch.whole:
        inside = inside & geometry.is_within(s, t, overstep, band.near, triangle)
    z = geometry.depth_at(s, t, triangle)
    visible = inside & (z < band.samples[at + plane.depth])
    if ti.static(config.unordered):
        # Of points that are equally far, that of the cell or triangle is seen which comes first.
        number = cell.i * cell.across + cell.j
        piece = (line * sheet.parts + column) * 2.0 + ti.select(triangle.below, 0.0, 1.0)
        kept, kept_piece = band.samples[at + plane.cell], band.samples[at + plane.triangle]
        before = (number < kept) | ((number == kept) & (piece < kept_piece))
        visible = visible | (inside & (z == band.samples[at + plane.depth]) & before)
        keep(at + plane.cell, visible, number, band.samples)
        keep(at + plane.triangle, visible, piece, band.samples)
    keep(at + plane.depth, visible, z, band.samples)
    store(at, visible, x, y, s, t, column, line, triangle, cell, sheet, band)


@ti.func
def cover(i, j, drawn: ti.template(), sheet: ti.template(), band: ti.template()):
    """Cover the samples of a band with the cell to the right and below of mass point (i, j).

    Where cells are unordered, `drawn` is the part of it that is drawn.
    """
    config, floats = ti.static((band.config, band.config.floats))
    corner = (i * sheet.cols + j) * geometry.POINT_NUMBERS
    outline = ti.static(geometry.outlined(corner, sheet.cols, band.near, sheet.point))
    whole = geometry.is_whole(outline)
    if ti.static(config.unordered):
        whole = drawn.whole
    patch = ti.static(geometry.patch_of(corner, sheet.cols, outline.side, whole, sheet.point, False))
    cell = ti.static(cell_at(i, j, patch, sheet))
    count = ti.cast(sheet.parts, ti.i32)
    first, end = 0, ti.select(whole, 1, 2 * count * count)
    if ti.static(config.unordered):
        first, end = drawn.first, drawn.end
    for piece in range(first, end):
        # For a triangle that is drawn by itself: its quad, and whether it is below the diagonal.
        quad = piece // 2
        quad_s = ti.cast(quad % count, ti.f32)
        quad_t = ti.cast(quad // count, ti.f32)
        lower = piece % 2 == 0
        low_x, high_x, low_y, high_y = outline.left, outline.right, outline.top, outline.bottom
        overstep = geometry.OVERSTEP
        if not whole:
            low_x, high_x, low_y, high_y, overstep = geometry.triangle_bounds(
                quad_s, quad_t, lower, 1.0 / sheet.parts, band.near, band.width, band.height,
                patch, band.numbers, config.lens,
            )  # fmt: skip
        elif ti.static(config.bends):
            bent = sheet.bent + (i * sheet.cols + j) * BENT_NUMBERS
            low_x, high_x, low_y, high_y = geometry.cell_bounds(bent, sheet.cols, outline, band.numbers, sheet.point)
        first_column, end_column, first_row, end_row = clip(low_x - 0.5, high_x + 0.5, low_y - 0.5, high_y + 0.5, band)
        first_tile, end_tile, first_line, end_line = tiles_of(first_column, end_column, first_row, end_row, band)
        tiles = ti.max(end_line - first_line, 0) * ti.max(end_tile - first_tile, 0)
        tile, tile_line = first_tile, first_line
        # A tile is covered after the small quads of the next one are found: neither needs the other, so the
        # processor works on both at once. `held` is the entry of the tile that waits to be covered; -1: none does.
        held = -1
        held_x, held_y, held_inside = floats(0), floats(0), floats(0)
        held_column, held_line = floats(0), floats(0)
        for n in range(tiles + 1):
            tile_x = ti.cast(tile * config.tile_width, ti.f32)
            tile_y = ti.cast(band.top + tile_line * config.tile_height, ti.f32)
            at = band.first + (tile_line * band.across + tile) * config.planes
            x, y = centres(tile_x, tile_y, config)
            inside = floats(1) > 0.0
            column, line = floats(quad_s), floats(quad_t)
            # The last round only covers the tile that still waits.
            reached = True
            if n < tiles:
                if ti.static(config.bends):
                    x, y = places(tile_x, tile_y, places_of(at, band), band.samples, config)
                if whole:
                    reached = reaches(box_of(at, tile_x, tile_y, band), outline.side, outline)
                    if reached:
                        # Left and upper edges belong to a cell, right and lower ones do not.
                        of_left, of_right, of_top, of_bottom = geometry.edges(x, y, outline.side, outline)
                        inside = (of_left >= 0.0) & (of_right > 0.0) & (of_top >= 0.0) & (of_bottom > 0.0)
                        if ti.static(config.refined):
                            column, line = geometry.small_quad(x, y, inside, sheet.parts, patch)
                else:
                    # Outside its bounds rounding would decide, in samples that depend on the tiles' shape.
                    column_x, row_y = centres(tile_x, tile_y, config)
                    inside = (
                        (column_x > ti.cast(first_column, ti.f32))
                        & (column_x < ti.cast(end_column, ti.f32))
                        & (row_y > ti.cast(first_row, ti.f32))
                        & (row_y < ti.cast(end_row, ti.f32))
                    )
                    if ti.static(config.bends):
                        inside = inside & (x < BEYOND)
            if reached:
                if held >= 0:
                    cover_tile(
                        held, held_x, held_y, held_inside > 0.0, held_column, held_line, lower, overstep,
                        cell, sheet, band,
                    )  # fmt: skip
                held = at
                held_x, held_y, held_inside = x, y, ti.select(inside, 1.0, 0.0)
                held_column, held_line = column, line
            tile += 1
            if tile == end_tile:
                tile = first_tile
                tile_line += 1
