"""From a scene to its plan."""

from __future__ import annotations

from dataclasses import replace

from taichi_msm.errors import Problem, SceneError
from taichi_msm.physics import stiffness_map, timestep, workload
from taichi_msm.physics.lattice import fixed_points
from taichi_msm.physics.material import kind_problems, tissue_problems
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.slots import probe_slots
from taichi_msm.physics.stiffness_map import MapImage
from taichi_msm.physics.terms import material_of
from taichi_msm.picture import PictureError
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid


def make_plan(scene: Scene, image: MapImage | None = None) -> Plan:
    """Plan a scene for a CPU; arguments as for `try_plan`.

    Raises:
        SceneError: with all that makes its sheet or its steps impossible.
    """
    plan, problems = try_plan(scene, image)
    if plan is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return plan


def try_plan(scene: Scene, image: MapImage | None = None) -> tuple[Plan | None, list[Problem]]:
    """Plan a scene for a CPU, or find what is wrong with what its sheet is material of, and with its steps.

    Args:
        scene: whose keys are valid each by itself.
        image: of its map, from the plan of a scene with the same map: a run reads it once, and so has one map even if
            its file changes meanwhile. None: it is read.

    Returns:
        The plan, or None where there can be none; and the problems.
    """
    problems = list(kind_problems(scene))
    if problems:
        return None, problems
    fixed = fixed_points(scene.sheet)
    if scene.stiffness_map is not None and image is None:
        try:
            image = stiffness_map.read(scene.stiffness_map)
        except PictureError as error:
            problems.append(Problem((scene.kind, "map", "image"), str(error)))
    material = material_of(scene, image)
    problems += tissue_problems(scene, fixed, material.factors)
    if problems:
        return None, problems
    limit = timestep.stable_step(material, scene.sheet, scene.time.damping_difference)
    steps = timestep.steps_per_frame(scene.time, limit)
    grid = TimeGrid(scene.time.frames_per_second, scene.time.frames, steps, "f64")
    plan = on(
        Plan(scene, image, fixed, material, limit, grid, probe_slots(scene.probes, scene.sheet, grid.step)), "cpu"
    )
    return plan, list(timestep.step_problems(plan))


def on(plan: Plan, arch: str) -> Plan:
    """Choose the precision for an arch, unless the scene gives it.

    A tolerance asks for f64; so does `auto` where it is a small part of the run. On a GPU f64 is slow or missing.
    """
    time = plan.scene.time
    if time.precision != "auto":
        return replace(plan, grid=replace(plan.grid, precision=time.precision))
    in_f64 = arch == "cpu" and (time.tolerance is not None or workload.is_small_in_f64(plan))
    return replace(plan, grid=replace(plan.grid, precision="f64" if in_f64 else "f32"))
