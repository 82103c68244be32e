"""Plain data -> Scene, or everything that is wrong with it, each problem at its key."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import cache
from types import UnionType
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin

from pydantic import ValidationError

from taichi_msm import budget, camera, stability, texture
from taichi_msm.errors import Path, Problem
from taichi_msm.scene import LARGEST, REFUSED, SMALLEST, Scene, Section

MAX_SHOWN = 60

# Nobody reads further, and a broken file of the greatest size has tens of thousands.
MAX_FAULTS = 1000

Model = TypeVar("Model", bound=Section)

# What one section cannot know: these see the whole scene.
CHECKS: tuple[Callable[[Scene], Iterable[Problem]], ...] = (
    stability.problems,
    camera.problems,
    texture.problems,
    budget.problems,
)

# Faultless sections to stand for faulty ones, chosen so that no check finds anything in them.
_STAND_INS: dict[str, Any] = {
    "image": None,
    "sheet": {"points": [2, 2], "size": [1, 1], "mass": 1},
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
            problems += [problem for check in CHECKS for problem in check(scene)]
            break
        data = _spare(data, found)
    return (None if problems else scene), problems


def flow(value: Any) -> str:
    """Show a value as it could stand in the file, cut to a line's measure."""
    return cut(json.dumps(value, ensure_ascii=False))


def cut(text: str) -> str:
    """Keep the beginning of a long text."""
    return text if len(text) <= MAX_SHOWN else text[:MAX_SHOWN] + "..."


def _spare(data: dict[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Replace the faulty sections; without the picture, nothing may ask to draw it."""
    faulty = {problem.path[0] for problem in problems}
    if "image" in faulty:
        faulty.add("output")
    return {name: value for name, value in data.items() if name not in faulty} | {
        name: value for name, value in _STAND_INS.items() if name in faulty
    }


def parse(model: type[Model], data: dict[str, Any]) -> tuple[Model | None, list[Problem]]:
    """Check each section of a file by itself.

    Returns:
        What the file says, None if there is any problem; and the problems.
    """
    try:
        return model.model_validate(data), []
    except ValidationError as error:
        faults = [_fault(one, model) for one in error.errors(include_url=False, include_input=False)[:MAX_FAULTS]]
        settled = _drop_short(_choose_kinds(faults))
        return None, [Problem(fault.path, _message(fault, data)) for fault in settled]


class _Fault(NamedTuple):
    """One of pydantic's errors, in terms of the document.

    Attributes:
        path: the key at fault.
        kind: pydantic's type of the error.
        text: its message.
        context: the numbers and names in the message.
        section: the section that the key belongs to.
        expects: what the key may hold.
        choice: the nearest key above that may hold values of several kinds, if there is one.
        branch: the one of these kinds that was tried.
    """

    path: Path
    kind: str
    text: str
    context: dict[str, Any]
    section: type[Section]
    expects: str
    choice: Path | None
    branch: str


class _Key(NamedTuple):
    """What `_fault` needs of a key: the section below it or its own, what it expects, if of several kinds."""

    section: type[Section]
    expects: str
    has_choice: bool


def _fault(error: Any, section: type[Section]) -> _Fault:
    """Follow an error's location through the models, past pydantic's names for the kinds of a value."""
    path: Path = ()
    expects, choice, branch = "", None, ""
    parts = iter(error["loc"])
    for part in parts:
        path += (part,)
        if part in section.model_fields:
            section, expects, has_choice = _describe(section, part)
            if has_choice:
                choice, branch = path, next(parts, "")
    context = error.get("ctx", {})
    if "key" in context:
        path += (context["key"],)
    return _Fault(path, error["type"], error["msg"], context, section, expects, choice, branch)


@cache
def _describe(section: type[Section], name: str) -> _Key:
    field = section.model_fields[name]
    extra = field.json_schema_extra
    assert isinstance(extra, dict)
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)]
    has_choice = get_origin(field.annotation) in (Union, UnionType) and len(kinds) > 1
    return _Key(next(_sections(field.annotation), section), str(extra["expects"]), has_choice)


def _sections(annotation: Any) -> Iterator[type[Section]]:
    """Find the sections in an annotation such as tuple[Probe, ...]."""
    if get_origin(annotation) is None and isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for argument in get_args(annotation):
        yield from _sections(argument)


def _choose_kinds(faults: Sequence[_Fault]) -> Iterator[_Fault]:
    """Of a key that may hold several kinds of value, report only the kind that was meant.

    That is the one that got furthest into the value; if two got equally far, all of the value is at fault.
    """
    reached: dict[Path | None, dict[str, int]] = defaultdict(dict)
    for fault in faults:
        reached[fault.choice][fault.branch] = max(reached[fault.choice].get(fault.branch, 0), len(fault.path))
    for fault in faults:
        branches = reached[fault.choice]
        furthest = max(branches.values())
        if fault.choice is None:
            yield fault
        elif list(branches.values()).count(furthest) > 1:
            yield fault._replace(path=fault.choice, kind="choice")
        elif branches[fault.branch] == furthest:
            yield fault


def _drop_short(faults: Iterable[_Fault]) -> Iterator[_Fault]:
    """Report a list that lacks items as one fault, and not at all where an item of it is at fault."""
    merged = [
        fault._replace(path=fault.path[:-1], kind="too_short")
        if fault.kind == "missing" and isinstance(fault.path[-1], int)
        else fault
        for fault in faults
    ]
    parents = {fault.path[:n] for fault in merged for n in range(len(fault.path))}
    return (fault for fault in merged if fault.kind != "too_short" or fault.path not in parents)


def _message(fault: _Fault, data: Any) -> str:
    """Say what is wrong and what is expected."""
    if fault.kind == REFUSED:
        return fault.text
    if fault.kind == "missing":
        return f"missing; expected {fault.expects}"
    if fault.kind == "extra_forbidden":
        return _unknown(str(fault.path[-1]), list(fault.section.model_fields))
    for part in fault.path:
        data = data[part]
    limit = fault.context.get("ge", fault.context.get("le"))
    if limit in (LARGEST, -LARGEST) or (limit == SMALLEST and data > 0):
        return f"{flow(data)} is out of range; numbers are from {SMALLEST:g} to {LARGEST:g} in size"
    return f"{flow(data)} is not allowed; expected {fault.expects}"


def _unknown(name: str, known: Sequence[str]) -> str:
    near = get_close_matches(name[:MAX_SHOWN], known, n=1)
    return f"unknown key; did you mean '{near[0]}'?" if near else f"unknown key; allowed: {', '.join(known)}"
