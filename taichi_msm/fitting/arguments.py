"""The arguments of `fit`, and the types that they must be of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from taichi_msm.errors import ArgumentError, did_you_mean


class Method(TypedDict, total=False):
    """How a fit is made."""

    sigma: float | None  # standard deviation of what was seen, in place of that in the file [m] or [px]
    robust: bool  # whether what is far off counts less
    profile: bool  # whether the intervals are found by profiles
    correlation: float | None  # how far in the picture errors of tracks are alike [px]
    resolution: int | None  # fields along a side of the map that is fitted


def require_types(observed: Any, free: Any, method: Mapping[str, Any], **others: Any) -> None:
    """Make sure that all arguments are of the types that `fit` takes; ArgumentError: one is not."""
    if unknown := set(method) - set(Method.__annotations__):
        name = min(unknown)
        near = did_you_mean(name, Method.__annotations__)
        raise ArgumentError(f"{name}: unknown; take {', '.join(Method.__annotations__)}{near}")
    _require("observed", observed)
    _require("free", free)
    for name, value in (others | dict(method)).items():
        if value is not None:
            _require(name, value)


def _require(name: str, value: Any) -> None:
    fits, expected = _TYPES[name]
    if not fits(value):
        raise ArgumentError(f"{name}: {value!r}; take {expected}")


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_list(value: Any, *items: Callable[[Any], bool]) -> bool:
    """Tell whether a value is a list, of items that each fulfil one of the conditions, in order."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != len(items):
        return False
    return all(fits(item) for fits, item in zip(items, value, strict=True))


def _is_key(value: Any) -> bool:
    return isinstance(value, str)


def _is_path(value: Any) -> bool:
    return isinstance(value, (str, Path)) and "\0" not in str(value)


# What each argument must be, and that in words.
_TYPES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "observed": (
        lambda it: _is_path(it) or isinstance(it, Mapping),
        "the path of an .npz file, or a mapping of arrays",
    ),
    "free": (
        lambda it: isinstance(it, Sequence) and _is_list(it, *[_is_key] * len(it)),
        "a list of keys, such as ['tissue.young']",
    ),
    "bounds": (
        lambda it: isinstance(it, Mapping) and all(_is_list(ends, _is_number, _is_number) for ends in it.values()),
        "a mapping of keys to two numbers each, such as {'tissue.young': (5e3, 1e5)}",
    ),
    "forces": (
        lambda it: _is_list(it, _is_path, _is_number),
        "a forces.csv and the standard deviation of its forces, such as ('forces.csv', 0.01)",
    ),
    "directory": (_is_path, "a path, or None"),
    "workers": (lambda it: _is_whole(it) and it > 0, "a whole number, 1 or more, or None"),
    "sigma": (_is_number, "a number, or None"),
    "correlation": (_is_number, "a number of pixels, or None"),
    "resolution": (_is_whole, "a whole number, or None"),
    **dict.fromkeys(("robust", "profile"), (lambda it: isinstance(it, bool), "True or False")),
}
