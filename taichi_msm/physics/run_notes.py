"""What to know before trusting the result of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from taichi_msm.physics import probe_force
from taichi_msm.physics.contact_notes import contact_notes
from taichi_msm.physics.energy_growth import growth_notes
from taichi_msm.physics.error_control import Estimate
from taichi_msm.physics.material import has_fixed_border
from taichi_msm.physics.mesh_error import MeshEstimate, with_points
from taichi_msm.physics.paths import MOST_FINER, TOO_FEW, path_notes
from taichi_msm.physics.pilots import AT_REST
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import variant
from taichi_msm.physics.probe_force import ProbeRecord
from taichi_msm.physics.run_error import ForceEstimate
from taichi_msm.physics.state import RunProgress
from taichi_msm.scene import MAX_POINTS, Foundation

# The stability limit holds while no spring is compressed below this share of its rest length (see
# `SpringTerm.bound`).
SHORTEST = 0.5

# Tissue that is compressed by more than this share of its depth gets much stiffer, which the foundation does not.
DEEPEST = 1 / 3

# No tissue can be stretched to more than this many times its rest length.
LONGEST = 2.0

# If an error is above this share of the largest displacement, a remedy is named.
WRONG = 0.01


def run_notes(
    plan: Plan,
    probes: Sequence[ProbeRecord],
    progress: RunProgress,
    estimate: Estimate | None,
    reason: str = "",
    mesh: MeshEstimate | None = None,
    force: ForceEstimate | None = None,
    affords: Callable[[Plan], bool] = lambda plan: True,
    scale: float | None = None,
) -> Iterator[str]:
    """Say what is remarkable about a run up to its last frame, each in a line.

    Args:
        plan: of the run.
        probes: what is known of the force of each.
        progress: of the run.
        estimate: as in `Known`, like the next three.
        reason: why there is none.
        mesh: the error due to the number of points.
        force: the error of the forces.
        affords: whether a run takes at most an hour.
        scale: pixels per metre at the middle of the sheet; None: no picture is drawn.
    """
    scene, grid = plan.scene, plan.grid
    if estimate is not None or mesh is not None:
        yield error(estimate, mesh, progress.max_displacement, scale) + (
            "; mesh error unknown: another number of points is another sheet" if scene.tissue is None else ""
        )
    if estimate is not None:
        if WRONG < estimate.error < math.inf:
            of = "the time step" if not estimate.parted or estimate.in_f64 > WRONG / 2 else "rounding"
            yield f"for a smaller error of {of}, {_remedy(plan, estimate, affords)}"
    elif reason == AT_REST:
        yield "error: none due to a time step, as the sheet is at rest"
    elif reason:
        yield f"error {'of the time step ' if mesh is not None else ''}not estimated: {reason}"
    if force is not None:
        if force.error is None:
            yield f"force error not known: {force.doubt}"
        else:
            yield f"force error at most about {_percent(force.error, 2)} % of the greatest force"
    yield from probe_force.force_notes(scene, probes)
    paths = list(path_notes(scene, plan.tools))
    yield from paths
    yield from contact_notes(plan, progress)
    yield from growth_notes(plan, progress)
    if mesh is not None and mesh.doubt and mesh.error < math.inf:
        yield f"the error due to the number of points may be larger: {mesh.doubt}"
    # Where points are too far apart for a tool, it is said already what would help.
    if mesh is not None and WRONG < mesh.error < math.inf and not any(TOO_FEW in note for note in paths):
        yield f"for a smaller error of the mesh, {_finer(plan, mesh, affords)}"
    if progress.max_displacement == 0 and progress.frame > 0:
        yield "nothing moved: does a probe press where and when it should?"
    below = scene.tissue.foundation if scene.tissue is not None else None
    if isinstance(below, Foundation) and progress.deepest > DEEPEST * below.depth:
        yield (
            f"the sheet was pressed {1000 * progress.deepest:.3g} mm into the {1000 * below.depth:.3g} mm of "
            "tissue.foundation.depth: beyond a third tissue gets much stiffer than this foundation, so that the true "
            "dent of a force is less deep, and the true force of a path larger; press less"
        )
    if progress.longest_spring > LONGEST:
        yield (
            f"a spring was stretched to {progress.longest_spring:.2g} times its rest length, which no tissue "
            "withstands: press less, or with a wider tool"
        )
    if progress.shortest_spring < SHORTEST:
        yield (
            f"a spring was pressed to {progress.shortest_spring:.2g} of its rest length: below {SHORTEST} the sheet "
            "folds over itself and small errors grow; press less"
        )
    quick = plan.material.drag * grid.step
    if quick > 2 and scene.time.damping_difference == "central":
        yield (
            f"the damping stops a point within 1/{quick:.3g} of a step: velocities change their sign at every step; "
            f"take a time.step of at most {2 * grid.step / quick:.2g} s"
        )


def error(
    estimate: Estimate | None, mesh: MeshEstimate | None = None, largest: float = 0.0, scale: float | None = None
) -> str:
    """Say how wrong a run is, in parts of its largest displacement [m]; scale: in pixels per metre, if any."""
    if estimate is not None and estimate.error == math.inf:
        return "error not known: a pilot run diverged, or steps do not resolve the damping"
    parts, known = [], [mesh.error] if mesh is not None and mesh.error < math.inf else []
    if estimate is not None:
        bound = _bound(estimate.at_most or not estimate.parted, estimate.at_least)
        named = "time step" if estimate.parted else "time step and rounding"
        parts.append(f"{named} {bound}{_percent(estimate.in_f64 if estimate.parted else estimate.error, 1)} %")
        if estimate.parted and estimate.rounding:
            parts.append(f"rounding {_percent(estimate.rounding, 1)} %")
        known.append(estimate.error)
    if mesh is not None and mesh.error < math.inf:
        parts.append(f"mesh {_bound(mesh.at_most, bool(mesh.doubt))}{_percent(mesh.error, 2)} %")
    of = ""
    if known:
        away = max(known) * largest
        pixels = f", {_digits(away * scale)} px" if scale is not None else ""
        of = f" of {_digits(1000 * largest, 2)} mm ({_digits(1000 * away)} mm{pixels})"
    unknown = f"; mesh error not known: {mesh.doubt}" if mesh is not None and mesh.error == math.inf else ""
    return f"error: {', '.join(parts)}{of}{unknown}" if parts else f"error{unknown}".replace("error; ", "")


def _percent(share: float, digits: int) -> str:
    return _digits(100 * share, digits)


def _digits(number: float, digits: int = 1) -> str:
    """Write a number with this many digits, and without an exponent unless it is tiny."""
    rounded = float(f"{number:.{digits}g}")
    return np.format_float_positional(rounded, trim="-") if 1e-6 <= rounded < 1e6 or not rounded else f"{rounded:g}"


def _finer(plan: Plan, mesh: MeshEstimate, affords: Callable[[Plan], bool]) -> str:
    """Say what would reduce the error that the number of points makes: no more than four times as many."""
    scene, cut = plan.scene, math.sqrt(mesh.error / (WRONG / 2))
    rows, cols = (math.ceil((count - 1) * cut) + 1 for count in scene.sheet.points)
    few = rows * cols <= MOST_FINER * math.prod(scene.sheet.points) and max(rows, cols) < MAX_POINTS
    if few and affords(variant(plan, with_points(scene, (rows, cols)))):
        return f"try sheet.points: {[rows, cols]}"
    return "more than points, tissue.bending, tissue.pretension or a wider tip help"


def _bound(at_most: bool, at_least: bool) -> str:
    """Say whether an error may be smaller or larger than what is told; if it may be both, it is known roughly."""
    return ("roughly " if at_least else "at most about ") if at_most else "at least " if at_least else ""


def _remedy(plan: Plan, estimate: Estimate, affords: Callable[[Plan], bool]) -> str:
    """Say what would reduce the error."""
    if not estimate.parted:
        return "pass --estimate-error to learn whether the step or rounding makes it"
    said = []
    if estimate.rounding > WRONG / 2:
        said.append("time.precision: f64")
        if max(plan.material.across, plan.material.down, plan.material.shear) > 0:
            held = "tissue.pretension or bending" if has_fixed_border(plan.fixed) else "tissue.foundation"
            support = "springs.virtual" if plan.scene.tissue is None else held
            said.append(f"more {support}, where the sheet buckles")
    if estimate.in_f64 > WRONG / 2:
        needed = plan.grid.steps_per_frame * (estimate.in_f64 / (WRONG / 2)) ** (1 / estimate.order)
        finer = replace(plan.grid, steps_per_frame=math.ceil(needed))
        if not affords(replace(plan, grid=finer)):
            return "steps as short as that needs take more than an hour: fewer sheet.points make them faster"
        said.insert(0, f"time.step: {finer.step:.9g}")
    return f"try {', or '.join(said)}"
