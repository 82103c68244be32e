"""Cells of a text table or of a workbook, by row and column, before they have a meaning.

A text may be UTF-8, UTF-16 or Windows-1252; its separator is the one that splits its header.
"""

from __future__ import annotations

import csv
import datetime
import io
import math
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_msm.errors import NotInstalledError, SceneError, did_you_mean
from taichi_msm.images import irregular_kind

Row = list[str]

# Limits: size of the file, unpacked size of a workbook, and cells of a sheet.
MAX_BYTES, MAX_UNPACKED_BYTES, MAX_CELLS = 2**26, 2**29, 10**7

WORKBOOK_SUFFIX = ".xlsx"

# Separators by name, in the order in which they are tried on a header: names may contain commas and spaces.
SEPARATORS = {"tabs": "\t", "semicolons": ";", "commas": ",", "bars": "|", "wide spaces": "", "spaces": ""}

# Where spaces separate the names of a header; a unit in brackets belongs to the name before it.
SPACES = {"wide spaces": re.compile(r"\s{2,}"), "spaces": re.compile(r"\s+(?![\[(])")}

BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}

# A letter that numbers do not have.
LETTER = re.compile(r"[^\W\d_eE]")


@dataclass(frozen=True)
class Grid:
    """Cells of a table.

    Attributes:
        name: the file.
        sheet: the sheet of a workbook; empty for a text.
        rows: cells by row; a row ends at its last filled cell.
        separator: name of the separator of a text.
        merged: rows and columns of the cells that are merged with the cell to their right.
    """

    name: str
    sheet: str
    rows: list[Row]
    separator: str = ""
    merged: frozenset[tuple[int, int]] = frozenset()

    @property
    def title(self) -> str:
        """The file, and the sheet of a workbook."""
        return f"{self.name}: {self.sheet}" if self.sheet else self.name

    def place(self, row: int, column: int = 0) -> str:
        """Return the place of a row or a cell, counted from 0, for a message."""
        if self.sheet:
            return f"{self.name}: {self.sheet}!{column_letters(column)}{row + 1}"
        return f"{self.name}:{row + 1}"


def column_letters(column: int) -> str:
    """Return the letters of a workbook's column, counted from 0."""
    letters = ""
    column += 1
    while column:
        column, digit = divmod(column - 1, 26)
        letters = chr(ord("A") + digit) + letters
    return letters


def read_text(name: str, is_header: Callable[[Row], bool]) -> Grid:
    """Read a text table.

    Args:
        name: the file.
        is_header: whether a row names the columns; it selects the separator.

    Raises:
        SceneError: when the file cannot be read, or is not a text.
    """
    rows, separator = [], ""
    for line in re.split(r"\r\n|\r|\n", _decode(name, _read_bytes(name))):
        headers = ((mark, _split_header(line, mark)) for mark in SEPARATORS) if LETTER.search(line) else ()
        if header := next((header for header in headers if is_header(header[1])), None):
            separator = header[0]
        rows.append(header[1] if header else _split(line, separator))
    return Grid(name, "", rows, separator)


def read_workbook(name: str) -> dict[str, Grid | None]:
    """Read the sheets of a workbook by name; None for a chart sheet.

    Raises:
        SceneError: when the file cannot be read, or is not a workbook.
        NotInstalledError: when openpyxl is not installed.
    """
    try:
        import openpyxl
    except ImportError:
        raise NotInstalledError(f"{name}: needs openpyxl, which is not installed; pip install openpyxl") from None
    data = _read_bytes(name)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_UNPACKED_BYTES:
            raise SceneError([f"{name}: {unpacked / 1e6:.0f} MB unpacked; save the sheet as CSV"])
        # openpyxl warns of parts that it leaves out, such as styles.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # The values as saved, and the formulas for cells that were saved without one.
            values, formulas = (openpyxl.load_workbook(io.BytesIO(data), data_only=saved) for saved in (True, False))
        return {
            sheet.title: _sheet(name, sheet, formulas[sheet.title]) if hasattr(sheet, "iter_rows") else None
            for sheet in map(values.__getitem__, values.sheetnames)
        }
    except SceneError:
        raise
    # openpyxl has no error of its own for a damaged file.
    except Exception as error:
        reason = f"not a workbook, or a damaged one ({type(error).__name__})"
        raise SceneError([f"{name}: {reason}; save it again as .xlsx, or as CSV"]) from None


def choose_sheet(name: str, sheets: dict[str, Grid | None], sheet: str | None, tables: list[str]) -> Grid:
    """Return the chosen sheet of a workbook, or the only one with a table.

    Args:
        name: the file.
        sheets: its sheets, from `read_workbook`.
        sheet: the chosen one.
        tables: names of the sheets with a table.

    Raises:
        SceneError: when there is no such sheet, or when several need a choice.
    """
    if sheet is None:
        if len(tables) > 1:
            raise SceneError([f"{name}: {len(tables)} sheets with a table; choose one by --sheet: {', '.join(tables)}"])
        if not tables and len(sheets) > 1:
            listed = ", ".join(sheets)
            raise SceneError(
                [f"{name}: no sheet has a table of time, depth and force; choose one by --sheet: {listed}"]
            )
        sheet = next(iter(tables or sheets))
    matching = [title for title in sheets if title == sheet] or [
        title for title in sheets if title.casefold() == sheet.casefold()
    ]
    if not matching:
        listed = ", ".join(tables or sheets)
        raise SceneError([f"--sheet {sheet}: not in {name}{did_you_mean(sheet, sheets)}; it has {listed}"])
    grid = sheets[matching[0]]
    if grid is None:
        raise SceneError([f"{name}: {matching[0]}: a chart sheet, without cells; choose another by --sheet"])
    return grid


def _sheet(name: str, sheet: Any, formulas: Any) -> Grid:
    """Read the cells of a sheet as texts."""
    if (cells := sheet.max_row * sheet.max_column) > MAX_CELLS:
        raise SceneError([f"{name}: {sheet.title}: {cells} cells; delete the empty rows and columns around the table"])
    rows = [
        _stripped([_text(value if value is not None else formula) for value, formula in zip(*pair, strict=False)])
        for pair in zip(sheet.iter_rows(values_only=True), formulas.iter_rows(values_only=True), strict=False)
    ]
    merged = frozenset(
        (row - 1, block.min_col - 1)
        for block in sheet.merged_cells.ranges
        for row in range(block.min_row, min(block.max_row, len(rows)) + 1)
        if block.max_col > block.min_col
    )
    return Grid(name, sheet.title, rows, merged=merged)


def _text(value: object) -> str:
    """Write a cell of a workbook as a text, a number with the digits that Excel shows."""
    if isinstance(value, float):
        return format(value, ".15g") if math.isfinite(value) else str(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time | datetime.timedelta):
        return f"a date or time of day, {value}"
    return "" if value is None else str(value)


def _stripped(cells: Row) -> Row:
    """Strip spaces, and empty cells at the end."""
    cells = [" ".join(cell.split()) for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _split_header(line: str, separator: str) -> Row:
    """Split a line that may be a header."""
    if spaces := SPACES.get(separator):
        return _stripped(spaces.split(line.replace('"', "").strip("#% \t")))
    return _split(line, separator)


def _split(line: str, separator: str) -> Row:
    """Split a line of text; a line before the first header, without a separator, is a cell."""
    if separator in SPACES:
        return line.replace('"', "").split()
    if not separator:
        return _stripped([line])
    try:
        return _stripped(next(csv.reader([line], delimiter=SEPARATORS[separator], skipinitialspace=True), []))
    except csv.Error:
        return _stripped([line])


def _read_bytes(name: str) -> bytes:
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
    raise SceneError([f"{name}: {reason}; name a table of a testing machine: .csv, .tsv, .txt or {WORKBOOK_SUFFIX}"])


def _decode(name: str, data: bytes) -> str:
    """Decode a text; without a byte order mark, zeros at even or odd places mean UTF-16."""
    if data.startswith((b"PK", b"\xd0\xcf\x11\xe0")):
        raise SceneError([f"{name}: a workbook; save it as {WORKBOOK_SUFFIX}, or as CSV"])
    encoding = BYTE_ORDER_MARKS.get(data[:2], "utf-8-sig")
    if encoding == "utf-8-sig" and b"\0" in data:
        encoding = "utf-16-le" if data[1::2].count(0) > data[::2].count(0) else "utf-16-be"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8-sig":
            raise SceneError([f"{name}: not a text; save it as CSV in UTF-8"]) from None
        # Windows programs of western Europe write so; their numbers are ASCII in any encoding.
        text = data.decode("cp1252", "replace")
    if "\0" in text:
        raise SceneError([f"{name}: not a text; save it as CSV in UTF-8"])
    return text
