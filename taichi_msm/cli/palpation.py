"""The command `palpation`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from taichi_msm.cli import common, options

# Factors of the units of a length, and lengths of a ball's radius [m].
LENGTH_UNITS = {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
MIN_RADIUS, MAX_RADIUS = 1e-5, 0.5


@options.program.command()
@click.argument("table", metavar="TABLE")
@click.option("--radius", metavar="LENGTH", required=True, help="Radius of the ball, such as 4mm; without a unit [m].")
@click.option("--predict", metavar="TABLE2", help="Table of places and depths, whose forces are predicted.")
@click.option("--columns", metavar="NAME=COLUMN", multiple=True, help='A column, as "depth=Indentation, mm".')
@click.option("--sheet", metavar="SHEET", help="Sheet of a workbook.")
@options.out_option("Directory for the map.", "output/<name of the table>-palpation")
@options.json_option
def palpation(table: str, radius: str, out: str | None, as_json: bool, **settings: Any) -> int:
    """Map the stiffness of tissue from many presses of a ball, TABLE: place, x, y, z, depth and force.

    TABLE: .csv, .tsv, .txt or .xlsx, with units in the titles; instead of force fx, fy, fz; optionally nx, ny, nz.
    """
    length = parse_length(radius)
    directory = common.result_directory(out, f"{Path(table).stem}-palpation")

    from taichi_msm.palpation.palpate import palpate

    with common.interruptible(as_json) as progress:
        result = palpate(table, length, directory, progress, **settings)
    lines = [f"{directory}: map of {result.name}", *result.summary()]
    common.print_result(as_json, {"directory": str(directory), **result.as_json()}, lines)
    return common.DONE


def parse_length(text: str) -> float:
    """Parse the radius of a ball [m], a number with or without a unit."""
    found = re.fullmatch(r"\s*([-+.\deE]*\d\.?)\s*([a-z]*)\s*", text)
    try:
        length = float(found[1]) * LENGTH_UNITS[found[2]] if found else 0.0
    except (KeyError, ValueError):
        length = 0.0
    if not MIN_RADIUS <= length <= MAX_RADIUS:
        expected = f"expected a length from {1e3 * MIN_RADIUS:g} mm to {1e3 * MAX_RADIUS:g} mm, such as 4mm"
        raise click.BadParameter(f"{text}: {expected}; without a unit it is in metres", param_hint="--radius")
    return length
