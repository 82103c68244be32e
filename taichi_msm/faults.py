"""Translate pydantic's errors into the user's terms: each problem at its key, with the values that it may have."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from types import UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

from taichi_msm.errors import Key, Problem, did_you_mean

# Beyond these limits, squares and quotients of two numbers overflow or underflow.
LARGEST = 1e30
SMALLEST = 1e-30

# The type of the errors that validators raise.
REFUSED = "refused"

MAX_SHOWN = 60

# The most faults that are reported; a broken file of the largest size can have tens of thousands.
MAX_FAULTS = 1000


def refused(message: str, *below: str | int) -> PydanticCustomError:
    """Make the error that a validator raises: the user reads this message, at the value or a key or item below it."""
    return PydanticCustomError(REFUSED, message, {"below": below})


def flow(value: Any) -> str:
    """Show a value as it could be written in the file, cut to a length that fits a line."""
    return cut(json.dumps(value, ensure_ascii=False, default=repr))


def cut(text: str) -> str:
    """Keep the beginning of a long text."""
    return text if len(text) <= MAX_SHOWN else text[:MAX_SHOWN] + "..."


def key_problems(error: ValidationError, section: type[BaseModel], data: Any) -> list[Problem]:
    """Say what pydantic found wrong with plain data that a model should match."""
    faults = [_fault(one, section) for one in error.errors(include_url=False, include_input=False)[:MAX_FAULTS]]
    return [Problem(fault.path, _message(fault, data)) for fault in _drop_short(_choose_kinds(faults))]


class _Fault(NamedTuple):
    """One of pydantic's errors, in terms of the document."""

    path: Key  # of the key at fault
    kind: str  # pydantic's type of the error
    text: str
    context: dict[str, Any]  # the numbers and names in the text
    section: type[BaseModel]  # that the key belongs to
    expects: str  # what the key may hold
    # The keys above it that may hold several kinds of value, each with the kind that was tried.
    choices: tuple[tuple[Key, str], ...]
    words: tuple[str, ...]  # those that the value may be


def _fault(error: Any, section: type[BaseModel]) -> _Fault:
    """Follow an error's location through the models, skipping pydantic's names for the kinds of a value."""
    path: Key = ()
    expects = ""
    choices: tuple[tuple[Key, str], ...] = ()
    words: tuple[tuple[str, ...], ...] = (), ()
    parts = iter(error["loc"])
    for part in parts:
        path += (part,)
        if part in section.model_fields:
            section, expects, has_names, has_choice, words = _describe(section, part)
            path += (name,) if has_names and (name := next(parts, None)) is not None else ()
            if has_choice:
                choices += ((path, next(parts, "")),)
    context = error.get("ctx", {})
    path += context.get("below", ())
    in_list = bool(path) and isinstance(path[-1], int)
    return _Fault(path, error["type"], error["msg"], context, section, expects, choices, words[in_list])


@cache
def _describe(
    section: type[BaseModel], name: str
) -> tuple[type[BaseModel], str, bool, bool, tuple[tuple[str, ...], ...]]:
    """Describe a key.

    Returns:
        Its section, or the one below it; what it may hold; whether that has values by names; whether it, or such a
        value, may be of several kinds; the words that it may be, and those that the items of its list may be.
    """
    field = section.model_fields[name]
    extra = field.json_schema_extra
    assert isinstance(extra, dict)
    kinds = _kinds(field.annotation)
    if has_names := get_origin(kinds[0]) is dict:
        kinds = _kinds(get_args(kinds[0])[1])
    words = tuple(tuple(_words(field.annotation, depth)) for depth in (0, 1))
    return next(_sections(field.annotation), section), str(extra["expects"]), has_names, len(kinds) > 1, words


def _kinds(annotation: Any) -> list[Any]:
    """List the kinds of value that an annotation allows, but for None."""
    if get_origin(annotation) not in (Union, UnionType):
        return [annotation]
    return [kind for kind in get_args(annotation) if kind is not type(None)]


def _words(annotation: Any, depth: int) -> Iterator[str]:
    """Find the words that an annotation allows inside so many lists."""
    if get_origin(annotation) is Literal:
        yield from (word for word in get_args(annotation) if depth == 0)
        return
    for argument in get_args(annotation):
        yield from _words(argument, depth - (get_origin(annotation) is tuple))


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    """Find the sections in an annotation such as tuple[Probe, ...]."""
    if get_origin(annotation) is None and isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _sections(argument)


def _choose_kinds(faults: Sequence[_Fault]) -> Iterator[_Fault]:
    """For a key that may hold several kinds of value, report only the faults of the kind that was meant.

    That is the kind whose check got furthest into the value; if two got equally far, the whole value is at fault.
    """
    reached: dict[Key, dict[str, int]] = defaultdict(dict)
    for fault in faults:
        for choice, branch in fault.choices:
            reached[choice][branch] = max(reached[choice].get(branch, 0), len(fault.path))
    for fault in faults:
        for choice, branch in fault.choices:
            branches = reached[choice]
            furthest = max(branches.values())
            if list(branches.values()).count(furthest) > 1:
                yield fault._replace(path=choice, kind="choice")
                break
            if branches[branch] != furthest:
                break
        else:
            yield fault


def _drop_short(faults: Iterable[_Fault]) -> Iterator[_Fault]:
    """Report a list that lacks items as one fault, or not at all if one of its items is at fault."""
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
    near = did_you_mean(data, fault.words) if isinstance(data, str) else ""
    return f"{flow(data)} is not allowed; expected {fault.expects}{near}"


def _unknown(name: str, known: Sequence[str]) -> str:
    return "unknown key" + (did_you_mean(name, known) or f"; allowed: {', '.join(known)}")
