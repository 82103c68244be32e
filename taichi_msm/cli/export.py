"""taichi_msm.cli.main.export."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import click

from taichi_msm.cli.options import Choice, json_option, program
from taichi_msm.cli.session import DONE, interrupted, interruptible, print_json, result_directory
from taichi_msm.errors import (
    printable,
)
from taichi_msm.exports.formats import FORMATS
from taichi_msm.system.process import Interruption

if TYPE_CHECKING:
    pass

# So many files of an export are named at the end; more are counted.
FEW = 2


@program.command()
@click.argument("directories", metavar="DIR ...", nargs=-1, required=True)
@click.option(
    "--format",
    "name",
    type=Choice(FORMATS),
    metavar="FORMAT",
    required=True,
    help="; ".join(f"{name}: {row.description}" for name, row in FORMATS.items()) + ".",
)
@click.option(
    "--out",
    metavar="DIR2",
    help="Directory for the files.  [default: DIR/export-FORMAT; of several DIR, output/export-FORMAT]",
)
@click.option("--camera", metavar="NAME", help="Of runs with several cameras, the one whose files are taken.")
@click.option("--quiet", is_flag=True, help="Print no progress and no summary.")
@json_option
def export(
    directories: tuple[str, ...], name: str, out: str | None, camera: str | None, quiet: bool, as_json: bool
) -> int:
    """Convert the results of runs and sweeps, each in a DIR, to the formats of other programs."""
    runs = [result_directory(directory, option="DIR") for directory in directories]
    folder = None if out is None else result_directory(out)

    from taichi_msm.cli.console import Progress
    from taichi_msm.exports import export as export_module

    interruption = Interruption()
    try:
        with Progress(quiet=quiet or as_json) as bar:
            done = export_module.export(runs, name, folder, partial(interruptible(bar, interruption), "export"), camera)
    except KeyboardInterrupt:
        return interrupted(interruption, as_json)
    if as_json:
        print_json({"directory": str(done.directory), "format": name, "files": done.files, "notes": done.notes})
    elif not quiet:
        files = ", ".join(done.files) if len(done.files) <= FEW else f"{len(done.files)} files"
        click.echo(printable(f"{done.directory}: {files}"))
        for note in done.notes:
            click.echo(printable(note))
    return DONE
