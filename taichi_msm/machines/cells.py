"""Readers of the cells of text tables and workbooks, and parser of their numbers.

Texts are UTF-8, UTF-16 or Windows-1252; their separator is detected from the header.
"""

from __future__ import annotations

import codecs
import csv
import datetime
import io
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_msm.errors import NotInstalledError, SceneError
from taichi_msm.images import irregular_kind
from taichi_msm.scene.section import MAX_MAGNITUDE

Row = list[str]

# Largest size of a file and of an unpacked workbook [bytes], and largest number of cells of a sheet.
MAX_BYTES, MAX_UNPACKED_BYTES, MAX_CELLS = 2**26, 2**29, 10**7

WORKBOOK_SUFFIX = ".xlsx"

# Separators by name, in order of trial: tabs and semicolons first, as titles may contain commas and spaces.
SEPARATORS = {"tabs": "\t", "semicolons": ";", "commas": ",", "bars": "|", "wide spaces": "", "spaces": ""}

# Patterns of the spaces between titles; a single space before a unit in brackets does not separate.
SPACES = {"wide spaces": re.compile(r"\s{2,}"), "spaces": re.compile(r"\s+(?![\[(])")}

# Letter other than e, which numbers contain.
LETTER = re.compile(r"[^\W\d_eE]")

NUMBER_PATTERN = re.compile(r"[+-]?(?:\d+(?:\.(\d*))?|\.(\d+))(?:[eE]([+-]?\d{1,3}))?", re.ASCII)

# Numbers with grouped thousands, 1,234.5 and 1.234,5, by decimal mark.
GROUPS = {
    mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:\{group}\d{{3}})+\{mark}\d+", re.ASCII) for mark, group in (",.", ".,")
}


@dataclass(frozen=True)
class Grid:
    """Cells of a table.

    Attributes:
        name: name of the file.
        sheet: name of the sheet of a workbook, empty for a text.
        rows: cells of every row, without empty ones at the end.
        separator: key of `SEPARATORS`, empty for a workbook.
        counts: number of cells of every row of a text, including empty ones at the end.
        merged: (row, column) of every cell that is merged with its right neighbour.
    """

    name: str
    sheet: str
    rows: list[Row]
    separator: str = ""
    counts: Sequence[int] = ()
    merged: frozenset[tuple[int, int]] = frozenset()

    @property
    def title(self) -> str:
        """Name of the file, followed by the sheet of a workbook."""
        return f"{self.name}: {self.sheet}" if self.sheet else self.name

    def place(self, row: int, column: int = 0) -> str:
        """Return the line of a text, as FILE:LINE, or the cell of a workbook, as FILE: SHEET!A1, for messages.

        Args:
            row: index of the row, from 0.
            column: index of the column, from 0.
        """
        if not self.sheet:
            return f"{self.name}:{row + 1}"
        from openpyxl.utils import get_column_letter

        return f"{self.name}: {self.sheet}!{get_column_letter(column + 1)}{row + 1}"

    def has_content(self, row: int) -> bool:
        """Return whether a row has letters or digits, and is not a comment of a text."""
        cells = self.rows[row]
        is_comment = not self.sheet and cells[:1] and cells[0].startswith(("#", "%"))
        return not is_comment and any(character.isalnum() for cell in cells for character in cell)

    def require_width(self, row: int, header: int) -> None:
        """Check that a row of a text is not longer than its header.

        Args:
            row: index of the row.
            header: index of the header.

        Raises:
            SceneError: when the row is longer.
        """
        cells, names = self.rows[row], self.rows[header]
        if not self.sheet and len(cells) > len(names):
            is_decimal = self.separator == "commas"
            remedy = "with decimal commas, separate cells by semicolons" if is_decimal else "name each column"
            fault = f"{len(cells)} cells separated by {self.separator}, but {len(names)} columns in the header"
            raise SceneError([f"{self.place(row)}: {fault}; {remedy}"])

    def numbers(self, header: int, cells: Iterable[tuple[int, int]], remedy: str) -> list[tuple[float, int]]:
        """Return the number of every cell, with the power of its last digit, as `parse_number` does.

        Args:
            header: index of the header, for messages.
            cells: (row, column) of every cell.
            remedy: end of the message about a cell that is not a number.

        Raises:
            SceneError: when a cell is not a number, or when decimal marks differ.
        """
        numbers, known_mark = [], ""
        for row, column in cells:
            cell = self.rows[row][column]
            where = f"{self.place(row, column)}: {self.rows[header][column]}: {cell[:40]!r}"
            if (number := parse_number(cell)) is None:
                if cell.startswith("="):
                    remedy = "calculate and save the workbook"
                    where += ", a formula without a saved value"
                raise SceneError([f"{where}; {remedy}"])
            mark = decimal_mark(cell)
            if mark and known_mark not in ("", mark):
                raise SceneError([f"{where}; the table has both . and , as decimal marks; take one"])
            known_mark = mark or known_mark
            numbers.append(number)
        return numbers


def read_text(name: str, is_header: Callable[[Row], bool], expected: str) -> Grid:
    """Return the cells of a text table.

    Args:
        name: path of the file.
        is_header: whether a row is a header; the separator is one that splits a line into a header.
        expected: description of a readable file, for messages.

    Raises:
        SceneError: when the file cannot be read, or is not a text.
    """
    rows, counts, separator = [], [], ""
    lines = re.split(r"\r\n|\r|\n", _decode(name, _read_bytes(name, expected), expected))
    for n, line in enumerate(lines):
        headers = {}
        if LETTER.search(line):
            headers = {key: row for key in SEPARATORS if is_header(row := _split_header(line, key))}
        if headers:
            separator = _choose_separator(headers, lines[n + 1 :])
        cells = headers[separator] if headers else _split_line(line, separator)
        rows.append(_strip(cells))
        counts.append(len(cells))
    return Grid(name, "", rows, separator, counts)


def read_workbook(name: str, expected: str) -> dict[str, Grid]:
    """Return the worksheets of a workbook by name.

    Args:
        name: path of the file.
        expected: description of a readable file, for messages.

    Raises:
        SceneError: when the file cannot be read, or is not a workbook.
        NotInstalledError: when openpyxl is not installed.
    """
    try:
        import openpyxl
    except ImportError:
        raise NotInstalledError(f"{name}: needs openpyxl, which is not installed; pip install openpyxl") from None
    data = _read_bytes(name, expected)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_UNPACKED_BYTES:
            raise SceneError([f"{name}: {unpacked / 1e6:.0f} MB unpacked; save the sheet as CSV"])
        # openpyxl warns about ignored parts, such as styles.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Saved values, and formulas where no value was saved.
            values, formulas = (openpyxl.load_workbook(io.BytesIO(data), data_only=saved) for saved in (True, False))
        return {sheet.title: _read_sheet(name, sheet, formulas[sheet.title]) for sheet in values.worksheets}
    except SceneError:
        raise
    # openpyxl raises errors of any kind for a damaged file.
    except Exception as error:
        reason = f"not a workbook, or a damaged one ({type(error).__name__})"
        raise SceneError([f"{name}: {reason}; save it again as .xlsx, or as CSV"]) from None


def parse_number(cell: str) -> tuple[float, int] | None:
    """Parse a number; accept decimal commas, grouped thousands, and U+2212 as minus.

    Returns:
        Number, and power of ten of its last digit; None for a cell that is not a number.
    """
    text = cell.replace("\N{MINUS SIGN}", "-")
    if (mark := decimal_mark(text)) and GROUPS[mark].fullmatch(text):
        text = text.replace("," if mark == "." else ".", "")
    match_ = NUMBER_PATTERN.fullmatch(text.replace(",", "."))
    if match_ is None or abs(value := float(match_[0])) > MAX_MAGNITUDE:
        return None
    return value, int(match_[3] or 0) - len(match_[1] or match_[2] or "")


def decimal_mark(cell: str) -> str:
    """Return the last . or , in a cell, or an empty string."""
    return "," if cell.rfind(",") > cell.rfind(".") else "." if "." in cell else ""


def _read_sheet(name: str, sheet: Any, formulas: Any) -> Grid:
    """Read the cells of a worksheet as strings."""
    if (cells := sheet.max_row * sheet.max_column) > MAX_CELLS:
        raise SceneError([f"{name}: {sheet.title}: {cells} cells; delete the empty rows and columns around the table"])
    rows = [
        _strip([_format_cell(value if value is not None else formula) for value, formula in zip(*pair, strict=False)])
        for pair in zip(sheet.iter_rows(values_only=True), formulas.iter_rows(values_only=True), strict=False)
    ]
    merged = frozenset(
        (row - 1, block.min_col - 1)
        for block in sheet.merged_cells.ranges
        for row in range(block.min_row, min(block.max_row, len(rows)) + 1)
        if block.max_col > block.min_col
    )
    return Grid(name, sheet.title, rows, merged=merged)


def _format_cell(value: object) -> str:
    """Format the value of a cell, numbers with the 15 digits of Excel."""
    if isinstance(value, float):
        return format(value, ".15g")
    if isinstance(value, datetime.date | datetime.time | datetime.timedelta):
        return f"a date or time of day, {value}"
    return "" if value is None else str(value)


def _strip(cells: Row) -> Row:
    """Normalise spaces, and drop empty cells at the end."""
    cells = [" ".join(cell.split()) for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _choose_separator(headers: dict[str, Row], lines: list[str]) -> str:
    """Return the first separator that splits the next line of numbers into at least three; otherwise the first key."""
    line = next((line for line in lines if line.strip() and not LETTER.search(line)), "")

    def count(separator: str) -> int:
        cells = _strip(_split_line(line, separator))[: len(headers[separator])]
        return sum(parse_number(cell) is not None for cell in cells)

    return next((separator for separator in headers if count(separator) >= 3), next(iter(headers)))


def _split_header(line: str, separator: str) -> Row:
    """Split a line that may be a header."""
    if spaces := SPACES.get(separator):
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


def _read_bytes(name: str, expected: str) -> bytes:
    """Read a file of at most `MAX_BYTES`."""
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
    """Decode a text; without a byte order mark, zero bytes mean UTF-16, and their parity its byte order."""
    if data.startswith((b"PK", b"\xd0\xcf\x11\xe0")):
        raise SceneError([f"{name}: a workbook; {expected}"])
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ["utf-16"]
    elif b"\0" in data:
        encodings = ["utf-16-le" if data[1::2].count(0) > data[::2].count(0) else "utf-16-be"]
    else:
        # Windows programs of western Europe write cp1252; the numbers are ASCII in any encoding.
        data, encodings = data.removeprefix(codecs.BOM_UTF8), ["utf-8", "cp1252"]
    for encoding in encodings:
        with suppress(UnicodeDecodeError):
            if "\0" not in (text := data.decode(encoding, "replace" if encoding == "cp1252" else "strict")):
                return text
    raise SceneError([f"{name}: not a text; save it as CSV in UTF-8"])
