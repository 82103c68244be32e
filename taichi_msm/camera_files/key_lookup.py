"""Lookup of the keys of a calibration by any of their spellings."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from taichi_msm.camera_files.camera_file import MAX_DEPTH, CameraFile, CameraFileError, Entries, listed
from taichi_msm.errors import truncate

# Largest number in a calibration.
MAX_NUMBER = 1e6

# Largest relative difference of equal numbers that are rounded to different numbers of digits.
ROUNDING_TOLERANCE = 1e-6


class Keys:
    """Keys of one camera in a calibration."""

    def __init__(
        self, file: CameraFile, data: Entries, folded: Mapping[str, str] | None = None, camera: str = ""
    ) -> None:
        self.file = file
        self.camera = camera  # name of the camera, in files of which one camera is selected by its name
        self.data = data  # values by name in the file
        # Folded names without the mark of the camera (left, 1, ...), by default with it.
        self.folded = {name: fold(name) for name in data} if folded is None else folded
        self._read_names: set[str] = set()

    def __str__(self) -> str:
        return listed(self.data)

    def fault(self, fault: str, name: str | None) -> CameraFileError:
        """Return an error, for the caller to raise, with the line of the key `name`; None for the file as a whole."""
        return self.file.fault(fault, None if name is None else self.data.lines.get(name))

    def values(self, spelling: str, kind: type = object) -> dict[str, Any]:
        """Return the non-empty values of a type, by name in the file, whose folded names match a spelling (pattern)."""
        names = [name for name, value in self.data.items() if isinstance(value, kind)]
        matches = {name: self.data[name] for name in names if re.fullmatch(spelling, self.folded[name])}
        self._read_names |= matches.keys()
        return {name: value for name, value in matches.items() if value is not None and value != ""}

    def find(self, spelling: str) -> str | None:
        """Return the first name in the file that matches a spelling, or None."""
        return next(iter(self.values(spelling)), None)

    def numbers(self, spelling: str) -> list[float] | None:
        """Return the numbers of a key, or None if it is missing; the values of several matching keys must agree."""
        matches = [(name, self._numbers(name, value)) for name, value in self.values(spelling).items()]
        if not matches:
            return None
        (first, numbers), *others = matches
        for name, values in others:
            pairs = zip_longest(numbers, values, fillvalue=0.0)
            if not all(math.isclose(a, b, rel_tol=ROUNDING_TOLERANCE) for a, b in pairs):
                raise self.fault(f"{first} and {name} differ; keep the right one", name)
        return numbers

    def require(self, spelling: str, count: int, name: str) -> list[float]:
        """Return the numbers of a required key, whose name in messages is `name`."""
        numbers = self.numbers(spelling)
        if numbers is None:
            raise self.file.fault(f"has no {name}; found {self}; add it")
        if len(numbers) != count:
            fault = f"{name}: {describe_count(numbers)} in place of {count}"
            raise self.fault(f"{fault}; found {self}; write {count} numbers", self.find(spelling))
        return numbers

    def number(self, name: str, default: float | None = None) -> float:
        """Return the number of a key; without the key the default, or a CameraFileError if there is none."""
        if default is not None and not self.values(fold(name)):
            return default
        return self.require(fold(name), 1, name)[0]

    def unread(self, spelling: str) -> list[str]:
        """Return the names that match a spelling, were never looked up, and have a value other than 0."""
        names = [name for name in self.data if name not in self._read_names]
        return [name for name in names if re.fullmatch(spelling, self.folded[name]) and any(flat(self.data[name]))]

    def _numbers(self, name: str, value: Any) -> list[float]:
        try:
            numbers = [math.nan if isinstance(item, bool) else float(item) for item in flat(value)]
        except (TypeError, ValueError, OverflowError):
            numbers = [math.nan]
        if isinstance(value, dict) and "data" not in value:
            raise self.fault(f"{name}: has {listed(value)}; expected a matrix with rows, cols and data", name)
        # The comparison is false for NaN.
        if not all(abs(number) <= MAX_NUMBER for number in numbers):
            fault = f"{truncate(str(value))} is not a list of numbers up to {MAX_NUMBER:g}"
            raise self.fault(f"{name}: {fault}; write it as OpenCV does", name)
        rows, cols = (value.get(side) if isinstance(value, dict) else None for side in ("rows", "cols"))
        if isinstance(rows, int) and isinstance(cols, int) and rows * cols != len(numbers):
            fault = f"{len(numbers)} numbers for {rows} rows of {cols}; write {rows * cols} numbers"
            raise self.fault(f"{name}: {fault}", name)
        return numbers


def describe_count(numbers: Sequence[float]) -> str:
    """Describe the count of numbers, of which 16 are a matrix."""
    return "16 numbers, a 4 x 4 matrix," if len(numbers) == 16 else f"{len(numbers)} numbers"


def fold(name: object) -> str:
    """Reduce a name to its lower-case letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def flat(value: Any) -> list[Any]:
    """Flatten nested lists, the data of a matrix or the words of a text, up to MAX_DEPTH."""
    items = [value["data"]] if isinstance(value, dict) and "data" in value else [value]
    for _ in range(MAX_DEPTH):
        if not any(isinstance(item, list) for item in items):
            break
        items = [inner for item in items for inner in (item if isinstance(item, list) else [item])]
    return [word for item in items for word in (item.split() if isinstance(item, str) else [item])]
