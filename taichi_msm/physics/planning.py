"""From a scene to its plan, and the choice of its steps and their precision."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Problem, SceneError
from taichi_msm.physics import workload
from taichi_msm.physics.lattice import fixed_points, spacing
from taichi_msm.physics.material import MapImage, Maps, Material, kind_problems, read_map, tissue_problems
from taichi_msm.physics.paths import path_problems, tools_of
from taichi_msm.physics.plan import Plan, slots_of
from taichi_msm.physics.terms import highest_frequency, material_of
from taichi_msm.picture import PictureError
from taichi_msm.scene import WHOLE, Scene, Sheet, Time
from taichi_msm.timegrid import TimeGrid

# Lengths [m] whose squares, and a few of their products, f32 holds.
SMALLEST_SINGLE, LARGEST_SINGLE = 1e-15, 1e17

# Keeps a frame that is exactly n limits long from being cut into n + 1 steps by rounding.
SLACK = 1 - 1e-12


def make_plan(scene: Scene, maps: Maps | None = None) -> Plan:
    """Plan a scene for a CPU as `try_plan` does; SceneError: with all that makes its sheet or its steps impossible."""
    plan, problems = try_plan(scene, maps)
    if plan is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return plan


def try_plan(scene: Scene, maps: Maps | None = None) -> tuple[Plan | None, list[Problem]]:
    """Plan a scene for a CPU, None where there can be no plan, and find what is wrong with its sheet and its steps.

    Args:
        scene: whose keys are valid each by itself.
        maps: from the plan of a scene with the same maps; None: they are read.
    """
    problems = list(kind_problems(scene))
    if problems:
        return None, problems
    if maps is None:
        maps, unreadable = _read_maps(scene)
        problems += unreadable
    fixed, material = fixed_points(scene.sheet), material_of(scene, maps)
    problems += tissue_problems(scene, fixed, material.factors)
    if problems:
        return None, problems
    plan = _plan(scene, maps, fixed, material)
    return plan, [*_step_problems(plan), *path_problems(scene, plan.tools, plan.grid)]


def variant(plan: Plan, scene: Scene) -> Plan:
    """Plan a scene that a valid one was turned into, with its maps, without looking for what is wrong with it."""
    return _plan(scene, plan.maps, fixed_points(scene.sheet), material_of(scene, plan.maps))


def _read_maps(scene: Scene) -> tuple[dict[str, MapImage], list[Problem]]:
    """Read the maps of a scene, and find those that cannot be read."""
    maps, problems = {}, []
    for name, one in scene.maps.items():
        try:
            maps[name] = read_map(one)
        except PictureError as error:
            problems.append(Problem((scene.kind, name, "image"), str(error)))
    return maps, problems


def _plan(scene: Scene, maps: Maps, fixed: NDArray[np.bool_], material: Material) -> Plan:
    limit = stable_step(material, scene.sheet, scene.time.damping_difference)
    grid = TimeGrid(scene.time.frames_per_second, scene.time.frames, steps_per_frame(scene.time, limit), "f64")
    tools = tools_of(scene.probes, scene.sheet)
    return on(Plan(scene, maps, fixed, material, limit, grid, slots_of(scene, grid), tools), "cpu")


def on(plan: Plan, arch: str) -> Plan:
    """Choose the precision for an arch, unless the scene gives it.

    A tolerance asks for f64; so does `auto` where it is a small part of the run. On a GPU f64 is slow or missing. At
    rest it is always f64.
    """
    time = plan.scene.time
    if time.at_rest:
        return plan.with_grid(precision="f64")
    if time.precision != "auto":
        return plan.with_grid(precision=time.precision)
    in_f64 = arch == "cpu" and (time.tolerance is not None or workload.is_small_in_f64(plan))
    return plan.with_grid(precision="f64" if in_f64 else "f32")


def stable_step(material: Material, sheet: Sheet, difference: str) -> float:
    """Find the largest stable step [s]; infinite where nothing oscillates.

    central: 2 / w. backward: (sqrt(g^2 + 4 w^2) - g) / w^2, written without its cancellation; g = C / m.
    """
    w = highest_frequency(material, sheet)
    g = material.drag if difference == "backward" else 0.0
    limit = math.hypot(g, 2 * w) + g
    return 4 / limit if limit > 0 else math.inf


def stable_steps(plan: Plan) -> int:
    """Count the fewest stable steps of a frame."""
    return max(1, math.ceil(1 / plan.grid.frames_per_second / plan.stable_step * SLACK))


def steps_per_frame(time: Time, limit: float) -> int:
    """Count the steps of one frame.

    auto: the fewest whose step is at most half the stability limit. A given step is rounded to a fraction of a frame.
    A tolerance may ask for more steps, which `error_control.choose_step` finds. At rest a frame counts as a step.
    """
    if time.at_rest:
        return 1
    frame = 1 / time.frames_per_second
    if time.step == "auto":
        return max(1, math.ceil(2 * frame / limit * SLACK))
    return max(1, round(frame / time.step))


def with_time(scene: Scene, **changes: Any) -> Scene:
    """Change keys of the scene's time."""
    return scene.model_copy(update={"time": scene.time.model_copy(update=changes)})


def with_chosen_grid(plan: Plan) -> Plan:
    """Write the grid into the scene, so that every plan of it has the same grid, on any arch.

    The precision is written, and a step in the place of a tolerance; a step that follows from the scene stays "auto".
    """
    changes: dict[str, Any] = {"precision": plan.grid.precision}
    if plan.scene.time.tolerance is not None:
        changes |= {"step": 1 / plan.grid.frames_per_second / plan.grid.steps_per_frame, "tolerance": None}
    return replace(plan, scene=with_time(plan.scene, **changes))


def _step_problems(plan: Plan) -> Iterator[Problem]:
    """Find a given step that is unstable or does not divide a frame, and what would overflow or vanish in f32."""
    if plan.scene.time.at_rest:
        return
    given, limit, frame = plan.scene.time.step, plan.stable_step, 1 / plan.grid.frames_per_second
    if given == "auto":
        pass
    elif given > limit * (1 + 1e-12):
        below = frame / math.ceil(frame / limit)
        said = f"{given:g} s is above the stability limit {limit:.6g} s; try {below:.9g}, or auto"
        yield Problem(("time", "step"), said)
    elif abs(frame / given - round(frame / given)) > WHOLE * max(1.0, frame / given):
        said = f"{given:g} s does not divide a frame of {frame:.9g} s; try {frame / math.ceil(frame / given):.9g}"
        yield Problem(("time", "step"), said)
    if plan.grid.precision == "f64":
        return
    cells, size, step, mass = spacing(plan.scene.sheet), plan.scene.sheet.size, plan.grid.step, plan.material.mass
    if min(cells) < SMALLEST_SINGLE or max(size) > LARGEST_SINGLE:
        yield Problem(
            ("sheet", "size"),
            f"cells of {min(cells):g} m in a sheet of {max(size):g} m leave the range of f32, "
            f"{SMALLEST_SINGLE:g} to {LARGEST_SINGLE:g} m; take time.precision: f64",
        )
    gain = step**2 / mass
    if not SMALLEST_SINGLE**2 < gain < LARGEST_SINGLE**2:
        yield Problem(
            ("time", "precision"),
            f"f32 cannot hold the {gain:g} m by which a step of {step:g} s moves a mass of "
            f"{mass:g} kg for every newton; take f64",
        )
