"""Pixels and occlusion of material points, computed in f64 without a depth map.

A material point is located on the drawn triangles, and projected. It is occluded if another part of the surface or an
instrument is nearer on its line of sight. Bins list the cells on which that part may be.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.render import geometry, lens_kernels
from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS_STRIDE, build_bins, store_bounds
from taichi_msm.render.camera import Shot
from taichi_msm.render.config import INFINITY, Bytes, Doubles, Floats, Integers, is_present
from taichi_msm.render.coverage import intersect_instrument
from taichi_msm.render.geometry import NODE_STRIDE
from taichi_msm.render.labels import NO_FLOW, Flow, Labels, PicturedLabels, Sight
from taichi_msm.render.undistortion import undistorted_view
from taichi_msm.scene.scene import Scene
from taichi_msm.system.launches import Launches, end_thread
from taichi_msm.system.runtime import compilation_options, lanes, ti

Array = NDArray[Any]

# Layout of `outlines`: for every cell its bounds in the picture [px]; its least depth [m]; `facing`, 0 if the cell is
# drawn triangle by triangle.
CELL_MIN_X, CELL_MAX_X, CELL_MIN_Y, CELL_MAX_Y, CELL_MIN_DEPTH, CELL_FACING, CELL_STRIDE = range(7)

# Bounds of a cell that may be anywhere [px].
UNBOUNDED = 1e9

CELLS_AROUND_POINT = 4

# Accuracy of coordinates of labels [sides of a cell].
COORDINATE_TOLERANCE = 1e-4

# Pixel coordinate of points without a projection.
NOT_VISIBLE = math.nan


def locate_points(scene: Scene, coordinates: Array, shot: Shot) -> Sight:
    """Project material points, with coordinates as in `Labels`, shape (n, 2), and determine their occlusion."""
    rest = rest_of(scene.sheet)
    places = np.asarray(coordinates, float)
    pixels, hidden = _track(scene, rest.mesh_places(places), shot)
    is_missing = ~rest.covers(places, COORDINATE_TOLERANCE)
    pixels[is_missing], hidden[is_missing] = NOT_VISIBLE, True
    return Sight(pixels, hidden.view(np.bool_))


def mesh_of(scene: Scene, labels: Labels) -> Array:
    """Return the (u, v) of labels, shape (height, width, 2), NaN where the sheet is not visible."""
    coordinates, rest = np.asarray(labels.coordinates), rest_of(scene.sheet)
    if not isinstance(rest, PicturedRest):
        return coordinates
    if isinstance(labels, PicturedLabels):
        return labels.mesh
    on_sheet, mesh = ~np.isnan(coordinates[..., 0]), np.full(coordinates.shape, np.nan)
    mesh[on_sheet] = rest.mesh_places(coordinates[on_sheet].astype(float))
    return mesh


def compute_flow(scene: Scene, mesh: Array, shot: Shot) -> Flow:
    """Compute the optical flow from another frame, whose labels have this `mesh_of`, to this one."""
    shape = mesh.shape[:2]
    moved, hidden = _track(scene, mesh.reshape(-1, 2), shot, as_flow=True)
    return Flow(moved.reshape(*shape, 2), hidden.reshape(shape) * np.uint8(255))


def compute_stereo(scene: Scene, labels: Labels, shot: Shot) -> Flow:
    """Compute the flow of the sheet and the instruments from a camera's picture to its companion's at the same time."""
    view = shot.view
    assert view.companion is not None
    companion_shot = shot._replace(view=view.companion)
    flow, occlusion = compute_flow(scene, mesh_of(scene, labels), companion_shot)
    instrument_pixels = np.argwhere(labels.instrument)
    if len(instrument_pixels):
        y, x = instrument_pixels.T
        centres = instrument_pixels[:, ::-1].astype(np.float64) + 0.5
        pixels = view.undistort(centres)
        depth = _instrument_depth(scene, pixels, shot)
        # Pixels just outside an instrument's outline may show it, by rounding to f32.
        depth = np.where(depth < INFINITY, depth, labels.depth[y, x])
        companion_pixels, hidden = _track(scene, view.points(pixels, depth), companion_shot)
        flow[y, x] = np.where(np.isnan(companion_pixels), NO_FLOW, companion_pixels - centres)
        occlusion[y, x] = hidden * np.uint8(255)
    return Flow(flow, occlusion)


def _instrument_depth(scene: Scene, pixels: Array, shot: Shot) -> Array:
    """Return the depth [m] of the nearest instrument at undistorted pixels, shape (n, 2); INFINITY without one."""
    launches, count = Launches(bounded=lanes("f64") == 1), len(shot.instruments)
    uniforms = uni.view_uniforms(shot.view._replace(lens=None), scene, shot.instruments)
    depth = launches.array(np.float64, len(pixels))
    launches.launch(
        _ray_kernel(scene.shapes), len(pixels), launches.upload(np.ascontiguousarray(pixels).ravel()),
        launches.upload(uniforms), count, depth, rounds=count,
    )  # fmt: skip
    launches.require_completion()
    return launches.download(depth)


def _track(
    scene: Scene, points: Array, shot: Shot, *, as_flow: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the pixels of points, or with `as_flow` their flow, and their occlusion.

    The points are (u, v) of material points, shape (n, 2), or points of instruments [m], shape (n, 3). For the
    flow from another frame, they are those at the centres of its pixels, row by row.
    """
    total, is_material, view, instruments = len(points), points.shape[-1] == 2, shot.view, shot.instruments
    if total == 0:
        return np.empty((0, 2), np.float32), np.empty(0, np.uint8)
    rows, cols = scene.sheet.points
    cells = (rows - 1) * (cols - 1)
    # Occlusion is computed without lens distortion.
    undistorted = view if view.lens is None else undistorted_view(view)
    points = np.asarray(points, np.float32) if is_material else undistorted.project(points)
    width, height = (int(side) for side in undistorted.size)
    # Bins half as wide as cells: most of them overlap only the cells around one mass point.
    bin_size = max(4, round((width * height / cells) ** 0.5 / 2))
    launches = Launches(bounded=lanes("f64") == 1)
    uniform_values = uni.view_uniforms(undistorted, scene, instruments)
    if view.lens is not None:
        uni.set_lens(uniform_values, view, 1, view.lens.limit)
    uniforms = launches.upload(uniform_values)
    sizes = uni.sizes_of(scene, np.empty((0, 3), np.int32), (width, height))
    sizes[uni.INSTRUMENT_COUNT] = len(instruments)
    nodes, outlines = (launches.array(np.float64, n) for n in (rows * cols * NODE_STRIDE, cells * CELL_STRIDE))
    bounds = launches.array(np.int32, cells * BOUNDS_STRIDE)
    position = np.ascontiguousarray(shot.positions, np.float64)
    with compilation_options(optimised=False):
        masked = scene.sheet.mask is not None
        _outline_cells(position, uniforms, launches.upload(sizes), nodes, outlines, bounds, masked)
    bins = build_bins(launches, bounds, cells, (width, height), bin_size)
    sizes[[uni.BIN_SIZE, uni.BINS_ACROSS, uni.WIDTH, uni.HEIGHT]] = bins.size, bins.columns, *scene.render.size
    is_simple = launches.array(np.uint8, bins.lengths.size)
    launches.launch(
        _mark_simple_bins, bins.lengths.size, outlines, cols, bins.starts, bins.entries, is_simple,
        rounds=3 * CELLS_AROUND_POINT,
    )  # fmt: skip
    pixels, hidden = launches.array(np.float32, 2 * total), launches.array(np.uint8, total)
    arguments = (
        launches.upload(np.ascontiguousarray(points).ravel()),
        int(as_flow), uniforms, launches.upload(sizes), nodes, outlines, bins.starts, bins.entries, is_simple,
        pixels, hidden,
    )  # fmt: skip
    kernel = _kernel(view.lens_model, scene.shapes, is_material)
    # Iterations per point: one per cell, and one per triangle.
    rounds = 1 + 2 * (scene.render.refine + 1) ** 2
    for start, size in launches.chunks(int(bins.lengths.max()), rounds):
        launches.launch(kernel, total, start, size, *arguments, rounds=size * rounds + len(instruments))
    launches.require_completion()
    return launches.download(pixels).reshape(-1, 2), launches.download(hidden)


@ti.kernel
def _outline_cells(
    position: ti.types.ndarray(dtype=ti.f64, ndim=3), uniforms: Doubles, sizes: Integers, nodes: Doubles,
    outlines: Doubles, bounds: Integers, masked: ti.template(),
):  # fmt: skip
    """Project the mass points, and compute the outlines of the cells and their bounds in whole pixels."""
    for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
        cols = sizes[uni.COLS]
        geometry.project(position, index // cols, index % cols, cols, uniforms, nodes, True)

    for index in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
        cols, entry = sizes[uni.COLS], index * CELL_STRIDE
        corner = geometry.corner_entry(index, cols)
        outline = ti.static(geometry.cell_outline(corner, cols, uniforms[uni.NEAR], nodes))
        left, right, top, bottom, facing = outline.left, outline.right, outline.top, outline.bottom, outline.facing
        corners = ti.static(geometry.corner_entries(corner, cols, NODE_STRIDE))
        projected = [[nodes[corner_start + n] for n in ti.static(range(4))] for corner_start in corners]
        if outline.behind:
            left, right, top, bottom = 1.0, -1.0, 1.0, -1.0
        elif not outline.in_front:
            left, right, top, bottom, facing = -UNBOUNDED, UNBOUNDED, -UNBOUNDED, UNBOUNDED, 0.0
            width, height = ti.cast(sizes[uni.WIDTH], ti.f64), ti.cast(sizes[uni.HEIGHT], ti.f64)
            if geometry.is_off_screen(projected, 0.0, width, 0.0, height):
                left, right = 1.0, -1.0
        if ti.static(masked):  # noqa: SIM102  (evaluated at compile time)
            if not is_present(index, sizes):
                left, right, top, bottom = 1.0, -1.0, 1.0, -1.0
        outlines[entry + CELL_MIN_X], outlines[entry + CELL_MAX_X] = left, right
        outlines[entry + CELL_MIN_Y], outlines[entry + CELL_MAX_Y] = top, bottom
        outlines[entry + CELL_MIN_DEPTH] = ti.min(projected[0][3], projected[1][3], projected[2][3], projected[3][3])
        outlines[entry + CELL_FACING] = facing
        store_bounds(index, left, right, top, bottom, sizes[uni.WIDTH], sizes[uni.HEIGHT], bounds)


@ti.kernel
def _mark_simple_bins(
    first: ti.i32, end: ti.i32, ended: Integers, outlines: Doubles, cols: ti.i32, starts: Integers, entries: Integers,
    is_simple: Bytes,
):  # fmt: skip
    """Mark the bins in which no two cells overlap.

    Such a bin has only cells around one mass point, all invertible and with equal `facing`. A cell is convex, so it is
    within the angle between its two edges at the mass point, and these angles add up to 360 degrees.
    """
    for bin_index in range(first, end):
        first_i, last_i, first_j, last_j = 1 << 30, -1, 1 << 30, -1
        length = starts[bin_index + 1] - starts[bin_index]
        for n in range(starts[bin_index], starts[bin_index] + ti.min(length, CELLS_AROUND_POINT)):
            i, j = entries[n] // (cols - 1), entries[n] % (cols - 1)
            first_i, last_i = ti.min(first_i, i), ti.max(last_i, i)
            first_j, last_j = ti.min(first_j, j), ti.max(last_j, j)
        around_point = length <= CELLS_AROUND_POINT and last_i - first_i <= 1 and last_j - first_j <= 1
        if around_point:
            facing_sum, count = 0.0, 0.0
            # Also with cells that do not overlap the bin.
            for i in range(first_i, last_i + 1):
                for j in range(first_j, last_j + 1):
                    facing_sum += outlines[(i * (cols - 1) + j) * CELL_STRIDE + CELL_FACING]
                    count += 1.0
            around_point = abs(facing_sum) == count
        is_simple[bin_index] = ti.cast(around_point, ti.u8)
        end_thread(ended)


@ti.func
def _quad_depth(x, y, quad_column, quad_row, quad_side, lower, near, patch: ti.template()):
    """Return the depth of a sub-quad of a cell at (x, y); INFINITY if its triangle is not there."""
    triangle = ti.static(geometry.triangle_at(x, y, quad_column, quad_row, quad_side, lower, patch))
    s, t = geometry.on_triangle(x, y, triangle)
    depth = geometry.depth_at(s, t, triangle)
    return ti.select(patch.invertible | geometry.is_within(s, t, 0.0, near, triangle), depth, INFINITY)


@ti.func
def _cell_occludes(
    x, y, depth, index, point_cell, point_triangle, cols, subdivisions, near,
    nodes: ti.template(), outlines: ti.template(),
):  # fmt: skip
    """Return whether a cell occludes a point at (x, y) and `depth`, which is on `point_triangle` of `point_cell`."""
    entry, quad_side = index * CELL_STRIDE, 1.0 / subdivisions
    facing = outlines[entry + CELL_FACING]
    invertible = facing != 0.0
    occluded = False
    # An invertible cell has at most one point on a line of sight.
    possible = outlines[entry + CELL_MIN_DEPTH] < depth and not (index == point_cell and invertible)
    if (
        possible
        and x >= outlines[entry + CELL_MIN_X]
        and x <= outlines[entry + CELL_MAX_X]
        and y >= outlines[entry + CELL_MIN_Y]
        and y <= outlines[entry + CELL_MAX_Y]
    ):
        corner = geometry.corner_entry(index, cols)
        patch = ti.static(geometry.cell_patch(corner, cols, facing, invertible, nodes, True))
        if invertible:
            outline = ti.static(geometry.cell_outline(corner, cols, near, nodes))
            left_edge, right_edge, top_edge, bottom_edge = geometry.edges(x, y, facing, outline)
            if left_edge >= 0.0 and right_edge >= 0.0 and top_edge >= 0.0 and bottom_edge >= 0.0:
                column, row = geometry.find_quads(x, y, True, subdivisions, patch)
                occluded = _quad_depth(x, y, column, row, quad_side, False, near, patch) < depth
        else:
            per_side = ti.cast(subdivisions, ti.i32)
            for triangle in range(2 * per_side * per_side):
                if not occluded and not (index == point_cell and triangle == point_triangle):
                    quad = triangle // 2
                    column, row = ti.cast(quad % per_side, ti.f64), ti.cast(quad // per_side, ti.f64)
                    occluded = _quad_depth(x, y, column, row, quad_side, triangle % 2 == 1, near, patch) < depth
    return occluded


@cache
def _ray_kernel(shapes: tuple[str, ...]) -> Callable[..., None]:
    """Return the kernel that intersects lines of sight with instruments of these shapes."""

    @ti.kernel
    def intersect_lines(
        first: ti.i32, end: ti.i32, ended: Integers, pixels: Doubles, uniforms: Doubles, count: ti.i32, depth: Doubles
    ):
        """Compute the depth [m] of the nearest instrument at pixels [px], shape (2 * n,); INFINITY without one."""
        for k in range(first, end):
            nearest = ti.cast(INFINITY, ti.f64)
            for index in range(count):
                hit_depth, _, _, _ = intersect_instrument(pixels[2 * k], pixels[2 * k + 1], index, uniforms, shapes)
                if geometry.w_at(hit_depth, uniforms) > uniforms[uni.NEAR]:
                    nearest = ti.min(nearest, hit_depth)
            depth[k] = nearest
            end_thread(ended)

    return intersect_lines


@ti.func
def _instrument_occludes(x, y, depth, uniforms: ti.template(), sizes: ti.template(), shapes: ti.template()):
    """Return whether an instrument occludes a point at (x, y) and `depth`."""
    occluded = False
    for index in range(sizes[uni.INSTRUMENT_COUNT]):
        base = uni.INSTRUMENTS + index * uni.INSTRUMENT_STRIDE
        is_in_columns = x >= uniforms[base + uni.LEFT] and x <= uniforms[base + uni.RIGHT]
        if is_in_columns and y >= uniforms[base + uni.TOP] and y <= uniforms[base + uni.BOTTOM]:
            hit_depth, _, _, _ = intersect_instrument(x, y, index, uniforms, shapes)
            if hit_depth < depth and geometry.w_at(hit_depth, uniforms) > uniforms[uni.NEAR]:
                occluded = True
    return occluded


@ti.func
def _material_point(entry, points: ti.template(), sizes: ti.template(), subdivisions, nodes: ti.template()):
    """Return X, Y, w and depth of a material point on the drawn triangles, its cell and its triangle in the cell."""
    rows, cols = sizes[uni.ROWS], sizes[uni.COLS]
    s = ti.math.clamp(ti.cast(points[entry], ti.f64), 0.0, 1.0) * (cols - 1)
    t = ti.math.clamp(ti.cast(points[entry + 1], ti.f64), 0.0, 1.0) * (rows - 1)
    j, i = ti.min(ti.cast(s, ti.i32), cols - 2), ti.min(ti.cast(t, ti.i32), rows - 2)
    s, t = s - j, t - i
    cell, quad_side = i * (cols - 1) + j, 1.0 / subdivisions
    quad_column = ti.min(ti.floor(s * subdivisions), subdivisions - 1.0)
    quad_row = ti.min(ti.floor(t * subdivisions), subdivisions - 1.0)
    s0, t0 = quad_column * quad_side, quad_row * quad_side
    s1, t1 = s - s0, t - t0
    triangle = 2 * ti.cast(quad_row * subdivisions + quad_column, ti.i32) + ti.cast(t1 > s1, ti.i32)
    patch = ti.static(geometry.cell_patch(geometry.corner_entry(cell, cols), cols, 0.0, True, nodes, True))
    # In the sub-quad, D s t is replaced by a function that is linear on each side of the diagonal.
    twist = s0 * t0 + s1 * t0 + s0 * t1 + ti.min(s1, t1) * quad_side
    p = patch.a + patch.b * s + patch.c * t + patch.d * twist
    return p[0], p[1], p[2], p[3], cell, triangle


@ti.func
def _instrument_point(entry, points: ti.template(), _sizes: ti.template(), _subdivisions, _nodes: ti.template()):
    """Return X, Y, w and depth of a point that is not on the sheet, with -1 as its cell and its triangle."""
    return points[entry], points[entry + 1], points[entry + 2], points[entry + 3], -1, -1


@cache
def _kernel(lens: str, shapes: tuple[str, ...], is_material: bool) -> Callable[..., None]:
    """Return the kernel that locates material points, or points of instruments."""
    Points: Any = Floats if is_material else Doubles
    locate, stride, limit = (_material_point, 2, 2.0) if is_material else (_instrument_point, 4, INFINITY)

    @ti.kernel
    def locate_kernel(
        first: ti.i32, end: ti.i32, ended: Integers, chunk_start: ti.i32, chunk_size: ti.i32, points: Points,
        as_flow: ti.i32, uniforms: Doubles, sizes: Integers, nodes: Doubles, outlines: Doubles,
        starts: Integers, entries: Integers, is_simple: Bytes, pixels: Floats, hidden: Bytes,
    ):  # fmt: skip
        """Project points, and test their occlusion by a chunk of the cells in their bins.

        `points` are coordinates of material points, shape (2 * n,), or X, Y, w and depth of points of instruments,
        shape (4 * n,). With `as_flow`, `pixels` are displacements of points k from the centres of pixels k of another
        frame. `uniforms` are those of the undistorted view, with the lens.
        """
        for k in range(first, end):
            cols, width, height = sizes[uni.COLS], sizes[uni.WIDTH], sizes[uni.HEIGHT]
            near, subdivisions = uniforms[uni.NEAR], uniforms[uni.SUBDIVISIONS]
            x, y, is_hidden = ti.cast(NOT_VISIBLE, ti.f64), ti.cast(NOT_VISIBLE, ti.f64), False
            if abs(points[stride * k]) < limit:  # false for NaN
                p_x, p_y, w, p_depth, point_cell, point_triangle = locate(
                    stride * k, points, sizes, subdivisions, nodes
                )
                is_hidden = True
                if w > near:
                    x, y = p_x / w, p_y / w
                    undistorted_x, undistorted_y, is_valid = x, y, True
                    if ti.static(lens != ""):
                        x, y, is_valid = lens_kernels.distorted_point(undistorted_x, undistorted_y, uniforms, lens)
                    if is_valid and x >= 0.0 and y >= 0.0 and x < width and y < height:
                        is_hidden = False
                        depth = p_depth - uniforms[uni.DEPTH_TOLERANCE]
                        bin_index = ti.cast(undistorted_y, ti.i32) // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS]
                        bin_index += ti.cast(undistorted_x, ti.i32) // sizes[uni.BIN_SIZE]
                        if is_simple[bin_index] == 0:
                            begin = starts[bin_index] + chunk_start
                            for n in range(begin, ti.min(begin + chunk_size, starts[bin_index + 1])):
                                if not is_hidden:
                                    is_hidden = _cell_occludes(
                                        undistorted_x, undistorted_y, depth, entries[n], point_cell, point_triangle,
                                        cols, subdivisions, near, nodes, outlines,
                                    )  # fmt: skip
                        if ti.static(len(shapes) > 0):
                            is_hidden = is_hidden or _instrument_occludes(
                                undistorted_x, undistorted_y, depth, uniforms, sizes, shapes
                            )
                    if not is_valid:
                        x, y = ti.cast(NOT_VISIBLE, ti.f64), ti.cast(NOT_VISIBLE, ti.f64)
            if as_flow > 0:
                is_visible = x > -INFINITY  # false for NaN
                x = ti.select(is_visible, x - ti.cast(k % width, ti.f64) - 0.5, NO_FLOW)
                y = ti.select(is_visible, y - ti.cast(k // width, ti.f64) - 0.5, NO_FLOW)
            pixels[2 * k] = ti.cast(x, ti.f32)
            pixels[2 * k + 1] = ti.cast(y, ti.f32)
            if chunk_start > 0:
                is_hidden = is_hidden or hidden[k] > 0
            hidden[k] = ti.cast(is_hidden, ti.u8)
            end_thread(ended)

    return locate_kernel
