"""Reader of tests of a testing machine: time, depth and force from a text table or a workbook.

A table is a row of names, perhaps a row of units, and rows of numbers. A file may have several of them, blocks, and
other lines before, between and after them. Names are English, French or German; --columns chooses any other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError, did_you_mean
from taichi_msm.machines.cells import LETTER, WORKBOOK_SUFFIX, Grid, Row, parse_number, read_text, read_workbook

Array = NDArray[np.float64]

# Fewest rows of a test: the noise of the force is estimated from ten.
MIN_ROWS = 10

TORE = "it tore"

EXPECTED = f"name a table of a testing machine: .csv, .tsv, .txt or {WORKBOOK_SUFFIX}"

# Standard gravity [m/s2]: a kilogram-force in newtons.
GRAVITY = 9.80665

# Names of the quantities; and the ends of German compounds: Prüfzeit, Standardweg, Standardkraft.
WORDS = {
    "time": {"time", "temps", "zeit"},
    "depth": {"depth", "displacement", "indentation", "extension", "elongation", "allongement", "stroke", "position"}
    | {"travel", "distance", "weg"},
    "force": {"force", "load", "fz", "kraft"},
}
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

# A cell that stands for a value, valid or not: a number, NaN, or an error or a formula of a workbook.
VALUE_START = re.compile(r"[+\-\N{MINUS SIGN}]?[.,]?\d|[+-]?(nan|inf)|[#=]", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class MachineTest:
    """A test of a testing machine.

    Attributes:
        name: name of the file, and sheet and block where there is a choice.
        time: increasing times [s], shape (n,).
        depth: depths or elongations, the one of largest magnitude positive [m], shape (n,).
        force: forces, the one of largest magnitude positive [N], shape (n,).
        digit: last digit of the forces in the file [N].
        notes: sentences about choices of the reader, and about the test.
    """

    name: str
    time: Array
    depth: Array
    force: Array
    digit: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Block:
    """A header, its row of units, its other rows with content, and the row after the last."""

    header: int
    units: int | None
    rows: list[int]
    end: int


@dataclass(frozen=True)
class _Column:
    """A column of a quantity: its index, its title in the header, and its unit in SI units."""

    index: int
    title: str
    scale: float


def read_machine_test(
    path: str | Path, columns: Sequence[str] = (), sheet: str | None = None, block: int | None = None
) -> MachineTest:
    """Return the test of a table.

    Args:
        path: path of a workbook (.xlsx), or of a text with any other suffix.
        columns: chosen columns, such as "depth=Traverse, mm"; without a unit, that of the file.
        sheet: chosen sheet of a workbook, or None for the only one with a table.
        block: number of the chosen block, from 1, or None for the only one.

    Raises:
        SceneError: when the file is not such a table, or needs a choice.
        NotInstalledError: when the file is a workbook and openpyxl is not installed.
    """
    name, chosen = str(path), _parse_choices(columns)
    if name.lower().endswith(WORKBOOK_SUFFIX):
        sheets = read_workbook(name, EXPECTED)
        grid = _choose_sheet(name, sheets, sheet, [title for title, each in sheets.items() if _blocks(each, chosen)])
    elif sheet is None:
        grid = read_text(name, lambda row: _is_header(row, chosen), EXPECTED)
    else:
        raise SceneError([f"--sheet {sheet}: {name} is a text, without sheets; leave the option out"])
    # A block without enough rows is described if there is no other.
    blocks = _blocks(grid, chosen) or _blocks(grid, chosen, min_rows=0)
    if not blocks:
        raise SceneError([_missing_header(grid, chosen)])
    if block is None and len(blocks) > 1:
        listed = ", ".join(f"{n} (rows {part.header + 1} to {part.end})" for n, part in enumerate(blocks, 1))
        raise SceneError([f"{grid.title}: {len(blocks)} blocks of rows; choose one by --block: {listed}"])
    if block is not None and not 1 <= block <= len(blocks):
        raise SceneError([f"--block {block}: {grid.title} has {len(blocks)}, numbered from 1"])
    test = _read_block(grid, blocks[(block or 1) - 1], chosen)
    return _finish(test if len(blocks) == 1 else replace(test, name=f"{test.name}, block {block}"))


def cut_window(test: MachineTest, start: float, end: float) -> MachineTest:
    """Return the part of a test between two times; its times remain those of the table.

    Args:
        test: the test.
        start: first time [s of the table].
        end: last time [s of the table].

    Raises:
        SceneError: when too few rows remain.
    """
    kept = (test.time >= start) & (test.time <= end)
    if (count := int(kept.sum())) < MIN_ROWS:
        lies = f"the table is from {test.time[0]:g} to {test.time[-1]:g} s"
        raise SceneError([f"--window {start:g},{end:g}: {test.name}: {count} rows, fewer than {MIN_ROWS}; {lies}"])
    notes = tuple(note for note in test.notes if TORE not in note)
    return _finish(replace(test, time=test.time[kept], depth=test.depth[kept], force=test.force[kept], notes=notes))


def _finish(test: MachineTest) -> MachineTest:
    """Turn the signs so that the largest magnitudes are positive, and note a test that tore."""
    depth, force = (
        values if values[np.abs(values).argmax()] >= 0 else 0.0 - values for values in (test.depth, test.force)
    )
    test, time, peak = replace(test, depth=depth, force=force), test.time, int(force.argmax())
    fallen = np.flatnonzero(force[peak:] < force[peak] / 2) + peak
    if not len(fallen) or not peak:
        return test
    # While a held tissue relaxes, the depth may creep, but not at half the speed of the test.
    speed = (depth[peak] - depth[0]) / (time[peak] - time[0])
    growth = depth[fallen[0]] - depth[peak]
    if growth <= 0 or growth < speed / 2 * (time[fallen[0]] - time[peak]):
        return test
    note = (
        f"{test.name}: the force falls by half from {force[peak]:.4g} N at {time[peak]:.4g} s while the depth grows: "
        f"{TORE}; --window {time[0]:.4g},{time[peak]:.4g} cuts it there"
    )
    return replace(test, notes=(*test.notes, note))


def _parse_choices(columns: Sequence[str]) -> dict[str, str]:
    """Parse chosen columns, such as "depth=Traverse, mm", into titles by quantity."""
    chosen: dict[str, str] = {}
    for text in columns:
        quantity, _, title = (part.strip() for part in text.partition("="))
        if quantity not in WORDS or not title:
            expected = 'take time, depth or force and the name of its column, such as "depth=Traverse, mm"'
            raise SceneError([f'--columns "{text}": {expected}'])
        if quantity in chosen:
            raise SceneError([f'--columns "{text}": {quantity} is chosen twice; leave one'])
        chosen[quantity] = title
    return chosen


def _choose_sheet(name: str, sheets: dict[str, Grid], chosen: str | None, tables: list[str]) -> Grid:
    """Return the chosen sheet of a workbook, or the only one with a table; `tables`: names of those."""
    if chosen is None:
        if len(tables) > 1:
            raise SceneError([f"{name}: {len(tables)} sheets with a table; choose one by --sheet: {', '.join(tables)}"])
        if not tables and len(sheets) != 1:
            listed = ", ".join(sheets) or "none has cells"
            raise SceneError(
                [f"{name}: no sheet has a table of time, depth and force; choose one by --sheet: {listed}"]
            )
        chosen = next(iter(tables or sheets))
    for title, grid in sheets.items():
        if title.casefold() == chosen.casefold():
            return grid
    listed = ", ".join(tables or sheets)
    raise SceneError([f"--sheet {chosen}: not in {name}{did_you_mean(chosen, sheets)}; it has {listed}"])


def _blocks(grid: Grid, chosen: dict[str, str], min_rows: int = MIN_ROWS) -> list[_Block]:
    """Find the blocks with enough rows of numbers, unlike a summary."""
    headers = [n for n, row in enumerate(grid.rows) if _is_header(row, chosen)]
    blocks = []
    for header, end in pairwise([*headers, len(grid.rows)]):
        rows = [n for n in range(header + 1, end) if grid.has_content(n)]
        candidates = _find_candidates(grid.rows[header], chosen)
        has_units = bool(rows) and any(
            index < len(grid.rows[rows[0]]) and _scale(quantity, grid.rows[rows[0]][index]) is not None
            for quantity, columns in candidates.items()
            for index in columns
        )
        units, rows = (rows[0], rows[1:]) if has_units else (None, rows)
        if sum(sum(parse_number(cell) is not None for cell in grid.rows[n]) >= len(WORDS) for n in rows) >= min_rows:
            blocks.append(_Block(header, units, rows, end))
    return blocks


def _is_header(row: Row, chosen: dict[str, str]) -> bool:
    """Return whether a row names all quantities in different cells."""
    if sum(bool(LETTER.search(cell)) for cell in row) < len(WORDS):
        return False
    candidates = _find_candidates(row, chosen).values()
    return any(len({*columns}) == len(columns) for columns in product(*candidates))


def _find_candidates(row: Row, chosen: dict[str, str]) -> dict[str, list[int]]:
    """Return the columns of a header that may be each quantity."""
    candidates = {}
    for quantity, title in chosen.items():
        name = _plain(_split_choice(title, quantity)[0])
        same = [n for n, cell in enumerate(row) if _plain(cell) == _plain(title)]
        candidates[quantity] = same or [
            n for n, cell in enumerate(row) if name in (_plain(cell), _plain(_split_title(cell, quantity)[0]))
        ]
    taken = {column for columns in candidates.values() for column in columns}
    for quantity in WORDS.keys() - chosen.keys():
        candidates[quantity] = [n for n, cell in enumerate(row) if n not in taken and _is_named(cell, quantity)]
    return {quantity: candidates[quantity] for quantity in WORDS}


def _is_named(cell: str, quantity: str) -> bool:
    """Return whether a title has a name of a quantity, outside of brackets."""
    words = re.findall(r"[^\W\d_]+", re.sub(r"[(\[].*?[)\]]", " ", cell).casefold())
    return bool(WORDS[quantity] & {*words}) or any(word.endswith(ENDINGS[quantity]) for word in words)


def _plain(text: str) -> str:
    """Return a name without differences of case and spaces."""
    return " ".join(text.split()).casefold()


def _scale(quantity: str, unit: str) -> float | None:
    """Return a unit in SI units; None if it is not one of the quantity."""
    unit, known = unit.strip("[]() "), UNITS[quantity]
    # MN are not millinewtons.
    if unit in known or unit == "MN":
        return known.get(unit)
    lower = {name.casefold(): scale for name, scale in known.items()}
    return lower.get(UNIT_ALIASES.get(unit.casefold(), unit.casefold()))


def _split_title(title: str, quantity: str) -> tuple[str, float | None]:
    """Split a title into the name and the unit in SI units; None without a unit of the quantity."""
    match_ = UNIT_PATTERN.fullmatch(title)
    scale = _scale(quantity, match_[2]) if match_ else None
    return (match_[1], scale) if match_ and scale is not None else (title, None)


def _split_choice(title: str, quantity: str) -> tuple[str, float | None]:
    """Split a chosen title at its last comma, as `_split_title`; without a comma it has no unit."""
    name, _, unit = (part.strip() for part in title.rpartition(","))
    scale = _scale(quantity, unit)
    return (name, scale) if name and scale is not None else (title, None)


def _read_block(grid: Grid, block: _Block, chosen: dict[str, str]) -> MachineTest:
    """Read the numbers of a block."""
    columns, notes = _select_columns(grid, block, chosen)
    rows = list(_rows_of_numbers(grid, block, columns))
    if len(rows) < MIN_ROWS:
        raise SceneError([f"{grid.place(block.header)}: {len(rows)} rows of numbers; a test has at least {MIN_ROWS}"])
    cells = [(row, column.index) for row in rows for column in columns]
    parsed = grid.numbers(block.header, cells, "take a number, or delete the row")
    scales = np.array([column.scale for column in columns])
    time, depth, force = (np.array([value for value, _ in parsed]).reshape(-1, len(columns)) * scales).T.copy()
    if len(still := np.flatnonzero(np.diff(time) <= 0)):
        n = int(still[0])
        fault = f"{time[n + 1]:.9g} s after {time[n]:.9g} s; time must increase: delete the row, or split the file"
        raise SceneError([f"{grid.place(rows[n + 1], columns[0].index)}: {columns[0].title}: {fault}"])
    for quantity, column, values in (("depth", columns[1], depth), ("force", columns[2], force)):
        if not np.ptp(values):
            remedy = f'choose another column by --columns "{quantity}=NAME, UNIT"'
            raise SceneError([f"{grid.place(block.header, column.index)}: {column.title}: never changes; {remedy}"])
    digit = 10.0 ** min(power for _, power in parsed[2 :: len(columns)]) * columns[2].scale
    return MachineTest(grid.title, time, depth, force, digit, tuple(notes))


def _select_columns(grid: Grid, block: _Block, chosen: dict[str, str]) -> tuple[list[_Column], list[str]]:
    """Select the columns of time, depth and force, of two candidates the one nearest 0 in the first row; and notes."""
    header, titles = block.header, grid.rows[block.header]
    units = grid.rows[block.units] if block.units is not None else []
    first = grid.rows[block.rows[0]] if block.rows else []

    def first_size(column: _Column) -> float:
        number = parse_number(first[column.index]) if column.index < len(first) else None
        return math.inf if number is None else abs(number[0]) * column.scale

    selected, notes = [], []
    for quantity, candidates in _find_candidates(titles, chosen).items():
        given, columns = _split_choice(chosen.get(quantity, ""), quantity)[1], []
        for index in candidates:
            scale = _split_title(titles[index], quantity)[1]
            if scale is None and index < len(units):
                scale = _scale(quantity, units[index])
            if given is not None and scale not in (None, given):
                title = chosen[quantity]
                notes.append(f"{grid.title}: {quantity} is read as {title!r}, although the file has another unit")
            scale = scale if given is None else given
            if scale is not None:
                columns.append(_Column(index, titles[index], scale))
        known = ", ".join(UNITS[quantity])
        if not columns:
            title = titles[candidates[0]]
            fault = f'no unit of {quantity} ({known}); give it by --columns "{quantity}={title}, UNIT"'
            raise SceneError([f"{grid.place(header, candidates[0])}: {title}: {fault}"])
        best = min(columns, key=first_size)
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


def _missing_header(grid: Grid, chosen: dict[str, str]) -> str:
    """Describe a table without a header."""
    if not any(grid.rows):
        return f"{grid.title}: is empty; a table has columns of time, depth and force"
    # The row that names most; the cells of a text are separated only below a header.
    cells = [row if grid.sheet else re.split(r"[\t;,|]", ";".join(row)) for row in grid.rows]
    named = [{quantity for quantity, columns in _find_candidates(row, chosen).items() if columns} for row in cells]
    best = max(range(len(named)), key=lambda row: len(named[row]))
    if merged := [column for row, column in grid.merged if row == best and named[best]]:
        return _merged(grid, best, min(merged))
    shown = f"{grid.place(best)}: {', '.join(grid.rows[best])[:100]!r}"
    missing = [quantity for quantity in WORDS if quantity not in named[best]]
    if not missing:
        return f"{shown} names time, depth and force, but not in a cell each; separate them"
    quantity = missing[0] if named[best] else "depth"
    known = ", ".join(UNITS[quantity])
    remedy = f'choose columns by --columns "{quantity}=NAME, {next(iter(UNITS[quantity]))}" (units: {known})'
    if not named[best]:
        return f"{grid.title}: no row names time, depth and force; {remedy}"
    return f"{shown} names no {repr(chosen[quantity]) if quantity in chosen else quantity}; {remedy}"


def _merged(grid: Grid, row: int, column: int) -> str:
    fault = "merged with the cell to its right; unmerge them and name each column"
    return f"{grid.place(row, column)}: {grid.rows[row][column]}: {fault}"


def _rows_of_numbers(grid: Grid, block: _Block, columns: list[_Column]) -> Iterator[int]:
    """Yield the rows of numbers of a block, up to the text after them.

    Raises:
        SceneError: when a row has too few or too many cells, or when numbers follow the text.
    """
    indices, text, names = [column.index for column in columns], None, grid.rows[block.header]
    for n in block.rows:
        row = grid.rows[n]
        cells = [row[index] for index in indices if index < len(row)]
        is_whole = len(cells) == len(indices)
        if is_whole and not any(cells):
            continue
        # A line of text may have a number in it, so a short row is known by the time, or by its first cell.
        if not any(map(VALUE_START.match, cells if is_whole else row[indices[0] :][:1] or row[:1])):
            text = n if text is None else text
        elif text is None:
            grid.require_names(n, block.header)
            for column in columns:
                if column.index >= len(row) or not row[column.index]:
                    fault = "empty"
                    if not grid.sheet and column.index >= len(row):
                        fault += f": the row has {len(row)} of {len(names)} cells separated by {grid.separator}"
                        fault += " as in the header"
                    remedy = "fill it in, or delete the row"
                    raise SceneError([f"{grid.place(n, column.index)}: {column.title}: {fault}; {remedy}"])
            yield n
        elif is_whole and all(map(parse_number, cells)):
            fault = f"{', '.join(grid.rows[text])[:40]!r} within the rows of numbers"
            raise SceneError([f"{grid.place(text)}: {fault}; delete this row, or repeat the names after it"])
