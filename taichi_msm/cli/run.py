"""taichi_msm.cli.main.run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.cli import STARTED
from taichi_msm.cli.options import (
    arch_option,
    image_option,
    json_option,
    program,
    quality_option,
    require_alone,
    scene_argument,
    set_option,
    threads_option,
)
from taichi_msm.cli.session import (
    DONE,
    EXIT_CODES,
    going_on,
    interrupted,
    interruptible,
    naming,
    print_json,
    repeated,
    result_directory,
    resumable,
)
from taichi_msm.system.process import Interruption, tell

if TYPE_CHECKING:
    pass
# What may be given together with --resume, and with --again.
RESUMABLE = ("resume", "threads", "quiet", "as_json")
REPEATABLE = ("again", "out", "arch", "threads", "estimate_error", "quiet", "as_json")


@program.command()
@click.argument("scene", metavar="SCENE", required=False)
@click.option(
    "--out",
    metavar="DIR",
    help="Directory for the results.  [default: output/<name of the scene file>; with --again, its DIR]",
)
@image_option
@set_option
@arch_option
@threads_option
@click.option(
    "--estimate-error/--no-estimate",
    default=None,
    help="Always or never estimate the error.  [default: if that takes at most two fifths of the run]",
)
@quality_option
@click.option("--resume", metavar="DIR", help="Continue the unfinished run in DIR, instead of running SCENE.")
@click.option("--again", metavar="DIR", help="Repeat the run that run.json in DIR tells of, instead of running SCENE.")
@click.option("--quiet", is_flag=True, help="Print no progress and no summary.")
@json_option
@click.pass_context
def run(
    context: click.Context,
    scene: str | None,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    arch: str,
    threads: int | None,
    estimate_error: bool | None,
    quality: int | None,
    resume: str | None,
    again: str | None,
    quiet: bool,
    as_json: bool,
) -> int:
    """Simulate SCENE, draw its frames and write them."""
    overrides += () if quality is None else (f"render.quality={quality}",)
    typed = [*overrides, *([f"image={image}"] if image is not None else [])]
    if resume is not None:
        require_alone(context, "--resume continues", RESUMABLE)
        directory = result_directory(resume, option="--resume")
        if not going_on(directory):
            raise click.BadParameter(f"there is no unfinished run in {resume}", param_hint="--resume")
    elif again is not None:
        require_alone(context, "--again repeats", REPEATABLE)
        directory = result_directory(again, option="--again") if out is None else result_directory(out)
        plan, typed = repeated(again)
    elif scene is None:
        raise click.MissingParameter(param_hint="'SCENE'", param_type="argument")
    else:
        from taichi_msm.load.scene_file import load_plan

        plan = load_plan(scene, overrides, image)
        directory = result_directory(out, Path(scene).stem)

    from taichi_msm.cli.console import Progress, summary
    from taichi_msm.runs import run as run_module

    interruption, name = Interruption(), str(scene or resume or again)
    try:
        with Progress(quiet=quiet or as_json) as bar, resumable(directory), naming(name):
            progress = interruptible(bar, interruption)
            if resume is not None:
                record = run_module.resume(directory, threads=threads, started=STARTED, progress=progress)
            else:
                record = run_module.run(
                    plan,
                    directory,
                    arch=arch,
                    threads=threads,
                    overrides=typed,
                    estimate_error=estimate_error,
                    started=STARTED,
                    progress=progress,
                )
    except KeyboardInterrupt:
        return interrupted(interruption, as_json, f"interrupted; nothing was written{going_on(directory)}")
    if as_json:
        print_json({"directory": str(directory), **record})
    if record["status"] != "complete":
        said = f"{name}: {record.get('error', 'interrupted')}; frames in {directory}: {record['frames']}"
        then = f"; last good state: {record['dump']}" if record.get("dump") else going_on(directory)
        tell([said + then])
    elif not quiet and not as_json:
        click.echo(summary(record, directory))
    return EXIT_CODES.get(record["status"], interruption.code)


@program.command()
@scene_argument
@image_option
@set_option
@json_option
def check(scene: str, image: str | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Validate SCENE and print the steps, time, memory and disk space it needs; compute nothing."""
    from taichi_msm.load import cost as cost_module
    from taichi_msm.load.scene_file import load_plan
    from taichi_msm.model import tool_force
    from taichi_msm.model.tool_force import in_words, probe_records
    from taichi_msm.model.tools import path_notes
    from taichi_msm.render.notes import drawing_notes
    from taichi_msm.render.texture import load_texture

    plan = load_plan(scene, overrides, image)
    with naming(scene):
        cost_module.require_disk(plan, Path("output"))
        if plan.scene.draws:
            load_texture(plan.scene)
    loaded, grid, limit = plan.scene, plan.grid, plan.stable_step
    steps = {
        "step": grid.step,
        "stable_step": limit if limit < float("inf") else None,
        "steps_per_frame": grid.steps_per_frame,
        "precision": grid.precision,
        "steps": plan.grid.steps,
    }
    if loaded.time.at_rest:
        steps |= dict.fromkeys(("step", "stable_step", "steps_per_frame", "steps"))
    need, takes = cost_module.estimate_budget(plan), cost_module.estimate_duration(plan)
    facts: dict[str, Any] = {
        "scene": loaded.model_dump(mode="json"),
        **steps,
        "frames": need.frames,
        "estimated_seconds": takes.seconds,
        "memory": need.memory_bytes,
        "disk": need.disk_bytes,
        "disk_while_running": need.disk_bytes + need.working_bytes,
        "probes": (records := probe_records(loaded)),
        "notes": [*tool_force.force_notes(loaded, records), *path_notes(loaded, plan.tools), *drawing_notes(loaded)],
    }
    if as_json:
        print_json(facts)
        return DONE
    import yaml

    from taichi_msm.load.cost import format_rough_time

    asking = [f"{name}.tolerance" for name in ("sheet", "time") if getattr(loaded, name).tolerance is not None]
    more, longer = (", or more", f", or longer, as {' and '.join(asking)} may ask for more") if asking else ("", "")
    click.echo(yaml.safe_dump(facts["scene"], sort_keys=False, default_flow_style=None), nl=False)
    stepped = (
        f"each at rest{more}, in {grid.precision}"
        if loaded.time.at_rest
        else f"{need.steps} steps of {grid.step:.6g} s (limit {limit:.6g} s), {grid.steps_per_frame} a frame{more}, in "
        f"{grid.precision}"
    )
    click.echo(
        f"\n{need.points} points, {need.frames} frames, {stepped}\n"
        f"about {format_rough_time(takes.seconds)} to run{longer} (estimated from its work)\n"
        f"about {need.memory_bytes / 2**20:.0f} MiB of memory, at most {need.disk_bytes / 2**20:.1f} MiB on disk, "
        f"{need.working_bytes / 2**20:.1f} MiB more while it runs"
    )
    for index, probe in enumerate(facts["probes"]):
        if said := in_words(probe):
            click.echo(f"probes.{index}: {said}")
    for note in facts["notes"]:
        click.echo(note)
    return DONE


@program.command()
def schema() -> int:
    """Print the JSON Schema of a scene, for editors."""
    from taichi_msm.load.scene_file import schema

    print_json(schema())
    return DONE
