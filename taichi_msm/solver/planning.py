"""Planning of a run: the plan of a scene, its steps and precision, an estimate of its work, and steering.

The unit of work is a step of one mass point in f32, which takes 1 to 2 ns on two CPU cores of 2024. Work is computed
from the scene alone, so that decisions based on it are the same on every machine.

Steering replaces loads and paths during a run. A position-controlled tool cannot jump: it moves straight from its
current position to the first keyframe of its new path. Past keyframes remain in its path as long as later steps depend
on them, through the position at which a grip began or through the activity of a foundation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, Problem, SceneError
from taichi_msm.images import PictureError
from taichi_msm.integrators import INTEGRATORS
from taichi_msm.model.mask_checks import mask_problems, place_problems
from taichi_msm.model.plan import Plan, build_slots
from taichi_msm.model.rest import rest_of
from taichi_msm.model.sheet import (
    MapImage,
    Maps,
    Material,
    fixed_points,
    material_key_problems,
    read_map,
    tissue_problems,
)
from taichi_msm.model.surface_checks import surface_problems
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.model.tools import SolidTool, build_tools, path_problems, solid_tools
from taichi_msm.scene.scene import Scene, Time
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe
from taichi_msm.terms import derive_material, highest_frequency

# Work of starting Python and Taichi and compiling the kernels.
START_WORK = 4e8

# Work of a step of a mass point in f64.
F64_WORK = 2.0

# Additional work of a step per moving control point, for bending, and per position-controlled tool.
MOVING_LOAD_WORK, BENDING_WORK, CONTACT_WORK = 1.2, 1.0, 0.5

# Additional work of a step of a curved sheet.
CURVED_WORK = 0.6

# Work of encoding a pixel, and of drawing a sample of a pixel.
ENCODING_WORK, SAMPLE_WORK = 40.0, 6.0

# Number of evaluations of the forces for a quasi-static frame, per row and column.
EVALUATIONS_PER_LINE = 2.0

# `precision: auto` chooses f64 if stepping takes at most this fraction of the work of everything else.
MAX_F64_FRACTION = 0.25

# Largest work of companion runs that the user does not request, as a fraction of all work of a run.
MAX_COMPANION_FRACTION = 2 / 5

# Range of lengths whose squares, and products of squares, f32 can represent [m].
MIN_F32_LENGTH_M, MAX_F32_LENGTH_M = 1e-15, 1e17

# Range of lengths whose fourth powers f32 can represent, as in the springs of a curved sheet [m].
CURVED_F32_LENGTHS_M = 1e-9, 1e9

# Prevents n + 1 steps due to rounding in a frame of exactly n stable steps.
ROUNDING_MARGIN = 1 - 1e-12


class Work(NamedTuple):
    """The work of a run by stages [f32 steps of a mass point]."""

    start: float  # starting Python and Taichi, and compiling the kernels
    stepping: float  # all steps
    companions: float  # companion runs
    pictures: float  # drawing and encoding


def count_work(plan: Plan, companions: float) -> Work:
    """Return the estimated work of a run by stages [f32 steps of a mass point].

    `companions` is the work of its companion runs [f64 steps of the sheet per step of the run].
    """
    steps = _stepping_work(plan)
    stepping = F64_WORK * steps if plan.grid.precision == "f64" else steps
    return Work(START_WORK, stepping, F64_WORK * companions * steps, _other_work(plan.scene) - START_WORK)


def affords_companions(plan: Plan, companions: float) -> bool:
    """Return whether companion runs, see `count_work`, take at most MAX_COMPANION_FRACTION of the work of a run."""
    work = count_work(plan, companions)
    return work.companions <= MAX_COMPANION_FRACTION * sum(work)


def _stepping_work(plan: Plan) -> float:
    moving, points = sum(slot.moves for slot in plan.slots), plan.scene.sheet.points
    cost = 1 + MOVING_LOAD_WORK * moving + BENDING_WORK * (plan.material.bending > 0) + CONTACT_WORK * len(plan.tools)
    cost += CURVED_WORK * (plan.scene.sheet.surface is not None)
    steps = float(plan.grid.steps)
    if plan.scene.time.at_rest:
        # Each evaluation is followed by an update of the positions, which takes as long as a step.
        cost, steps = cost + 1, EVALUATIONS_PER_LINE * sum(points) * (plan.grid.frames + 1)
    return cost * steps * math.prod(points)


def _other_work(scene: Scene) -> float:
    pixels = (scene.time.frames + 1) * math.prod(scene.render.size) * len(scene.render.all_cameras) * scene.renders
    return START_WORK + pixels * (ENCODING_WORK + SAMPLE_WORK * scene.render.supersample**2)


def make_plan(scene: Scene) -> Plan:
    """Return the plan of a scene for a CPU; a SceneError has all problems of sheet, steps and paths."""
    plan, problems = try_plan(scene)
    if plan is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return plan


def try_plan(scene: Scene, maps: Maps | None = None) -> tuple[Plan | None, list[Problem]]:
    """Build the plan of a scene for a CPU, None with an invalid material, and check sheet, steps and paths.

    The keys of the scene are valid; checks across keys may fail. By default its stiffness maps are read from their
    files.
    """
    problems = [*material_key_problems(scene), *(list(mask_problems(scene)) or surface_problems(scene))]
    if problems:
        return None, problems
    if maps is None:
        maps, unreadable = _read_maps(scene)
        problems += unreadable
    fixed, material = fixed_points(scene.sheet), derive_material(scene, maps)
    problems += tissue_problems(scene, fixed, material.factors)
    if problems:
        return None, problems
    plan = _plan(scene, maps, fixed, material)
    return plan, [*_step_problems(plan), *precision_problems(plan), *path_problems(scene, plan.tools, plan.grid)]


def plan_variant(plan: Plan, scene: Scene) -> Plan:
    """Return the plan of a modified scene that is known to be valid, with the maps of the original, without checks."""
    return _plan(scene, plan.maps, fixed_points(scene.sheet), derive_material(scene, plan.maps))


def _read_maps(scene: Scene) -> tuple[dict[str, MapImage], list[Problem]]:
    """Read the images of a scene's stiffness maps; unreadable ones become problems."""
    maps, problems = {}, []
    for name, stiffness_map in scene.maps.items():
        try:
            maps[name] = read_map(stiffness_map)
        except PictureError as error:
            problems.append(Problem((scene.kind, name, "image"), str(error)))
    return maps, problems


def _plan(scene: Scene, maps: Maps, fixed: NDArray[np.bool_], material: Material) -> Plan:
    limit = stable_step(material, scene.sheet, scene.time.damping_difference)
    grid = TimeGrid(scene.time.frames_per_second, scene.time.frames, steps_per_frame(scene.time, limit), "f64")
    tools = build_tools(scene.probes, scene.sheet)
    return choose_precision(Plan(scene, maps, fixed, material, limit, grid, build_slots(scene, grid), tools), "cpu")


def choose_precision(plan: Plan, arch: str) -> Plan:
    """Return a plan with the precision chosen for an arch, cpu, cuda or vulkan.

    Quasi-static scenes always use f64. With `auto`, a CPU uses f64 if the scene has a tolerance or if stepping is a
    small part of the work; GPUs use f32, because f64 is slow or missing there.
    """
    time = plan.scene.time
    if time.at_rest:
        return plan.with_grid(precision="f64")
    if time.precision != "auto":
        return plan.with_grid(precision=time.precision)
    f64_is_cheap = F64_WORK * _stepping_work(plan) <= MAX_F64_FRACTION * _other_work(plan.scene)
    in_f64 = arch == "cpu" and (time.tolerance is not None or f64_is_cheap)
    return plan.with_grid(precision="f64" if in_f64 else "f32")


def stable_step(material: Material, sheet: Sheet, difference: str) -> float:
    """Return the largest stable step of a sheet [s] for a difference quotient of the damping, central or backward."""
    return INTEGRATORS[difference].largest_step(highest_frequency(material, sheet), material.drag)


def min_stable_steps(plan: Plan) -> int:
    """Return the smallest stable number of steps per frame."""
    return max(1, math.ceil(1 / plan.grid.frames_per_second / plan.stable_step * ROUNDING_MARGIN))


def steps_per_frame(time: Time, limit: float) -> int:
    """Return the number of steps per frame, for the largest stable step [s]; 1 in quasi-static scenes.

    With `auto`, it is the smallest number whose step is at most half the limit; `accuracy.time_step` increases it for a
    tolerance. A given step is rounded to a frame divided by a whole number.
    """
    if time.at_rest:
        return 1
    frame = 1 / time.frames_per_second
    if time.step == "auto":
        return max(1, math.ceil(2 * frame / limit * ROUNDING_MARGIN))
    return max(1, round(frame / time.step))


def with_time(scene: Scene, **changes: Any) -> Scene:
    """Return a copy of a scene with other values in its section `time`, which are not validated."""
    return scene.model_copy(update={"time": scene.time.model_copy(update=changes)})


def freeze_grid(plan: Plan) -> Plan:
    """Write the chosen precision, and the step chosen for a tolerance, into the scene of a plan.

    Every plan of this scene then has the same grid on any arch. Without a tolerance the step is left as it is, because
    it follows from the scene.
    """
    changes: dict[str, Any] = {"precision": plan.grid.precision}
    if plan.scene.time.tolerance is not None:
        changes |= {"step": 1 / plan.grid.frames_per_second / plan.grid.steps_per_frame, "tolerance": None}
    return replace(plan, scene=with_time(plan.scene, **changes))


def _step_problems(plan: Plan) -> Iterator[Problem]:
    given, limit, frame = plan.scene.time.step, plan.stable_step, 1 / plan.grid.frames_per_second
    if plan.scene.time.at_rest or given == "auto":
        return
    if given > limit * (1 + 1e-12):
        below = frame / math.ceil(frame / limit)
        text = f"{given:g} s is above the stability limit {limit:.6g} s; try {below:.9g}, or auto"
        yield Problem(("time", "step"), text)
    elif abs(frame / given - round(frame / given)) > FRAME_TOLERANCE * max(1.0, frame / given):
        text = f"{given:g} s does not divide a frame of {frame:.9g} s; try {frame / math.ceil(frame / given):.9g}"
        yield Problem(("time", "step"), text)


def precision_problems(plan: Plan) -> Iterator[Problem]:
    """Check that lengths and gain are in the range of the precision."""
    if plan.grid.precision == "f64":
        return
    rest, step, mass = rest_of(plan.scene.sheet), plan.grid.step, plan.material.mass
    least, most = (MIN_F32_LENGTH_M, MAX_F32_LENGTH_M) if rest.is_flat else CURVED_F32_LENGTHS_M
    if rest.shortest_side < least or rest.extent > most:
        yield Problem(
            ("sheet", "size"),
            f"cells of {rest.shortest_side:g} m in a sheet of {rest.extent:g} m leave the range of f32, "
            f"{least:g} to {most:g} m; take time.precision: f64",
        )
    gain = step**2 / mass
    if not MIN_F32_LENGTH_M**2 < gain < MAX_F32_LENGTH_M**2:
        yield Problem(
            ("time", "precision"),
            f"a step of {step:g} s moves a mass of {mass:g} kg by {gain:g} m per newton, outside the range of f32; "
            "take f64",
        )


Keyframe = tuple[float, float, float, float]


def steer_plan(plan: Plan, probes: Sequence[Probe | Mapping[str, Any] | None], now: float) -> Plan:
    """Replace the probes of a plan from a time [s] on; None or the current probe for no change.

    The given `path` of a position-controlled tool contains only keyframes after `now`; a mapping may omit its
    instrument, friction and grips, which then stay the same. The new paths include the past keyframes on which later
    steps depend. An ArgumentError reports another number of probes, and a SceneError an invalid probe or a position-
    controlled tool that would jump or change its past.
    """
    before = plan.scene.probes
    if len(probes) != len(before):
        raise ArgumentError(f"probes: {len(probes)} given, but the scene has {len(before)}; give all of them")
    given = [_fill_omitted_keys(*pair) for pair in zip(before, probes, strict=True)]
    after = plan.with_probes(given)
    joined = list(after.scene.probes)
    lines = [str(problem) for problem in place_problems(after.scene, rest_of(plan.scene.sheet))]
    for index, (old, new) in enumerate(zip(before, after.scene.probes, strict=True)):
        if old.moved and new.moved and old != new:
            lines += [str(problem) for problem in _path_problems(plan, index, old, new, now)]
            if not lines:
                joined[index], _ = _join_paths(plan, old, new, now)
    if lines:
        raise SceneError(lines)
    return after.with_probes(joined) if joined != list(after.scene.probes) else after


def with_current_paths(plan: Plan, probes: Sequence[Probe]) -> Plan:
    """Return a plan with the position-controlled tools of other probes, one per probe of the plan."""
    if not plan.tools:
        return plan
    pairs = zip(plan.scene.probes, probes, strict=True)
    return plan.with_probes([new if old.moved and new.moved else old for old, new in pairs])


def _fill_omitted_keys(before: Probe, given: Probe | Mapping[str, Any] | None) -> Probe | Mapping[str, Any]:
    if given is None:
        return before
    if not (before.moved and isinstance(given, Mapping) and "path" in given):
        return given
    if before.clamp is not None:
        return {"clamp": before.clamp, **given}
    return {"instrument": before.instrument, "friction": before.friction, "grip": before.grip, **given}


def _join_paths(plan: Plan, before: Probe, given: Probe, now: float) -> tuple[Probe, int]:
    """Return the given probe with past keyframes that later steps need before its path, and the last one's index."""
    assert before.path is not None
    assert given.path is not None
    tolerance = FRAME_TOLERANCE / plan.grid.frames_per_second
    past = _past_keyframes(before.path, now, tolerance)
    begun = [begin for begin, end in given.grip if begin < now < end]
    if before.path[-1][0] < now - tolerance and not begun:
        past = past[-1:]  # The tool has not pressed since its last keyframe.
    # Averages of loads reach one step back, and bounds of the energy one frame.
    since = min([now - 1 / plan.grid.frames_per_second, *begun]) - 2 * plan.grid.step
    past = past[max((n for n, key in enumerate(past) if key[0] <= since), default=0) :]
    return given.model_copy(update={"path": (*past, *given.path)}), len(past) - 1


def _path_problems(plan: Plan, index: int, before: Probe, given: Probe, now: float) -> Iterator[Problem]:
    """Report keyframes in the past, jumps of position or shape, and grips that begin in the past."""
    key, sheet, at_rest = ("probes", index), plan.scene.sheet, plan.scene.time.at_rest
    # Times that differ by less count as equal [s].
    tolerance = FRAME_TOLERANCE / plan.grid.frames_per_second
    assert given.path is not None
    if given.path[0][0] <= now + tolerance:
        text = f"is at {given.path[0][0]:g} s, not after the current time, {now:g} s; give only later times"
        yield Problem((*key, "path", 0), text)
        return
    if given.clamp != before.clamp:
        yield Problem((*key, "clamp"), "cannot change; restart with the new scene")
        return
    joined, first = _join_paths(plan, before, given, now)
    old_tools, tools = (solid_tools(build_tools((probe,), sheet)) for probe in (before, joined))
    for n, tool in tools.items():
        if problem := tool.friction_problem(at_rest=at_rest):
            yield Problem((*key, "friction"), problem)
        if not at_rest and (fault := tool.speed_problem(plan.grid, first)):
            yield Problem((*key, "path", fault[0] - first - 1), fault[1])
        deviation = _shape_change(old_tools[n], tool)
        if deviation > tool.stride_limit:
            text = f"changes by {deviation:.3g} m in a step, over {tool.stride_limit:.3g} m; change it gradually"
            yield Problem((*key, "instrument"), text)
    for n, (begin, end) in enumerate(given.grip):
        has_ended = end <= now + tolerance
        continues = any(begin == old_begin and old_end > now + tolerance for old_begin, old_end in before.grip)
        if begin < now - tolerance and not (has_ended or continues):
            text = f"begins at {begin:g} s, before the current time, {now:g} s; begin at that time or later"
            yield Problem((*key, "grip", n), text)


def _past_keyframes(path: Sequence[Keyframe], now: float, tolerance: float) -> list[Keyframe]:
    """Return the keyframes of a path up to a time, with an interpolated one at this time if it has none."""
    past = [key for key in path if key[0] <= now + tolerance]
    if past and past[-1][0] >= now - tolerance:
        return past
    times, *coordinates = np.array(path).T
    across, down, height = (float(np.interp(now, times, values)) for values in coordinates)
    return [*past, (now, across, down, height)]


def _shape_change(before: SolidTool, after: SolidTool) -> float:
    """Bound the displacement [m] of points of a tool whose shape changes while its lowest point is fixed."""
    ends = np.linalg.norm(after.length * after.axis - before.length * before.axis)
    return float(ends) + 2 * abs(after.radius - before.radius)
