"""Translate pydantic's errors into the user's terms: each problem at its key, with the values that it may have."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
)
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError, did_you_mean
from taichi_msm.scene import section
from taichi_msm.scene.outputs import OUTPUTS

# Beyond these limits, squares and quotients of two numbers overflow or underflow.
MAX_MAGNITUDE = 1e30
MIN_MAGNITUDE = 1e-30

# The type of the errors that validators raise.
SCENE_FAULT = "refused"

MAX_SHOWN = 60

# The most faults that are reported; a broken file of the largest size can have tens of thousands.
MAX_FAULTS = 1000


def scene_fault(message: str, *below: str | int) -> PydanticCustomError:
    """Make the error that a validator raises: the user reads this message, at the value or a key or item below it."""
    return PydanticCustomError(SCENE_FAULT, message, {"below": below})


def format_value(value: Any) -> str:
    """Show a value as it could be written in the file, cut to a length that fits a line."""
    return truncate(json.dumps(value, ensure_ascii=False, default=repr))


def truncate(text: str) -> str:
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
    if fault.kind == SCENE_FAULT:
        return fault.text
    if fault.kind == "missing":
        return f"missing; expected {fault.expects}"
    if fault.kind == "extra_forbidden":
        return _unknown(str(fault.path[-1]), list(fault.section.model_fields))
    for part in fault.path:
        data = data[part]
    limit = fault.context.get("ge", fault.context.get("le"))
    if limit in (MAX_MAGNITUDE, -MAX_MAGNITUDE) or (limit == MIN_MAGNITUDE and data > 0):
        return f"{format_value(data)} is out of range; numbers are from {MIN_MAGNITUDE:g} to {MAX_MAGNITUDE:g} in size"
    near = did_you_mean(data, fault.words) if isinstance(data, str) else ""
    return f"{format_value(data)} is not allowed; expected {fault.expects}{near}"


def _unknown(name: str, known: Sequence[str]) -> str:
    return "unknown key" + (did_you_mean(name, known) or f"; allowed: {', '.join(known)}")


MAX_POINTS = 4096
MAX_PROBES = 16
MAX_PIXELS = 8192
MAX_REFINE = 64
MAX_TRACKS = 256
MAX_RELIEF = 10
MAX_SUPERSAMPLE = 4

# The smallest field of view [degrees]. Directions that differ by less than 2^-24, 3.4e-6 degrees, are one in f32; so a
# narrower picture would have fewer than about 300 distinct rows.
MIN_FOV = 1e-3

# Operating systems limit the length of a path to about this.
MAX_PATH = 4096

# The offset of a probe in the paper (eq. 5).
DEFAULT_OFFSET = 10.0

# Times that differ by less than this fraction of a frame are one instant: 0.1 s x 30 /s is 3 frames.
FRAME_TOLERANCE = 1e-6

# Below the first, rounding in f64 is no longer small beside the error; above the second, the result means nothing.
MIN_TOLERANCE = 1e-10
MAX_TOLERANCE = 0.5

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_MAGNITUDE, le=MAX_MAGNITUDE)]
NotNegative = Annotated[Number, Field(ge=0)]
Integer = Annotated[int, Field(strict=True)]
Tolerance = Annotated[Number, Field(ge=MIN_TOLERANCE, le=MAX_TOLERANCE)]
NodeCount = Annotated[Integer, Field(ge=2, le=MAX_POINTS)]
Pixels = Annotated[Integer, Field(ge=1, le=MAX_PIXELS)]
Byte = Annotated[Integer, Field(ge=0, le=255)]
FilePath = Annotated[str, Field(strict=True, min_length=1, max_length=MAX_PATH)]
UnitInterval = Annotated[Number, Field(ge=0, le=1)]
Side = Literal["top", "bottom", "left", "right"]
Vector = tuple[Number, Number, Number]
# A tool may come from beyond the edge; larger numbers are taken for pixels given by mistake, and refused.
SheetFraction = Annotated[Number, Field(ge=-1, le=2)]


def key(default: Any, description: str, expects: str) -> Any:
    """Describe one key: its default (... where it is required), what it means, and what errors say that it may hold."""
    return Field(default, description=description, json_schema_extra={"expects": expects})


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass

    OutputName = str
else:
    ModelMetaclass = type(BaseModel)
    OutputName = Literal[tuple(OUTPUTS)]


class _Checked(ModelMetaclass):
    """Makes the sections that a caller asks for; pydantic makes those inside them, and collects their faults."""

    def __call__(cls: type[BaseModel], /, *values: Any, **keys: Any) -> Any:  # type: ignore[misc]  # noqa: N805
        if values:
            raise ArgumentError(f"{cls.__name__} takes its keys by name: {', '.join(cls.model_fields)}")
        try:
            return super().__call__(**keys)  # type: ignore[misc]
        except ValidationError as error:
            raise SceneError([str(problem) for problem in section.key_problems(error, cls, keys)]) from None


class Section(BaseModel, metaclass=_Checked):
    """A section of the scene: immutable, and strict about its keys.

    Raises:
        SceneError: when a key is unknown, missing or wrong, here and in `model_copy`; when a key is assigned to.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy the section, with other values for some keys."""
        del deep  # The values are immutable, so a shallow copy is as good.
        if not (update is None or (isinstance(update, Mapping) and all(isinstance(name, str) for name in update))):
            raise ArgumentError(f"update: {update!r}; take a mapping from keys to values")
        return type(self)(**{**{name: getattr(self, name) for name in self.model_fields_set}, **(update or {})})

    def __setattr__(self, name: str, value: object) -> None:
        raise SceneError([f"{name}: a scene cannot be changed; use model_copy(update={{{name!r}: ...}})"])
