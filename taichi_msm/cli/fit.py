"""The command `fit`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from taichi_msm.cli import common, options
from taichi_msm.errors import DivergedError
from taichi_msm.system.process import write_stderr


@options.program.command()
@options.scene_argument
@click.argument("observed", metavar="OBSERVED")
@click.argument("more", metavar="", nargs=-1)
@click.option("--free", metavar="KEY ...", multiple=True, help="Parameters to fit: keys of the scene, by dotted path.")
@click.option("--bounds", metavar="KEY=LOW,HIGH ...", multiple=True, help="Smallest and largest value of a parameter.")
@options.set_option
@click.option(
    "--forces",
    metavar="FILE,SIGMA",
    help="Measured forces of the tools, as in forces.csv, and their standard deviation [N].",
)
@click.option("--sigma", type=float, metavar="SIGMA", help="Standard deviation of the observations [m] or [px].")
@click.option("--robust", is_flag=True, help="Leave out outliers; of tables, reduce their weight.")
@click.option(
    "--correlation", type=float, metavar="PX", help="Correlation length of the errors of tracks in a picture [px]."
)
@click.option("--drift", type=float, metavar="SECONDS", help="Correlation time of the errors of a track [s].")
@click.option("--profile", is_flag=True, help="Compute all intervals by profile likelihood; takes more runs.")
@click.option("--resolution", type=int, metavar="R", help="Cells along a side of a fitted map.")
@click.option("--columns", metavar="NAME=COLUMN", multiple=True, help='Of tables: a column, as "depth=Traverse, mm".')
@click.option("--sheet", metavar="SHEET", help="Of tables: sheet of a workbook.")
@click.option("--block", type=int, metavar="N", help="Of tables: block of rows in a file, from 1.")
@click.option("--window", metavar="T0,T1", help="Of tables: first and last time to use [s].")
@click.option(
    "--rate", type=float, metavar="RATE", help="Of tables: frame rate [1/s].  [default: 10, less above 200 frames]"
)
@click.option(
    "--contact",
    type=float,
    metavar="DEPTH",
    multiple=True,
    help="Of tables: depth at contact [m], one for all or each.",
)
@click.option(
    "--force-offset",
    type=float,
    metavar="FORCE",
    multiple=True,
    help="Of tables: exact force without contact [N], one for all or each.",
)
@options.out_option("Directory for the fit.", "output/<name of the scene file>-fit")
@options.workers_option(help="Number of worker processes.  [default: chosen by the duration of the first run]")
@options.json_option
def fit(
    scene: str,
    observed: str,
    more: tuple[str, ...],
    free: tuple[str, ...],
    bounds: tuple[str, ...],
    overrides: tuple[str, ...],
    forces: str | None,
    window: str | None,
    out: str | None,
    as_json: bool,
    **settings: Any,
) -> int:
    """Estimate parameters of SCENE from OBSERVED data, with confidence intervals.

    OBSERVED: positions or pixels of points, an .npz; or one or more tables of a testing machine, .csv, .tsv, .txt,
    .dat, .lvm or .xlsx, with time, depth and force.
    """
    from taichi_msm.fitting.machine_model import is_table
    from taichi_msm.load.scene_file import load_scene

    # --free, --bounds and OBSERVED accept several words; click collects all but the first in `more`.
    tables = [observed, *(word for word in more if is_table(word))]
    more = tuple(word for word in more if not is_table(word))
    limits: dict[str, tuple[float, float]] = {}
    for key, interval in map(parse_bounds, (*bounds, *(word for word in more if "=" in word))):
        if key in limits:
            raise click.BadParameter(f"{key}: given twice; leave one of them out", param_hint="--bounds")
        limits[key] = interval
    loaded = load_scene(scene, overrides)
    directory = common.result_directory(out, f"{Path(scene).stem}-fit")

    from taichi_msm.fitting.fit import fit as fit_scene

    try:
        with common.interruptible(as_json) as progress:
            result = fit_scene(
                loaded,
                tables if len(tables) > 1 else observed,
                (*free, *(word for word in more if "=" not in word)),
                bounds=limits,
                forces=None if forces is None else parse_forces(forces),
                window=None if window is None else parse_window(window),
                directory=directory,
                progress=progress,
                report=lambda note: None if as_json else write_stderr([note]),
                **settings,
            )
    except DivergedError as error:
        common.report_failure("diverged", [f"{scene}: at the initial values of the search: {error}"], as_json)
        return common.DIVERGED
    lines = [f"{directory}: fit of {', '.join(tables)}", *result.summary()]
    common.print_result(as_json, {"directory": str(directory), **result.as_json()}, lines)
    return common.DONE


def parse_bounds(text: str) -> tuple[str, tuple[float, float]]:
    """Parse KEY=LOW,HIGH, where a missing bound is infinite."""
    with _expecting("KEY=LOW,HIGH, such as tissue.young=5e3,1e5", text, "--bounds"):
        key, interval = text.split("=", 1)
        low, high = interval.split(",", 1)
        return key.strip(), (float(low or "-inf"), float(high or "inf"))


def parse_forces(text: str) -> tuple[str, float]:
    """Parse FILE,SIGMA."""
    with _expecting("FILE,SIGMA, such as forces.csv,0.01", text, "--forces"):
        name, sigma = text.rsplit(",", 1)
        return name, float(sigma)


def parse_window(text: str) -> tuple[float, float]:
    """Parse T0,T1."""
    with _expecting("T0,T1, such as 0.5,12", text, "--window"):
        first, last = text.split(",", 1)
        return float(first), float(last)


@contextmanager
def _expecting(expected: str, text: str, option: str) -> Iterator[None]:
    """Convert a ValueError of the block to a BadParameter of an option with this text."""
    try:
        yield
    except ValueError:
        raise click.BadParameter(f"{text}: expected {expected}", param_hint=option) from None
