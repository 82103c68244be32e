"""Reader of measured tool forces, a forces.csv with any separator and decimal mark.

Empty cells and NaN mean "not measured"; any other cell must be a number.
"""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np

from taichi_msm.errors import SceneError
from taichi_msm.fitting.forces import ToolForces
from taichi_msm.images import irregular_kind
from taichi_msm.scene.section import MAX_MAGNITUDE

COLUMNS = {"time": "s", "probe": "", "force_x": "N", "force_y": "N", "force_z": "N"}
EXPECTED = f"name a forces.csv, with the columns {', '.join(COLUMNS)}"

MAX_BYTES = 2**26

# Encodings by byte order mark.
BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}

NUMBER_PATTERN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def read_forces(path: str | Path, sigma: float, probes: int) -> ToolForces:
    """Read a forces.csv.

    Args:
        path: the file.
        sigma: standard deviation of the error of each component [N].
        probes: number of tools of the scene.

    Raises:
        SceneError: when the file is not such a table, or refers to a missing tool.
    """
    name = str(path)
    if not 0 < sigma < math.inf:
        raise SceneError([f"--forces {name},{sigma:g}: take a number above 0, the standard deviation in newtons"])
    if not (text := _text(name)).strip():
        raise SceneError([f"{name}: is empty; {EXPECTED}"])
    table = np.array(_Reader(name, text).rows(), np.float64).reshape(-1, len(COLUMNS))
    time, probe, force = table[:, 0], table[:, 1], table[:, 2:]
    if not (np.isfinite(force).any() and np.isfinite(time).all()):
        fault = "no row" if not len(time) else "no force" if np.isfinite(time).all() else "a row without a time"
        raise SceneError([f"{name}: {fault}; {EXPECTED}, and numbers in them"])
    if unknown := [index for index in probe.tolist() if index not in range(probes)]:
        raise SceneError([f"{name}: probe: {unknown[0]:g}; the scene has {probes}, numbered from 0"])
    return ToolForces(name, time, force, sigma, probe.astype(np.intp))


def _text(name: str) -> str:
    """Read a text file of at most `MAX_BYTES`."""
    try:
        if not (reason := irregular_kind(Path(name))):
            if (size := Path(name).stat().st_size) <= MAX_BYTES:
                data = Path(name).read_bytes()
                if data.startswith(b"PK") or (b"\0" in data and data[:2] not in BYTE_ORDER_MARKS):
                    raise SceneError(
                        [f"{name}: a workbook, or UTF-16 without a byte order mark; save it as CSV in UTF-8"]
                    )
                return data.decode(BYTE_ORDER_MARKS.get(data[:2], "utf-8-sig"))
            reason = f"{size / 1e6:.0f} MB, more than the {MAX_BYTES / 1e6:.0f} MB of a table"
    except UnicodeDecodeError as error:
        reason = f"byte {error.start + 1} is not of UTF-8 text; save it as UTF-8"
    except OSError as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else str(error.strerror).lower()
    except ValueError as error:
        reason = str(error)
    raise SceneError([f"{name}: {reason}; {EXPECTED}"])


class _Reader:
    """Reader of a table; detects its header, separator and decimal mark."""

    def __init__(self, name: str, text: str) -> None:
        self._name, lines = name, text.splitlines()
        # Other lines may precede the header.
        headers = (n for n, line in enumerate(lines) if set(COLUMNS) <= set(re.findall(r"\w+", line.lower())))
        self._header_index = next(headers, 0)
        self._lines = lines[self._header_index :]
        self._delimiter = next((mark for mark in ";\t" if mark in self._lines[0]), ",")
        self._decimal = ""  # once detected
        self._row_keys: set[tuple[str, str]] = set()

    def rows(self) -> list[list[float]]:
        """Return the numbers of all rows in the order of `COLUMNS`."""
        reader = csv.reader(self._lines, delimiter=self._delimiter, skipinitialspace=True)
        rows: list[list[float]] = []
        try:
            header = _header(
                f"{self._name}:{self._header_index + 1}", [cell.lstrip("#% ").strip() for cell in next(reader)]
            )
            for cells in reader:
                if any(map(str.strip, cells)) and not cells[0].startswith(("#", "%")):
                    rows += self._row(
                        f"{self._name}:{self._header_index + reader.line_num}", header, cells, first=not rows
                    )
        except csv.Error as error:
            raise SceneError([f"{self._name}:{self._header_index + reader.line_num}: {error}; {EXPECTED}"]) from None
        return rows

    def _row(self, where: str, header: list[str], cells: list[str], *, first: bool) -> list[list[float]]:
        """Parse a row; return a list of its numbers, or an empty list for a row of units."""
        if len(cells) < len(header) or any(cells[len(header) :]):
            remedy = "with decimal commas, separate cells by ;" if self._delimiter == "," else "give a cell a column"
            raise SceneError([f"{where}: {len(cells)} cells, and {len(header)} columns; {remedy}"])
        named = {key: cells[header.index(key)].strip() for key in COLUMNS}
        if first and _is_units(where, named):
            return []
        if (row_key := (named["time"], named["probe"])) in self._row_keys:
            raise SceneError([f"{where}: a second row of {row_key[0]} s and probe {row_key[1]}; leave one"])
        self._row_keys.add(row_key)
        return [[self._number(where, key, cell) for key, cell in named.items()]]

    def _number(self, where: str, key: str, cell: str) -> float:
        """Parse a cell; NaN if it is empty."""
        if cell.lower() in ("", "nan"):
            return math.nan
        normalised, remedy = cell.replace("\N{MINUS SIGN}", "-"), "leave the cell empty where nothing was measured"
        for mark in {*normalised} & {*",."} if self._delimiter != "," else ():
            if self._decimal not in ("", mark):
                raise SceneError(
                    [f"{where}: {key}: {cell[:40]!r}; both . and , are decimal marks in this file; take one"]
                )
            self._decimal = mark
            normalised = normalised.replace(",", ".", 1)
        if "," in normalised:
            remedy = "with decimal commas, separate cells by ;"
        if not (NUMBER_PATTERN.fullmatch(normalised) and abs(value := float(normalised)) <= MAX_MAGNITUDE):
            raise SceneError([f"{where}: {key}: {cell[:40]!r}; take a number, or {remedy}"])
        return value


def _header(where: str, cells: list[str]) -> list[str]:
    """Return the column names without units; SceneError: missing or repeated columns, or other units."""
    matches = [re.fullmatch(r"(.*?)\s*[\[(](.*)[\])]", cell) for cell in cells]
    names = [cell if match_ is None else match_[1] for cell, match_ in zip(cells, matches, strict=True)]
    names = [name.lower() for name in names]
    if missing := [key for key in COLUMNS if key not in names]:
        listed = ", ".join(name[:20] for name in names[:12])
        raise SceneError([f"{where.rpartition(':')[0]}: {missing[0]}: missing; found {listed}; {EXPECTED}"])
    if repeated := [key for key in COLUMNS if names.count(key) > 1]:
        raise SceneError([f"{where}: {repeated[0]}: {names.count(repeated[0])} columns of this name; leave one"])
    for key, match_ in zip(names, matches, strict=True):
        if match_ is not None:
            _check_unit(where, key, match_[2].strip())
    return names


def _is_units(where: str, named: dict[str, str]) -> bool:
    """Return whether a row contains units instead of numbers; SceneError: other units."""
    units = {key: cell.strip("[]() ") for key, cell in named.items()}
    if not (units["time"].isalpha() and units["time"].lower() != "nan"):
        return False
    for key, unit in units.items():
        _check_unit(where, key, unit)
    return True


def _check_unit(where: str, key: str, unit: str) -> None:
    if key in COLUMNS and unit not in (COLUMNS[key], "", "-", "1"):
        raise SceneError([f"{where}: {key}: unit {unit!r}; give seconds and newtons"])
