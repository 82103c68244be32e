"""Validation of a scene, which reports all problems at once, each with its key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError, closest_name
from taichi_msm.load import cost
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Maps
from taichi_msm.render.camera import camera_problems
from taichi_msm.render.texture import image_problems, picture_problems
from taichi_msm.scene import outputs, section
from taichi_msm.scene.framing import is_framed
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import Section
from taichi_msm.solver.planning import try_plan

Model = TypeVar("Model", bound=Section)

# Valid sections that replace faulty ones.
_REPLACEMENTS: dict[str, Any] = {
    "image": None,
    "sheet": {"points": [2, 2], "size": [1, 1]},
    "tissue": {"young": 1e-20, "thickness": 1, "density": 1},
    "springs": {},
    "time": {"duration": 1, "frames_per_second": 1},
    "output": [],
}


def validate(data: dict[str, Any]) -> tuple[Plan | None, list[Problem]]:
    """Return the plan of a scene, None if it is invalid, and all problems of its keys and of their combinations.

    Faulty sections are replaced by valid ones before combinations are checked, so that all problems come at once.
    """
    problems: list[Problem] = []
    plan = None
    if is_framed(data) and (unreadable := list(picture_problems(data.get("image")))):
        return None, unreadable  # Cameras and sheet depend on its size.
    # At most three passes: sections; the whole scene, which pydantic validates after all sections; combinations.
    for _ in range(3):
        scene, new_problems = parse_model(Scene, data)
        problems += new_problems
        if scene is not None:
            plan, new_problems = _check_combinations(scene, None, with_image=True)
            # If a section that determines the step was replaced, problems of the tools' speed are meaningless.
            replaced = {problem.path[0] for problem in problems} & {"sheet", "tissue", "springs", "time"}
            problems += [
                _with_file(problem, data) for problem in new_problems if not (replaced and "path" in problem.path)
            ]
            break
        data = _replace_faulty(data, new_problems)
    if any(problem.path[:2] == ("sheet", "surface") and _hides_kind(problem) for problem in problems):
        # The camera of some surfaces needs no eye.
        problems = [problem for problem in problems if (problem.path[:1], problem.path[-1:]) != (("render",), ("eye",))]
    return (None if problems else plan), problems


def _hides_kind(problem: Problem) -> bool:
    """Return whether the kind of the surface is unknown because of its problem."""
    return len(problem.path) == 2 or (len(problem.path) == 3 and problem.is_unknown_key)


def value_at(data: Any, key: Key) -> Any:
    """Return the value at a key of unvalidated data, through mappings only; None for a missing key."""
    for part in key:
        data = data.get(part) if isinstance(data, dict) else None
    return data


def _with_file(problem: Problem, data: dict[str, Any]) -> Problem:
    """Prefix the message of a trajectory with the path of its file."""
    path = value_at(data, problem.path) if problem.path[-1:] == ("poses",) else None
    return Problem(problem.path, f"{path}: {problem.message}") if isinstance(path, str) else problem


def _check_combinations(scene: Scene, maps: Maps | None, *, with_image: bool) -> tuple[Plan | None, list[Problem]]:
    """Plan a scene, and check combinations of its keys; with `with_image`, also the image file."""
    plan, problems = try_plan(scene, maps)
    # Cameras look at the sheet at rest.
    if plan is not None or not (scene.sheet.surface or scene.sheet.mask):
        problems += camera_problems(scene)
    if "mp4" in scene.output and not outputs.is_pyav_installed():
        problems.append(Problem(("output",), outputs.PYAV_NOT_INSTALLED))
    if with_image:
        problems += image_problems(scene)
    if plan is not None:
        problems += cost.size_problems(plan)
    return plan, problems


def check_scene(scene: Plan | Scene | Mapping[str, Any], maps: Maps | None = None) -> Plan:
    """Validate a scene, except for the image file of a `Scene`, and plan it for a CPU; a plan is returned unchanged.

    `maps` are the images of the scene's maps, by key; None reads them from their files.
    """
    if isinstance(scene, Plan):
        return scene
    if isinstance(scene, Scene):
        plan, problems = _check_combinations(scene, maps, with_image=False)
    elif isinstance(scene, Mapping):
        plan, problems = validate(dict(scene))
    else:
        raise ArgumentError(f"{type(scene).__name__} is not a scene; take a Scene from load_scene, or a mapping")
    if plan is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return plan


def _replace_faulty(data: dict[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Replace faulty sections by valid ones, and remove outputs that depend on them."""
    faulty = {problem.path[0] for problem in problems}
    # The section that a misspelt one means is not missing.
    meant = {closest_name(str(problem.path[0]), Scene.model_fields) for problem in problems if problem.is_unknown_key}
    faulty |= meant - data.keys()
    if "image" in faulty:
        faulty.add("output")
    output = data.get("output")
    if is_framed(data) and faulty & {"image", "region", "render", "sheet"}:
        faulty |= {"render", "sheet"}  # The surface and its cameras belong together.
    if "render" in faulty and isinstance(output, list):
        # Without the cameras, an output of a stereo pair cannot be checked.
        stereo = {row.entry for row in OUTPUTS.values() if row.needs_stereo_pair}
        data = {**data, "output": [name for name in output if name not in stereo]}
    replacements = {name: value for name, value in _REPLACEMENTS.items() if name in faulty}
    valid = {name: value for name, value in data.items() if name not in faulty} | replacements
    time = data.get("time")
    if "time" in faulty and isinstance(time, Mapping) and time.get("motion", "dynamic") != "dynamic":
        valid["time"] = {**valid["time"], "motion": "quasistatic"}
    if "sheet" in faulty and "tissue" not in valid:
        valid["sheet"] = {**valid["sheet"], "mass": 1}
    return valid


def parse_model(model: type[Model], data: dict[str, Any]) -> tuple[Model | None, list[Problem]]:
    """Validate the keys of a section separately; return it without problems, or None and one for each faulty key."""
    try:
        return model.model_validate(data), []
    except ValidationError as error:
        return None, section.key_problems(error, model, data)
