"""What to know before trusting the result of a run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from taichi_msm.physics import probe_force
from taichi_msm.physics.contact_notes import contact_notes
from taichi_msm.physics.energy_growth import growth_notes
from taichi_msm.physics.error_control import Estimate
from taichi_msm.physics.material import has_fixed_border
from taichi_msm.physics.mesh_error import MeshEstimate
from taichi_msm.physics.paths import path_notes
from taichi_msm.physics.pilots import AT_REST
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.probe_force import ProbeRecord
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
) -> Iterator[str]:
    """Say what is remarkable about a run up to its last frame, each in a line; the last three are what is `Known`."""
    scene, grid = plan.scene, plan.grid
    if estimate is not None:
        yield error(estimate, mesh)
        if WRONG < estimate.error < math.inf:
            wrong = float(f"{100 * estimate.error:.2g}")
            at_most = (estimate.at_most and not estimate.at_least) or not estimate.parted
            bound = "up to" if at_most else "about"
            yield f"the run is {bound} {wrong:g} % wrong; {_remedy(plan, estimate)}"
    elif reason == AT_REST:
        points = f", {_size(mesh)} of the largest displacement due to the number of points" if mesh is not None else ""
        yield f"error: none due to a time step, as the sheet is at rest{points}"
    elif reason:
        if mesh is None:
            yield f"error not estimated: {reason}"
        else:
            yield f"error {_size(mesh)} due to the number of points; due to the time step not estimated: {reason}"
    yield from probe_force.force_notes(scene, probes)
    yield from path_notes(scene, plan.tools)
    yield from contact_notes(plan, progress)
    yield from growth_notes(plan, progress)
    if mesh is not None and mesh.doubt:
        yield f"the error due to the number of points may be larger: {mesh.doubt}"
    if mesh is not None and WRONG < mesh.error < math.inf:
        wrong, cut = float(f"{100 * mesh.error:.2g}"), math.sqrt(mesh.error / (WRONG / 2))
        finer = [min(MAX_POINTS, math.ceil((count - 1) * cut) + 1) for count in scene.sheet.points]
        remedy = f"; try sheet.points: {finer}" if max(finer) < MAX_POINTS else ""
        bound = ("roughly" if mesh.at_most else "at least") if mesh.doubt else "up to"
        yield f"so few points make the run {bound} {wrong:g} % wrong{remedy}"
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


def error(estimate: Estimate, mesh: MeshEstimate | None = None) -> str:
    """Say how wrong a run is."""
    if estimate.error == math.inf:
        return "error not known: a pilot run diverged, or steps do not resolve the damping"
    bound = _bound(estimate.at_most or not estimate.parted, estimate.at_least)
    parts = [f"{bound}{estimate.in_f64:.1g} due to the time step"]
    if not estimate.parted:
        parts = [f"{bound}{estimate.error:.1g} due to the time step and rounding"]
    elif estimate.rounding:
        parts.append(f"{estimate.rounding:.1g} to rounding")
    if mesh is None:
        return f"error {bound}{estimate.error:.1g} of the largest displacement: {', '.join(parts)}"
    return (
        f"error, as a fraction of the largest displacement: {', '.join(parts)}, {_size(mesh)} to the number of points"
    )


def _size(mesh: MeshEstimate) -> str:
    """Say how large the error is that the number of points makes."""
    bound = _bound(mesh.at_most, bool(mesh.doubt))
    return f"{bound}{mesh.error:.2g}" if mesh.error < math.inf else "an unknown part"


def _bound(at_most: bool, at_least: bool) -> str:
    """Say whether an error may be smaller or larger than what is told; if it may be both, it is known roughly."""
    return ("roughly " if at_least else "at most about ") if at_most else "at least " if at_least else ""


def _remedy(plan: Plan, estimate: Estimate) -> str:
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
        said.insert(0, f"time.step: {finer.step:.9g}")
    return f"try {', or '.join(said)}"
