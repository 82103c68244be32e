"""How much work a run is, and what follows from it: whether f64 is cheap enough for `auto`, and whether pilots are.

The unit of work is a step of one point in f32, which takes 1 to 2 ns on two cores of 2024. It is counted from the scene
alone, so that the decisions are the same on every machine.

From a scene to its plan, and the choice of its steps and their precision.

Other loads, and other paths of tools, from a time of a run on.

A tool that is moved cannot jump: it goes straight from where it is to the first key of its new path. What it did before
stays part of its path as far as later steps depend on it: on its place when its grip began, and on whether it pressed.
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
from taichi_msm.model.plan import Plan, slots_of
from taichi_msm.model.sheet import (
    MapImage,
    Maps,
    Material,
    fixed_points,
    kind_problems,
    read_map,
    spacing,
    tissue_problems,
)
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.model.tools import LARGEST_STRIDE, Tool, path_problems, too_fast, tools_of
from taichi_msm.scene.scene import Scene, Time
from taichi_msm.scene.section import FRAME_TOLERANCE
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe
from taichi_msm.terms import highest_frequency, material_of

# Work of starting Python and Taichi and of compiling the kernels.
START = 4e8

# Work of a step of a point in f64.
DOUBLE = 2.0

# Additional work of a step for a moving control point, for bending and for a tool that touches, relative to the step
# without them.
MOVING, BENDING, CONTACT = 1.2, 1.0, 0.5

# Work of encoding a pixel, and of drawing one of its samples.
ENCODING, SAMPLE = 40.0, 6.0

# Evaluations of the forces that a frame at rest takes, for each of the rows and columns together. Each is a step, and
# as much again to move the points.
EVALUATIONS = 2.0

# Stepping in f64 is a small part of a run if it takes at most this share of the time of everything else.
SMALL = 0.25

# Unless they are asked for, pilots are run only if they take at most this share of the run.
MOST_FOR_PILOTS = 2 / 5


class Work(NamedTuple):
    """The work of the parts of a run."""

    start: float  # starting Python and Taichi, and compiling the kernels
    stepping: float  # all steps
    pilots: float  # those that go with the run
    pictures: float  # drawing and encoding


def work(plan: Plan, pilots: float) -> Work:
    """Count the work of a run; pilots: their steps in f64 for each step of it, counted in steps of the whole sheet."""
    steps = _steps(plan)
    stepping = DOUBLE * steps if plan.grid.precision == "f64" else steps
    return Work(START, stepping, DOUBLE * pilots * steps, _other(plan.scene) - START)


def is_small_in_f64(plan: Plan) -> bool:
    """Tell whether stepping in f64 is a small part of a run, so that `auto` chooses it."""
    return DOUBLE * _steps(plan) <= SMALL * _other(plan.scene)


def affords_pilots(plan: Plan, pilots: float) -> bool:
    """Tell whether pilots take at most two fifths of a run; arguments as for `work`."""
    parts = work(plan, pilots)
    return parts.pilots <= MOST_FOR_PILOTS * sum(parts)


def _steps(plan: Plan) -> float:
    """Count the work of stepping in f32, or of finding the shape of every frame."""
    moving, points = sum(slot.moves for slot in plan.slots), plan.scene.sheet.points
    cost = 1 + MOVING * moving + BENDING * (plan.material.bending > 0) + CONTACT * len(plan.tools)
    steps = float(plan.grid.steps)
    if plan.scene.time.at_rest:
        cost, steps = cost + 1, EVALUATIONS * sum(points) * (plan.grid.frames + 1)
    return cost * steps * math.prod(points)


def _other(scene: Scene) -> float:
    """Count the work of everything but stepping."""
    pixels = (scene.time.frames + 1) * math.prod(scene.render.size) * len(scene.render.all_cameras) * scene.renders
    return START + pixels * (ENCODING + SAMPLE * scene.render.supersample**2)


pass  # REMOVED

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
    in_f64 = arch == "cpu" and (time.tolerance is not None or is_small_in_f64(plan))
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
    A tolerance may ask for more steps, which `time_step.choose_step` finds. At rest a frame counts as a step.
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
    elif abs(frame / given - round(frame / given)) > FRAME_TOLERANCE * max(1.0, frame / given):
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


Key = tuple[float, float, float, float]


def steered(plan: Plan, probes: Sequence[Probe | Mapping[str, Any] | None], now: float) -> Plan:
    """Replace the probes of a plan from a time on [s].

    A tool that stays as it is, also on its path, is None or given as it is. Any other with a path gets the keys of its
    path from `now` on; in a mapping, what is not given of its instrument, friction and grips stays.

    Raises:
        ArgumentError: when they are more or fewer.
        SceneError: when one of them is not a probe; or when a tool that is moved would jump, or do something before
            `now`.
    """
    before = plan.scene.probes
    if len(probes) != len(before):
        raise ArgumentError(f"probes: {len(probes)} are given, and the scene has {len(before)}; give all of them")
    given = [_completed(*pair) for pair in zip(before, probes, strict=True)]
    after = plan.with_probes(given)
    steering = [
        _Steering(plan, index, *pair, now)
        for index, pair in enumerate(zip(before, after.scene.probes, strict=True))
        if pair[0].moved and pair[1].moved and pair[0] != pair[1]
    ]
    if lines := [str(problem) for one in steering for problem in one.problems()]:
        raise SceneError(lines)
    going_on = {one.index: one.probe for one in steering}
    if not going_on:
        return after
    return after.with_probes([going_on.get(index, probe) for index, probe in enumerate(after.scene.probes)])


def with_paths_of(plan: Plan, probes: Sequence[Probe]) -> Plan:
    """Give the tools that are moved the paths, and all else, that they have among these probes."""
    if not plan.tools:
        return plan
    pairs = zip(plan.scene.probes, probes, strict=True)
    return plan.with_probes([other if own.moved and other.moved else own for own, other in pairs])


def _completed(before: Probe, given: Probe | Mapping[str, Any] | None) -> Probe | Mapping[str, Any]:
    if given is None:
        return before
    if not (before.moved and isinstance(given, Mapping) and "path" in given):
        return given
    return {"instrument": before.instrument, "friction": before.friction, "grip": before.grip, **given}


class _Steering:
    """A tool that gets another path.

    Attributes:
        index: of its probe.
        probe: with the path that it has from now on, and what counts of that which it had before.
    """

    def __init__(self, plan: Plan, index: int, before: Probe, given: Probe, now: float) -> None:
        self.index, self._plan, self._before, self._given, self._now = index, plan, before, given, now
        # Times that are as good as now.
        self._nearly = FRAME_TOLERANCE / plan.grid.frames_per_second
        assert before.path is not None
        assert given.path is not None
        self._past, h = _past(before.path, now, self._nearly), plan.grid.step
        begun = [begin for begin, end in given.grip if begin < now < end]
        if before.path[-1][0] < now - self._nearly and not begun:
            self._past = self._past[-1:]  # It has not pressed since the last key.
        # The averages of loads reach a step back, and bounds of the energy a frame.
        since = min([now - 1 / plan.grid.frames_per_second, *begun]) - 2 * h
        self._past = self._past[max((n for n, key in enumerate(self._past) if key[0] <= since), default=0) :]
        self.probe = given.model_copy(update={"path": (*self._past, *given.path)}) if self._is_later() else given

    def problems(self) -> Iterator[Problem]:
        """Find what a tool cannot do from one step to the next."""
        now, nearly, where = self._now, self._nearly, ("probes", self.index)
        assert self._given.path is not None
        if not self._is_later():
            said = f"is at {self._given.path[0][0]:g} s, and it is {now:g} s; give only times after that"
            yield Problem((*where, "path", 0), said)
            return
        grid, sheet = self._plan.grid, self._plan.scene.sheet
        (was,), (tool,) = tools_of((self._before,), sheet), tools_of((self.probe,), sheet)
        first = len(self._past) - 1
        if not self._plan.scene.time.at_rest and (fault := too_fast(tool, grid, first)):
            yield Problem((*where, "path", fault[0] - first - 1), fault[1])
        turned = _change(was, tool)
        if turned > LARGEST_STRIDE * tool.radius:
            yield Problem(
                (*where, "instrument"),
                f"changes its shape by {turned:.3g} m in a step, over half its radius; change it little by little",
            )
        for n, (begin, end) in enumerate(self._given.grip):
            is_over = end <= now + nearly
            goes_on = any(begin == began and ends > now + nearly for began, ends in self._before.grip)
            if begin < now - nearly and not (is_over or goes_on):
                said = f"begins at {begin:g} s, and it is {now:g} s; begin at that time or later"
                yield Problem((*where, "grip", n), said)

    def _is_later(self) -> bool:
        assert self._given.path is not None
        return self._given.path[0][0] > self._now + self._nearly


def _past(path: Sequence[Key], now: float, nearly: float) -> list[Key]:
    """Give the keys of a path up to a time, the last one at that time."""
    past = [key for key in path if key[0] <= now + nearly]
    if past and past[-1][0] >= now - nearly:
        return past
    times, *places = np.array(path).T
    across, down, height = (float(np.interp(now, times, place)) for place in places)
    return [*past, (now, across, down, height)]


def _change(before: Tool, after: Tool) -> float:
    """Bound how far any point of a rod moves when it becomes another one, whose lowest point is at the same place."""
    ends = np.linalg.norm(after.length * after.axis - before.length * before.axis)
    return float(ends) + 2 * abs(after.radius - before.radius)
