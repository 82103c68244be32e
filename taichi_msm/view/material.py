"""Values of the material that a session can change."""

from __future__ import annotations

from functools import reduce
from typing import Any

from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import Section

# Name and unit of each key whose value a session can change, where it is above 0.
MATERIAL = {
    "tissue.young": ("Young's modulus", "Pa"),
    "tissue.foundation": ("foundation", "N/m³"),
    "tissue.foundation.young": ("foundation", "Pa"),
    "tissue.damping": ("damping", "1/s"),
    "springs.structural": ("structural springs", "N/m"),
    "springs.shear": ("shear springs", "N/m"),
    "springs.virtual": ("virtual springs", "N/m"),
    "damping": ("damping", "N s/m"),
}

# Largest ratio between a changed value and the scene's, in either direction.
MAX_FACTOR = 10.0


def material_values(scene: Scene) -> dict[str, float]:
    """Return the values of a scene that a session can change, by key of `MATERIAL`."""
    values = {key: reduce(_attribute, key.split("."), scene) for key in MATERIAL}
    return {key: float(value) for key, value in values.items() if isinstance(value, (int, float)) and value > 0}


def _attribute(section: Any, name: str) -> Any:
    return getattr(section, name, None)


def with_value(section: Any, key: str, value: float) -> Any:
    """Return a copy of a scene or a section with another value of a number, whose key is a dotted path."""
    name, _, rest = key.partition(".")
    changed: Section | float = with_value(getattr(section, name), rest, value) if rest else value
    return section.model_copy(update={name: changed})
