"""The error of a run, by the pilots that were chosen for it: some go with the run, and one may follow it.

What to know before trusting the result of a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.companions import AT_REST, ENOUGH, Pilots
from taichi_msm.accuracy.contact_warnings import contact_notes
from taichi_msm.accuracy.energy_growth import growth_notes
from taichi_msm.accuracy.mesh import (
    APART,
    LARGEST_DIFFERENCE,
    STEPPED,
    UNTOUCHED,
    MeshEstimate,
    MeshPilot,
    companion,
    with_points,
)
from taichi_msm.accuracy.time_step import Estimate, Pilot, reconcile
from taichi_msm.errors import Pause, ProgressCallback
from taichi_msm.model import tool_force
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import has_fixed_border
from taichi_msm.model.tool_force import ProbeRecord
from taichi_msm.model.tools import COARSE_TIP_PHRASE, MAX_REFINEMENT, path_warnings
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.sheet import Foundation
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import plan_variant
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device

# The error of a tool's force, in root mean squares of its difference to the run with fewer points over the frames with
# contact; and the least, as a share of the greatest force, in errors of the displacement by points: where a grip holds
# points of about the same force by chance, the first says little. The most is the error of the displacement
# (docs/decisions/0027).
IN_FORCES, IN_MESH_ERRORS = 1.15, 0.5


class ForceEstimate(NamedTuple):
    """What is known about the error of the forces of tools on a path."""

    error: float | None  # of any tool at any frame, as a fraction of the greatest force; None: not known
    doubt: str = ""  # why it is not known


class Known(NamedTuple):
    """What is known about the error of a run."""

    estimate: Estimate | None = None  # the error due to the step and to rounding; None: not estimated
    reason: str = ""  # why it was not estimated
    mesh: MeshEstimate | None = None  # the error due to the number of points; None: not estimated
    force: ForceEstimate | None = None  # the error of the forces of tools on a path; None: there are none


class RunError:
    """The pilots of a run.

    Args:
        known: what was found before the run, and is not estimated again.

    Raises:
        DeviceError: when the device cannot run the scene in f64.
    """

    def __init__(self, plan: Plan, pilots: Pilots, known: Known, device: Device, cores: int) -> None:
        self._plan, self._pilots, self._known = plan, pilots, known
        self._device, self._cores = device, cores
        self._coarse = known.estimate is None and 0 < pilots.beside < plan.grid.steps_per_frame
        tells_time = known.estimate is None and not pilots.reason
        self._time = Pilot(plan, pilots.beside, device, cores) if tells_time else None
        coarse = companion(plan) if pilots.points and known.mesh is None else None
        # Otherwise it is compared with the run itself.
        self._mesh_beside_coarse = self._coarse and not plan.tools
        beside = plan.with_grid(steps_per_frame=pilots.beside) if self._mesh_beside_coarse else plan
        self._mesh = None if coarse is None else MeshPilot(beside, coarse, device, cores)
        self._squares, self._touched, self._greatest = np.zeros((3, len(plan.tools)))
        self._all_forces = True

    def compile(self) -> None:
        """Compile now what the first frame would compile."""
        for pilot in (self._time, self._mesh):
            if pilot is not None:
                pilot.compile()

    def follow(self, displacement: NDArray[Any], pause: Pause, forces: NDArray[np.float64] | None = None) -> None:
        """Step to the next frame, and compare, as a `Pilot` does.

        Args:
            displacement: of the run at that frame [m], shape (rows, cols, 3).
            pause: as of a `Pilot`.
            forces: of the tools on a path, the means since the frame before [N], shape (tools, 3); None: not kept.
        """
        if self._time is not None:
            self._time.follow(displacement, pause)
        if self._mesh is not None:
            beside = self._time.displacement if self._time and self._mesh_beside_coarse else displacement
            self._mesh.follow(beside, pause)
        if forces is None:
            self._all_forces = False
        elif self._plan.tools and self._mesh is not None:
            coarse = self._mesh.tool_forces()
            apart = IN_FORCES * np.abs(forces - coarse)
            if self._time is not None:
                apart = np.maximum(apart, self._time.force_error(forces))
            self._squares += (apart**2).sum(axis=1)
            self._touched += forces.any(axis=1) | coarse.any(axis=1)
            self._greatest = np.maximum(self._greatest, np.linalg.norm(forces, axis=1))

    def finish(self, displacements: Iterator[NDArray[Any]] | None, progress: ProgressCallback) -> None:
        """After the last frame, take pilots again where the first ones show an error that matters.

        displacements: of the run at all frames but the first [m]; None: not kept, and the run is repeated.
        """
        early = self._time
        takes_finer = early is not None and self._pilots.after and early.estimate.error >= ENOUGH
        fine = Pilot(self._plan, self._pilots.after, self._device, self._cores) if takes_finer else None
        nearer = self._mesh.nearer(self._plan, self._device, self._cores) if self._mesh is not None else None
        pilots = [pilot for pilot in (fine, nearer) if pilot is not None]
        if not pilots:
            return
        frames = self._plan.grid.frames
        for frame, displacement in enumerate(displacements or self._repeated(), 1):
            for pilot in pilots:
                pilot.follow(displacement, partial(progress, frame, frames))
        if early is not None and fine is not None:
            self._known = self._known._replace(estimate=reconcile(early.estimate, fine.estimate))

    def _repeated(self) -> Iterator[NDArray[Any]]:
        """Run the scene again; give the displacements of its frames."""
        own = Dynamics(self._plan, self._device, cores=self._cores)
        for _ in range(self._plan.grid.frames):
            own.advance(self._plan.grid.steps_per_frame)
            yield own.displacement()

    @property
    def known(self) -> Known:
        """What the frames so far show."""
        known = self._known
        if known.estimate is None and self._time is not None:
            estimate = self._time.estimate
            # What a coarse pilot tells of a run in f32 is an upper bound.
            if self._coarse and estimate.parted and ENOUGH <= estimate.error < math.inf:
                estimate = replace(estimate, at_least=True)
            known = known._replace(estimate=estimate)
        if self._mesh is not None:
            known = known._replace(mesh=self._mesh.estimate)
            if self._plan.tools and self._all_forces and not self._greatest.all():
                known = known._replace(mesh=MeshEstimate(math.inf, UNTOUCHED))
            elif self._plan.tools and known.estimate is not None and known.estimate.error > LARGEST_DIFFERENCE:
                known = known._replace(mesh=MeshEstimate(math.inf, STEPPED))
        return known._replace(force=self._force(known)) if self._plan.tools else known

    def _force(self, known: Known) -> ForceEstimate:
        """Estimate the error of the forces."""
        mesh = known.mesh
        if self._mesh is None or mesh is None:
            return ForceEstimate(None, "there is no run with fewer points")
        if not self._all_forces:
            return ForceEstimate(None, "the forces of the frames before the run was continued are not kept")
        if mesh.error == math.inf:
            return ForceEstimate(None, mesh.doubt)
        relative = float(np.sqrt(self._squares / np.maximum(self._touched, 1)).max() / self._greatest.max())
        if relative > IN_FORCES * LARGEST_DIFFERENCE:
            return ForceEstimate(None, APART)
        most = max(mesh.error, known.estimate.error if known.estimate is not None else 0.0)
        return ForceEstimate(min(max(relative, IN_MESH_ERRORS * mesh.error), most))


pass  # REMOVED

# The stability limit holds while no spring is compressed below this share of its rest length (see
# `SpringTerm.stiffness_bound`).
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
    yield from tool_force.force_warnings(scene, probes)
    paths = list(path_warnings(scene, plan.tools))
    yield from paths
    yield from contact_notes(plan, progress)
    yield from growth_notes(plan, progress)
    if mesh is not None and mesh.doubt and mesh.error < math.inf:
        yield f"the error due to the number of points may be larger: {mesh.doubt}"
    # Where points are too far apart for a tool, it is said already what would help.
    if mesh is not None and WRONG < mesh.error < math.inf and not any(COARSE_TIP_PHRASE in note for note in paths):
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
    few = rows * cols <= MAX_REFINEMENT * math.prod(scene.sheet.points) and max(rows, cols) < MAX_POINTS
    if few and affords(plan_variant(plan, with_points(scene, (rows, cols)))):
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
