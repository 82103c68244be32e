"""Reader of machine tests: time, depth and force from a text table or a workbook.

A block is a header, an optional row of units, and rows of numbers. A file may have several blocks, with other lines
around them. Titles are recognised in English, French and German; --columns selects others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError, did_you_mean
from taichi_msm.machines.cells import LETTER, WORKBOOK_SUFFIX, Grid, Row, parse_number, read_text
from taichi_msm.machines.titles import UNITS, fold, split_choice, split_title, unit_factor
from taichi_msm.machines.workbook import read_workbook

# Smallest number of rows of a test, and of those that the noise of the force is estimated from.
MIN_ROWS = 10

# Clause of the note about torn tissue.
TORE = "the tissue tore"

EXPECTED = f"name a table of a testing machine: .csv, .tsv, .txt or {WORKBOOK_SUFFIX}"

# Words for the quantities in titles, and endings of German compounds, such as Prüfzeit, Standardweg, Standardkraft.
WORDS = {
    "time": {"time", "temps", "zeit"},
    "depth": {"depth", "displacement", "indentation", "extension", "elongation", "allongement", "stroke", "position"}
    | {"travel", "distance", "weg"},
    "force": {"force", "load", "fz", "kraft"},
}
ENDINGS = {"time": "zeit", "depth": "weg", "force": "kraft"}

# Smallest ranges of a test, in SI units.
MIN_RANGES = {"time": (1e-9, "s"), "depth": (1e-12, "m"), "force": (1e-15, "N")}

# Content of a table, for messages.
CONTENT = "time, depth and force"

# Longest title [characters].
MAX_TITLE_LENGTH = 200

# Words, and parts of a title in brackets.
WORD, BRACKETS = re.compile(r"[^\W\d_]+"), re.compile(r"[(\[][^)\]]*[)\]]")

# Start of a value, even an invalid one: a number, NaN, or an error or a formula of a workbook.
VALUE_START = re.compile(r"[+\-\N{MINUS SIGN}]?[.,]?\d|[+-]?(nan|inf)|[#=]", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class MachineTest:
    """Test of a testing machine."""

    name: str  # name of the file, with the sheet of a workbook, and the block if there are several
    time: Array  # increasing times [s], shape (n,)
    depth: Array  # depths or elongations [m], shape (n,), signed so that the largest magnitude is positive
    force: Array  # forces [N], shape (n,), signed likewise
    digit: float  # resolution of the forces: their last digit in the file [N]
    notes: tuple[str, ...] = ()  # warnings about choices of the reader, and about the test

    @property
    def noise_rows(self) -> int:
        """Number of first rows, which the noise of the force is estimated from."""
        return max(MIN_ROWS, math.ceil(0.05 * len(self.force)))


@dataclass(frozen=True)
class _Block:
    """Header, row of units, other rows with content, and row after the last, by index."""

    header: int
    units: int | None
    rows: list[int]
    end: int


@dataclass(frozen=True)
class _Column:
    """Column of a quantity: index, title, and factor from its unit to SI."""

    index: int
    title: str
    scale: float


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
        tables = [title for title, each in sheets.items() if _find_blocks(each, chosen)]
        grid = choose_sheet(name, sheets, sheet, tables)
    elif sheet is None:
        grid = read_text(name, lambda row: _is_header(row, chosen), EXPECTED)
    else:
        raise SceneError([f"--sheet {sheet}: {name} is a text, without sheets; leave the option out"])
    # A block of too few rows counts only if there is no other; `_read_block` then raises the error.
    blocks = _find_blocks(grid, chosen) or _find_blocks(grid, chosen, min_rows=0)
    if not blocks:
        raise SceneError([_missing_header(grid, chosen)])
    if block is None and len(blocks) > 1:
        numbered = listed([f"{n} (rows {part.header + 1} to {part.end})" for n, part in enumerate(blocks, 1)])
        raise SceneError([f"{grid.title}: {len(blocks)} blocks of rows; choose one by --block: {numbered}"])
    if block is not None and not 1 <= block <= len(blocks):
        raise SceneError([f"--block {block}: {grid.title} has {len(blocks)}, numbered from 1"])
    test = _read_block(grid, blocks[(block or 1) - 1], chosen)
    return _orient(test if len(blocks) == 1 else replace(test, name=f"{test.name}, block {block}"))


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


def _find_blocks(grid: Grid, chosen: dict[str, str], min_rows: int = MIN_ROWS) -> list[_Block]:
    """Find the blocks with at least `min_rows` rows of numbers; shorter ones are summaries."""
    headers = [n for n, row in enumerate(grid.rows) if _is_header(row, chosen)]
    blocks = []
    for header, end in pairwise([*headers, len(grid.rows)]):
        rows = [n for n in range(header + 1, end) if grid.has_content(n)]
        candidates = _find_candidates(grid.rows[header], chosen)
        first = rows[0] if rows else None
        pairs = ((quantity, index) for quantity, columns in candidates.items() for index in columns)
        has_units = any(unit_factor(quantity, grid.cell(first, index)) is not None for quantity, index in pairs)
        units, rows = (first, rows[1:]) if has_units else (None, rows)
        counts = [sum(parse_number(cell) is not None for cell in grid.rows[n]) for n in rows]
        if sum(count >= len(WORDS) for count in counts) >= min_rows:
            blocks.append(_Block(header, units, rows, end))
    return blocks


def _is_header(row: Row, chosen: dict[str, str]) -> bool:
    """Return whether a row has a title of every quantity, each in its own cell."""
    if len(row) < len(WORDS) or sum(bool(LETTER.search(cell)) for cell in row) < len(WORDS):
        return False
    candidates = _find_candidates(row, chosen).values()
    return any(len({*columns}) == len(columns) for columns in product(*candidates))


def _find_candidates(row: Row, chosen: dict[str, str]) -> dict[str, list[int]]:
    candidates = {}
    for quantity, title in chosen.items():
        # Columns of the whole title, or else of its name without the unit.
        name = fold(split_choice(title, quantity)[0])
        same = [n for n, cell in enumerate(row) if fold(cell) == fold(title)]
        candidates[quantity] = same or [
            n for n, cell in enumerate(row) if name in (fold(cell), fold(split_title(cell, quantity)[0]))
        ]
    taken = {column for columns in candidates.values() for column in columns}
    titles = [n for n, cell in enumerate(row) if n not in taken and 0 < len(cell) <= MAX_TITLE_LENGTH]
    for quantity in WORDS.keys() - chosen.keys():
        candidates[quantity] = [n for n in titles if quantity in _named_quantities(row[n])]
    return {quantity: candidates[quantity] for quantity in WORDS}


@lru_cache(10_000)
def _named_quantities(title: str) -> frozenset[str]:
    """Return the quantities whose words a title contains, outside brackets."""
    # Without closing brackets, `BRACKETS` takes quadratic time.
    end = max(title.rfind(")"), title.rfind("]")) + 1
    words = WORD.findall((BRACKETS.sub(" ", title[:end]) + title[end:]).casefold())
    by_ending = {quantity for quantity, ending in ENDINGS.items() if any(word.endswith(ending) for word in words)}
    return frozenset(by_ending | {quantity for quantity, known in WORDS.items() if known & {*words}})


def _read_block(grid: Grid, block: _Block, chosen: dict[str, str]) -> MachineTest:
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
    for quantity, column, values in zip(WORDS, columns, (time, depth, force), strict=True):
        least, unit = MIN_RANGES[quantity]
        if (extent := np.ptp(values)) < least:
            fault = f"changes by only {extent:.3g} {unit}" if extent else "never changes"
            remedy = f'choose another column or unit by --columns "{quantity}=NAME, UNIT"'
            raise SceneError([f"{grid.place(block.header, column.index)}: {column.title}: {fault}; {remedy}"])
    digit = 10.0 ** min(power for _, power in parsed[2 :: len(columns)]) * columns[2].scale
    return MachineTest(grid.title, time, depth, force, digit, tuple(notes))


def _select_columns(grid: Grid, block: _Block, chosen: dict[str, str]) -> tuple[list[_Column], list[str]]:
    """Select the columns of time, depth and force, and collect notes.

    Of several candidates, the one nearest 0 in the first row is selected.
    """
    header, titles = block.header, grid.rows[block.header]
    first = block.rows[0] if block.rows else None

    def first_size(column: _Column) -> float:
        number = parse_number(grid.cell(first, column.index))
        return math.inf if number is None else abs(number[0]) * column.scale

    selected, notes = [], []
    for quantity, candidates in _find_candidates(titles, chosen).items():
        given, columns = split_choice(chosen.get(quantity, ""), quantity)[1], []
        for index in candidates:
            scale = unit_factor(quantity, grid.cell(block.units, index))
            if scale is None:
                scale = split_title(titles[index], quantity)[1]
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
        if best.index in grid.merged_columns(header):
            raise SceneError([describe_merged(grid, header, best.index)])
        unit = grid.cell(block.units, best.index)
        title_scale, scale = split_title(best.title, quantity)[1], unit_factor(quantity, unit)
        if given is None and unit and title_scale not in (None, scale):
            reason = f"not a unit of {quantity}; so it is in that of its title" if scale is None else "its unit"
            notes.append(f"{grid.title}: {best.title!r}: {unit[:40]!r} in the row below is {reason}")
        if others := [column.title for column in columns if column != best]:
            than = " and ".join(map(repr, others[:5]))
            notes.append(f"{grid.title}: {quantity} is {best.title!r}, as it starts nearer 0 than {than}")
        selected.append(best)
    return selected, notes


def _missing_header(grid: Grid, chosen: dict[str, str]) -> str:
    """Describe the fault of a table without a header."""
    if not any(grid.rows):
        return f"{grid.title}: is empty; a table has columns of time, depth and force"
    # Find the row with most quantities; a text without a header is not split yet.
    cells = [row if grid.sheet else re.split(r"[\t;,|]", ";".join(row)) for row in grid.rows]
    named = [{quantity for quantity, columns in _find_candidates(row, chosen).items() if columns} for row in cells]
    best = max(range(len(named)), key=lambda row: len(named[row]))
    if named[best] and (merged := grid.merged_columns(best)):
        return describe_merged(grid, best, min(merged))
    shown = f"{grid.place(best)}: {', '.join(grid.rows[best])[:100]!r}"
    missing = [quantity for quantity in WORDS if quantity not in named[best]]
    if not missing:
        return f"{shown} names time, depth and force in one cell; separate them"
    quantity = missing[0] if named[best] else "depth"
    known = ", ".join(UNITS[quantity])
    remedy = f'choose columns by --columns "{quantity}=NAME, {next(iter(UNITS[quantity]))}" (units: {known})'
    if not named[best]:
        return f"{grid.title}: no row names time, depth and force; {remedy}"
    return f"{shown} names no {repr(chosen[quantity]) if quantity in chosen else quantity}; {remedy}"


def describe_merged(grid: Grid, row: int, column: int) -> str:
    """Describe the fault of a title that is merged with its right neighbour."""
    fault = "merged with the cell to its right; unmerge them and name each column"
    return f"{grid.place(row, column)}: {grid.rows[row][column]}: {fault}"


def _rows_of_numbers(grid: Grid, block: _Block, columns: list[_Column]) -> Iterator[int]:
    """Yield the indices of the rows of numbers of a block, up to the first row of text.

    Raise a SceneError when a row has too few or too many cells, or numbers follow a row of text.
    """
    indices, text, names = [column.index for column in columns], None, grid.rows[block.header]
    for n in block.rows:
        row = grid.rows[n]
        cells = [row[index] for index in indices if index < len(row)]
        is_complete = len(cells) == len(indices)
        if is_complete and not any(cells):
            continue
        # A row of text may contain numbers: of a short row only the time decides, or else the first cell.
        if not any(map(VALUE_START.match, cells if is_complete else row[indices[0] :][:1] or row[:1])):
            text = n if text is None else text
        elif text is None:
            grid.require_width(n, block.header)
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
