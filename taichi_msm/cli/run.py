"""The commands `run`, `check` and `schema`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.cli import START_TIME, common, options
from taichi_msm.system.process import Interruption, write_stderr

if TYPE_CHECKING:
    from taichi_msm.model.plan import Plan


@options.program.command()
@click.argument("scene", metavar="SCENE", required=False)
@options.out_option("Directory for the results.", "output/<name of the scene file>; with --again, its DIR")
@options.device_options
@click.option(
    "--estimate-error/--no-estimate",
    default=None,
    help="Estimate the error always or never.  [default: if it takes at most two fifths of the run]",
)
@options.quality_option
@click.option("--resume", metavar="DIR", help="Continue the unfinished run in DIR instead of running SCENE.")
@click.option("--again", metavar="DIR", help="Repeat the run of DIR/run.json instead of running SCENE.")
@options.quiet_option
@options.json_option
def run(
    scene: str | None,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    threads: int | None,
    quality: int | None,
    resume: str | None,
    again: str | None,
    quiet: bool,
    as_json: bool,
    **settings: Any,
) -> int:
    """Simulate SCENE, draw its frames and write them."""
    overrides += () if quality is None else (f"render.quality={quality}",)
    recorded = [*overrides, *([f"image={image}"] if image is not None else [])]
    if resume is not None:
        _require_no_settings("--resume continues", ("resume", "threads", "quiet", "as_json"))
        from taichi_msm.scene.outputs import RUN_RECORD

        directory = common.result_directory(resume, option="--resume")
        if not common.resume_hint(directory):
            fault = "has no unfinished run" if directory.is_dir() else "is not a folder"
            if (directory / RUN_RECORD).is_file():
                fault = "has a complete run; nothing is left to continue, and --again repeats it"
            raise click.BadParameter(f"{resume} {fault}", param_hint="--resume")
    elif again is not None:
        allowed = ("again", "out", "arch", "threads", "estimate_error", "quiet", "as_json")
        _require_no_settings("--again repeats", allowed)
        from taichi_msm.load.check import check_scene
        from taichi_msm.runs.finished import read_run

        directory = common.result_directory(again, option="--again")
        earlier = read_run(directory)
        earlier.require_same_pictures(drawn=earlier.scene.draws or "image" in earlier.sha256)
        plan, recorded = check_scene(earlier.scene), earlier.overrides
        directory = directory if out is None else common.result_directory(out)
    elif scene is None:
        raise click.MissingParameter(param_hint="'SCENE'", param_type="argument")
    else:
        from taichi_msm.load.scene_file import load_plan

        plan = load_plan(scene, overrides, image)
        directory = common.result_directory(out, Path(scene).stem)

    from taichi_msm.cli.console import run_summary
    from taichi_msm.runs import run as run_module

    interruption, name = Interruption(), str(scene or resume or again)
    with (
        common.interruptible(
            as_json, quiet, interruption, lambda: f"; nothing was written{common.resume_hint(directory)}"
        ) as progress,
        common.add_resume_hint(directory),
        common.prefix_errors(name),
    ):
        if resume is not None:
            record = run_module.resume(directory, threads=threads, started=START_TIME, progress=progress)
        else:
            settings |= {"threads": threads, "overrides": recorded, "started": START_TIME, "progress": progress}
            record = run_module.run(plan, directory, **settings)
    if as_json:
        common.print_json({"directory": str(directory), **record})
    if record["status"] != "complete":
        message = f"{name}: {record.get('error', 'interrupted')}; frames in {directory}: {record['frames']}"
        remedy = f"; last good state: {record['dump']}" if record.get("dump") else common.resume_hint(directory)
        write_stderr([message + remedy])
    elif not quiet and not as_json:
        click.echo(run_summary(record, directory))
    return common.EXIT_CODES.get(record["status"], interruption.code)


def _require_no_settings(action: str, allowed: Sequence[str]) -> None:
    """Raise a UsageError for an option that the settings of an earlier run determine."""
    context = click.get_current_context()
    for option in context.command.params:
        is_given = context.get_parameter_source(str(option.name)) is click.core.ParameterSource.COMMANDLINE
        if is_given and option.name not in allowed:
            name = option.opts[0] if isinstance(option, click.Option) else "SCENE"
            raise click.UsageError(f"{action} a run with its own settings; leave out {name}")


@options.program.command()
@options.scene_argument
@options.image_option
@options.set_option
@options.json_option
def check(scene: str, image: str | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Validate SCENE, and print the steps, time, memory and disk space that it needs."""
    from taichi_msm.accuracy.mask import describe_mask, mask_notes, mask_record
    from taichi_msm.accuracy.surface import describe_surface, surface_notes, surface_record
    from taichi_msm.load import cost
    from taichi_msm.load.scene_file import load_plan
    from taichi_msm.model.tool_force import describe_forces, force_warnings, probe_records
    from taichi_msm.model.tools import path_warnings
    from taichi_msm.render.notes import describe_cameras, drawing_warnings
    from taichi_msm.render.texture import load_texture

    plan = load_plan(scene, overrides, image)
    with common.prefix_errors(scene):
        cost.require_disk(plan, Path("output"))
        if plan.scene.draws:
            load_texture(plan.scene)
    loaded, grid = plan.scene, plan.grid
    budget, duration = cost.estimate_budget(plan), cost.estimate_duration(plan)
    report: dict[str, Any] = {
        "scene": loaded.model_dump(mode="json"),
        **cost.step_entries(plan, grid.frames),
        "frames": budget.frames,
        "estimated_seconds": duration.seconds,
        "memory": budget.memory_bytes,
        "disk": budget.disk_bytes,
        "disk_while_running": budget.disk_bytes + budget.working_bytes,
        "probes": (records := probe_records(loaded)),
        "notes": [
            *surface_notes(loaded),
            *mask_notes(plan),
            *force_warnings(loaded, records),
            *path_warnings(loaded, plan.tools),
            *drawing_warnings(loaded),
        ],
    }
    if surface := surface_record(loaded):
        report["surface"] = surface
    if mask := mask_record(loaded):
        report["mask"] = mask
    import yaml

    tolerances = [f"{name}.tolerance" for name in ("sheet", "time") if getattr(loaded, name).tolerance is not None]
    # With a tolerance, companion runs may refine the scene.
    more = ", or more" if tolerances else ""
    longer = f", or longer, if refined for {' and '.join(tolerances)}" if tolerances else ""
    stepping = (
        f"each at rest{more}, in {grid.precision}"
        if loaded.time.at_rest
        else f"{grid.steps} steps of {grid.step:.6g} s (limit {plan.stable_step:.6g} s{_lock_cost(plan)}), "
        f"{grid.steps_per_frame} a frame{more}, in {grid.precision}"
    )
    forces = enumerate(map(describe_forces, records))
    memory, disk, working = (size / 2**20 for size in (budget.memory_bytes, budget.disk_bytes, budget.working_bytes))
    lines = [
        *yaml.safe_dump(report["scene"], sort_keys=False, default_flow_style=None).splitlines(),
        "",
        f"{math.prod(loaded.sheet.points)} points, {budget.frames} frames, {stepping}",
        f"about {cost.format_rough_time(duration.seconds)} to run{longer} (estimated from its work)",
        f"about {memory:.0f} MiB of memory, at most {disk:.1f} MiB on disk, {working:.1f} MiB more while it runs",
        *describe_mask(loaded),
        *describe_surface(plan),
        *describe_cameras(loaded),
        *(f"probes.{index}: {description}" for index, description in forces if description),
        *report["notes"],
    ]
    common.print_result(as_json, report, lines)


def _lock_cost(plan: Plan) -> str:
    """Describe by how much locking shortens the stable step of tissue; empty for tissue that does not lock."""
    if plan.material.stiffening is None and plan.material.virtual_stiffening is None:
        return ""
    from taichi_msm.solver.planning import stable_step

    linear = replace(plan.material, stiffening=None, virtual_stiffening=None)
    ratio = stable_step(linear, plan.scene.sheet, plan.scene.time.damping_difference) / plan.stable_step
    return f", {ratio:.2g} times shorter than without lock" if ratio > 1.01 else ""


@options.program.command()
def schema() -> None:
    """Print the JSON Schema of a scene, for editors."""
    from taichi_msm.load.scene_file import schema

    common.print_json(schema())
