"""Plain data -> Scene, or everything that is wrong with it, each problem at its key."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from taichi_msm import faults
from taichi_msm.errors import ArgumentError, Problem, SceneError
from taichi_msm.physics import material, timestep
from taichi_msm.render import camera, texture
from taichi_msm.scene import Scene, Section
from taichi_msm.scenefile import budget

Model = TypeVar("Model", bound=Section)

# What one section cannot know: these see the whole scene, once `material` finds it to be one.
CHECKS: tuple[Callable[[Scene], Iterable[Problem]], ...] = (
    timestep.problems,
    camera.problems,
    texture.problems,
    budget.problems,
)

# Faultless sections to stand for faulty ones, chosen so that no check finds anything in them.
_STAND_INS: dict[str, Any] = {
    "image": None,
    "sheet": {"points": [2, 2], "size": [1, 1]},
    "tissue": {"young": 1e-20, "thickness": 1, "density": 1},
    "springs": {},
    "time": {"duration": 1, "frames_per_second": 1},
    "output": [],
}


def validate(data: dict[str, Any]) -> tuple[Scene | None, list[Problem]]:
    """Check a scene, its keys first and then what joins them.

    Where some sections are wrong, the checks that join several keys still run on the others, so that all
    problems come at once.

    Returns:
        The scene, None if there is any problem; and the problems.
    """
    problems: list[Problem] = []
    # Pydantic asks for the picture once the sections are faultless, and CHECKS run once it has that too.
    for _ in range(3):
        scene, found = parse(Scene, data)
        problems += found
        if scene is not None:
            problems += joint_problems(scene)
            break
        data = _spare(data, found)
    return (None if problems else scene), problems


def joint_problems(scene: Scene, *, picture: bool = True) -> list[Problem]:
    """Find what is wrong with keys that are right each by itself.

    Args:
        scene: whose sections are right.
        picture: whether its picture is looked at.
    """
    checks = [check for check in CHECKS if picture or check is not texture.problems]
    found = list(material.problems(scene))
    if found:
        # Steps and memory follow from what the sheet is made of.
        checks = [check for check in checks if check in (camera.problems, texture.problems)]
    return found + [problem for check in checks for problem in check(scene)]


def checked(scene: Scene | Mapping[str, Any]) -> Scene:
    """Give a scene of which all but its picture is checked.

    Args:
        scene: one that may have been made in Python, or its keys.

    Raises:
        SceneError: with all that is wrong with it.
    """
    if isinstance(scene, Scene):
        problems = joint_problems(scene, picture=False)
        made: Scene | None = scene
    elif isinstance(scene, Mapping):
        made, problems = validate(dict(scene))
    else:
        raise ArgumentError(f"{type(scene).__name__} is no scene; take what load_scene returns, or a mapping")
    if made is None or problems:
        raise SceneError([str(problem) for problem in problems])
    return made


def _spare(data: dict[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Replace the faulty sections; without the picture, nothing may ask to draw it."""
    faulty = {problem.path[0] for problem in problems}
    if "image" in faulty:
        faulty.add("output")
    spared = {name: value for name, value in data.items() if name not in faulty} | {
        name: value for name, value in _STAND_INS.items() if name in faulty
    }
    if "sheet" in faulty and "tissue" not in spared:
        spared["sheet"] = {**spared["sheet"], "mass": 1}
    return spared


def parse(model: type[Model], data: dict[str, Any]) -> tuple[Model | None, list[Problem]]:
    """Check each section of a file by itself.

    Returns:
        What the file says, None if there is any problem; and the problems.
    """
    try:
        return model.model_validate(data), []
    except ValidationError as error:
        return None, faults.problems(error, model, data)
