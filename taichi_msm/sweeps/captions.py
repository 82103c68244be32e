"""Keys and values of a sweep, as short as a person can read them in a picture."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any


def short_names(keys: Sequence[str]) -> list[str]:
    """Shorten keys to their last parts, as far as these are words and no other key ends with them."""
    return [next(name for name in _endings(key) if _is_clear(name, key, keys)) for key in keys]


def short_value(value: Any) -> str:
    """Write a value with three significant digits of its numbers; of a path its last part."""
    if isinstance(value, float):
        return f"{float(f'{value:.3g}'):g}"
    if isinstance(value, str):
        return value.rpartition("/")[2]
    if isinstance(value, list):
        return f"[{', '.join(map(short_value, value))}]"
    if isinstance(value, dict):
        return ", ".join(f"{name} {short_value(one)}" for name, one in value.items())
    return json.dumps(value)


def _endings(key: str) -> Iterable[str]:
    """List the ends of a key, the shortest first."""
    parts = key.split(".")
    return (".".join(parts[start:]) for start in reversed(range(len(parts))))


def _is_clear(name: str, key: str, keys: Sequence[str]) -> bool:
    return name == key or not (
        name[0].isdigit() or any(f".{other}".endswith(f".{name}") for other in keys if other != key)
    )
