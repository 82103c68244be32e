"""Base class, types and limits of the scene's sections, and the translation of pydantic's errors.

Every error is reported at its key, with the values that the key may have.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice, pairwise
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, ValidationError, model_serializer
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError
from typing_extensions import Self

from taichi_msm.errors import (
    MAX_VALUE_LENGTH,
    ArgumentError,
    Key,
    Problem,
    SceneError,
    closest_name,
    did_you_mean,
    truncate,
)
from taichi_msm.scene.outputs import ENTRIES

# Limits of a number's magnitude, so that products and quotients of two numbers neither overflow nor underflow.
MAX_MAGNITUDE = 1e30
MIN_MAGNITUDE = 1e-30

# Pydantic's type of the errors that our validators raise.
SCENE_FAULT = "refused"


def scene_fault(message: str, *below: str | int) -> PydanticCustomError:
    """Return the error that a validator raises for its value, or for the one at the path `below` within it."""
    return PydanticCustomError(SCENE_FAULT, message, {"below": below})


def require_increasing(keyframes: Iterable[Sequence[float]]) -> None:
    """Raise a fault unless the times of keyframes, their first numbers, increase."""
    for n, ((previous, *_), (time, *_)) in enumerate(pairwise(keyframes), 1):
        if time <= previous:
            fault = f"is at {time:g} s, not after the previous keyframe at {previous:g} s"
            raise scene_fault(f"{fault}; sort the keyframes by time, without equal times", n)


def format_value(value: Any) -> str:
    """Format a value as in a scene file, truncated to the length of a message."""
    try:
        return truncate(json.dumps(value, ensure_ascii=False, default=repr))
    except ValueError:  # Python does not print integers of more than 4300 digits.
        return "a value that is too long"


def key_problems(error: ValidationError, section: type[BaseModel], data: Any) -> list[Problem]:
    """Convert pydantic's errors to problems at keys of the scene, without duplicates at lists and unions."""
    # A broken file of the largest size could have tens of thousands of faults.
    errors = error.errors(include_url=False, include_input=False)[:1000]
    faults = [_locate(details, section) for details in errors]
    return [
        Problem(fault.path, _message(fault, data), is_unknown_key=fault.kind == "extra_forbidden")
        for fault in _merge_misspelt(_merge_missing_items(_choose_members(faults)))
    ]


class _Fault(NamedTuple):
    """An error of pydantic, located in the scene."""

    path: Key  # to the key at fault
    error: ErrorDetails
    kind: str  # pydantic's type of the error
    section: type[BaseModel]  # innermost section in the path
    field: FieldInfo | None  # of the last key in the path
    branches: tuple[tuple[Key, str], ...]  # keys with a union type, each with the member that failed


def _locate(error: ErrorDetails, section: type[BaseModel]) -> _Fault:
    """Locate an error in the scene: its path without pydantic's names of union members."""
    path: Key = ()
    field = None
    branches: tuple[tuple[Key, str], ...] = ()
    parts = iter(error["loc"])
    for part in parts:
        path += (part,)
        if part not in section.model_fields:
            continue
        field = section.model_fields[str(part)]
        kinds = _union_members(field.annotation)
        if get_origin(kinds[0]) is dict:  # a mapping from names
            kinds = _union_members(get_args(kinds[0])[1])
            path += tuple(islice(parts, 1))
        if len(kinds) > 1:
            branches += ((path, str(next(parts, ""))),)
        section = next(_section_types(field.annotation), section)
    path += error.get("ctx", {}).get("below", ())
    return _Fault(path, error, error["type"], section, field, branches)


def _union_members(annotation: Any) -> list[Any]:
    """Return the members of a union type without None; for another type, a list of it."""
    if get_origin(annotation) not in (Union, UnionType):
        return [annotation]
    return [kind for kind in get_args(annotation) if kind is not type(None)]


def _literals(annotation: Any, depth: int) -> Iterator[str]:
    """Yield the values of Literals nested in `depth` tuples of an annotation."""
    if get_origin(annotation) is Literal:
        yield from get_args(annotation) if depth == 0 else ()
        return
    for argument in get_args(annotation):
        yield from _literals(argument, depth - (get_origin(annotation) is tuple))


def _section_types(annotation: Any) -> Iterator[type[BaseModel]]:
    """Iterate over the sections of an annotation such as tuple[Probe, ...]."""
    if isinstance(annotation, type) and get_origin(annotation) is None and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _section_types(argument)


def _choose_members(faults: Sequence[_Fault]) -> Iterator[_Fault]:
    """Keep the faults of one member of each union type, the member with the deepest fault.

    The value most probably has the type of that member. If two faults are equally deep, the whole value is at fault.
    """
    depths: dict[Key, dict[str, int]] = defaultdict(dict)
    for fault in faults:
        for path, member in fault.branches:
            depths[path][member] = max(depths[path].get(member, 0), len(fault.path))
    for fault in faults:
        for path, member in fault.branches:
            deepest = max(depths[path].values())
            if list(depths[path].values()).count(deepest) > 1:
                yield fault._replace(path=path, kind="choice")
                break
            if depths[path][member] != deepest:
                break
        else:
            yield fault


def _merge_missing_items(faults: Iterable[_Fault]) -> Iterator[_Fault]:
    """Replace the faults of missing items by one fault of their list, or by none if another item is at fault."""
    merged = [
        fault._replace(path=fault.path[:-1], kind="too_short")
        if fault.kind == "missing" and isinstance(fault.path[-1], int)
        else fault
        for fault in faults
    ]
    parents = {fault.path[:n] for fault in merged for n in range(len(fault.path))}
    return (fault for fault in merged if fault.kind != "too_short" or fault.path not in parents)


def _merge_misspelt(faults: Iterable[_Fault]) -> Iterator[_Fault]:
    """Drop the fault of a missing key if an unknown key of its section is similar, whose message suggests it."""
    merged = list(faults)
    meant = {
        (*fault.path[:-1], closest_name(str(fault.path[-1]), fault.section.model_fields))
        for fault in merged
        if fault.kind == "extra_forbidden"
    }
    return (fault for fault in merged if fault.kind != "missing" or fault.path not in meant)


# Units that a value may have been given in: the word for the SI unit in `expects`, and the factor to it.
_UNITS: dict[str, tuple[str, float]] = {
    **{"Pa": ("Pa", 1), "kPa": ("Pa", 1e3), "MPa": ("Pa", 1e6), "GPa": ("Pa", 1e9), "mmHg": ("Pa", 133.322)},
    **{"m": ("metres", 1), "cm": ("metres", 1e-2), "mm": ("metres", 1e-3), "um": ("metres", 1e-6)},
    **{"µm": ("metres", 1e-6), "μm": ("metres", 1e-6), "s": ("seconds", 1), "ms": ("seconds", 1e-3)},
    **{"N": ("newtons", 1), "mN": ("newtons", 1e-3), "kN": ("newtons", 1e3), "kg": ("kg", 1), "g": ("kg", 1e-3)},
    **{"kg/m3": ("kg/m3", 1), "kg/m^3": ("kg/m3", 1), "g/cm3": ("kg/m3", 1e3), "g/cm^3": ("kg/m3", 1e3)},
    **{"N/m": ("N/m", 1), "N/mm": ("N/m", 1e3), "mN/mm": ("N/m", 1), "g/ml": ("kg/m3", 1e3)},
}
_QUANTITY = re.compile(r"([-+]?(?:[0-9]+(?:[.,][0-9]*)*|[.,][0-9]+)(?:[eE][-+]?[0-9]+)?)\s*([^\W\d_][^\s]*)?")


def _number_hint(text: str, expected: str) -> str:
    """Return a hint with the number to write for a text such as "30 kPa" or "3,0e4"; empty for other texts."""
    match = _QUANTITY.fullmatch(text.strip())
    if match is None or len(text) > MAX_VALUE_LENGTH:
        return ""
    digits, unit = match[1], match[2]
    if re.fullmatch("[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+", digits):
        alternative = f" or {digits.replace(',', '.')}" if digits.count(",") == 1 else ""
        return f"; write {digits.replace(',', '')}{alternative}, the number in SI units, without a comma"
    digits = digits.replace(",", ".")
    try:
        value = float(digits)
    except ValueError:  # several points
        return ""
    if unit is None:
        reason = "with a point" if "," in text else "without quotes"
        return f"; write {_shortest(value)}, {reason}"
    name, factor = _UNITS.get(unit, ("", 1.0))
    long_names = expected.replace("in m,", "in metres,").replace("in s,", "in seconds,")
    if not name or f"in {name}," not in f"{long_names},":
        return "; write the number alone, in SI units, such as 3.0e+4 for 30 kPa"
    return f"; write {_shortest(value * factor)}, the number in {name}"


def _shortest(value: float) -> str:
    """Format a number as in a scene file, such as 0.003 or 3.0e+4."""
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.10g}"
    mantissa, exponent = f"{value:.9e}".split("e")
    return f"{float(mantissa)}e{int(exponent):+}"


def _message(fault: _Fault, data: Any) -> str:
    """Format a fault with the allowed values."""
    if fault.kind == SCENE_FAULT:
        return fault.error["msg"]
    if fault.kind == "extra_forbidden":
        known = list(fault.section.model_fields)
        return "unknown key" + (did_you_mean(str(fault.path[-1]), known) or f"; allowed: {', '.join(known)}")
    if fault.kind == "invalid_key":
        return "a key must be text; put it in quotes"
    assert fault.field is not None
    expected = f"expected {fault.field.json_schema_extra['expects']}"  # type: ignore[index]
    if fault.kind == "missing":
        return f"missing; {expected}"
    for part in fault.path:
        data = data[part]
    context = fault.error.get("ctx", {})
    limit = context.get("ge", context.get("le"))
    if limit in (MAX_MAGNITUDE, -MAX_MAGNITUDE) or (limit == MIN_MAGNITUDE and data > 0):
        return f"{format_value(data)} is out of range; magnitudes are {MIN_MAGNITUDE:g} to {MAX_MAGNITUDE:g}"
    is_item = isinstance(fault.path[-1], int)
    hint = ""
    if isinstance(data, str):
        hint = did_you_mean(data, _literals(fault.field.annotation, is_item)) or _number_hint(data, expected)
    elif isinstance(data, Mapping) and data and expected.startswith("expected a list"):
        hint = f"; begin each item with a dash: - {next(iter(data))}: ..."
    return f"{format_value(data)} is not allowed; {expected}{hint}"


# Limits of the scene's numbers.
MAX_POINTS = 4096  # rows or columns of mass points
MAX_PROBES = 16
MAX_PIXELS = 8192  # width or height of a frame
MAX_SUPERSAMPLE = 4

# Longest path, about the limit of operating systems.
MAX_PATH = 4096

# Offset of a probe in the paper (eq. 5).
DEFAULT_OFFSET = 10.0

# Times that differ by less than this fraction of a frame are equal, so that 0.1 s at 30 frames/s is 3 frames.
FRAME_TOLERANCE = 1e-6

# Limits of tolerances: smaller errors are lost in rounding of f64, larger ones make a result meaningless.
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
OpenUnitInterval = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, lt=1)]
UnitInterval = Annotated[Number, Field(ge=0, le=1)]
Side = Literal["top", "bottom", "left", "right"]
Vector = tuple[Number, Number, Number]
# Position on the sheet as a fraction of its width or height. A tool may come from beyond the edge, but much larger
# numbers are probably pixels.
MIN_FRACTION, MAX_FRACTION = -1, 2
SheetFraction = Annotated[Number, Field(ge=MIN_FRACTION, le=MAX_FRACTION)]


def key(default: Any, description: str, expects: str) -> Any:
    """Return the declaration of a key, required if the default is ...; messages have `expects` after "expected"."""
    return Field(default, description=description, json_schema_extra={"expects": expects})


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass

    OutputName = str
else:
    ModelMetaclass = type(BaseModel)
    OutputName = Literal[tuple(ENTRIES)]


class _SectionMeta(ModelMetaclass):
    """Metaclass that converts pydantic's errors of a constructor call to a SceneError.

    Pydantic does not call it for nested sections, and collects their errors in that of the outer section.
    """

    def __call__(cls: type[BaseModel], /, *values: Any, **keys: Any) -> Any:  # type: ignore[misc]  # noqa: N805
        if values:
            raise ArgumentError(f"{cls.__name__} takes its keys by name: {', '.join(cls.model_fields)}")
        try:
            return super().__call__(**keys)  # type: ignore[misc]
        except ValidationError as error:
            raise SceneError([str(problem) for problem in key_problems(error, cls, keys)]) from None


class Section(BaseModel, metaclass=_SectionMeta):
    """Base class of the sections of a scene, which are immutable.

    Raises:
        SceneError: by the constructor and `model_copy`, when a key is unknown, missing or invalid; by any assignment.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with new values by key, which are validated; `deep` is ignored, as values are immutable."""
        del deep
        if not (update is None or (isinstance(update, Mapping) and all(isinstance(name, str) for name in update))):
            raise ArgumentError(f"update: {update!r}; take a mapping from keys to values")
        return type(self)(**{**{name: getattr(self, name) for name in self.model_fields_set}, **(update or {})})

    def _unused_keys(self) -> Collection[str]:
        """Return the keys to omit from a dump, with which the scene could not be read again."""
        return ()

    @model_serializer(mode="wrap")
    def _dump_used_keys(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        unused = self._unused_keys()
        return {name: value for name, value in dump(self).items() if name not in unused}

    def __setattr__(self, name: str, value: object) -> None:
        raise SceneError([f"{name}: a scene cannot be changed; use model_copy(update={{{name!r}: ...}})"])
