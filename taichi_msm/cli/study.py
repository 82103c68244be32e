"""The command `study`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from taichi_msm.cli import common, options
from taichi_msm.runs.directory import require_no_link
from taichi_msm.system.process import Interruption


@options.program.command()
@options.scene_argument
@options.out_option("Directory for the report.", "output/<name of the scene file>-study")
@options.device_options
@click.option(
    "--tolerance",
    type=float,
    metavar="ERROR",
    help="Largest error, as a fraction of the largest displacement.  [default: the scene's, or 1e-3]",
)
@click.option("--quick", is_flag=True, help="Make fewer and shorter measurements, in about a minute.")
@options.json_option
def study(
    scene: str,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    tolerance: float | None,
    as_json: bool,
    **settings: Any,
) -> int:
    """Measure the speed and error of every setting of SCENE, and recommend one."""
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.scene.section import MAX_TOLERANCE, MIN_TOLERANCE

    loaded = load_scene(scene, overrides, image)
    directory = common.result_directory(out, f"{Path(scene).stem}-study")
    if tolerance is not None and not MIN_TOLERANCE <= tolerance <= MAX_TOLERANCE:
        expected = f"expected a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}"
        raise click.BadParameter(f"{tolerance:g} is not allowed; {expected}", param_hint="--tolerance")

    from taichi_msm.study.report import RECORD_FILE, format_summary, require_writable, study_record, write_report
    from taichi_msm.study.study import run_study

    require_writable(directory)
    interruption = Interruption()
    with common.interruptible(as_json, interruption=interruption) as progress, common.prefix_errors(scene):
        results = run_study(loaded, Path(scene).stem, tolerance=tolerance, progress=progress, **settings)
        if not results.stepping:
            raise KeyboardInterrupt
    if results.status == "interrupted" and (directory / RECORD_FILE).exists():
        # An interrupted study must not replace a complete one.
        directory = require_no_link(directory / "interrupted", "--out")
    outputs = write_report(results, directory)
    lines = [*format_summary(results).splitlines(), f"{directory}: {', '.join(outputs)}"]
    common.print_result(as_json, {"directory": str(directory), **study_record(results), "outputs": outputs}, lines)
    return common.EXIT_CODES.get(results.status, interruption.code)
