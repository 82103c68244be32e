"""The command `export`."""

from __future__ import annotations

from functools import partial

import click

from taichi_msm.cli import common, options
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
@options.out_option("Directory for the files.", "DIR/export-FORMAT; of several DIR, output/export-FORMAT", "DIR2")
@click.option("--camera", metavar="NAME", help="Camera whose files are exported, of runs with several cameras.")
@options.quiet_option
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
    record = {"directory": str(exported.directory), "format": name, "files": exported.files, "notes": exported.notes}
    files = ", ".join(exported.files) if len(exported.files) <= 2 else f"{len(exported.files)} files"
    common.print_result(as_json, record, [f"{exported.directory}: {files}", *exported.notes], quiet)
