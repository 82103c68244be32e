"""Numbers as testing machines write them: decimal point or comma, grouped thousands, U+2212 as minus."""

from __future__ import annotations

import re
from collections.abc import Iterable

from taichi_msm.scene.section import MAX_MAGNITUDE

NUMBER_PATTERN = re.compile(r"[+-]?(?:\d+(?:\.(\d*))?|\.(\d+))(?:[eE]([+-]?\d{1,3}))?", re.ASCII)

# Thousands in groups, with the mark of the groups and the decimal mark.
GROUPS = {
    mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:\{other}\d{{3}})+\{mark}\d+", re.ASCII) for mark, other in (",.", ".,")
}

# A cell that stands for a value, valid or not: a number, NaN, or an error, a formula or a date of a workbook.
VALUE_START = re.compile(r"[+\-\N{MINUS SIGN}]?[.,]?\d|[+-]?(nan|inf)|[#=]|a date", re.ASCII | re.IGNORECASE)


def decimal_mark(cell: str) -> str:
    """Return the decimal mark of a cell: the last mark in it, or an empty text."""
    return "," if cell.rfind(",") > cell.rfind(".") else "." if "." in cell else ""


def find_mixed_marks(cells: Iterable[str]) -> int | None:
    """Return the index of the first cell whose decimal mark differs from that of an earlier one."""
    known = ""
    for index, cell in enumerate(cells):
        if mark := decimal_mark(cell):
            if known not in ("", mark):
                return index
            known = mark
    return None


def parse_number(cell: str) -> tuple[float, int] | None:
    """Parse a number.

    Returns:
        The number, and the power of ten of its last digit; None if the cell is not a number.
    """
    text = cell.replace("\N{MINUS SIGN}", "-")
    if (mark := decimal_mark(text)) and GROUPS[mark].fullmatch(text):
        text = text.replace("," if mark == "." else ".", "")
    match_ = NUMBER_PATTERN.fullmatch(text.replace(",", "."))
    if match_ is None or abs(value := float(match_[0])) > MAX_MAGNITUDE:
        return None
    return value, int(match_[3] or 0) - len(match_[1] or match_[2] or "")


def parse_alone(cell: str) -> float | None:
    """Parse a number without its last digit; None if the cell is not a number."""
    parsed = parse_number(cell)
    return None if parsed is None else parsed[0]
