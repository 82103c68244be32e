"""Distributions of varied keys and variables."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, create_model, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.scene.section import MAX_MAGNITUDE, Section, format_value, key, scene_fault

LIST = "a list of values that is not empty"


def _require_finite(values: list[Any]) -> list[Any]:
    try:
        json.dumps(values, allow_nan=False)
    except ValueError:
        raise scene_fault(f"{format_value(values)} has an infinite number or NaN; take finite ones") from None
    return values


NonEmptyList = Annotated[list[Any], Field(min_length=1), AfterValidator(_require_finite)]


class Continuous(NamedTuple):
    """A distribution of numbers with any number of parameters, which are numbers or lists of one shape."""

    meaning: str  # for users
    parameters: tuple[str, ...]  # names, in the order of the file
    quantile: Callable[..., float]  # of a fraction in [0, 1) and the parameters; finite also at 0
    fault: Callable[..., str]  # fault of the parameters with its remedy; empty if they are valid
    logarithmic: bool = False  # whether plots have a logarithmic axis


def _uniform(fraction: float, low: float, high: float) -> float:
    return low + (high - low) * fraction


def _order_fault(low: float, high: float) -> str:
    return f"{low:g} is above {high:g}; give the lower number first" if low > high else ""


def _log_uniform(fraction: float, low: float, high: float) -> float:
    # Rounded values could be outside the interval.
    return min(max(math.exp(_uniform(fraction, math.log(low), math.log(high))), low), high)


def _logarithm_fault(low: float, high: float) -> str:
    no_logarithm = f"{low:g} has no logarithm; take numbers above 0, or uniform" if low <= 0 else ""
    return _order_fault(low, high) or no_logarithm


def _normal(fraction: float, mean: float, deviation: float) -> float:
    from scipy.special import ndtri

    # Sobol points are multiples of 2^-30 and include 0, where the quantile is infinite.
    return mean + deviation * float(ndtri(max(fraction, 2.0**-31)))


def _deviation_fault(_mean: float, deviation: float) -> str:
    return f"a standard deviation of {deviation:g} is not possible; take 0 or more" if deviation < 0 else ""


CONTINUOUS = {
    "uniform": Continuous("between two numbers", ("low", "high"), _uniform, _order_fault),
    "log_uniform": Continuous(
        "between two numbers above 0, uniform in the logarithm", ("low", "high"), _log_uniform, _logarithm_fault, True
    ),
    "normal": Continuous("normally distributed", ("mean", "standard deviation"), _normal, _deviation_fault),
}

_FIELDS: dict[str, Any] = {
    name: (Any, key(None, row.meaning, f"[{', '.join(row.parameters)}]: numbers, or lists of one shape"))
    for name, row in CONTINUOUS.items()
}
_Continuous: Any = create_model("_Continuous", __base__=Section, **_FIELDS)


class Distribution(_Continuous):  # type: ignore[misc]
    """Distribution of a varied key, by exactly one field; lists of numbers vary componentwise."""

    model_config = ConfigDict(validate_default=False)

    choice: NonEmptyList = key(None, "one of some values, all equally likely; of files also a pattern", LIST)
    grid: NonEmptyList = key(None, "every one of some values, with every combination of the other keys'", LIST)

    @model_validator(mode="before")
    @classmethod
    def _is_mapping(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            remedy = "take one such as {uniform: [1, 2]} or {choice: [1, 2]}"
            raise scene_fault(f"{format_value(data)} is not a distribution; {remedy}")
        if data.keys().isdisjoint(cls.model_fields) and any(isinstance(value, dict) for value in data.values()):
            raise scene_fault("give each key by its dotted path, such as tissue.young: {uniform: [1.0e+4, 3.0e+4]}")
        return data

    @field_validator(*CONTINUOUS)
    @classmethod
    def _has_valid_parameters(cls, value: Any, info: ValidationInfo) -> Any:
        row = CONTINUOUS[info.field_name or ""]
        is_complete = isinstance(value, list) and len(value) == len(row.parameters) and all(map(numbers, value))
        if not is_complete or any(_shape(parameter) != _shape(value[0]) for parameter in value):
            raise ValueError
        for parameters in zip(*map(numbers, value), strict=True):
            if fault := row.fault(*parameters):
                raise scene_fault(fault)
        return value

    @model_validator(mode="after")
    def _has_one_field(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise scene_fault(f"expected one of {', '.join(type(self).model_fields)}")
        return self

    @property
    def kind(self) -> str:
        """Name of the field that is set."""
        return next(iter(self.model_fields_set))

    @property
    def values(self) -> Any:
        """Value of the field: the parameters, or the values of a choice or grid."""
        return getattr(self, self.kind)

    @property
    def continuous(self) -> Continuous | None:
        """Its row of `CONTINUOUS`; None for a choice or grid."""
        return CONTINUOUS.get(self.kind)

    @property
    def dimensions(self) -> int:
        """Number of fractions for `value`: one per number, one for a choice, none for a grid."""
        return len(numbers(self.values[0])) if self.continuous else int(self.kind == "choice")

    def value(self, fractions: Sequence[float]) -> Any:
        """Return the value of fractions in [0, 1), by the quantile function; shape (dimensions,)."""
        if self.continuous is None:
            return self.values[int(fractions[0] * len(self.values))]
        remaining, quantile = iter(fractions), self.continuous.quantile
        return _map_numbers(lambda *parameters: quantile(next(remaining), *parameters), *self.values)


def _map_numbers(function: Callable[..., float], *values: Any) -> Any:
    """Apply a function to corresponding numbers in values of one shape."""
    if isinstance(values[0], list):
        return [_map_numbers(function, *items) for items in zip(*values, strict=True)]
    return float(function(*values))


def numbers(value: Any) -> list[float]:
    """Return all numbers in nested lists; empty if they contain anything else."""
    if isinstance(value, list):
        parts = [numbers(item) for item in value]
        return [number for part in parts for number in part] if all(parts) else []
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_MAGNITUDE
    return [value] if is_number else []


def _shape(value: Any) -> Any:
    """Return nested lists with None in place of each number, for comparisons of shapes."""
    return [_shape(item) for item in value] if isinstance(value, list) else None
