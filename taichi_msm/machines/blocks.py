"""Blocks of a table: titles, units and rows of numbers of a machine test.

Titles are recognised in English, French and German; --columns selects others, by title or number. A row of titles names
every quantity. Without such a row, titles are the last row of texts, other than units, above the numbers, or missing.
Tests in groups of columns with the same titles are blocks of their own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product

from taichi_msm.machines.cells import LETTER, Grid, Row, decimal_mark, is_value, parse_number
from taichi_msm.machines.titles import LABVIEW_TIME, fold, has_unit, split_choice, split_title, unit_factor

# Smallest number of rows of a test.
MIN_ROWS = 10

# Words for the quantities in titles, and endings of German compounds, such as Prüfzeit, Standardweg, Standardkraft.
WORDS = {
    "time": {"time", "temps", "zeit", "seriestime"},
    "depth": {"depth", "displacement", "indentation", "extension", "elongation", "allongement", "stroke", "position"}
    | {"travel", "distance", "weg", "disp", "crosshead", "pd", "height"},
    "force": {"force", "load", "fz", "kraft", "fn", "deflection", "vdeflection"},
}
ENDINGS = {"time": "zeit", "depth": "weg", "force": "kraft"}

# Longest title [characters], and number of a column [digits].
MAX_TITLE_LENGTH, MAX_DIGITS = 200, 5

# Largest distance of titles from the numbers, and of units above titles [rows]; largest size of a group [columns].
MAX_TITLE_ROWS, MAX_GROUP = 100, 100

# Words, and parts of a title in brackets; digits.
WORD, BRACKETS, DIGITS = re.compile(r"[^\W\d_]+"), re.compile(r"[(\[][^)\]]*[)\]]"), re.compile(r"\d+")

# Columns of every quantity.
Candidates = dict[str, list[int]]


@dataclass(frozen=True)
class Block:
    """Block of a table, by the indices of its rows and columns."""

    header: int  # row of the titles, or first row of numbers without titles
    titles: Row
    units: int | None  # row of the units
    rows: list[int]  # other rows with content
    end: int  # row after the last
    candidates: Candidates
    group: tuple[int, int] | None = None  # first column of a group, and the one after its last

    @property
    def has_titles(self) -> bool:
        """Whether a row has the titles."""
        return self.header not in self.rows

    def __str__(self) -> str:
        columns = f", columns {self.group[0] + 1} to {self.group[1]}" if self.group else ""
        return f"rows {self.header + 1} to {self.end}{columns}"


def find_blocks(grid: Grid, chosen: dict[str, str], min_rows: int = MIN_ROWS) -> list[Block]:
    """Find the blocks with at least `min_rows` rows of numbers; shorter ones are summaries."""
    headers, blocks, last = [n for n, row in enumerate(grid.rows) if is_header(row, chosen)], list[Block](), -1
    for header, end in pairwise([*headers, len(grid.rows)]):
        block = _build_block(grid, header, grid.rows[header], end, chosen, last)
        counts = [sum(map(is_value, grid.rows[n])) for n in block.rows]
        if sum(count >= len(WORDS) for count in counts) >= min_rows:
            blocks += _split_groups(block)
        last = header if block.rows else last
    return blocks


def find_blocks_of_numbers(grid: Grid, chosen: dict[str, str]) -> list[Block]:
    """Find the runs of at least `MIN_ROWS` rows of numbers, with the titles above; quantities may have no column."""
    runs, is_run = list[list[int]](), False
    for n, row in enumerate(grid.rows):
        if grid.has_content(n):
            if (continues := sum(map(is_value, row)) >= len(WORDS)) and not is_run:
                runs.append([])
            is_run = continues
            if is_run:
                runs[-1].append(n)
    blocks, last = list[Block](), -1
    for run in runs:
        if len(run) >= MIN_ROWS:
            header = _titles_above(grid, run[0], last)
            numbered = [f"column {n + 1}" for n in range(max(len(grid.rows[n]) for n in run))]
            first, titles = (run[0], numbered) if header is None else (header, grid.rows[header])
            blocks += _split_groups(_build_block(grid, first, titles, run[-1] + 1, chosen, last))
        last = run[-1]
    return blocks


def is_header(row: Row, chosen: dict[str, str]) -> bool:
    """Return whether a row has a title of every quantity, each in its own cell."""
    if len(row) < len(WORDS) or sum(bool(LETTER.search(cell)) for cell in row) < len(WORDS):
        return False
    if all(_number(chosen.get(quantity, "")) for quantity in WORDS):
        return False  # Any row has columns of these numbers.
    candidates = find_candidates(row, chosen).values()
    return any(len({*columns}) == len(columns) for columns in product(*candidates))


def find_candidates(row: Row, chosen: dict[str, str]) -> Candidates:
    """Return the columns of every quantity by its words, or those of a chosen title or number."""
    candidates = {}
    for quantity, title in chosen.items():
        # Columns of the whole title, or else of its name without the unit, or else of its number.
        name = fold(split_choice(title, quantity)[0])
        same = [n for n, cell in enumerate(row) if fold(cell) == fold(title)]
        same = same or [n for n, cell in enumerate(row) if name in (fold(cell), fold(split_title(cell, quantity)[0]))]
        number = _number(name)
        candidates[quantity] = same or ([number - 1] if 0 < number <= len(row) else [])
    taken = {column for columns in candidates.values() for column in columns}
    titles = [n for n, cell in enumerate(row) if n not in taken and 0 < len(cell) <= MAX_TITLE_LENGTH]
    for quantity in WORDS.keys() - chosen.keys():
        candidates[quantity] = [n for n in titles if quantity in _named_quantities(row[n])]
    return {quantity: candidates[quantity] for quantity in WORDS}


def _number(choice: str) -> int:
    """Return the number of a chosen column, 0 for a title."""
    name = choice.rpartition(",")[0].strip() or choice.strip()
    return int(name) if name.isdecimal() and len(name) <= MAX_DIGITS else 0


@lru_cache(10_000)
def _named_quantities(title: str) -> frozenset[str]:
    """Return the quantities whose words a title contains, outside brackets."""
    if fold(title) == LABVIEW_TIME:
        return frozenset({"time"})
    # Without closing brackets, `BRACKETS` takes quadratic time.
    end = max(title.rfind(")"), title.rfind("]")) + 1
    words = WORD.findall((BRACKETS.sub(" ", title[:end]) + title[end:]).casefold())
    by_ending = {quantity for quantity, ending in ENDINGS.items() if any(word.endswith(ending) for word in words)}
    return frozenset(by_ending | {quantity for quantity, known in WORDS.items() if known & {*words}})


def _build_block(grid: Grid, header: int, titles: Row, end: int, chosen: dict[str, str], last: int) -> Block:
    """Build a block up to the row `end`; `last`: row before those above it."""
    candidates, is_header_row = find_candidates(titles, chosen), titles is grid.rows[header]
    rows = [n for n in range(header + is_header_row, end) if grid.has_content(n)]
    above = range(header - 1, max(last, header - 1 - MAX_TITLE_ROWS), -1)
    if fold(titles[0]) == LABVIEW_TIME:
        _fill_times(grid, above, rows)

    def quantities_with_unit(row: int | None) -> int:
        pairs = ((quantity, [grid.cell(row, n) for n in columns]) for quantity, columns in candidates.items())
        return sum(any(unit_factor(quantity, cell) is not None for cell in cells) for quantity, cells in pairs)

    units = rows[0] if rows and (quantities_with_unit(rows[0]) or _are_units(grid.rows[rows[0]])) else None
    rows = rows if units is None else rows[1:]
    if rows and units is None and is_header_row:
        # JPK and LabVIEW write units above the names; a word may be a unit by chance.
        units = next((n for n in above if quantities_with_unit(n) >= 2), None)
    return Block(header, titles, units, rows, end, candidates)


def _fill_times(grid: Grid, above: range, rows: list[int]) -> None:
    """Fill the empty times of LabVIEW's first column, with the interval [s] in the rows above."""
    cell = next((grid.cell(n, 1) for n in above if grid.cell(n, 0) == "Delta_X"), "")
    if interval := parse_number(cell):
        for k, n in enumerate(rows):
            if len(grid.rows[n]) > 1 and not grid.rows[n][0]:
                grid.rows[n][0] = str(k * interval[0]).replace(".", decimal_mark(cell) or ".")


def _titles_above(grid: Grid, first: int, last: int) -> int | None:
    """Return the row of titles above the numbers: the nearest one of texts, no units, with a cell per column."""
    width = sum(map(bool, grid.rows[first]))
    # The comments of LabVIEW are mostly empty.
    for n in range(first - 1, max(last, first - 1 - MAX_TITLE_ROWS), -1):
        cells = [cell for cell in grid.rows[n] if cell and fold(cell) != "comment"]
        are_texts = all(any(map(str.isalpha, cell)) and not is_value(cell) for cell in cells)
        if len(cells) == width and are_texts and not _are_units(cells):
            return n
    return None


def _are_units(cells: Row) -> bool:
    """Return whether at least half of the cells are units."""
    return 2 * sum(map(has_unit, cells)) >= max(1, len(cells))


def _split_groups(block: Block) -> Iterator[Block]:
    """Yield a block for every group of columns, with the same titles up to digits; else the block itself.

    All groups may share the time in the first column.
    """
    titles = [DIGITS.sub("", fold(title)) for title in block.titles]
    for shared, size in product((0, 1), range(2, min(MAX_GROUP, (len(titles) + 1) // 2) + 1)):
        count = (len(titles) - shared + 1) // size
        if count < 2 or any(a != b for a, b in zip(titles[shared:], titles[shared + size :], strict=False)):
            continue
        found = False
        for first in range(shared, shared + count * size, size):
            columns = {*range(first, first + size), *range(shared)}
            group = {quantity: [n for n in of_all if n in columns] for quantity, of_all in block.candidates.items()}
            if all(group.values()):
                found = True
                yield replace(block, candidates=group, group=(first, min(first + size, len(titles))))
        if found:
            return
    yield block
