"""Reader of tables of palpation: place, x, y, z, depth and force of each row, from a text or a workbook.

Titles match whole, apart from their unit. With fx, fy and fz, the force is their part along the normal nx, ny, nz,
which points out of the tissue and is z by default. Without labels of places, a press ends where the depth falls back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.machines.cells import LETTER, WORKBOOK_SUFFIX, Grid, Row, read_text
from taichi_msm.machines.reader import VALUE_START, choose_sheet, describe_merged, parse_choices
from taichi_msm.machines.titles import UNITS, fold, split_choice, split_title, unit_factor
from taichi_msm.machines.workbook import read_workbook

# Kind of unit of each column: a key of `UNITS`, or empty for numbers and labels without a unit.
KINDS = {
    "place": "",
    **dict.fromkeys(("x", "y", "z"), "depth"),
    **dict.fromkeys(("nx", "ny", "nz"), ""),
    "depth": "depth",
    **dict.fromkeys(("force", "fx", "fy", "fz"), "force"),
}
POSITION, NORMAL, COMPONENTS = ("x", "y", "z"), ("nx", "ny", "nz"), ("fx", "fy", "fz")

EXPECTED = f"name a table of palpation: .csv, .tsv, .txt or {WORKBOOK_SUFFIX}"
CONTENT = "x, y, z, depth and force"

# Columns of a header, at least; the others are named in the error.
MIN_TITLES = 3

# Least extent of the places [m].
MIN_EXTENT = 1e-6

# A press ends where the depth has fallen back by this share of the way so far.
RETREAT = 0.1

# Unit of a title without a kind of unit, such as that of nx [-].
SUFFIX = re.compile(r"\s*[\[(][^\])]*[\])]$")


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a table with a force, in the order of their places, shape (N,)."""

    name: str  # of the file, with the sheet of a workbook
    places: tuple[str, ...]  # labels, n, including those of places without rows
    position: Array  # of the places, those of their deepest rows [m], shape (n, 3)
    index: NDArray[np.intp]  # place of each row
    depth: Array  # [m], signed so that the largest magnitude is positive
    force: Array  # along the normal [N], signed likewise; 0 in tables without a force
    normal: Array  # mean direction out of the tissue, shape (3,)
    digit: float  # resolution of the forces: their last digit in the file [N]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Column:
    index: int
    title: str
    scale: float


def read_table(name: str, choices: Sequence[str] = (), sheet: str | None = None, *, with_force: bool = True) -> Table:
    """Return the presses of a table; selected columns are such as "depth=Traverse, mm"."""
    chosen = parse_choices(choices, tuple(KINDS))
    if name.lower().endswith(WORKBOOK_SUFFIX):
        sheets = read_workbook(name, EXPECTED)
        tables = [title for title, each in sheets.items() if any(_is_header(row, chosen) for row in each.rows)]
        grid = choose_sheet(name, sheets, sheet, tables, CONTENT)
    elif sheet is None:
        grid = read_text(name, lambda row: _is_header(row, chosen), EXPECTED)
    else:
        raise SceneError([f"--sheet {sheet}: {name} is a text, without sheets; leave the option out"])
    headers = [n for n, row in enumerate(grid.rows) if _is_header(row, chosen)]
    if not headers:
        remedy = 'name them, or choose columns by --columns "depth=NAME, mm"'
        raise SceneError([f"{grid.title}: no row names {CONTENT}; {remedy}"])
    if len(headers) > 1:
        raise SceneError([f"{grid.place(headers[1])}: a second header; keep one table in the file"])
    columns = _select_columns(grid, headers[0], chosen, with_force=with_force)
    return _read_rows(grid, headers[0], columns)


def _is_header(row: Row, chosen: dict[str, str]) -> bool:
    # Most rows are numbers, which are no titles.
    if sum(bool(LETTER.search(cell)) for cell in row) < MIN_TITLES:
        return False
    return sum(map(bool, _find_columns(row, chosen).values())) >= MIN_TITLES


def _find_columns(row: Row, chosen: dict[str, str]) -> dict[str, list[int]]:
    """Return the columns of each quantity by its title, or by the chosen one."""
    found: dict[str, list[int]] = {}
    for quantity, kind in KINDS.items():
        title = chosen.get(quantity, quantity)
        name = _split(title, kind, split_choice)[0] if quantity in chosen else title
        same = [n for n, cell in enumerate(row) if quantity in chosen and fold(cell) == fold(title)]
        split = [_split(cell, kind, split_title)[0] for cell in row]
        found[quantity] = same or [n for n, cell in enumerate(split) if fold(cell) == fold(name)]
    return found


def _split(title: str, kind: str, split: Callable[[str, str], tuple[str, float | None]]) -> tuple[str, float | None]:
    """Split a title into its name and the factor of its unit, 1 for a quantity without a unit."""
    return split(title, kind) if kind else (SUFFIX.sub("", title), 1.0)


def _select_columns(grid: Grid, header: int, chosen: dict[str, str], *, with_force: bool) -> dict[str, _Column]:
    """Return the columns that are read; raise a SceneError for missing ones, and those without a unit."""
    titles, found = grid.rows[header], _find_columns(grid.rows[header], chosen)
    first = next((n for n in range(header + 1, len(grid.rows)) if grid.has_content(n)), None)
    has_vector = all(found[name] for name in COMPONENTS)
    forces = COMPONENTS if has_vector and "force" not in chosen else ("force",)
    normal = NORMAL if any(found[name] for name in NORMAL) else ()
    needed = [*POSITION, "depth", *((*forces, *normal) if with_force else ())]
    if found["place"] or "place" in chosen:
        needed.append("place")
    columns = {}
    for quantity in needed:
        kind = KINDS[quantity]
        option = f'--columns "{quantity}=NAME{f", {next(iter(UNITS[kind]))}" if kind else ""}"'
        if not found[quantity]:
            fault = f"no column {chosen.get(quantity, quantity)}"
            fault += ", nor fx, fy and fz" if quantity == "force" else ""
            raise SceneError([f"{grid.place(header)}: {fault}; add it, or choose another by {option}"])
        n = found[quantity][0]
        where = f"{grid.place(header, n)}: {titles[n]}"
        if len(found[quantity]) > 1:
            fault = f"{len(found[quantity])} columns are {quantity}"
            raise SceneError([f"{where}: {fault}; delete or rename all but one, or choose one by {option}"])
        if n in grid.merged_columns(header):
            raise SceneError([describe_merged(grid, header, n)])
        scale = 1.0
        if kind:
            given, of_title = split_choice(chosen.get(quantity, ""), kind)[1], split_title(titles[n], kind)[1]
            scale = given or unit_factor(kind, grid.cell(first, n)) or of_title or 0.0
            if not scale:
                fault = f"no unit of {quantity} ({', '.join(UNITS[kind])})"
                raise SceneError([f'{where}: {fault}; give it by --columns "{quantity}={titles[n]}, UNIT"'])
        columns[quantity] = _Column(n, titles[n], scale)
    return columns


def _read_rows(grid: Grid, header: int, columns: dict[str, _Column]) -> Table:
    place = columns.pop("place", None)
    of_force = [column for name, column in columns.items() if KINDS[name] == "force"]
    labels, rows, without_force = list[str](), list[int](), list[int]()
    for n in range(header + 1, len(grid.rows)):
        cells = [grid.cell(n, column.index) for column in columns.values()]
        # Rows of units and remarks have no numbers.
        if not grid.has_content(n) or not any(map(VALUE_START.match, cells)):
            continue
        grid.require_width(n, grid.rows[header])
        is_measured = all(grid.cell(n, column.index).casefold() not in ("", "nan") for column in of_force)
        (rows if is_measured else without_force).append(n)
        for column in [*([place] if place else []), *(columns.values() if is_measured else [])]:
            if not grid.cell(n, column.index):
                where = f"{grid.place(n, column.index)}: {column.title}"
                raise SceneError([f"{where}: empty; fill it in, or delete the row"])
        if place:
            labels.append(grid.cell(n, place.index))
    if not rows:
        raise SceneError([f"{grid.place(header)}: no rows with numbers below; add some"])
    numbers, digit = _read_numbers(grid, header, rows, columns)
    notes = list[str]()
    if without_force:
        first = grid.place(without_force[0])
        notes.append(f"{grid.title}: rows without a force are left out: {len(without_force)}, the first at {first}")
    position = np.column_stack([numbers[name] for name in POSITION])
    normals = _normals(grid, rows, columns, numbers)
    force = numbers.get("force", np.zeros(len(rows)))
    if "fx" in numbers:
        force = (np.column_stack([numbers[name] for name in COMPONENTS]) * normals).sum(axis=1)
    depth, signs = numbers["depth"], [_sign(numbers["depth"]), _sign(force)]
    if of_force and signs[0] != signs[1]:
        fault = "forces have another sign than depths"
        notes.append(f"{grid.title}: {fault}; each is taken so that its largest magnitude is positive")
    depth, force = signs[0] * depth + 0.0, signs[1] * force + 0.0
    if place is None:
        kept, numbered = _split_presses(depth) if of_force else _split_places(position, depth)
        position, depth, force, of_rows = position[kept], depth[kept], force[kept], numbered.astype(str).tolist()
        labels = of_rows
    else:
        of_rows = [grid.cell(n, place.index) for n in rows]
    places = {label: n for n, label in enumerate(dict.fromkeys(labels))}
    index = np.array([places[label] for label in of_rows])
    order = np.argsort(index, kind="stable")
    centres, by_depth = np.full((len(places), 3), np.nan), np.argsort(depth, kind="stable")
    centres[index[by_depth]] = position[by_depth]  # the deepest row is the last
    x = columns["x"]
    if (extent := float(np.ptp(position, axis=0).max())) < MIN_EXTENT:
        remedy = f'if their unit is another, give it by --columns "x={x.title}, UNIT", and of y and z'
        where = f"{grid.place(header, x.index)}: {x.title}"
        raise SceneError([f"{where}: all places are within {extent:.2g} m; {remedy}"])
    return Table(
        grid.title,
        tuple(places),
        centres,
        index[order],
        depth[order],
        force[order],
        normals.mean(axis=0),
        digit,
        tuple(notes),
    )


def _sign(values: Array) -> float:
    """Return the sign of the value of the largest magnitude."""
    return -1.0 if values[np.abs(values).argmax()] < 0 else 1.0


def _read_numbers(
    grid: Grid, header: int, rows: list[int], columns: dict[str, _Column]
) -> tuple[dict[str, Array], float]:
    """Return the numbers of each column in SI units, and the last digit of the forces [N]."""
    cells = [(n, column.index) for n in rows for column in columns.values()]
    parsed = grid.numbers(grid.rows[header], cells, "take a number, or delete the row")
    numbers, digit = {}, math.inf
    for k, (name, column) in enumerate(columns.items()):
        of_column = parsed[k :: len(columns)]
        numbers[name] = np.array([value for value, _ in of_column]) * column.scale
        if KINDS[name] == "force":
            # Components that are 0 are written without digits.
            digit = min(digit, 10.0 ** min(power for _, power in of_column) * column.scale)
    return numbers, digit


def _normals(grid: Grid, rows: list[int], columns: dict[str, _Column], numbers: dict[str, Array]) -> Array:
    """Return the unit normal of each row, shape (rows, 3)."""
    if "nx" not in numbers:
        return np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    normals = np.column_stack([numbers[name] for name in NORMAL])
    lengths = np.linalg.norm(normals, axis=1)
    if not lengths.all():
        where = grid.place(rows[int(lengths.argmin())], columns["nx"].index)
        raise SceneError([f"{where}: nx, ny and nz are 0; give the direction out of the tissue, or delete the row"])
    return np.asarray(normals / lengths[:, None])


def _split_presses(depth: Array) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Return whether each row belongs to a press, and the number of the press of each of these.

    Rows on the way back, between the end of a press and the next rise, belong to none.
    """
    kept, numbers = np.ones(len(depth), bool), list[int]()
    press, first, deepest, retreats = 0, depth[0], depth[0], False
    for n, d in enumerate(depth):
        if retreats and d <= depth[n - 1]:
            kept[n - 1] = False
            numbers.pop()
            first = deepest = d
        elif deepest - d > RETREAT * (deepest - first):
            press, first, deepest, retreats = press + 1, d, d, True
        else:
            deepest, retreats = max(deepest, d), False
        numbers.append(press)
    if retreats:
        kept[-1] = False
        numbers.pop()
    return kept, np.array(numbers)


def _split_places(position: Array, depth: Array) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Return the same as `_split_presses` for rows without a force, of which a place ends also where another begins."""
    changes = np.any(np.diff(position, axis=0) != 0, axis=1) | (np.diff(depth) < 0)
    return np.ones(len(depth), bool), np.append(0, np.cumsum(changes))
