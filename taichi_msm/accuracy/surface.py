"""Cells of a curved sheet and their isotropy: record in run.json, notes, and lines of `check`."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from typing_extensions import TypedDict

from taichi_msm.accuracy.depth import depth_steps
from taichi_msm.model.cells import cell_stiffness
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface_checks import (
    FOLD_REMEDY,
    aspect,
    describe_fold,
    describe_largest,
    isotropy_remedy,
    neighbour_angles,
    square_points,
)
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.surface import METRES
from taichi_msm.terms import fictitious_masses
from taichi_msm.terms.elasticity import spring_families

# Notes warn from these on: mean isotropy error, angle between neighbouring cells, step of heights or depths in sides of
# a cell.
NOTED_ISOTROPY_ERROR, NOTED_ANGLE_DEGREES, NOTED_STEP = 0.1, 45.0, 1 / 20

# Share of pixels without depth from which a note warns.
NOTED_FILLED = 0.05

# Extent above which, and rise relative to it below which, a wrong unit is likely.
MAX_EXTENT_M, MIN_RISE = 5.0, 1e-3

# Largest depths beyond which a wrong unit is likely.
MIN_DEPTH_M, MAX_DEPTH_M = 2e-3, 2.0

# Distance from the origin, in lengths of the sheet, from which rounding matters.
MAX_DISTANCE = 20.0


class IsotropyRecord(TypedDict):
    """Isotropy errors of the cells, see `isotropy_errors`."""

    mean: float  # over the area
    worst: float


class SurfaceRecord(TypedDict):
    """A curved sheet at rest, as written to run.json."""

    kind: str
    sha256: str | None  # of the file
    sides: list[float]  # shortest and longest side of a cell [m]
    isotropy_error: IsotropyRecord
    clamped: int  # number of cells with a spring whose stiffness would be negative
    filled: float  # share of pixels without depth


def surface_record(scene: Scene) -> SurfaceRecord | None:
    """Return the record of a curved sheet at rest; None for a flat one."""
    rest, surface = rest_of(scene.sheet), scene.sheet.surface
    if not isinstance(rest, CurvedRest) or surface is None:
        return None
    errors, area, file = rest.isotropy_errors, np.where(rest.present, rest.cells.area, 0), surface.file
    return {
        "kind": surface.kind,
        "sha256": file.sha256 if file else None,
        "sides": [rest.shortest_side, rest.longest_side],
        "isotropy_error": {"mean": float((errors * area).sum() / area.sum()), "worst": float(errors.max())},
        "clamped": int(cell_stiffness(rest.present_cells, 1.0).is_clamped.sum()),
        "filled": rest.origin.filled,
    }


def surface_notes(scene: Scene) -> Iterator[str]:
    """Yield notes about cells, steps of heights and sharp folds of a curved sheet."""
    rest, record, surface = rest_of(scene.sheet), surface_record(scene), scene.sheet.surface
    if not isinstance(rest, CurvedRest) or record is None or surface is None:
        return
    isotropy, file, side = record["isotropy_error"], surface.file, min(rest.cell_sides)
    if scene.tissue is not None and isotropy["mean"] > NOTED_ISOTROPY_ERROR:
        yield (
            f"sheet.surface: the springs deviate from isotropic tissue by {isotropy['mean']:.2g} on the mean, up to "
            f"{isotropy['worst']:.2g}; {isotropy_remedy(rest, surface)}"
        )
    if surface.height and file and file.step > NOTED_STEP * side:
        yield (
            f"sheet.surface: heights in steps of {file.step:.3g} m, over a twentieth of a cell's side, {side:.3g} m; "
            "take a picture of 16 bits, or an array of floating-point numbers"
        )
    if (steps := depth_steps(surface, rest)) and steps.size > NOTED_STEP * side:
        remedy = f"depth.smooth: {steps.smooth:.2g} evens them out"
        if rest.origin.deviation is not None and rest.origin.deviation >= steps.smooth:
            remedy = f"smoothing by {rest.origin.deviation:.2g} px evens them out"
        yield (
            f"sheet.surface: depths in steps of {steps.size:.3g} m, over a twentieth of a cell's side, {side:.3g} m; "
            f"{remedy}"
        )
    if (filled := rest.origin.filled) > NOTED_FILLED:
        yield (
            f"sheet.surface: {filled:.1%} of the pixels have no depth and are filled in from those around them; leave "
            "large holes out by sheet.mask"
        )
    extents = np.sort(np.ptp(rest.box, axis=0))
    if isinstance(rest, PicturedRest) and surface.depth:
        near, far = depth_range(rest)
        if not MIN_DEPTH_M < far < MAX_DEPTH_M:
            remedy = "unit: 1.0e-5 is for counts of a hundredth of a millimetre"
            if MIN_DEPTH_M < METRES["mm"] / surface.depth.metres * far < MAX_DEPTH_M:
                remedy = "if these are millimetres, take unit: mm"
            yield f"sheet.surface.depth: depths of {near:.3g} to {far:.3g} m are unlikely for tissue; {remedy}"
    elif surface.has_own_size and extents[2] > MAX_EXTENT_M:
        fault = f"{extents[2]:.3g} m is long for tissue; if these are millimetres, take unit: mm"
        yield f"sheet.surface.{surface.kind}: {fault}"
    elif (distance := float(np.linalg.norm(rest.box.mean(axis=0)))) > MAX_DISTANCE * extents[2]:
        fault = f"{distance:.3g} m from the origin, {distance / extents[2]:.0f} times its length"
        yield f"sheet.surface: {fault}, where f32 and pictures lose digits; subtract the mean of its points"
    elif not surface.points and extents[0] < MIN_RISE * extents[2]:
        rise = f"{extents[0]:.2g} m over {extents[2]:.3g} m"
        yield f"sheet.surface: nearly flat, as it rises by {rise}; lengths are in metres"
    angles = neighbour_angles(rest.cell_normals, rest.present)
    if angles.max() > NOTED_ANGLE_DEGREES:
        yield f"sheet.surface: {describe_fold(angles)}; {FOLD_REMEDY}"


def describe_surface(plan: Plan) -> Iterator[str]:
    """Yield lines about the cells of a curved sheet, the steps that they cost, and the pressure on a tense one."""
    rest, record = rest_of(plan.scene.sheet), surface_record(plan.scene)
    if not isinstance(rest, CurvedRest) or record is None:
        return
    (rows, cols), cells = plan.scene.sheet.points, rest.present_cells
    ratios, angles = cells.side_a / cells.side_b, np.degrees(np.arccos(cells.cosine))
    aspect = max(ratios.max(), 1 / ratios.min())
    low, high = f"{angles.min():.0f}", f"{angles.max():.0f}"
    yield (
        f"surface: {record['kind']}, {rows} x {cols} points, cells of {rest.shortest_side:.3g} to "
        f"{rest.longest_side:.3g} m, at most {aspect:.3g} times as long as wide, with sides at "
        f"{low if low == high else f'{low} to {high}'} degrees"
    )
    yield from _describe_file(rest, record)
    if plan.scene.tissue is not None:
        yield _describe_isotropy(rest, record)
    if not plan.scene.time.at_rest:
        present = plan.area_shares > 0
        squares = fictitious_masses(plan.material, plan.scene.sheet)[present]
        if plan.material.by_area:
            squares /= plan.area_shares[present]
        if (ratio := math.sqrt(float(squares.max() / np.median(squares)))) > 1.05:
            yield f"surface: its smallest or stiffest cells make the step {ratio:.2g} times shorter than median ones"
    if plan.material.is_tense:
        pulls = np.zeros(rest.position.shape)
        for family in spring_families(plan):
            pull = family.tension[..., None] * family.offset
            pulls[family.start] += pull
            pulls[family.end] -= pull
        free = ~plan.fixed
        pressures = np.abs((pulls * rest.point_normals).sum(axis=-1)[free]) / rest.areas[free]
        largest = float(pressures.max(initial=0.0))
        yield f"surface: at rest, a pressure of up to {largest:.4g} Pa holds the pretension"


def _describe_file(rest: CurvedRest, record: SurfaceRecord) -> Iterator[str]:
    """Yield lines about the even grid, with the numbers of points whose cells are square, and about filled pixels."""
    if rest.origin.grid is not None:
        square, shape = list(square_points(rest)), list(rest.position.shape[:2])
        remedy = "square" if square == shape else f"square with sheet.points: {square}"
        yield f"surface: cells of the even grid are {aspect(rest):.3g} times as wide as high, {remedy}"
    if isinstance(rest, PicturedRest):
        near, far = (1000 * depth for depth in depth_range(rest))
        yield f"surface: {near:.4g} to {far:.4g} mm from the camera, along its direction"
    if rest.origin.deviation is not None:
        deviation = f"smoothed by {rest.origin.deviation:.3g} px" if rest.origin.deviation else "not smoothed"
        share = f"{record['filled']:.2%} of the pixels are filled in, as they have no depth"
        yield f"surface: {share if record['filled'] else 'all pixels have a depth'}; {deviation}"


def depth_range(rest: PicturedRest) -> tuple[float, float]:
    """Return the least and the largest depth of a sheet at rest from the camera of its picture [m]."""
    depths = rest.picture.view.project(rest.present_positions)[:, 3]
    return float(depths.min()), float(depths.max())


def _describe_isotropy(rest: CurvedRest, record: SurfaceRecord) -> str:
    isotropy, clamped, line = record["isotropy_error"], record["clamped"], "surface: isotropy error 0"
    # Rectangles and rhombi are exact but for rounding.
    if isotropy["worst"] > 1e-9:
        place = describe_largest(rest.isotropy_errors)
        line = f"surface: isotropy error {isotropy['mean']:.2g} on the mean, {isotropy['worst']:.2g} at {place}"
    count = f"{clamped} cells are" if clamped > 1 else "a cell is"
    return f"{line}; {count} clamped, as a spring would need a stiffness below 0" if clamped else line
