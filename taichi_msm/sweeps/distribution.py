"""How a key of a scene is varied."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from pydantic import ConfigDict, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.faults import LARGEST, flow, refused
from taichi_msm.scene import Section, key

# Sobol points are multiples of 2^-30, 0 among them, where a normal distribution has no value.
SMALLEST_SHARE = 2.0**-31

RANGE = "[low, high]: numbers, or lists of one shape"
LIST = "a list of values that is not empty"


class Distribution(Section):
    """Exactly one way in which a key varies. Lists of numbers vary componentwise."""

    model_config = ConfigDict(validate_default=False)

    uniform: Any = key(None, "between two numbers", RANGE)
    log_uniform: Any = key(None, "between two numbers above 0, uniform in the logarithm", RANGE)
    normal: Any = key(None, "normally distributed", "[mean, standard deviation]: numbers, or lists of one shape")
    choice: Any = key(None, "one of some values, all equally likely; of a picture also a pattern of files", LIST)
    grid: Any = key(None, "every one of some values, with every combination of the other keys'", LIST)

    @model_validator(mode="before")
    @classmethod
    def _is_flat(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            raise refused(
                f"{flow(data)} is no way to vary; take one, such as {{uniform: [1, 2]}} or {{choice: [1, 2]}}"
            )
        if data.keys().isdisjoint(cls.model_fields) and any(isinstance(value, dict) for value in data.values()):
            raise refused("give each key by its dotted path, such as tissue.young: {uniform: [1e4, 3e4]}")
        return data

    @field_validator("uniform", "log_uniform", "normal")
    @classmethod
    def _is_pair(cls, value: Any) -> Any:
        if not (isinstance(value, list) and len(value) == 2 and all(map(_numbers, value))):
            raise refused(f"{flow(value)} is not allowed; expected two numbers, or two lists of numbers of one shape")
        if _shape(value[0]) != _shape(value[1]):
            raise refused(f"{flow(value[0])} and {flow(value[1])} differ in shape; give both as many numbers")
        return value

    @field_validator("uniform", "log_uniform")
    @classmethod
    def _is_ordered(cls, value: Any) -> Any:
        for low, high in zip(_numbers(value[0]), _numbers(value[1]), strict=True):
            if low > high:
                raise refused(f"{low:g} is above {high:g}; give the lower number first")
        return value

    @field_validator("log_uniform")
    @classmethod
    def _is_positive(cls, value: Any) -> Any:
        if (low := min(_numbers(value[0]))) <= 0:
            raise refused(f"{low:g} has no logarithm; take numbers above 0, or uniform")
        return value

    @field_validator("normal")
    @classmethod
    def _has_deviation(cls, value: Any) -> Any:
        if (deviation := min(_numbers(value[1]))) < 0:
            raise refused(f"a standard deviation of {deviation:g} is not possible; take 0 or more")
        return value

    @field_validator("choice", "grid")
    @classmethod
    def _is_list(cls, value: Any) -> Any:
        if not isinstance(value, list) or not value:
            raise refused(f"{flow(value)} is not allowed; expected {LIST}")
        if not _is_finite(value):
            raise refused(f"{flow(value)} has a number that is not finite; take others")
        return value

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise refused(f"expected one of {', '.join(type(self).model_fields)}")
        return self

    @property
    def kind(self) -> str:
        """Which of the ways it is."""
        return next(iter(self.model_fields_set))

    @property
    def values(self) -> Any:
        """The numbers or values that it is made from."""
        return getattr(self, self.kind)

    @property
    def dimensions(self) -> int:
        """How many shares a value is made from: one for each number, one for a choice, none for a grid."""
        if self.kind in ("choice", "grid"):
            return int(self.kind == "choice")
        return len(_numbers(self.values[0]))

    def value(self, shares: Sequence[float]) -> Any:
        """Turn shares, 0 <= share < 1, one for each dimension, into a value."""
        if self.kind == "choice":
            return self.values[int(shares[0] * len(self.values))]
        rest = iter(shares)
        return _each(lambda first, second: _NUMBERS[self.kind](first, second, next(rest)), *self.values)


def _uniform(low: float, high: float, share: float) -> float:
    return low + (high - low) * share


def _log_uniform(low: float, high: float, share: float) -> float:
    # Rounding must not lead outside.
    return min(max(math.exp(_uniform(math.log(low), math.log(high), share)), low), high)


def _normal(mean: float, deviation: float, share: float) -> float:
    from scipy.special import ndtri

    return mean + deviation * float(ndtri(max(share, SMALLEST_SHARE)))


_NUMBERS: dict[str, Callable[[float, float, float], float]] = {
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "normal": _normal,
}


def _each(make: Callable[[float, float], float], first: Any, second: Any) -> Any:
    """Make a value from two of one shape, number by number."""
    if isinstance(first, list):
        return list(map(partial(_each, make), first, second))
    return float(make(first, second))


def _numbers(value: Any) -> list[float]:
    """List the numbers in a value; empty: it holds something else."""
    if isinstance(value, list):
        parts = [_numbers(item) for item in value]
        return [number for part in parts for number in part] if all(parts) else []
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST
    return [value] if is_number else []


def _is_finite(value: Any) -> bool:
    if isinstance(value, (list, dict)):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _shape(value: Any) -> Any:
    """Tell values of different nesting apart; a number is None, anything else itself."""
    if isinstance(value, list):
        return [_shape(item) for item in value]
    return None if _numbers(value) else value
