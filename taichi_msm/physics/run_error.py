"""The error of a run, by the pilots that were chosen for it: some go with the run, and one may follow it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from numpy.typing import NDArray

from taichi_msm.physics.error_control import Estimate, Pilot, reconcile
from taichi_msm.physics.mesh_error import MeshEstimate, MeshPilot, coarser
from taichi_msm.physics.pilots import ENOUGH, Pilots
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count, Pause
from taichi_msm.system.runtime import Device


class Known(NamedTuple):
    """What is known about the error of a run."""

    estimate: Estimate | None = None  # the error due to the step and to rounding; None: not estimated
    reason: str = ""  # why it was not estimated
    mesh: MeshEstimate | None = None  # the error due to the number of points; None: not estimated


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
        coarse = coarser(plan) if pilots.points and known.mesh is None else None
        # Otherwise it is compared with the run itself.
        self._mesh_beside_coarse = self._coarse and not plan.tools
        beside = plan.with_grid(steps_per_frame=pilots.beside) if self._mesh_beside_coarse else plan
        self._mesh = None if coarse is None else MeshPilot(beside, coarse, device, cores)

    def compile(self) -> None:
        """Compile now what the first frame would compile."""
        for pilot in (self._time, self._mesh):
            if pilot is not None:
                pilot.compile()

    def follow(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Step to the next frame, and compare, as a `Pilot` does."""
        if self._time is not None:
            self._time.follow(displacement, pause)
        if self._mesh is not None:
            beside = self._time.displacement if self._time and self._mesh_beside_coarse else displacement
            self._mesh.follow(beside, pause)

    def finish(self, displacements: Iterator[NDArray[Any]] | None, progress: Count) -> None:
        """After the last frame, take a finer pilot where the coarse one shows an error that matters.

        displacements: of the run at all frames but the first [m]; None: not kept, and the run is repeated.
        """
        if self._time is None or not self._pilots.after or self._time.estimate.error < ENOUGH:
            return
        frames = self._plan.grid.frames
        fine = Pilot(self._plan, self._pilots.after, self._device, self._cores)
        for frame, displacement in enumerate(displacements or self._repeated(), 1):
            fine.follow(displacement, partial(progress, frame, frames))
        self._known = self._known._replace(estimate=reconcile(self._time.estimate, fine.estimate))

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
        return known
