"""The error of a run, by the pilots that were chosen for it: some go with the run, and one may follow it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.error_control import Estimate, Pilot, reconcile
from taichi_msm.physics.mesh_error import (
    APART,
    LARGEST_DIFFERENCE,
    STEPPED,
    UNTOUCHED,
    MeshEstimate,
    MeshPilot,
    companion,
)
from taichi_msm.physics.pilots import ENOUGH, Pilots
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count, Pause
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

    def finish(self, displacements: Iterator[NDArray[Any]] | None, progress: Count) -> None:
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
