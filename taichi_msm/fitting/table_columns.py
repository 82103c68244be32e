"""Columns of a table of a testing machine: which of them are time, depth and force, and their units.

Names are English, French or German; --columns chooses any other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from taichi_msm.errors import SceneError
from taichi_msm.fitting.table_grids import LETTER, Grid, Row
from taichi_msm.fitting.table_numbers import parse_alone

# Standard gravity [m/s2]: a kilogram-force in newtons.
GRAVITY = 9.80665

WORDS = {
    "time": {"time", "temps", "zeit"},
    "depth": {"depth", "displacement", "indentation", "extension", "elongation", "allongement", "stroke", "position"}
    | {"travel", "distance", "weg"},
    "force": {"force", "load", "fz", "kraft"},
}
# German compounds: Prüfzeit, Standardweg, Standardkraft.
ENDINGS = {"time": "zeit", "depth": "weg", "force": "kraft"}
# Units in SI units, the usual one first.
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "depth": {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 1e-3 * GRAVITY, "kgf": GRAVITY},
}
# Other spellings: texture analysers write sec and g.
UNIT_ALIASES = {"sec": "s", "g": "gf", "kg": "kgf", "µm": "um", "\N{GREEK SMALL LETTER MU}m": "um"}

# A name and its unit: Time, s; Fz [gf]; Force (mN); Weg / mm; Force_N; Kraft in N.
UNIT_PATTERN = re.compile(r"(.*?)[\s,/_\[(]+(?:in\s+)?([^\s,/_\[\]()]+)[\])]?")


@dataclass(frozen=True)
class Choice:
    """A column chosen by --columns: its name, its name with the unit, and the unit; empty for that of the file."""

    name: str
    title: str
    unit: str


@dataclass(frozen=True)
class Column:
    """A column of a quantity: its index, its title in the header, and its unit in SI units."""

    quantity: str
    index: int
    title: str
    scale: float


def parse_choices(columns: Sequence[str]) -> dict[str, Choice]:
    """Parse chosen columns, such as "depth=Traverse, mm", by quantity.

    Raises:
        SceneError: when one is not of this form, or a quantity is chosen twice.
    """
    chosen: dict[str, Choice] = {}
    for text in columns:
        quantity, _, title = (part.strip() for part in text.partition("="))
        if quantity not in WORDS or not title:
            expected = 'take time, depth or force and the name of its column, such as "depth=Traverse, mm"'
            raise SceneError([f'--columns "{text}": {expected}'])
        if quantity in chosen:
            raise SceneError([f'--columns "{text}": {quantity} is chosen twice; leave one'])
        name, _, unit = (part.strip() for part in title.rpartition(","))
        has_unit = bool(name) and _scale(quantity, unit) is not None
        chosen[quantity] = Choice(name if has_unit else title, title, unit if has_unit else "")
    return chosen


def find_candidates(row: Row, chosen: dict[str, Choice]) -> dict[str, list[int]]:
    """Return the columns of a header that may be each quantity.

    Args:
        row: cells of the header.
        chosen: columns chosen by --columns.
    """
    found = {quantity: _chosen_columns(row, quantity, choice) for quantity, choice in chosen.items()}
    taken = {column for columns in found.values() for column in columns}
    for quantity in WORDS.keys() - chosen.keys():
        found[quantity] = [n for n, cell in enumerate(row) if n not in taken and _is_named(cell, quantity)]
    return {quantity: found[quantity] for quantity in WORDS}


def is_header(row: Row, chosen: dict[str, Choice]) -> bool:
    """Return whether a row names all quantities in different cells; arguments as for `find_candidates`."""
    if sum(bool(LETTER.search(cell)) for cell in row) < len(WORDS):
        return False
    candidates = find_candidates(row, chosen).values()
    return all(candidates) and any(len({*columns}) == len(columns) for columns in product(*candidates))


def is_units(row: Row, candidates: dict[str, list[int]]) -> bool:
    """Return whether a row after a header has the unit of a quantity in one of its columns.

    Args:
        row: cells of the row.
        candidates: columns that may be each quantity.
    """
    return any(
        index < len(row) and _scale(quantity, row[index]) is not None
        for quantity, columns in candidates.items()
        for index in columns
    )


def select_columns(
    grid: Grid, header: int, units: int | None, first: Row, chosen: dict[str, Choice]
) -> tuple[list[Column], list[str]]:
    """Select the column of each quantity; of two candidates the one nearest 0 in the first row.

    Args:
        grid: the table.
        header: row of the header.
        units: row of the units; None without one.
        first: cells of the first row of numbers.
        chosen: columns chosen by --columns.

    Returns:
        The columns of time, depth and force, and notes about the selection.

    Raises:
        SceneError: when a column has no unit, or a name that another one has, or is merged with another.
    """
    titles = grid.rows[header]
    selected, notes = [], []
    for quantity, candidates in find_candidates(titles, chosen).items():
        choice, columns = chosen.get(quantity), []
        for index in candidates:
            scale = _split_title(titles[index], quantity)[1]
            if scale is None and units is not None and index < len(grid.rows[units]):
                scale = _scale(quantity, grid.rows[units][index])
            if choice and choice.unit:
                given = _scale(quantity, choice.unit)
                if scale not in (None, given):
                    notes.append(
                        f"{grid.title}: {quantity} is read in {choice.unit}, although the file has another unit"
                    )
                scale = given
            if scale is not None:
                columns.append(Column(quantity, index, titles[index], scale))
        if not columns:
            raise SceneError([_no_unit(grid, header, candidates[0], quantity)])
        best = min(columns, key=lambda column: _first_size(first, column))
        if (repeated := sum(column.title == best.title for column in columns)) > 1:
            fault = f"{repeated} columns of this name; rename or delete all but one"
            raise SceneError([f"{grid.place(header, best.index)}: {best.title}: {fault}"])
        if (header, best.index) in grid.merged:
            raise SceneError([_merged(grid, header, best.index)])
        if others := [column.title for column in columns if column != best]:
            than = " and ".join(map(repr, others))
            notes.append(f"{grid.title}: {quantity} is {best.title!r}, nearer 0 in the first row than {than}")
        selected.append(best)
    return selected, notes


def missing_header(grid: Grid, chosen: dict[str, Choice]) -> str:
    """Describe a table without a header; arguments as for `select_columns`."""
    if not any(grid.rows):
        return f"{grid.title}: is empty; a table has columns of time, depth and force"
    # The row that names most; the cells of a text are separated only below a header.
    cells = [row if grid.sheet else re.split(r"[\t;,|]", ";".join(row)) for row in grid.rows]
    found = [{quantity for quantity, columns in find_candidates(row, chosen).items() if columns} for row in cells]
    best = max(range(len(found)), key=lambda row: len(found[row]))
    if not found[best]:
        return f"{grid.title}: no row names time, depth and force; {_remedy('depth')}"
    if merged := [column for row, column in grid.merged if row == best]:
        return _merged(grid, best, min(merged))
    shown = ", ".join(grid.rows[best])[:100]
    if missing := [quantity for quantity in WORDS if quantity not in found[best]]:
        name = repr(chosen[missing[0]].title) if missing[0] in chosen else missing[0]
        return f"{grid.place(best)}: {shown!r} names no {name}; {_remedy(missing[0])}"
    return f"{grid.place(best)}: {shown!r} names time, depth and force, but not in a cell each; separate them"


def _merged(grid: Grid, row: int, column: int) -> str:
    fault = "merged with the cell to its right; unmerge them and name each column"
    return f"{grid.place(row, column)}: {grid.rows[row][column]}: {fault}"


def _remedy(quantity: str) -> str:
    known = ", ".join(UNITS[quantity])
    return f'choose columns by --columns "{quantity}=NAME, {next(iter(UNITS[quantity]))}" (units: {known})'


def _no_unit(grid: Grid, header: int, index: int, quantity: str) -> str:
    title, known = grid.rows[header][index], ", ".join(UNITS[quantity])
    remedy = f'give it by --columns "{quantity}={title}, {next(iter(UNITS[quantity]))}"'
    return f"{grid.place(header, index)}: {title}: no unit of {quantity} ({known}); {remedy}"


def _chosen_columns(row: Row, quantity: str, choice: Choice) -> list[int]:
    """Return the columns of a chosen title, or else of the chosen name."""
    same = [n for n, cell in enumerate(row) if _plain(cell) == _plain(choice.title)]
    name = _plain(choice.name)
    return same or [n for n, cell in enumerate(row) if name in (_plain(cell), _plain(_split_title(cell, quantity)[0]))]


def _is_named(cell: str, quantity: str) -> bool:
    """Return whether a title has a name of a quantity, outside of brackets."""
    words = re.findall(r"[^\W\d_]+", re.sub(r"[(\[].*?[)\]]", " ", cell).casefold())
    return bool(WORDS[quantity] & {*words}) or any(word.endswith(ENDINGS[quantity]) for word in words)


def _plain(text: str) -> str:
    """Return a name without differences of case and spaces."""
    return " ".join(text.split()).casefold()


def _scale(quantity: str, unit: str) -> float | None:
    """Return a unit in SI units; None if it is not one of the quantity."""
    unit = unit.strip("[]() ")
    known = UNITS[quantity]
    if unit in known:
        return known[unit]
    # MN are not millinewtons.
    lower = {name.casefold(): scale for name, scale in known.items()} if unit != "MN" else {}
    return lower.get(UNIT_ALIASES.get(unit.casefold(), unit.casefold()))


def _split_title(title: str, quantity: str) -> tuple[str, float | None]:
    """Split a title into the name and the unit in SI units; None without a unit of the quantity."""
    match_ = UNIT_PATTERN.fullmatch(title)
    scale = _scale(quantity, match_[2]) if match_ else None
    return (match_[1], scale) if match_ and scale is not None else (title, None)


def _first_size(first: Row, column: Column) -> float:
    """Return the magnitude of a column in the first row, infinite without a number."""
    value = parse_alone(first[column.index]) if column.index < len(first) else None
    return math.inf if value is None else abs(value) * column.scale
