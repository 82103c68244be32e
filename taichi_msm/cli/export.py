"""The command `export`."""

from __future__ import annotations

from functools import partial

import click

from taichi_msm.cli import common, options
from taichi_msm.errors import printable
from taichi_msm.exports.formats import FORMATS


@options.program.command()
@click.argument("directories", metavar="DIR ...", nargs=-1, required=True)
@click.option(
    "--format",
    "name",
    type=options.SuggestingChoice(FORMATS),
    metavar="FORMAT",
    required=True,
    help="; ".join(f"{name}: {row.description}" for name, row in FORMATS.items()) + ".",
)
@click.option(
    "--out",
    metavar="DIR2",
    help="Directory for the files.  [default: DIR/export-FORMAT; of several DIR, output/export-FORMAT]",
)
@click.option("--camera", metavar="NAME", help="Camera whose files are exported, of runs with several cameras.")
@click.option("--quiet", is_flag=True, help="Print no progress and no summary.")
@options.json_option
def export(
    directories: tuple[str, ...], name: str, out: str | None, camera: str | None, quiet: bool, as_json: bool
) -> None:
    """Convert the results of runs and sweeps, each in a DIR, to the formats of other programs."""
    runs = [common.result_directory(directory, option="DIR") for directory in directories]
    folder = None if out is None else common.result_directory(out)

    from taichi_msm.exports import export as export_module

    with common.interruptible(as_json, quiet) as progress:
        exported = export_module.export(runs, name, folder, partial(progress, "export"), camera)
    if as_json:
        common.print_json(
            {"directory": str(exported.directory), "format": name, "files": exported.files, "notes": exported.notes}
        )
    elif not quiet:
        files = ", ".join(exported.files) if len(exported.files) <= 2 else f"{len(exported.files)} files"
        click.echo(printable(f"{exported.directory}: {files}"))
        for note in exported.notes:
            click.echo(printable(note))
