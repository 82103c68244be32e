"""Plain data -> Scene and its plan, or everything that is wrong with it: a list of problems, each with its key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from taichi_msm.errors import ArgumentError, Problem, SceneError
from taichi_msm.load import cost
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Maps
from taichi_msm.render.camera import camera_problems
from taichi_msm.render.texture import image_problems
from taichi_msm.scene import outputs, section
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import Section
from taichi_msm.solver.planning import try_plan

Model = TypeVar("Model", bound=Section)

# Valid sections that replace faulty ones; no check finds anything in them.
_STAND_INS: dict[str, Any] = {
    "image": None,
    "sheet": {"points": [2, 2], "size": [1, 1]},
    "tissue": {"young": 1e-20, "thickness": 1, "density": 1},
    "springs": {},
    "time": {"duration": 1, "frames_per_second": 1},
    "output": [],
}


def validate(data: dict[str, Any]) -> tuple[Plan | None, list[Problem]]:
    """Check a scene: first each key by itself, then several keys together.

    If some sections are faulty, the checks of several keys still run on the others, so that all problems are reported
    at once. Returns the scene's plan, or None if there is any problem; and the problems.
    """
    problems: list[Problem] = []
    plan = None
    # Pydantic checks the scene as a whole once its sections are valid, and several keys are checked once that finds
    # nothing either.
    for _ in range(3):
        scene, wrong = parse_model(Scene, data)
        problems += wrong
        if scene is not None:
            plan, wrong = _joint_check(scene)
            problems += wrong
            break
        data = _spare(data, wrong)
    return (None if problems else plan), problems


def _joint_check(scene: Scene, maps: Maps | None = None, *, picture: bool = True) -> tuple[Plan | None, list[Problem]]:
    """Plan a scene whose keys are valid each by itself, and find what is wrong with several keys together."""
    plan, problems = try_plan(scene, maps)
    problems += camera_problems(scene)
    if "mp4" in scene.output and not outputs.is_pyav_installed():
        problems.append(Problem(("output",), outputs.PYAV_NOT_INSTALLED))
    if picture:
        problems += image_problems(scene)
    if plan is not None:
        problems += cost.size_problems(plan)
    return plan, problems


def check_scene(scene: Plan | Scene | Mapping[str, Any], maps: Maps | None = None) -> Plan:
    """Check a scene but for its picture, or a mapping of its keys, and plan it for a CPU; a plan was checked before.

    Raises:
        ArgumentError: when it is none of these.
        SceneError: with everything that is wrong with it.
    """
    if isinstance(scene, Plan):
        return scene
    if isinstance(scene, Scene):
        plan, problems = _joint_check(scene, maps, picture=False)
    elif isinstance(scene, Mapping):
        plan, problems = validate(dict(scene))
    else:
        raise ArgumentError(f"{type(scene).__name__} is no scene; take what load_scene returns, or a mapping")
    if plan is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return plan


def _spare(data: dict[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Replace the faulty sections; without a picture, output that draws it is removed too."""
    faulty = {problem.path[0] for problem in problems}
    if "image" in faulty:
        faulty.add("output")
    output = data.get("output")
    if "render" in faulty and isinstance(output, list):
        # Without the cameras, an output of a stereo pair cannot be checked.
        stereo = {name for name, row in OUTPUTS.items() if row.needs_stereo_pair}
        data = {**data, "output": [name for name in output if name not in stereo]}
    spared = {name: value for name, value in data.items() if name not in faulty} | {
        name: value for name, value in _STAND_INS.items() if name in faulty
    }
    time = data.get("time")
    if "time" in faulty and isinstance(time, Mapping) and time.get("motion", "dynamic") != "dynamic":
        spared["time"] = {**spared["time"], "motion": "quasistatic"}
    if "sheet" in faulty and "tissue" not in spared:
        spared["sheet"] = {**spared["sheet"], "mass": 1}
    return spared


def parse_model(model: type[Model], data: dict[str, Any]) -> tuple[Model | None, list[Problem]]:
    """Check each key by itself; returns the model, or None if there is any problem, and the problems."""
    try:
        return model.model_validate(data), []
    except ValidationError as error:
        return None, section.key_problems(error, model, data)
