"""Cells of tables, reader of text tables, and parser of numbers.

Texts are UTF-8, UTF-16 or Windows-1252; their separator is detected from the header, or without one from the numbers.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path

from taichi_msm.errors import SceneError
from taichi_msm.images import irregular_kind
from taichi_msm.scene.section import MAX_MAGNITUDE

Row = list[str]

# Largest size of a file [bytes], and number of lines of a text.
MAX_BYTES, MAX_LINES = 2**26, 2**23

WORKBOOK_SUFFIX = ".xlsx"

# Separators by name, in order of trial: tabs and semicolons first, as titles may contain commas and spaces.
SEPARATORS = {"tabs": "\t", "semicolons": ";", "commas": ",", "bars": "|", "wide spaces": "", "spaces": ""}

# Patterns of the spaces between titles; a single space before a unit in brackets does not separate.
SPACES = {"wide spaces": re.compile(r"\s{2,}"), "spaces": re.compile(r"\s+(?![\[(])")}

# Gap between cells; sign of a comment with a label, as in # columns: height vDeflection; quoted and other cells.
GAP, COMMENT = re.compile(r"\S\s{2,}\S"), re.compile(r"\s*[#%]+\s*(?:\w+:\s)?")
QUOTED = re.compile(r'"([^"]*)"|(\S+)')

# Lines and columns that may show the separator of numbers.
MAX_NUMBER_LINES, MAX_NUMBER_COLUMNS = 1000, 1000

LINE_END = re.compile(r"\r\n|\r|\n")

# Letter other than e, which numbers contain.
LETTER = re.compile(r"[^\W\d_eE]")

NUMBER_PATTERN = re.compile(r"[+-]?(?:\d+(?:\.(\d*))?|\.(\d+))(?:[eE]([+-]?\d{1,3}))?", re.ASCII)

# Clock times hh:mm:ss.fff.
CLOCK = re.compile(r"(\d{1,4}):([0-5]?\d):([0-5]?\d(?:[.,]\d+)?)", re.ASCII)

# Numbers with grouped thousands, 1,234.5 and 1.234,5, by decimal mark.
GROUPS = {
    mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:\{group}\d{{3}})+\{mark}\d+", re.ASCII) for mark, group in (",.", ".,")
}


@dataclass(frozen=True)
class Grid:
    """Cells of a table."""

    name: str  # of the file
    sheet: str  # of a workbook, empty for a text
    rows: list[Row]  # cells, without empty ones at the end of a row
    separator: str = ""  # key of `SEPARATORS`, empty for a workbook
    counts: Sequence[int] = ()  # number of cells of every row of a text, including empty ones at the end
    # (first row, last row, column) of cells that are merged with their right neighbours.
    merged: list[tuple[int, int, int]] = field(default_factory=list)

    @property
    def title(self) -> str:
        """Name of the file, followed by the sheet of a workbook."""
        return f"{self.name}: {self.sheet}" if self.sheet else self.name

    def place(self, row: int, column: int = 0) -> str:
        """Return the line of a text, as FILE:LINE, or the cell of a workbook, as FILE: SHEET!A1, for messages."""
        if not self.sheet:
            return f"{self.name}:{row + 1}"
        letters = ""
        while column >= 0:
            letters, column = chr(ord("A") + column % 26) + letters, column // 26 - 1
        return f"{self.name}: {self.sheet}!{letters}{row + 1}"

    def cell(self, row: int | None, column: int) -> str:
        """Return a cell, empty beyond the end of a row, and of a missing row."""
        cells = [] if row is None else self.rows[row]
        return cells[column] if column < len(cells) else ""

    def merged_columns(self, row: int) -> list[int]:
        """Return the columns of a row that are merged with their right neighbours."""
        return [column for first, last, column in self.merged if first <= row <= last]

    def has_content(self, row: int) -> bool:
        """Return whether a row has letters or digits, and is not a comment of a text."""
        cells = self.rows[row]
        is_comment = not self.sheet and cells[:1] and cells[0].startswith(("#", "%"))
        return not is_comment and any(character.isalnum() for cell in cells for character in cell)

    def require_width(self, row: int, names: Row) -> None:
        """Raise a SceneError if a row of a text is longer than its header."""
        cells = self.rows[row]
        if not self.sheet and len(cells) > len(names):
            is_decimal = self.separator == "commas"
            remedy = "with decimal commas, separate cells by semicolons" if is_decimal else "name each column"
            fault = f"{len(cells)} cells separated by {self.separator}, but {len(names)} columns in the header"
            raise SceneError([f"{self.place(row)}: {fault}; {remedy}"])

    def numbers(
        self, names: Row, cells: Iterable[tuple[int, int]], remedy: str, clock: int | None = None
    ) -> list[tuple[float, int]]:
        """Return the number of every cell (row, column), with the power of its last digit, as `parse_number` does.

        A column `clock` may have clock times. Raise a SceneError for a cell that is not a number, with the given
        remedy, or when decimal marks differ.
        """
        numbers, known_mark = [], ""
        for row, column in cells:
            cell = self.rows[row][column]
            number, mark = parse_number(cell) or (parse_clock(cell) if column == clock else None), decimal_mark(cell)
            if number is None or (mark and known_mark not in ("", mark)):
                where = f"{self.place(row, column)}: {names[column]}: {cell[:40]!r}"
                if number is not None:
                    where, remedy = f"{where}; the table has both . and , as decimal marks", "take one"
                elif cell.startswith("="):
                    where, remedy = f"{where}, a formula without a saved value", "calculate and save the workbook"
                raise SceneError([f"{where}; {remedy}"])
            known_mark = mark or known_mark
            numbers.append(number)
        return numbers


def read_text(name: str, is_header: Callable[[Row], bool], expected: str) -> Grid:
    """Return the cells of a text table; the separator is one that splits a line into a header."""
    rows, counts, separator = list[Row](), list[int](), ""
    numbers_row, numbers = -1, dict[str, list[bool]]()
    data = read_bytes(name, expected)
    if (count := max(data.count(b"\n"), data.count(b"\r"))) > MAX_LINES:
        raise SceneError([f"{name}: {count:,} lines, above {MAX_LINES:,}; delete lines without cells"])
    lines = LINE_END.split(_decode(name, data, expected))
    for n, line in enumerate(lines):
        headers = {}
        if LETTER.search(line):
            splits = {key: _split_header(line, key) for key, mark in SEPARATORS.items() if mark in line}
            headers = {key: row for key, row in splits.items() if is_header(row)}
        if headers:
            if numbers_row < n:
                numbers_row, numbers = _find_numbers(lines, n + 1)
            # The first separator that splits the next line of numbers into at least three, or else the first one.
            suitable = (key for key, row in headers.items() if sum(numbers[key][: len(row)]) >= 3)
            is_first, separator = not separator, next(suitable, next(iter(headers)))
            if is_first:
                rows, counts = _split_lines(lines[:n], n, separator)  # Units may be above the names.
        if headers:
            cells = headers[separator]
        elif separator in SPACES and n < numbers_row and COMMENT.match(line):
            cells = _split_header(line, separator)  # units
        else:
            cells = _split_line(line, separator) if line else []
        rows.append(_strip(cells))
        counts.append(len(cells))
    if not separator and (found := _find_separator(lines)):
        first, separator = found
        rows, counts = _split_lines(lines, first, separator)
    return Grid(name, "", rows, separator, counts)


def parse_number(cell: str) -> tuple[float, int] | None:
    """Parse a number; accept decimal commas, grouped thousands, and U+2212 as minus.

    Return the number, and the power of ten of its last digit, or None for a cell that is not a number.
    """
    text = cell.replace("\N{MINUS SIGN}", "-")
    if (mark := decimal_mark(text)) and GROUPS[mark].fullmatch(text):
        text = text.replace("," if mark == "." else ".", "")
    match_ = NUMBER_PATTERN.fullmatch(text.replace(",", "."))
    if match_ is None or abs(value := float(match_[0])) > MAX_MAGNITUDE:
        return None
    return value, int(match_[3] or 0) - len(match_[1] or match_[2] or "")


def parse_clock(cell: str) -> tuple[float, int] | None:
    """Parse a clock time hh:mm:ss.fff, and return it as `parse_number` does [s]; None for other cells."""
    if (match_ := CLOCK.fullmatch(cell)) is None:
        return None
    seconds = float(match_[3].replace(",", "."))
    return 3600.0 * int(match_[1]) + 60.0 * int(match_[2]) + seconds, -max(0, len(match_[3]) - 3)


def is_value(cell: str) -> bool:
    """Return whether a cell is a number or a clock time."""
    return parse_number(cell) is not None or CLOCK.fullmatch(cell) is not None


def decimal_mark(cell: str) -> str:
    """Return the last . or , in a cell, or an empty string."""
    return "," if cell.rfind(",") > cell.rfind(".") else "." if "." in cell else ""


def _strip(cells: Row) -> Row:
    """Normalise spaces, and drop empty cells at the end."""
    cells = [" ".join(cell.split()) for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _find_numbers(lines: list[str], start: int) -> tuple[int, dict[str, list[bool]]]:
    """Return the index of the next line of numbers, and whether its cells are numbers, by separator."""
    found = (n for n in range(start, len(lines)) if lines[n].strip() and not LETTER.search(lines[n]))
    index = next(found, len(lines))
    line = lines[index] if index < len(lines) else ""
    return index, {key: [is_value(cell) for cell in _split_line(line, key)] for key in SEPARATORS}


def _find_separator(lines: list[str]) -> tuple[int, str] | None:
    """Return the index of the first of two successive lines of at least three numbers each, and their separator."""
    numbers = (n for n, line in enumerate(lines) if line.strip() and not LETTER.search(line))
    for first, second in pairwise(islice(numbers, MAX_NUMBER_LINES)):
        for key in SEPARATORS:
            cells, below = (_strip(_split_line(lines[n], key)) for n in (first, second))
            if 3 <= len(cells) == len(below) <= MAX_NUMBER_COLUMNS and all(map(is_value, (*cells, *below))):
                return first, key
    return None


def _split_lines(lines: list[str], first: int, separator: str) -> tuple[list[Row], list[int]]:
    """Return the cells of lines, and their counts; lines before the first one of numbers may be titles or units."""
    rows = []
    for n, line in enumerate(lines):
        if n < first and LETTER.search(line):
            by_spaces = "wide spaces" if GAP.search(line) else "spaces"
            rows.append(_split_header(line, by_spaces if separator in SPACES else separator))
        else:
            rows.append(_split_line(line, separator) if line else [])
    return [_strip(row) for row in rows], [len(row) for row in rows]


def _split_header(line: str, separator: str) -> Row:
    """Split a line that may be a header."""
    if spaces := SPACES.get(separator):
        if comment := COMMENT.match(line):
            line = line[comment.end() :]
            if separator == "spaces" and '"' in line:
                return _strip([quoted or word for quoted, word in QUOTED.findall(line)])
        return _strip(spaces.split(line.replace('"', "").strip("#% \t")))
    return _strip(_split_line(line, separator))


def _split_line(line: str, separator: str) -> Row:
    """Split a line, with empty cells at the end; before the first header, without a separator, a line is one cell."""
    if separator in SPACES:
        return line.replace('"', "").split()
    if separator:
        with suppress(csv.Error):
            return next(csv.reader([line], delimiter=SEPARATORS[separator], skipinitialspace=True), [])
    return [line]


def read_bytes(name: str, expected: str) -> bytes:
    """Return the content of a file of at most `MAX_BYTES`; messages call a readable one `expected`."""
    try:
        if not (reason := irregular_kind(Path(name))):
            if (size := Path(name).stat().st_size) <= MAX_BYTES:
                return Path(name).read_bytes()
            reason = f"{size / 1e6:.0f} MB, more than the {MAX_BYTES / 1e6:.0f} MB of a table"
    except OSError as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else str(error.strerror).lower()
    except ValueError as error:
        reason = str(error)
    raise SceneError([f"{name}: {reason}; {expected}"])


def _decode(name: str, data: bytes, expected: str) -> str:
    """Decode a text; without a byte order mark, zero bytes are the halves of the ASCII characters of UTF-16."""
    if data.startswith((b"PK", b"\xd0\xcf\x11\xe0")):
        raise SceneError([f"{name}: a workbook; {expected}"])
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ["utf-16"]
    elif 4 * abs(zeros := data[1::2].count(0) - data[::2].count(0)) > len(data):
        encodings = ["utf-16-le" if zeros > 0 else "utf-16-be"]
    else:
        # Windows programs of western Europe write cp1252; the numbers are ASCII in any encoding.
        data, encodings = data.removeprefix(codecs.BOM_UTF8), ["utf-8", "cp1252"]
    for encoding in encodings:
        with suppress(UnicodeDecodeError):
            text = data.decode(encoding, "replace" if encoding == "cp1252" else "strict")
            if (zero := text.find("\0")) < 0:
                return text
            line = len(LINE_END.split(text[:zero]))
            raise SceneError([f"{name}:{line}: a zero byte; remove it, or save the table as CSV in UTF-8"])
    raise SceneError([f"{name}: not a text; save it as CSV in UTF-8"])
