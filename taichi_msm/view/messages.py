"""Messages of a page: JSON lists of the name of an event and its values, such as `["press", 256, 250, false]`."""

from __future__ import annotations

import json
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from taichi_msm.view import events
from taichi_msm.view.events import KEYS, Event
from taichi_msm.view.material import MATERIAL

# Largest message [bytes], and largest absolute value in it.
MAX_BYTES = 512
MAX_VALUE = 1e12

# The page has read a picture, and may get another.
SHOWN = ["shown"]

_CONFIG = ConfigDict(strict=True, allow_inf_nan=False)
_EVENTS: dict[str, TypeAdapter[Event]] = {
    kind.__name__.lower(): TypeAdapter(kind, config=_CONFIG)
    for kind in (
        *(events.Hover, events.Press, events.Drag, events.Release, events.Turn),
        *(events.Strength, events.StrengthChange, events.Key, events.Material),
    )
}


def parse_message(message: str | bytes) -> Event | None:
    """Parse a message; return its event, or None for `SHOWN`.

    Raises:
        ValueError: when it is neither.
    """
    values: Any = json.loads(message)
    if values == SHOWN:
        return None
    if not (isinstance(values, list) and values and isinstance(values[0], str) and values[0] in _EVENTS):
        raise ValueError(f"not a list of an event and its values; the events are {', '.join(_EVENTS)}")
    kind = _EVENTS[values[0]]
    if any(isinstance(value, (int, float)) and not abs(value) <= MAX_VALUE for value in values):
        raise ValueError(f"{values[0]}: a value is not from {-MAX_VALUE:g} to {MAX_VALUE:g}")
    try:
        event = kind.validate_python(tuple(values[1:]))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ValueError(f"{values[0]}: {first['msg']}") from None
    if isinstance(event, events.Key) and event.name not in KEYS:
        raise ValueError(f"key: no such key; the keys are {' '.join(KEYS)}")
    if isinstance(event, events.Material) and event.key not in MATERIAL:
        raise ValueError(f"material: no such key; the keys are {', '.join(MATERIAL)}")
    return event
