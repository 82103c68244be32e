"""Plain data -> Scene, or everything that is wrong with it: a list of problems, each with its key."""

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

# Checks of keys in several sections. They require a scene in which `material.problems` finds nothing.
CHECKS: tuple[Callable[[Scene], Iterable[Problem]], ...] = (
    timestep.problems,
    camera.problems,
    texture.problems,
    budget.problems,
)

# Valid sections that replace faulty ones; no check finds anything in them.
_STAND_INS: dict[str, Any] = {
    "image": None,
    "sheet": {"points": [2, 2], "size": [1, 1]},
    "tissue": {"young": 1e-20, "thickness": 1, "density": 1},
    "springs": {},
    "time": {"duration": 1, "frames_per_second": 1},
    "output": [],
}


def validate(data: dict[str, Any]) -> tuple[Scene | None, list[Problem]]:
    """Check a scene: first each key by itself, then several keys together.

    If some sections are faulty, the checks of several keys still run on the others, so that all problems are reported
    at once.

    Returns:
        The scene, or None if there is any problem; and the problems.
    """
    problems: list[Problem] = []
    # Pydantic checks the scene as a whole once its sections are valid, and CHECKS run once that finds nothing either.
    for _ in range(3):
        scene, found = parse(Scene, data)
        problems += found
        if scene is not None:
            problems += joint_problems(scene)
            break
        data = _spare(data, found)
    return (None if problems else scene), problems


def joint_problems(scene: Scene, *, picture: bool = True) -> list[Problem]:
    """Find what is wrong with several keys together.

    Args:
        scene: whose keys are valid each by itself.
        picture: whether to check its picture too.
    """
    checks = [check for check in CHECKS if picture or check is not texture.problems]
    found = list(material.problems(scene))
    if found:
        # Steps and memory depend on what the sheet is made of, so they cannot be checked.
        checks = [check for check in checks if check in (camera.problems, texture.problems)]
    return found + [problem for check in checks for problem in check(scene)]


def checked(scene: Scene | Mapping[str, Any]) -> Scene:
    """Check a scene, except for its picture, and return it.

    Args:
        scene: a scene, which may have been made in Python, or a mapping of its keys.

    Raises:
        SceneError: with everything that is wrong with it.
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
    """Replace the faulty sections; without a picture, output that draws it is removed too."""
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
        The model made of the file, or None if there is any problem; and the problems.
    """
    try:
        return model.model_validate(data), []
    except ValidationError as error:
        return None, faults.problems(error, model, data)
