"""Where material points are seen, and whether anything is in front of them: found in f64, without a depth map.

A point is placed on the drawn surface, and projected. It is hidden if another part of the surface, or an instrument, is
nearer on the same line of sight. Bins tell which cells may be there.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Rod
from taichi_msm.render import geometry, lens_kernels
from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS_STRIDE, build_bins, store_bounds
from taichi_msm.render.camera import View
from taichi_msm.render.config import INFINITY, Bytes, Doubles, Floats, Integers
from taichi_msm.render.coverage import intersect_capsule
from taichi_msm.render.geometry import NODE_STRIDE
from taichi_msm.render.labels import NO_FLOW, Flow, Sight
from taichi_msm.render.lens_table import undistorted_view
from taichi_msm.scene.scene import Scene
from taichi_msm.system.launches import Launches, end_thread
from taichi_msm.system.runtime import lanes, our_compilation, ti

Array = NDArray[np.floating]

# The smallest width of a bin [px].
MIN_BIN_SIZE = 4

# The numbers of a cell: its bounds in the picture; its least depth; and its side, 0 for a cell drawn triangle by
# triangle, else 1 or -1 as its front or its back is seen.
CELL_MIN_X, CELL_MAX_X, CELL_MIN_Y, CELL_MAX_Y, CELL_MIN_DEPTH, CELL_FACING, CELL_STRIDE = range(7)

# The bounds of a cell that may be anywhere [px].
UNBOUNDED = 1e9

# The cells around a mass point.
CELLS_AROUND_NODE = 4

# The pixel of a point that is seen nowhere.
NOT_VISIBLE = math.nan


def find(scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod] = ()) -> Sight:
    """Find material points by their coordinates on the sheet, as in `Labels`, shape (n, 2).

    The mass points are at `position` [m], shape (rows, cols, 3). Raises a DeviceError when threads were cut short.
    """
    pixels, hidden = _track(scene, coordinates, position, view, rods, moved=False)
    return Sight(pixels, hidden.view(np.bool_))


def compute_flow(scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod] = ()) -> Flow:
    """Find how far the points that the pixels of another frame show have moved in the picture; else as `find`.

    `coordinates` are those in the labels of the other frame, shape (height, width, 2); NaN where no sheet is seen.
    """
    shape = coordinates.shape[:2]
    moved, hidden = _track(scene, coordinates.reshape(-1, 2), position, view, rods, moved=True)
    return Flow(moved.reshape(*shape, 2), hidden.reshape(shape) * np.uint8(255))


def _track(
    scene: Scene, coordinates: Array, position: Array, view: View, rods: Sequence[Rod], *, moved: bool
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Find material points, or how far they are from the centres of all pixels, row by row; and which are hidden."""
    total = len(coordinates)
    if total == 0:
        return np.empty((0, 2), np.float32), np.empty(0, np.uint8)
    rows, cols = scene.sheet.points
    cells = (rows - 1) * (cols - 1)
    # What hides what is found without the lens.
    straight = view if view.lens is None else undistorted_view(view)
    width, height = (int(side) for side in straight.size)
    # If a bin is half as wide as a cell, the cells of most bins are around one mass point only.
    bin_size = max(MIN_BIN_SIZE, round((width * height / cells) ** 0.5 / 2))
    launches = Launches(bounded=lanes("f64") == 1)
    told = uni.view_numbers(straight, scene.render, 1, scene.sheet.size, (1, 1), rods)
    if view.lens is not None:
        uni.set_lens(told, view, 1, view.lens.limit)
    uniforms = launches.give(told)
    sizes = uni.sizes_of(scene, np.empty((0, 3), np.int32))
    sizes[[uni.CAPSULE_COUNT, uni.WIDTH, uni.HEIGHT]] = len(rods), width, height
    nodes, cell = (launches.array(np.float64, n) for n in (rows * cols * NODE_STRIDE, cells * CELL_STRIDE))
    bounds = launches.array(np.int32, cells * BOUNDS_STRIDE)
    with our_compilation(optimised=False):
        _outline_cells(np.ascontiguousarray(position, np.float64), uniforms, launches.give(sizes), nodes, cell, bounds)
    bins = build_bins(launches, bounds, cells, (width, height), bin_size)
    sizes[[uni.BIN_SIZE, uni.BINS_ACROSS, uni.WIDTH, uni.HEIGHT]] = bins.size, bins.columns, *scene.render.size
    simple = launches.array(np.uint8, bins.lengths.size)
    launches.launch(
        _mark_simple_bins,
        bins.lengths.size,
        cell,
        cols,
        bins.starts,
        bins.entries,
        simple,
        rounds=3 * CELLS_AROUND_NODE,
    )
    pixels, hidden = launches.array(np.float32, 2 * total), launches.array(np.uint8, total)
    arguments = (
        launches.give(np.ascontiguousarray(coordinates, np.float32).ravel()),
        int(moved), uniforms, launches.give(sizes), nodes, cell, bins.starts, bins.entries, simple, pixels, hidden,
    )  # fmt: skip
    # A point takes one round for a cell, and one for each of its triangles.
    rounds = 1 + 2 * (scene.render.refine + 1) ** 2
    for listed, count in launches.parts(int(bins.lengths.max()), rounds):
        launches.launch(_kernel(view.model), total, listed, count, *arguments, rounds=count * rounds + len(rods))
    launches.require_ended()
    return launches.take(pixels).reshape(-1, 2), launches.take(hidden)


@ti.kernel
def _outline_cells(
    position: ti.types.ndarray(dtype=ti.f64, ndim=3), uniforms: Doubles, sizes: Integers, nodes: Doubles, cell: Doubles,
    bounds: Integers,
):  # fmt: skip
    """Project the mass points, and find the outlines of the cells, and their bounds in whole pixels."""
    for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
        cols = sizes[uni.COLS]
        geometry.project(position, index // cols, index % cols, cols, uniforms, nodes, True)

    for index in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
        cols, entry = sizes[uni.COLS], index * CELL_STRIDE
        corner = geometry.corner_entry(index, cols)
        below = corner + cols * NODE_STRIDE
        outline = ti.static(geometry.cell_outline(corner, cols, uniforms[uni.NEAR], nodes))
        left, right, top, bottom, side = outline.left, outline.right, outline.top, outline.bottom, outline.side
        corners = [
            [nodes[at + n] for n in ti.static(range(3))]
            for at in ti.static((corner, corner + NODE_STRIDE, below, below + NODE_STRIDE))
        ]
        if outline.behind:
            left, right, top, bottom = 1.0, -1.0, 1.0, -1.0
        elif not outline.in_front:
            left, right, top, bottom, side = -UNBOUNDED, UNBOUNDED, -UNBOUNDED, UNBOUNDED, 0.0
            width, height = ti.cast(sizes[uni.WIDTH], ti.f64), ti.cast(sizes[uni.HEIGHT], ti.f64)
            if geometry.is_off_screen(corners, 0.0, width, 0.0, height):
                left, right = 1.0, -1.0
        cell[entry + CELL_MIN_X], cell[entry + CELL_MAX_X], cell[entry + CELL_MIN_Y], cell[entry + CELL_MAX_Y] = (
            left,
            right,
            top,
            bottom,
        )
        cell[entry + CELL_MIN_DEPTH] = ti.min(
            nodes[corner + 3], nodes[corner + NODE_STRIDE + 3], nodes[below + 3], nodes[below + NODE_STRIDE + 3]
        )
        cell[entry + CELL_FACING] = side
        store_bounds(index, left, right, top, bottom, sizes[uni.WIDTH], sizes[uni.HEIGHT], bounds)


@ti.kernel
def _mark_simple_bins(
    first: ti.i32, end: ti.i32, ended: Integers, cell: Doubles, cols: ti.i32, starts: Integers, entries: Integers,
    simple: Bytes,
):  # fmt: skip
    """Mark the bins in which no two cells can be seen at the same place.

    This is so if the cells of a bin are among the four around one mass point, and these four are all drawn as a whole
    and seen from the same side: each is convex, so it lies within the angle between its two edges at the point, and
    the four angles add up to 360 degrees without overlapping.
    """
    for square in range(first, end):
        first_i, last_i, first_j, last_j = 1 << 30, -1, 1 << 30, -1
        length = starts[square + 1] - starts[square]
        for n in range(starts[square], starts[square] + ti.min(length, CELLS_AROUND_NODE)):
            i, j = entries[n] // (cols - 1), entries[n] % (cols - 1)
            first_i, last_i = ti.min(first_i, i), ti.max(last_i, i)
            first_j, last_j = ti.min(first_j, j), ti.max(last_j, j)
        around_a_point = length <= CELLS_AROUND_NODE and last_i - first_i <= 1 and last_j - first_j <= 1
        if around_a_point:
            sides, around = 0.0, 0.0
            # All four matter, even those that do not reach the bin.
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    sides += cell[(i * (cols - 1) + j) * CELL_STRIDE + CELL_FACING]
                    around += 1.0
            around_a_point = abs(sides) == around
        simple[square] = ti.cast(around_a_point, ti.u8)
        end_thread(ended)


@ti.func
def _quad_depth(x, y, column, line, part, lower, near, patch: ti.template()):
    """Find the depth at which (x, y) shows a small quad of a cell, or INFINITY.

    Of a cell that is not whole this is the depth of the triangle below the diagonal, if `lower`, or above.
    """
    triangle = ti.static(geometry.triangle_at(x, y, column, line, part, lower, patch))
    s, t = geometry.on_triangle(x, y, triangle)
    depth = geometry.depth_at(s, t, triangle)
    return ti.select(patch.invertible | geometry.is_within(s, t, 0.0, near, triangle), depth, INFINITY)


@ti.func
def _cell_occludes(x, y, depth, index, own, own_triangle, cols, parts, near, nodes: ti.template(), cell: ti.template()):
    """Tell whether a cell is seen at (x, y) at a smaller depth than `depth`.

    `depth` is that of a point that is on the cell `own`, there on the small triangle `own_triangle`.
    """
    entry, part = index * CELL_STRIDE, 1.0 / parts
    side = cell[entry + CELL_FACING]
    invertible = side != 0.0
    hides = False
    # A cell that is drawn as a whole shows at most one of its points at a place of the picture.
    possible = cell[entry + CELL_MIN_DEPTH] < depth and not (index == own and invertible)
    if (
        possible
        and x >= cell[entry + CELL_MIN_X]
        and x <= cell[entry + CELL_MAX_X]
        and y >= cell[entry + CELL_MIN_Y]
        and y <= cell[entry + CELL_MAX_Y]
    ):
        corner = geometry.corner_entry(index, cols)
        patch = ti.static(geometry.cell_patch(corner, cols, side, invertible, nodes, True))
        if invertible:
            outline = ti.static(geometry.cell_outline(corner, cols, near, nodes))
            of_left, of_right, of_top, of_bottom = geometry.edges(x, y, side, outline)
            if of_left >= 0.0 and of_right >= 0.0 and of_top >= 0.0 and of_bottom >= 0.0:
                column, line = geometry.find_quads(x, y, True, parts, patch)
                hides = _quad_depth(x, y, column, line, part, False, near, patch) < depth
        else:
            per_side = ti.cast(parts, ti.i32)
            for triangle in range(2 * per_side * per_side):
                if not hides and not (index == own and triangle == own_triangle):
                    quad = triangle // 2
                    column, line = ti.cast(quad % per_side, ti.f64), ti.cast(quad // per_side, ti.f64)
                    hides = _quad_depth(x, y, column, line, part, triangle % 2 == 1, near, patch) < depth
    return hides


@ti.func
def _capsule_occludes(x, y, depth, uniforms: ti.template(), sizes: ti.template()):
    """Tell whether an instrument is seen at (x, y) at a smaller depth than `depth`."""
    hides = False
    for n in range(sizes[uni.CAPSULE_COUNT]):
        rod = uni.CAPSULES + n * uni.CAPSULE_STRIDE
        across_it = x >= uniforms[rod + uni.LEFT] and x <= uniforms[rod + uni.RIGHT]
        if across_it and y >= uniforms[rod + uni.TOP] and y <= uniforms[rod + uni.BOTTOM]:
            met, _, _, _ = intersect_capsule(x, y, n, uniforms)
            if met < depth and geometry.w_at(met, uniforms) > uniforms[uni.NEAR]:
                hides = True
    return hides


@cache
def _kernel(lens: str) -> Callable[..., None]:
    """Make the kernel that finds points, for a model of the lens, empty if it bends no lines."""

    @ti.kernel
    def find_points(
        first: ti.i32, end: ti.i32, ended: Integers, listed: ti.i32, count: ti.i32, coordinates: Floats, moved: ti.i32,
        uniforms: Doubles, sizes: Integers, nodes: Doubles, cell: Doubles, starts: Integers, entries: Integers,
        simple: Bytes, pixels: Floats, hidden: Bytes,
    ):  # fmt: skip
        """Find where material points are seen, and which are hidden by `count` cells of their lists from `listed` on.

        If `moved` is 0, `pixels` gets their places [px]. Otherwise they are what the pixels of another frame showed,
        and `pixels` gets how far each has moved from its pixel's centre [px].
        """
        for k in range(first, end):
            rows, cols, width, height = sizes[uni.ROWS], sizes[uni.COLS], sizes[uni.WIDTH], sizes[uni.HEIGHT]
            near, parts = uniforms[uni.NEAR], uniforms[uni.SUBDIVISIONS]
            u, v = coordinates[2 * k], coordinates[2 * k + 1]
            x, y, out_of_sight = ti.cast(NOT_VISIBLE, ti.f64), ti.cast(NOT_VISIBLE, ti.f64), False
            if abs(u) < 2.0:  # False for NaN
                s = ti.math.clamp(ti.cast(u, ti.f64), 0.0, 1.0) * (cols - 1)
                t = ti.math.clamp(ti.cast(v, ti.f64), 0.0, 1.0) * (rows - 1)
                j, i = ti.min(ti.cast(s, ti.i32), cols - 2), ti.min(ti.cast(t, ti.i32), rows - 2)
                s, t = s - j, t - i
                own, part = i * (cols - 1) + j, 1.0 / parts
                column, line = ti.min(ti.floor(s * parts), parts - 1.0), ti.min(ti.floor(t * parts), parts - 1.0)
                s0, t0 = column * part, line * part
                s1, t1 = s - s0, t - t0
                own_triangle = 2 * ti.cast(line * parts + column, ti.i32) + ti.cast(t1 > s1, ti.i32)
                patch = ti.static(geometry.cell_patch(geometry.corner_entry(own, cols), cols, 0.0, True, nodes, True))
                # In the small quad, D s t is replaced by a function that is linear on either side of the diagonal.
                twist = s0 * t0 + s1 * t0 + s0 * t1 + ti.min(s1, t1) * part
                p = patch.a + patch.b * s + patch.c * t + patch.d * twist
                out_of_sight = True
                if p[2] > near:
                    x, y = p[0] / p[2], p[1] / p[2]
                    place_x, place_y, within = x, y, True
                    if ti.static(lens != ""):
                        x, y, within = lens_kernels.bent(place_x, place_y, uniforms, lens)
                    if within and x >= 0.0 and y >= 0.0 and x < width and y < height:
                        out_of_sight = False
                        depth = p[3] - uniforms[uni.DEPTH_TOLERANCE]
                        square = ti.cast(place_y, ti.i32) // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS]
                        square += ti.cast(place_x, ti.i32) // sizes[uni.BIN_SIZE]
                        if simple[square] == 0:
                            begin = starts[square] + listed
                            for n in range(begin, ti.min(begin + count, starts[square + 1])):
                                if not out_of_sight:
                                    out_of_sight = _cell_occludes(
                                        place_x,
                                        place_y,
                                        depth,
                                        entries[n],
                                        own,
                                        own_triangle,
                                        cols,
                                        parts,
                                        near,
                                        nodes,
                                        cell,
                                    )
                        out_of_sight = out_of_sight or _capsule_occludes(place_x, place_y, depth, uniforms, sizes)
                    if not within:
                        x, y = ti.cast(NOT_VISIBLE, ti.f64), ti.cast(NOT_VISIBLE, ti.f64)
            if moved > 0:
                seen = x > -INFINITY  # False for NaN
                x = ti.select(seen, x - ti.cast(k % width, ti.f64) - 0.5, NO_FLOW)
                y = ti.select(seen, y - ti.cast(k // width, ti.f64) - 0.5, NO_FLOW)
            pixels[2 * k] = ti.cast(x, ti.f32)
            pixels[2 * k + 1] = ti.cast(y, ti.f32)
            if listed > 0:
                out_of_sight = out_of_sight or hidden[k] > 0
            hidden[k] = ti.cast(out_of_sight, ti.u8)
            end_thread(ended)

    return find_points
