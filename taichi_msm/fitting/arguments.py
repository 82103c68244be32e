"""The arguments of `fit`, and the types that they must be of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from taichi_msm.arguments import MAX_WORKERS
from taichi_msm.errors import ArgumentError, did_you_mean


class Method(TypedDict, total=False):
    """How a fit is made, as `fit` says."""

    sigma: float | None
    robust: bool
    profile: bool
    correlation: float | None
    drift: float | None
    resolution: int | None


def require_types(observed: Any, free: Any, method: Mapping[str, Any], **others: Any) -> None:
    """Make sure that all arguments are of the types that `fit` takes; ArgumentError: one is not."""
    known = Method.__annotations__
    if unknown := sorted(set(method) - set(known)):
        raise ArgumentError(f"{unknown[0]}: unknown; take {', '.join(known)}{did_you_mean(unknown[0], known)}")
    optional = {name: value for name, value in (others | dict(method)).items() if value is not None}
    for name, value in {"observed": observed, "free": free, **optional}.items():
        fits, expected = _TYPES[name]
        if not fits(value):
            raise ArgumentError(f"{name}: {value!r}; take {expected}")


def _is_number(value: Any, kind: type = Real) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)


def _is_path(value: Any) -> bool:
    return isinstance(value, (str, Path)) and "\0" not in str(value)


def _is_pair(value: Any, first: Callable[[Any], bool]) -> bool:
    return isinstance(value, Sequence) and len(value) == 2 and first(value[0]) and _is_number(value[1])


# What each argument must be, and that in words.
_TYPES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "observed": (
        lambda it: _is_path(it) or isinstance(it, Mapping),
        "the path of an .npz file, or a mapping of arrays",
    ),
    "free": (
        lambda it: isinstance(it, Sequence) and not isinstance(it, str) and all(isinstance(key, str) for key in it),
        "a list of keys, such as ['tissue.young']",
    ),
    "bounds": (
        lambda it: isinstance(it, Mapping) and all(_is_pair(ends, _is_number) for ends in it.values()),
        "a mapping of keys to two numbers each, such as {'tissue.young': (5e3, 1e5)}",
    ),
    "forces": (
        lambda it: _is_pair(it, _is_path),
        "a forces.csv and the standard deviation of its forces, such as ('forces.csv', 0.01)",
    ),
    "directory": (_is_path, "a path, or None"),
    "workers": (
        lambda it: _is_number(it, Integral) and 1 <= it <= MAX_WORKERS,
        f"a whole number, 1 to {MAX_WORKERS}, or None",
    ),
    "sigma": (_is_number, "a number, or None"),
    "correlation": (_is_number, "a number of pixels, or None"),
    "drift": (_is_number, "a number of seconds, or None"),
    "resolution": (lambda it: _is_number(it, Integral), "a whole number, or None"),
    **dict.fromkeys(("robust", "profile"), (lambda it: isinstance(it, bool), "True or False")),
}
