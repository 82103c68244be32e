"""Trajectories as tables: columns in TUM's order, t tx ty tz qx qy qz qw, or named by a header (EuRoC, TUM-VI)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from taichi_msm.camera_files.camera_file import LENGTH_UNITS, CameraFile, listed
from taichi_msm.camera_files.trajectory import COLUMNS, MAX_NUMBER, Trajectory, TrajectoryReader, parse_numbers
from taichi_msm.errors import truncate

# Lower-case words of the names of columns, of position and rotation those before the axis.
TIME = {"t", "ts", "sec", "secs", "seconds"}
POSITION = {"t", "p", "pos", "position", "trans", "translation"}
ROTATION = {"q", "quat", "quaternion", "rot", "rotation", "orientation"}
AXES = {*"wxyz"}

# Longer lines are not headers, and longer words not names of columns.
MAX_HEADER_LENGTH, MAX_NAME_LENGTH = 2000, 80

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
    if file.text.lstrip()[:1] in ("{", "[", "<"):
        fault = "JSON or XML without known poses; expected transforms.json of nerfstudio, frame_data of SCARED"
        raise file.fault(f"{fault}, or a text with lines {' '.join(COLUMNS)}")
    rows: list[tuple[int, list[float]]] = []
    columns = None
    for n, line in file.lines:
        text, _, comment = line.replace('"', "").partition("#")
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
            rows.append((n, _row(file, n, words, columns, separated="," in text)))
    columns = columns or TUM
    return Trajectory(rows, True, columns.time_unit, columns.length_unit)


def _header(text: str, *, is_comment: bool) -> list[str]:
    """Split a header into the names of columns; return an empty list for other lines."""
    if len(text) > MAX_HEADER_LENGTH or re.match(r"\s*[-+.]?\d", text := text.rpartition(":")[2].lower()):
        return []
    names = [name.strip() for name in text.split(",")] if "," in text else re.sub(r"\s+(?=[\[(])", "", text).split()
    if any(len(name) > MAX_NAME_LENGTH or re.match(r"[-+.]?\d", name) for name in names):
        return []
    bare = [UNIT.sub("", name) for name in names]
    rotations = [
        words for *words, axis in map(_words, bare) if axis in AXES and ROTATION & {*words[-1:]} | {"q"} & {*words}
    ]
    is_table = len(names) >= 7 and ("," in text or not is_comment)
    return names if len(rotations) >= 4 or {*bare} >= AXES or is_table else []


def _words(name: str) -> list[str]:
    """Split a name into words, of which the axis is the last, as in q_RS_x, orientation.x or qx."""
    words: list[str] = re.findall("[a-z]+", name) or [""]
    last = words[-1]
    return [*words[:-1], last[:-1], last[-1]] if last[:-1] in POSITION | ROTATION and last[-1] in AXES else words


def _column(name: str) -> str:
    """Return the name in `COLUMNS` of a column; "" for other columns."""
    *words, axis = _words(name)
    first, last, only = words[:1], words[-1:], words if len(words) == 1 else []
    if (not words and axis in TIME) or any(word == "time" or word.endswith("stamp") for word in (*words, axis)):
        return "t"
    if axis in AXES - {"w"} and (first in ([], ["t"], ["p"]) or last == ["position"] or {*only} & POSITION):
        return f"t{axis}"
    if axis in AXES and (first == ["q"] or last == ["orientation"] or {*only} & ROTATION):
        return f"q{axis}"
    return ""


def _columns(file: CameraFile, line: int, names: Sequence[str]) -> _Columns:
    columns = [_column(UNIT.sub("", name)) for name in names]
    matches = [[n for n, found in enumerate(columns) if found == column] for column in COLUMNS]
    if any(len(match) != 1 for match in matches):
        fault = f"unknown or repeated columns in {listed(names)}"
        raise file.fault(f"{fault}; name them {', '.join(COLUMNS)}", line)
    indices = tuple(match[0] for match in matches)
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
    ("poses: groundtruth.txt, poses_start: 0", "poses: data.csv, poses_start: 0"),
    _read,
)
