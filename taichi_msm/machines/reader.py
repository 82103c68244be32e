"""Reader of machine tests: time, depth and force from a text table or a workbook."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError, did_you_mean
from taichi_msm.machines.blocks import (
    MAX_TITLE_LENGTH,
    MIN_ROWS,
    WORDS,
    Block,
    find_blocks,
    find_blocks_of_numbers,
    find_candidates,
    is_header,
)
from taichi_msm.machines.cells import WORKBOOK_SUFFIX, Grid, parse_clock, parse_number, read_text
from taichi_msm.machines.titles import UNITS, fold, split_choice, split_title, unit_factor
from taichi_msm.machines.workbook import read_workbook

# Clause of the note about torn tissue.
TORE = "the tissue tore"

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".lvm", WORKBOOK_SUFFIX)
EXPECTED = f"name a table of a testing machine: {', '.join(TABLE_SUFFIXES[:-1])} or {WORKBOOK_SUFFIX}"

# Smallest ranges of a test, in SI units.
MIN_RANGES = {"time": (1e-9, "s"), "depth": (1e-12, "m"), "force": (1e-15, "N")}

# Content of a table, for messages.
CONTENT = "time, depth and force"

# Number of rows that are searched for the titles of a faulty table.
MAX_SHOWN_ROWS = 10_000

# Titles that shells leave unchanged within double quotes.
SAFE = re.compile(r"[\w .,:;/()\[\]°%#+-]+")

# Start of a value, even an invalid one: a number, NaN, or an error or a formula of a workbook.
VALUE_START = re.compile(r"[+\-\N{MINUS SIGN}]?[.,]?\d|[+-]?(nan|inf)|[#=]", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class Column:
    """Column of a quantity: index, title, factor from its unit to SI, and its choice by --columns without the unit."""

    index: int
    title: str
    scale: float
    choice: str = ""


@dataclass(frozen=True)
class MachineTest:
    """Test of a testing machine."""

    name: str  # name of the file, with the sheet of a workbook, and the block if there are several
    time: Array  # increasing times [s], shape (n,)
    depth: Array  # depths or elongations [m], shape (n,), signed so that the largest magnitude is positive
    force: Array  # forces [N], shape (n,), signed likewise
    digit: float  # resolution of the forces: their last digit in the file [N]
    notes: tuple[str, ...] = ()  # warnings about choices of the reader, and about the test
    columns: tuple[Column, ...] = ()  # of time, depth and force

    @property
    def noise_rows(self) -> int:
        """Number of first rows, which the noise of the force is estimated from."""
        return max(MIN_ROWS, math.ceil(0.05 * len(self.force)))


def read_machine_test(
    path: str | Path, columns: Sequence[str] = (), sheet: str | None = None, block: int | None = None
) -> MachineTest:
    """Return the machine test of a table, a workbook (.xlsx), or a text with any other suffix.

    Selected columns are such as "depth=Traverse, mm", by default with the unit of the file; blocks are counted from 1.
    A single sheet or block with a table needs no selection.
    """
    name, chosen = str(path), parse_choices(columns)
    if name.lower().endswith(WORKBOOK_SUFFIX):
        sheets = read_workbook(name, EXPECTED)
        tables = [title for title, each in sheets.items() if find_blocks(each, chosen)]
        tables = tables or [title for title, each in sheets.items() if find_blocks_of_numbers(each, chosen)]
        grid = choose_sheet(name, sheets, sheet, tables)
    elif sheet is None:
        grid = read_text(name, lambda row: is_header(row, chosen), EXPECTED)
    else:
        raise SceneError([f"--sheet {sheet}: {name} is a text, without sheets; leave the option out"])
    blocks = _require_blocks(grid, chosen)
    if block is None and len(blocks) > 1:
        numbered = listed([f"{n} ({part})" for n, part in enumerate(blocks, 1)])
        raise SceneError([f"{grid.title}: {len(blocks)} blocks of rows; choose one by --block: {numbered}"])
    if block is not None and not 1 <= block <= len(blocks):
        raise SceneError([f"--block {block}: {grid.title} has {len(blocks)}, numbered from 1"])
    test = _read_block(grid, blocks[(block or 1) - 1], chosen)
    return _orient(test if len(blocks) == 1 else replace(test, name=f"{test.name}, block {block}"))


def _require_blocks(grid: Grid, chosen: dict[str, str]) -> list[Block]:
    """Return the blocks of a table with all quantities; raise a SceneError without one."""
    if not (blocks := find_blocks(grid, chosen)):
        of_numbers = find_blocks_of_numbers(grid, chosen)
        blocks = [block for block in of_numbers if all(block.candidates.values())]
        # A block of too few rows counts only if there is no other; `_read_block` then raises the error.
        blocks = blocks or find_blocks(grid, chosen, min_rows=0)
        if not blocks:
            raise SceneError([_missing_columns(grid, of_numbers[0] if of_numbers else None, chosen)])
    return blocks


def cut_window(test: MachineTest, start: float, end: float) -> MachineTest:
    """Return the rows of a test between two times [s of the table], with unchanged times; require `MIN_ROWS`."""
    kept = (test.time >= start) & (test.time <= end)
    if (count := int(kept.sum())) < MIN_ROWS:
        extent = f"the table is from {test.time[0]:g} to {test.time[-1]:g} s"
        raise SceneError([f"--window {start:g},{end:g}: {test.name}: {count} rows, fewer than {MIN_ROWS}; {extent}"])
    notes = tuple(note for note in test.notes if TORE not in note)
    return _orient(replace(test, time=test.time[kept], depth=test.depth[kept], force=test.force[kept], notes=notes))


def _orient(test: MachineTest) -> MachineTest:
    """Flip signs so that the largest magnitudes are positive, and add a warning about torn tissue."""
    columns = test.depth, test.force
    depth, force = (each if each[np.abs(each).argmax()] >= 0 else 0.0 - each for each in columns)
    test, time, peak = replace(test, depth=depth, force=force), test.time, int(force.argmax())
    fallen = np.flatnonzero(force[peak:] < force[peak] / 2) + peak
    if not len(fallen) or not peak:
        return test
    # During relaxation the depth may creep, but slower than half the speed of the test.
    speed = (depth[peak] - depth[0]) / (time[peak] - time[0])
    growth = depth[fallen[0]] - depth[peak]
    if growth <= 0 or growth < speed / 2 * (time[fallen[0]] - time[peak]):
        return test
    fall = f"the force falls by half from {force[peak]:.4g} N at {time[peak]:.4g} s while the depth grows"
    note = f"{test.name}: {fall}: {TORE}; --window {time[0]:.4g},{time[peak]:.4g} cuts the table there"
    return replace(test, notes=(*test.notes, note))


def parse_choices(columns: Sequence[str], quantities: Sequence[str] = tuple(WORDS)) -> dict[str, str]:
    """Parse chosen columns, such as "depth=Traverse, mm", into titles by quantity."""
    chosen: dict[str, str] = {}
    for text in columns:
        quantity, _, title = (part.strip() for part in text.partition("="))
        if quantity not in quantities or not title:
            names = f"{', '.join(quantities[:-1])} or {quantities[-1]}"
            expected = f'take {names}, and the title of its column, such as "depth=Traverse, mm"'
            raise SceneError([f'--columns "{text}": {expected}'])
        if quantity in chosen:
            raise SceneError([f'--columns "{text}": {quantity} is chosen twice; leave one'])
        chosen[quantity] = title
    return chosen


def choose_sheet(
    name: str, sheets: dict[str, Grid], chosen: str | None, tables: list[str], content: str = CONTENT
) -> Grid:
    """Return the selected sheet of a workbook, or the only one with a table; `tables`: names of those with one."""
    if chosen is None:
        if len(tables) > 1:
            raise SceneError([f"{name}: {len(tables)} sheets with a table; choose one by --sheet: {listed(tables)}"])
        if not tables and len(sheets) != 1:
            remedy = f"choose one by --sheet: {listed(list(sheets))}" if sheets else "save one with cells"
            raise SceneError([f"{name}: no sheet has a table of {content}; {remedy}"])
        chosen = next(iter(tables or sheets))
    for title, grid in sheets.items():
        if title.casefold() == chosen.casefold():
            return grid
    raise SceneError(
        [f"--sheet {chosen}: not in {name}{did_you_mean(chosen, sheets)}; it has {listed(tables or list(sheets))}"]
    )


def listed(names: Sequence[str]) -> str:
    """List at most 50 names."""
    more = [f"and {len(names) - 50} more"] if len(names) > 50 else []
    return ", ".join([*(name[:MAX_TITLE_LENGTH] for name in names[:50]), *more])


def _read_block(grid: Grid, block: Block, chosen: dict[str, str]) -> MachineTest:
    columns, notes = _select_columns(grid, block, chosen)
    rows = list(_rows_of_numbers(grid, block, columns))
    if len(rows) < MIN_ROWS:
        raise SceneError([f"{grid.place(block.header)}: {len(rows)} rows of numbers; a test has at least {MIN_ROWS}"])
    cells = [(row, column.index) for row in rows for column in columns]
    clock = columns[0].index if parse_clock(grid.cell(rows[0], columns[0].index)) else None
    parsed = grid.numbers(block.titles, cells, "take a number, or delete the row", clock)
    scales = np.array([column.scale for column in columns])
    time, depth, force = (np.array([value for value, _ in parsed]).reshape(-1, len(columns)) * scales).T.copy()
    if len(still := np.flatnonzero(np.diff(time) <= 0)):
        n = int(still[0])
        fault = f"{time[n + 1]:.9g} s after {time[n]:.9g} s; time must increase: delete the row, or split the file"
        raise SceneError([f"{grid.place(rows[n + 1], columns[0].index)}: {columns[0].title}: {fault}"])
    for quantity, column, values in zip(WORDS, columns, (time, depth, force), strict=True):
        least, unit = MIN_RANGES[quantity]
        if (extent := np.ptp(values)) < least:
            fault = f"changes by only {extent:.3g} {unit}" if extent else "never changes"
            remedy = f'choose another column or unit by --columns "{quantity}=NAME, UNIT"'
            raise SceneError([f"{grid.place(block.header, column.index)}: {column.title}: {fault}; {remedy}"])
    digit = 10.0 ** min(power for _, power in parsed[2 :: len(columns)]) * columns[2].scale
    return MachineTest(grid.title, time, depth, force, digit, tuple(notes), tuple(columns))


def _select_columns(grid: Grid, block: Block, chosen: dict[str, str]) -> tuple[list[Column], list[str]]:
    """Select the columns of time, depth and force, and collect notes.

    Of several candidates, the one nearest 0 in the first row is selected.
    """
    header, titles = block.header, block.titles
    first = block.rows[0] if block.rows else None

    def first_size(column: Column) -> float:
        number = parse_number(grid.cell(first, column.index))
        return math.inf if number is None else abs(number[0]) * column.scale

    found, notes = dict[str, list[Column]](), []
    given = {quantity: split_choice(chosen.get(quantity, ""), quantity)[1] for quantity in WORDS}
    for quantity, candidates in block.candidates.items():
        found[quantity] = []
        for index in candidates:
            scale = _file_scale(grid, block, quantity, index)
            if given[quantity] is not None and scale not in (None, given[quantity]):
                title = chosen[quantity]
                notes.append(f"{grid.title}: {quantity} is read as {title!r}, although the file has another unit")
            if quantity == "time" and parse_clock(grid.cell(first, index)):
                scale = 1.0
            scale = scale if given[quantity] is None else given[quantity]
            if scale is not None:
                found[quantity].append(Column(index, titles[index], scale))
    if without_unit := [quantity for quantity, columns in found.items() if not columns]:
        n = block.candidates[without_unit[0]][0]
        listed_units = " and of ".join(f"{quantity} ({', '.join(UNITS[quantity])})" for quantity in without_unit)
        options = " ".join(
            _option(quantity, _choice(block, quantity, block.candidates[quantity][0])) for quantity in without_unit
        )
        raise SceneError([f"{grid.place(header, n)}: {titles[n]}: no unit of {listed_units}; give it by {options}"])
    selected = []
    for quantity, columns in found.items():
        best = min(columns, key=first_size)
        if (repeated := sum(column.title == best.title for column in columns)) > 1:
            fault = (
                f"{repeated} columns of this name; choose one by its number, {_option(quantity, str(best.index + 1))}"
            )
            raise SceneError([f"{grid.place(header, best.index)}: {best.title}: {fault}, or rename the others"])
        if block.has_titles and best.index in grid.merged_columns(header):
            raise SceneError([describe_merged(grid, header, best.index)])
        unit = grid.cell(block.units, best.index)
        title_scale, scale = split_title(best.title, quantity)[1], unit_factor(quantity, unit)
        is_below = block.units is not None and block.units > header
        if given[quantity] is None and unit and title_scale not in (None, scale) and (is_below or scale):
            reason = f"not a unit of {quantity}; so it is in that of its title" if scale is None else "its unit"
            row = "below" if is_below else "above"
            notes.append(f"{grid.title}: {best.title!r}: {unit[:40]!r} in the row {row} is {reason}")
        if others := [column.title for column in columns if column != best]:
            than = " and ".join(map(repr, others[:5]))
            notes.append(f"{grid.title}: {quantity} is {best.title!r}, as it starts nearer 0 than {than}")
        selected.append(replace(best, choice=_choice(block, quantity, best.index)))
    return selected, notes


def _file_scale(grid: Grid, block: Block, quantity: str, column: int) -> float | None:
    """Return the factor of a column's unit in the file; None without a unit of the quantity."""
    scale = unit_factor(quantity, grid.cell(block.units, column))
    return split_title(block.titles[column], quantity)[1] if scale is None else scale


def _choice(block: Block, quantity: str, column: int) -> str:
    """Return the choice of a column: its title without unit, or its number if that is not unique, or not safe."""
    names = [split_title(title, quantity)[0] for title in block.titles]
    is_title = SAFE.fullmatch(names[column]) and sum(fold(name) == fold(names[column]) for name in names) == 1
    return names[column] if is_title and block.has_titles else str(column + 1)


def _option(quantity: str, choice: str, unit: str = "") -> str:
    """Return the option for a column, by default with the usual unit."""
    return f'--columns "{quantity}={choice}, {unit or next(iter(UNITS[quantity]))}"'


def _missing_columns(grid: Grid, block: Block | None, chosen: dict[str, str]) -> str:
    """Describe the fault of a table without titles of all quantities; the remedy names a column for each."""
    if not any(grid.rows):
        return f"{grid.title}: is empty; a table has columns of time, depth and force"
    # Find the row with most quantities; a text without a header or numbers is not split.
    rows = grid.rows[: MAX_SHOWN_ROWS if block is None else block.rows[0] + 1]
    cells = [row if grid.sheet else re.split(r"[\t;,|]", ";".join(row)) for row in rows]
    named = [{quantity for quantity, columns in find_candidates(row, chosen).items() if columns} for row in cells]
    best = max(range(len(named)), key=lambda row: len(named[row]))
    if named[best] and (merged := grid.merged_columns(best)):
        return describe_merged(grid, best, min(merged))
    if len(named[best]) == len(WORDS):
        return f"{_shown(grid, best)} names time, depth and force in one cell; separate them"
    row, missing = best if named[best] else None, [quantity for quantity in WORDS if quantity not in named[best]]
    options = [_option(quantity, "NAME") for quantity in missing]
    if block is not None:
        row = block.header if block.has_titles else None
        missing = [quantity for quantity, columns in block.candidates.items() if not columns]
        options = list(_guess(grid, block, missing))
    *others, last = (repr(chosen[quantity]) if quantity in chosen else quantity for quantity in missing)
    conjunction = " and " if row is None else " or "
    names = conjunction.join([*([", ".join(others)] if others else []), last])
    fault = f"{grid.title}: no row names {names}" if row is None else f"{_shown(grid, row)} names no {names}"
    units = "; ".join(f"{quantity}: {', '.join(UNITS[quantity])}" for quantity in missing)
    return f"{fault}; choose by title or number, such as {' '.join(options)} (units of {units})"


def _shown(grid: Grid, row: int) -> str:
    return f"{grid.place(row)}: {', '.join(grid.rows[row])[:100]!r}"


def _guess(grid: Grid, block: Block, missing: list[str]) -> Iterator[str]:
    """Yield an option for every missing quantity: a column of its unit, or else an unused one, for time increasing."""
    used = {column for columns in block.candidates.values() for column in columns}
    cells = [[grid.cell(row, n) for row in block.rows[:MIN_ROWS]] for n in range(len(block.titles))]
    values = [[(parse_number(cell) or parse_clock(cell) or (math.nan,))[0] for cell in column] for column in cells]
    for quantity in missing:
        free = [n for n in range(len(values)) if n not in used and not any(map(math.isnan, values[n]))]
        with_unit = [n for n in free if _file_scale(grid, block, quantity, n) is not None]
        growing = [n for n in free if quantity == "time" and all(a < b for a, b in pairwise(values[n]))]
        if not (best := [*with_unit, *growing, *free]):
            yield _option(quantity, "NAME")
            continue
        used.add(best[0])
        scale = _file_scale(grid, block, quantity, best[0])
        unit = next((unit for unit, factor in UNITS[quantity].items() if factor == scale), "")
        yield _option(quantity, _choice(block, quantity, best[0]), unit)


def describe_merged(grid: Grid, row: int, column: int) -> str:
    """Describe the fault of a title that is merged with its right neighbour."""
    fault = "merged with the cell to its right; unmerge them and name each column"
    return f"{grid.place(row, column)}: {grid.rows[row][column]}: {fault}"


def _rows_of_numbers(grid: Grid, block: Block, columns: list[Column]) -> Iterator[int]:
    """Yield the indices of the rows of numbers of a block, up to the first row of text.

    Raise a SceneError when a row has too few or too many cells, or numbers follow a row of text.
    """
    indices, text, names = [column.index for column in columns], None, block.titles
    for n in block.rows:
        row = grid.rows[n]
        cells = [row[index] for index in indices if index < len(row)]
        is_complete = len(cells) == len(indices)
        # Tests in other groups of columns may be longer.
        if (is_complete or block.group) and not any(cells):
            continue
        # A row of text may contain numbers: of a short row only the time decides, or else the first cell.
        if not any(map(VALUE_START.match, cells if is_complete else row[indices[0] :][:1] or row[:1])):
            text = n if text is None else text
        elif text is None:
            grid.require_width(n, names)
            for column in columns:
                if not grid.cell(n, column.index):
                    fault = "empty"
                    if not grid.sheet and column.index >= len(row):
                        fault += f": the row has {len(row)} of {len(names)} cells, separated by {grid.separator}"
                    remedy = "fill it in, or delete the row"
                    raise SceneError([f"{grid.place(n, column.index)}: {column.title}: {fault}; {remedy}"])
            yield n
        elif is_complete and all(map(parse_number, cells)):
            fault = f"{', '.join(grid.rows[text])[:40]!r} within the rows of numbers"
            raise SceneError([f"{grid.place(text)}: {fault}; delete this row, or repeat the header after it"])
