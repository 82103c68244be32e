"""Reader of tests of a testing machine: time, depth and force from a text table or a workbook.

A table is a row of names, perhaps a row of units, and rows of numbers. A file may have several of them, blocks, and
other lines before, between and after them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.fitting.table_columns import (
    Choice,
    Column,
    find_candidates,
    is_header,
    is_units,
    missing_header,
    parse_choices,
    select_columns,
)
from taichi_msm.fitting.table_grids import WORKBOOK_SUFFIX, Grid, Row, choose_sheet, read_text, read_workbook
from taichi_msm.fitting.table_numbers import VALUE_START, find_mixed_marks, parse_number

Array = NDArray[np.float64]

# Fewest rows of a test: the noise of the force is estimated from ten.
MIN_ROWS = 10

TORE = "it tore"


@dataclass(frozen=True)
class MachineTest:
    """A test of a testing machine.

    Attributes:
        name: the file, and the sheet and block where there is a choice.
        time: times, increasing [s], shape (n,).
        depth: depths or elongations; their largest magnitude is positive [m], shape (n,).
        force: forces; their largest magnitude is positive [N], shape (n,).
        digit: last digit of the forces in the file [N].
        notes: sentences about choices of the reader, and about the test.
    """

    name: str
    time: Array
    depth: Array
    force: Array
    digit: float
    notes: tuple[str, ...] = ()


def read_machine_test(
    path: str | Path, columns: Sequence[str] = (), sheet: str | None = None, block: int | None = None
) -> MachineTest:
    """Read a test from a table.

    Args:
        path: a workbook (.xlsx), or a text of any other suffix.
        columns: chosen columns, such as "depth=Traverse, mm"; without a unit it is that of the file.
        sheet: chosen sheet of a workbook.
        block: chosen block, counted from 1.

    Raises:
        SceneError: when the file is not such a table, or needs a choice.
        NotInstalledError: when the file is a workbook and openpyxl is not installed.
    """
    name, chosen = str(path), parse_choices(columns)
    if name.lower().endswith(WORKBOOK_SUFFIX):
        sheets = read_workbook(name)
        tables = [title for title, grid in sheets.items() if grid is not None and _long_blocks(grid, chosen)]
        grid = choose_sheet(name, sheets, sheet, tables)
    elif sheet is None:
        grid = read_text(name, lambda row: is_header(row, chosen))
    else:
        raise SceneError([f"--sheet {sheet}: {name} is a text, without sheets; leave the option out"])
    # A block without enough rows is described if there is no other.
    blocks = _long_blocks(grid, chosen) or list(_blocks(grid, chosen))
    if not blocks:
        raise SceneError([missing_header(grid, chosen)])
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
        start: first time [s].
        end: last time [s].

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
    time, peak = test.time, int(force.argmax())
    fallen = np.flatnonzero(force[peak:] < force[peak] / 2) + peak
    if not len(fallen) or not peak:
        return replace(test, depth=depth, force=force)
    # While a held tissue relaxes, the depth may creep, but not at half the speed of the test.
    speed = (depth[peak] - depth[0]) / (time[peak] - time[0])
    growth = depth[fallen[0]] - depth[peak]
    if growth <= 0 or growth < speed / 2 * (time[fallen[0]] - time[peak]):
        return replace(test, depth=depth, force=force)
    note = (
        f"{test.name}: the force falls by half from {force[peak]:.4g} N at {time[peak]:.4g} s while the depth grows: "
        f"{TORE}; --window {time[0]:.4g},{time[peak]:.4g} cuts it there"
    )
    return replace(test, depth=depth, force=force, notes=(*test.notes, note))


@dataclass(frozen=True)
class _Block:
    """A header, its row of units, its other rows with content, and the row after the last."""

    header: int
    units: int | None
    rows: list[int]
    end: int


def _blocks(grid: Grid, chosen: dict[str, Choice]) -> Iterator[_Block]:
    """Find the blocks of a table."""
    headers = [n for n, row in enumerate(grid.rows) if is_header(row, chosen)]
    for header, end in pairwise([*headers, len(grid.rows)]):
        rows = [n for n in range(header + 1, end) if _has_content(grid, grid.rows[n])]
        has_units = bool(rows) and is_units(grid.rows[rows[0]], find_candidates(grid.rows[header], chosen))
        yield _Block(header, rows[0] if has_units else None, rows[1:] if has_units else rows, end)


def _long_blocks(grid: Grid, chosen: dict[str, Choice]) -> list[_Block]:
    """Return the blocks with enough rows of numbers for a test, unlike a summary."""

    def length(block: _Block) -> int:
        candidates = find_candidates(grid.rows[block.header], chosen).values()
        rows = map(grid.rows.__getitem__, block.rows)
        return sum(all(any(map(parse_number, _cells(row, columns))) for columns in candidates) for row in rows)

    return [block for block in _blocks(grid, chosen) if length(block) >= MIN_ROWS]


def _has_content(grid: Grid, row: Row) -> bool:
    """Return whether a row is not empty, a ruling or a comment of a text."""
    is_comment = not grid.sheet and row[:1] and row[0].startswith(("#", "%"))
    return not is_comment and any(character.isalnum() for cell in row for character in cell)


def _cells(row: Row, columns: Iterable[int]) -> list[str]:
    """Return the cells of a row in some columns, as far as it has them."""
    return [row[column] for column in columns if column < len(row)]


def _read_block(grid: Grid, block: _Block, chosen: dict[str, Choice]) -> MachineTest:
    """Read the numbers of a block."""
    first = grid.rows[block.rows[0]] if block.rows else []
    columns, notes = select_columns(grid, block.header, block.units, first, chosen)
    rows = list(_rows_of_numbers(grid, block, columns))
    if len(rows) < MIN_ROWS:
        raise SceneError([f"{grid.place(block.header)}: {len(rows)} rows of numbers; a test has at least {MIN_ROWS}"])
    cells = [(row, column, grid.rows[row][column.index]) for row in rows for column in columns]
    parsed = [_parse(grid, row, column, cell) for row, column, cell in cells]
    if (mixed := find_mixed_marks(cell for _, _, cell in cells)) is not None:
        row, column, cell = cells[mixed]
        fault = "both . and , are decimal marks in this table; take one"
        raise SceneError([f"{grid.place(row, column.index)}: {column.title}: {cell[:40]!r}; {fault}"])
    scales = np.array([column.scale for column in columns])
    time, depth, force = (np.array([value for value, _ in parsed]).reshape(-1, len(columns)) * scales).T.copy()
    _require_increasing(grid, rows, columns[0], time)
    for column, values in zip(columns[1:], (depth, force), strict=True):
        if not np.ptp(values):
            remedy = f'choose another column by --columns "{column.quantity}=NAME, UNIT"'
            raise SceneError([f"{grid.place(block.header, column.index)}: {column.title}: never changes; {remedy}"])
    digit = 10.0 ** min(power for _, power in parsed[2 :: len(columns)]) * columns[2].scale
    return MachineTest(grid.title, time, depth, force, digit, tuple(notes))


def _rows_of_numbers(grid: Grid, block: _Block, columns: list[Column]) -> Iterator[int]:
    """Return the rows of numbers of a block, up to the text after them.

    Raises:
        SceneError: when a row has too few or too many cells, or when numbers follow the text.
    """
    needed, text = [column.index for column in columns], None
    for n in block.rows:
        row = grid.rows[n]
        cells = _cells(row, needed)
        is_whole = len(row) > max(needed)
        if is_whole and not any(cells):
            continue
        # A line of text may have a number in it, so a short row is known by the time, or by its first cell.
        if not any(map(VALUE_START.match, cells if is_whole else _cells(row, needed[:1]) or row[:1])):
            text = n if text is None else text
        elif text is None:
            _require_cells(grid, n, block, columns)
            yield n
        elif is_whole and all(map(parse_number, cells)):
            fault = f"{', '.join(grid.rows[text])[:40]!r} within the rows of numbers"
            raise SceneError([f"{grid.place(text)}: {fault}; delete this row, or repeat the names after it"])


def _require_cells(grid: Grid, n: int, block: _Block, columns: list[Column]) -> None:
    """Raise an error unless a row has the cells of the columns, and a text not more of them than names."""
    row, names = grid.rows[n], grid.rows[block.header]
    as_header = f"separated by {grid.separator} as in the header"
    if not grid.sheet and len(row) > len(names):
        is_decimal = grid.separator == "commas"
        remedy = "with decimal commas, separate cells by semicolons" if is_decimal else "name each column"
        raise SceneError([f"{grid.place(n)}: {len(row)} cells {as_header}, and {len(names)} columns; {remedy}"])
    for column in columns:
        if column.index >= len(row) or not row[column.index]:
            details = f": the row has {len(row)} of {len(names)} cells {as_header}"
            fault = f"empty{'' if grid.sheet or len(row) > column.index else details}; fill it in, or delete the row"
            raise SceneError([f"{grid.place(n, column.index)}: {column.title}: {fault}"])


def _parse(grid: Grid, row: int, column: Column, cell: str) -> tuple[float, int]:
    """Parse a cell; return the number and the power of ten of its last digit."""
    if (parsed := parse_number(cell)) is not None:
        return parsed
    fault = f"{cell[:40]!r}; take a number, or delete the row"
    if cell.startswith("="):
        fault = f"{cell[:40]!r}, a formula without a saved value; calculate and save the workbook"
    raise SceneError([f"{grid.place(row, column.index)}: {column.title}: {fault}"])


def _require_increasing(grid: Grid, rows: list[int], column: Column, time: Array) -> None:
    """Raise an error at the first time that is not after the one before."""
    if len(still := np.flatnonzero(np.diff(time) <= 0)):
        n = int(still[0])
        fault = f"{time[n + 1]:.9g} s after {time[n]:.9g} s; time must increase: delete the row, or split the file"
        raise SceneError([f"{grid.place(rows[n + 1], column.index)}: {column.title}: {fault}"])
