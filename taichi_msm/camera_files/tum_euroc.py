"""Trajectories as tables: columns in TUM's order, t tx ty tz qx qy qz qw, or named by a header (EuRoC, TUM-VI)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from taichi_msm.camera_files.camera_file import LENGTH_UNITS, CameraFile, listed
from taichi_msm.camera_files.trajectory import COLUMNS, MAX_NUMBER, Trajectory, TrajectoryReader, parse_numbers
from taichi_msm.errors import truncate

# Lower-case spellings of the names of columns, and of their units.
_POSITION = r"(t|p|pos|(.*[^a-z])?position|trans|translation|[tp][^a-z].*[^a-z])?"
_ROTATION = r"(q|quat|quaternion|(.*[^a-z])?orientation|rot|rotation|q[^a-z].*)"
ROLES = (
    r"t|ts|secs?|seconds|(.*[^a-z])?time([^a-z].*)?|.*(timestamp|stamp)([^a-z].*)?",
    *(rf"{_POSITION}[^a-z]*{axis}" for axis in "xyz"),
    *(rf"{_ROTATION}[^a-z]*{axis}" for axis in "xyzw"),
)
UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]|[^a-z](m?u?n?s|nsecs?|mm?)$")
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "seconds"), "s"),
    **dict.fromkeys(("ms", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanoseconds"), "ns"),
}

# Comments that state another order of the quaternion, or the inverse transform.
OTHER_CONVENTION = re.compile(
    r"\bw[\s,]*x[\s,]*y[\s,]*z\b|scalar[\s-]*first|\bq_?0\b|world[\s-]*(to|2)[\s-]*cam\w*|\bw2c\b|\bT_?cw\b",
    re.IGNORECASE,
)


class _Columns(NamedTuple):
    """Columns of a trajectory file."""

    indices: tuple[int, ...]  # columns of t, tx, ty, tz, qx, qy, qz, qw
    column_count: int  # number of all columns
    time_unit: str | None = None  # unit of t, if the header has one
    length_unit: str | None = None  # unit of the position, if the header has one


TUM = _Columns(tuple(range(8)), 8)


def _read(file: CameraFile) -> Trajectory:
    """Read the rows; without a header, the columns are TUM's."""
    rows: list[list[float]] = []
    lines = []
    columns = None
    for n, line in enumerate(file.text.splitlines(), 1):
        text, _, comment = line.strip().replace('"', "").partition("#")
        if ";" in text:  # Spreadsheets with decimal commas separate columns by semicolons.
            text = text.replace(",", ".").replace(";", ",")
        words = text.replace(",", " ").split()
        if (header := _header(text or comment, is_comment=not words)) and not rows:
            columns = _columns(file, n, header)
        elif header and _columns(file, n, header) != (columns or TUM):
            raise file.fault("other columns than in the lines before; write one order of columns", n)
        elif not words and not header and (match := OTHER_CONVENTION.search(comment)):
            fault = f"a comment states another convention, {truncate(match[0])}"
            raise file.fault(f"{fault}; name the columns in the first line: # {', '.join(COLUMNS)}", n)
        elif words:
            rows.append(_row(file, n, words, columns, separated="," in text))
            lines.append(n)
    columns = columns or TUM
    return Trajectory(rows, lines, True, columns.time_unit, columns.length_unit)


def _header(text: str, *, is_comment: bool) -> list[str]:
    """Split a header into the names of columns; return an empty list for other lines."""
    text = text.rpartition(":")[2].lower()
    names = [name.strip() for name in text.split(",")] if "," in text else re.sub(r"\s+(?=[\[(])", "", text).split()
    if len(text) > 2000 or max(map(len, names), default=0) > 80:
        return []
    bare = [UNIT.sub("", name) for name in names]
    rotations = sum(bool(re.fullmatch(rf"(.*[^a-z])?{_ROTATION}[^a-z]*[wxyz]", name)) for name in bare)
    is_table = len(names) >= 7 and ("," in text or not is_comment)
    is_header = rotations >= 4 or {*"wxyz"} <= {*bare} or is_table
    return names if is_header and not any(re.match(r"[-+.]?\d", name) for name in names) else []


def _columns(file: CameraFile, line: int, names: Sequence[str]) -> _Columns:
    bare = [UNIT.sub("", name) for name in names]
    matches = [[n for n, name in enumerate(bare) if re.fullmatch(role, name)] for role in ROLES]
    if any(len(columns) != 1 for columns in matches):
        fault = f"unknown or repeated columns in {listed(names)}"
        raise file.fault(f"{fault}; name them {', '.join(COLUMNS)}", line)
    indices = tuple(columns[0] for columns in matches)
    time, *lengths = [(match[1] or match[2] or "") if (match := UNIT.search(names[n])) else "" for n in indices[:4]]
    units = {*lengths} - {""}
    if time not in {"", *TIME_UNITS} or len(units) > 1 or not units <= LENGTH_UNITS.keys():
        fault = f"{', '.join(names[n] for n in indices[:4])}: unknown or different units"
        remedy = "write [s], [ms], [us] or [ns] for t, and [m] for the others, or [mm] for all of them"
        raise file.fault(f"{fault}; {remedy}", line)
    return _Columns(indices, len(names), TIME_UNITS.get(time), max(lengths) or None)


def _row(
    file: CameraFile, line: int, words: Sequence[str], columns: _Columns | None, *, separated: bool
) -> list[float]:
    """Convert the words of a line to a pose; `separated`: whether by commas."""
    expected = columns or TUM
    numbers = parse_numbers(words)
    if numbers is None or len(numbers) != expected.column_count:
        needed = f"eight numbers up to {MAX_NUMBER:g}: {' '.join(COLUMNS)}"
        if expected.column_count != TUM.column_count:
            needed = f"{expected.column_count} numbers up to {MAX_NUMBER:g}, one a column of the header"
        hint = ""
        if columns is None and len(words) == 17:
            hint = ", but 17 numbers, as EuRoC's; keep their header"
        elif columns is None and separated:
            hint = "; numbers with decimal commas need ; between them"
        raise file.fault(f"not a pose{hint}; expected {needed}", line)
    if separated and columns is None:
        fault = "commas without a header, so w may be first, as in EuRoC, or last, as in TUM"
        raise file.fault(f"{fault}; name the columns in a first line: # {', '.join(COLUMNS)}", line)
    return [numbers[n] for n in expected.indices]


TABLES = TrajectoryReader(
    "TUM, EuRoC, TUM-VI",
    "lines `t tx ty tz qx qy qz qw`, or a header with names of columns, such as `#timestamp [ns],...`",
    _read,
)
