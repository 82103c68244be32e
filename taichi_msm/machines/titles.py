"""Titles of columns, with their units."""

from __future__ import annotations

import re

# Standard gravity [m/s2], which is also the number of newtons per kilogram-force.
GRAVITY = 9.80665

# Kilogram-forces per international pound-force.
POUND = 0.45359237

# Factors from units to SI units, the usual unit first.
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "depth": {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6, "nm": 1e-9, "in": 0.0254},
    "force": {
        **{"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "kN": 1e3, "gf": 1e-3 * GRAVITY, "kgf": GRAVITY},
        **{"lbf": POUND * GRAVITY, "ozf": POUND * GRAVITY / 16},
    },
}
LOWER_UNITS = {
    quantity: {unit.casefold(): factor for unit, factor in units.items()} for quantity, units in UNITS.items()
}

# Longest cell that may be a unit [characters].
MAX_UNIT_LENGTH = 20

# Aliases of units, such as sec and g of texture analysers.
UNIT_ALIASES = {"sec": "s", "inch": "in", "g": "gf", "kg": "kgf", "lb": "lbf", "lbs": "lbf", "oz": "ozf"}

# Title of the times [s] in LabVIEW's measurement files.
LABVIEW_TIME = "x_value"

# Signs of micro, the second a Greek letter.
MICRO = str.maketrans("\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}", "uu")

# Reversed title with a unit: Time, s; Fz [gf]; Force (mN); Weg / mm; Force_N; Kraft in N.
REVERSED_UNIT = re.compile(r"[\])]?([^\s,/_\[\]()]+)(?:\s+ni(?=[\s,/_\[(]))?[\s,/_\[(]+(.*)")


def fold(text: str) -> str:
    """Normalise case and spaces."""
    return " ".join(text.split()).casefold()


def unit_factor(quantity: str, unit: str) -> float | None:
    """Return the factor from a unit to SI; None if it is not a unit of the quantity."""
    unit = unit[:MAX_UNIT_LENGTH].strip("[](). ").translate(MICRO)
    # In lower case, meganewtons (MN) would be millinewtons.
    if unit in UNITS[quantity] or unit == "MN":
        return UNITS[quantity].get(unit)
    return LOWER_UNITS[quantity].get(UNIT_ALIASES.get(unit.casefold(), unit.casefold()))


def has_unit(cell: str) -> bool:
    """Return whether a cell is a unit of any quantity."""
    return any(unit_factor(quantity, cell) is not None for quantity in UNITS)


def split_title(title: str, quantity: str) -> tuple[str, float | None]:
    """Split a title into its name and the factor of its unit; None without a unit of the quantity."""
    if quantity == "time" and fold(title) == LABVIEW_TIME:
        return title, 1.0
    match_ = REVERSED_UNIT.fullmatch(title[::-1])
    scale = unit_factor(quantity, match_[1][::-1]) if match_ else None
    return (match_[2][::-1], scale) if match_ and scale is not None else (title, None)


def split_choice(title: str, quantity: str) -> tuple[str, float | None]:
    """Split a selected title, as `split_title` does, but only at its last comma."""
    name, _, unit = (part.strip() for part in title.rpartition(","))
    scale = unit_factor(quantity, unit)
    return (name, scale) if name and scale is not None else (title, None)
