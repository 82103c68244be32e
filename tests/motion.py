"""Motion of a scene, its error, and the warnings of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.mesh import MeshEstimate
from taichi_msm.accuracy.run_errors import RunErrorEstimates, run_warnings
from taichi_msm.accuracy.time_step import TimeStepEstimate, TimeStepTrials, max_norm
from taichi_msm.model.plan import Plan
from taichi_msm.model.tool_force import probe_records
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.arrays import SheetLayout
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.solver.state import RunProgress
from taichi_msm.system.runtime import Device
from tests.scenes import plan_of


def structure_of(made: Scene, device: Device, cores: int | None = None) -> SheetLayout:
    """Layout for which the stepping kernel of a scene is compiled."""
    return choose_layout(plan_of(made), device, cores)


def dynamics_of(made: Scene, device: Device, layout: SheetLayout | None = None) -> Dynamics:
    """Dynamics of a scene with its planned steps."""
    return Dynamics(plan_of(made), device, layout)


def frames(made: Scene, device: Device, cut: int | None = None) -> NDArray[np.float64]:
    """Displacements at every frame [m], shape (frames, rows, cols, 3); `cut` replaces the steps per frame."""
    plan = plan_of(made)
    return frames_on(plan if cut is None else plan.with_grid(steps_per_frame=cut), device)


def frames_on(plan: Plan, device: Device) -> NDArray[np.float64]:
    """Displacements at every frame of a plan [m], shape (frames, rows, cols, 3)."""
    dynamics = Dynamics(plan, device)
    displacements = []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        displacements.append(dynamics.displacement().astype(np.float64))
    dynamics.close()
    return np.array(displacements)


def true_error(plan: Plan, device: Device, fine: int) -> float:
    """Error due to steps and rounding of a plan, relative to the largest displacement.

    The reference is a run in f64 with `fine` times the number of steps; its error is about 1 / fine² of the result.
    """
    finer = plan.with_grid(precision="f64", steps_per_frame=fine * plan.grid.steps_per_frame)
    reference = frames_on(finer, device)
    return max_norm(frames_on(plan, device) - reference) / max_norm(reference)


def estimate_error(plan: Plan, device: Device) -> TimeStepEstimate:
    """Time-step error of a plan, estimated by a fine companion run."""
    return TimeStepTrials(plan, device).estimate(plan.grid.steps_per_frame)


def assert_steered_like(made: Scene, short: Scene, device: Device) -> None:
    """A scene steered keyframe by keyframe moves with the same bits as the scene with the whole path."""
    path: Any = made.probes[0].path
    with (
        Simulation(made, threads=device.threads) as expected,
        Simulation(short, threads=device.threads) as steered,
    ):
        for key in path[1:]:
            steered.steer([{"path": [key]}])
            steered.advance()
            expected.advance()
            assert steered.positions().tobytes() == expected.positions().tobytes()
            assert steered.forces() == expected.forces()
        assert steered.scene.probes[0].path is not None
        if not made.probes[0].grip and not made.probes[0].clamp:
            assert len(steered.scene.probes[0].path) < 6


def notes_of(
    made: Scene,
    progress: RunProgress,
    estimate: TimeStepEstimate | None,
    mesh: MeshEstimate | None = None,
    affords: Callable[[Plan], bool] = lambda plan: True,
) -> list[str]:
    """Warnings of a run of a scene."""
    errors = RunErrorEstimates(estimate, mesh=mesh)
    return list(run_warnings(plan_of(made), probe_records(made), progress, errors, affords))
