"""The numbers that varied in a sweep, and those that came out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.sweeps.captions import short_names, short_value
from taichi_msm.sweeps.distribution import Distribution
from taichi_msm.sweeps.result import SweepResult

# Columns of the table that are none.
NO_RESULTS = ("status", "error", "seconds")

# Of so many values at most that are no numbers, each has a label.
MOST_LABELS = 8

# Numbers that span a larger ratio than this are compared by their logarithms.
WIDE_RATIO = 50


class Parameter(NamedTuple):
    """A number that varied, or one of some values."""

    name: str  # the key, with the index of a list's component; as short as is clear
    numbers: NDArray[np.float64]  # for each run; of one of some values its place among them
    is_logarithmic: bool = False
    labels: Sequence[str] = ()  # of the values, if they are few


def parameters(result: SweepResult, runs: Sequence[int]) -> list[Parameter]:
    """Give all parameters that differ between some runs, in the order of the keys."""
    names = short_names(result.sweep.keys)
    every = [
        parameter
        for column, (name, one) in enumerate(zip(names, result.sweep.settings.vary.values(), strict=True))
        for parameter in _parameters(name, one, [result.values[run][column] for run in runs])
    ]
    return [parameter for parameter in every if len(np.unique(parameter.numbers)) > 1]


def results(result: SweepResult, runs: Sequence[int]) -> dict[str, NDArray[np.float64]]:
    """Give the results that differ between some complete runs, for each run; NaN: not complete, or not known."""
    outcomes = [result.outcomes[run] for run in runs]
    columns = {}
    for name, values in result.columns().items():
        if name in NO_RESULTS:
            continue
        numbers = [values[run] if one.status == "complete" else None for run, one in zip(runs, outcomes, strict=True)]
        column = np.array(numbers, dtype=np.float64)
        if len(np.unique(column[np.isfinite(column)])) > 1:
            columns[name] = column
    return columns


def is_wide(numbers: NDArray[np.float64]) -> bool:
    """Tell whether numbers, of which some may be NaN, are better compared by their logarithms."""
    return bool(np.nanmin(numbers) > 0 and np.nanmax(numbers) > WIDE_RATIO * np.nanmin(numbers))


def _parameters(name: str, one: Distribution, values: list[Any]) -> Iterator[Parameter]:
    """Turn the values of a key into parameters: one, or of lists of numbers one for each component."""
    if one.kind not in ("choice", "grid"):
        is_logarithmic = one.kind == "log_uniform"
        for suffix, *components in zip(_suffixes(values[0]), *map(_flat, values), strict=True):
            yield Parameter(name + suffix, np.array(components, dtype=np.float64), is_logarithmic)
        return
    if all(type(value) in (int, float) for value in one.values):
        numbers = np.array(values, dtype=np.float64)
        yield Parameter(name, numbers, is_wide(numbers))
        return
    places = {text: place for place, text in enumerate(dict.fromkeys(map(json.dumps, one.values)))}
    if len(places) <= MOST_LABELS:
        yield Parameter(name, _placed(places, values), labels=[short_value(json.loads(text)) for text in places])
    else:
        yield Parameter(f"{name} ({len(places)} values)", _placed(places, values))


def _placed(places: dict[str, int], values: list[Any]) -> NDArray[np.float64]:
    return np.array([places[json.dumps(value)] for value in values], dtype=np.float64)


def _flat(value: Any) -> Iterator[float]:
    """List the numbers in a value."""
    if isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield value


def _suffixes(value: Any) -> Iterator[str]:
    """List what tells these numbers apart, such as [0] and [1]."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from (f"[{index}]{rest}" for rest in _suffixes(item))
    else:
        yield ""
