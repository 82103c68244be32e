"""The command line: arguments, exit codes, printing. No other module prints or exits."""

from __future__ import annotations

import time

STARTED = time.perf_counter()

import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm import __version__
from taichi_msm.arguments import MAX_WORKERS
from taichi_msm.errors import (
    ArgumentError,
    DeviceError,
    DivergedError,
    ExecutorError,
    FilesError,
    LostExecutorError,
    NotInstalledError,
    SceneError,
    did_you_mean,
    printable,
)
from taichi_msm.exports.formats import FORMATS
from taichi_msm.results.entries import without_link
from taichi_msm.system.signals import Interruption
from taichi_msm.system.streams import mute, tell

if TYPE_CHECKING:
    from taichi_msm.console import Progress
    from taichi_msm.physics.plan import Plan
    from taichi_msm.sweeps.cost import Cost
    from taichi_msm.sweeps.sweepfile import Sweep

DONE, BUG, WRONG_INPUT, DIVERGED, FILES = 0, 1, 2, 3, 4
# What may be given together with --resume, and with --again.
RESUMABLE = ("resume", "threads", "quiet", "as_json")
REPEATABLE = ("again", "out", "arch", "threads", "estimate_error", "quiet", "as_json")

# So many files of an export are named at the end; more are counted.
FEW = 2
# Sweeps of more runs, or of more seconds, must be meant.
MANY_RUNS, LONG = 10_000, 86400

EXIT_CODES = {"complete": DONE, "diverged": DIVERGED}


class Choice(click.Choice):  # type: ignore[type-arg]  # before click 8.2 it takes none
    """One of some words; the message about any other names the nearest."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Give the word, or say which may have been meant."""
        try:
            return str(super().convert(value, param, ctx))
        except click.BadParameter as error:
            said = error.message.rstrip(".") + did_you_mean(str(value), [str(word) for word in self.choices])
            raise click.BadParameter(said, ctx, param) from None


class Shard(click.ParamType):  # type: ignore[type-arg]  # as above
    """A part of some work, I/N: part I of N, from 1."""

    name = "I/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Read the two numbers."""
        numbers = re.fullmatch("([0-9]{1,9})/([0-9]{1,9})", value)
        if numbers is None or not 1 <= int(numbers[1]) <= int(numbers[2]):
            self.fail(f"{value} is no part; take I/N with 1 <= I <= N, such as 3/8", param, ctx)
        return int(numbers[1]), int(numbers[2])


scene_argument = click.argument("scene", metavar="SCENE")
image_option = click.option("--image", metavar="FILE", help="The picture on the sheet, instead of the scene's.")
quality_option = click.option(
    "--quality",
    type=click.IntRange(1, 100),
    metavar="N",
    help="Quality of the film, with output: mp4 [%]; 65 by default.",
)
set_option = click.option(
    "--set",
    "overrides",
    metavar="KEY=VALUE",
    multiple=True,
    help="Override a key of the scene by its dotted path, e.g. sheet.points=[61,61]; list items by index.",
)
arch_option = click.option(
    "--arch", metavar="cpu|cuda|vulkan", default="cpu", show_default=True, help="Device to compute on."
)
threads_option = click.option(
    "--threads", type=click.IntRange(1, MAX_WORKERS), metavar="N", help="CPU threads.  [default: every core]"
)
workers_option = partial(click.option, "--workers", type=click.IntRange(1, MAX_WORKERS), metavar="N")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout and nothing else.")


def tell_version(context: click.Context, _option: click.Parameter, asked: bool) -> None:
    """Print the versions of the program and of its compiler, and end, if that was asked for."""
    if asked:
        from taichi_msm.system.compiler import chosen

        click.echo(f"taichi-msm {__version__}")
        click.echo(f"{chosen().title} {chosen().version}")
        context.exit()


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=tell_version, help="Print the versions."
)
def program() -> None:
    """Deform an image as tissue deforms."""


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
        from taichi_msm.scenefile.load import load_plan

        plan = load_plan(scene, overrides, image)
        directory = result_directory(out, Path(scene).stem)

    from taichi_msm import runner
    from taichi_msm.console import Progress, summary

    interruption, name = Interruption(), str(scene or resume or again)
    try:
        with Progress(quiet=quiet or as_json) as bar, resumable(directory), naming(name):
            progress = interruptible(bar, interruption)
            if resume is not None:
                record = runner.resume(directory, threads=threads, started=STARTED, progress=progress)
            else:
                record = runner.run(
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
    from taichi_msm.physics import probe_force
    from taichi_msm.physics.paths import path_notes
    from taichi_msm.physics.probe_force import in_words, probe_records
    from taichi_msm.render.drawing_notes import drawing_notes
    from taichi_msm.render.texture import load_texture
    from taichi_msm.scenefile import budget, duration
    from taichi_msm.scenefile.load import load_plan

    plan = load_plan(scene, overrides, image)
    with naming(scene):
        budget.require_disk(plan, Path("output"))
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
    need, takes = budget.estimate(plan), duration.estimate(plan)
    facts: dict[str, Any] = {
        "scene": loaded.model_dump(mode="json"),
        **steps,
        "frames": need.frames,
        "estimated_seconds": takes.seconds,
        "memory": need.memory_bytes,
        "disk": need.disk_bytes,
        "disk_while_running": need.disk_bytes + need.working_bytes,
        "probes": (records := probe_records(loaded)),
        "notes": [*probe_force.force_notes(loaded, records), *path_notes(loaded, plan.tools), *drawing_notes(loaded)],
    }
    if as_json:
        print_json(facts)
        return DONE
    import yaml

    from taichi_msm.console import rough_time

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
        f"about {rough_time(takes.seconds)} to run{longer} (estimated from its work)\n"
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
    from taichi_msm.scenefile.load import schema

    print_json(schema())
    return DONE


@program.command()
@scene_argument
@click.option(
    "--out", metavar="DIR", help="Directory for the report.  [default: output/<name of the scene file>-study]"
)
@image_option
@set_option
@arch_option
@threads_option
@click.option(
    "--tolerance",
    type=float,
    metavar="ERROR",
    help="Largest error, as a fraction of the largest displacement.  [default: the scene's, or 1e-3]",
)
@click.option("--quick", is_flag=True, help="Take a minute instead of several: fewer and shorter measurements.")
@json_option
def study(
    scene: str,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    arch: str,
    threads: int | None,
    tolerance: float | None,
    quick: bool,
    as_json: bool,
) -> int:
    """Measure how fast and how wrong every setting of SCENE is, and recommend one."""
    from taichi_msm.scene import LARGEST_TOLERANCE, SMALLEST_TOLERANCE
    from taichi_msm.scenefile.load import load_scene

    loaded = load_scene(scene, overrides, image)
    directory = result_directory(out, f"{Path(scene).stem}-study")
    if tolerance is not None and not SMALLEST_TOLERANCE <= tolerance <= LARGEST_TOLERANCE:
        expected = f"expected a number, {SMALLEST_TOLERANCE:g} to {LARGEST_TOLERANCE:g}"
        raise click.BadParameter(f"{tolerance:g} is not allowed; {expected}", param_hint="--tolerance")

    from taichi_msm.console import Progress
    from taichi_msm.study.measure import study as measure
    from taichi_msm.study.page import summary
    from taichi_msm.study.report import RECORD, as_record, require_writable, write_report

    require_writable(directory)
    interruption = Interruption()
    with Progress(quiet=as_json) as bar, naming(scene):
        results = measure(
            loaded,
            Path(scene).stem,
            tolerance=tolerance,
            quick=quick,
            arch=arch,
            threads=threads,
            progress=interruptible(bar, interruption),
        )
    if not results.stepping:
        return interrupted(interruption, as_json)
    if results.status == "interrupted" and (directory / RECORD).exists():
        # An earlier study is not replaced by part of a new one.
        directory = without_link(directory / "interrupted", "--out")
    outputs = write_report(results, directory)
    if as_json:
        print_json({"directory": str(directory), **as_record(results), "outputs": outputs})
    else:
        click.echo(summary(results))
        click.echo(printable(f"{directory}: {', '.join(outputs)}"))
    return EXIT_CODES.get(results.status, interruption.code)


@program.command()
@scene_argument
@click.option(
    "--out",
    metavar="DIR",
    help="Directory for saved images, films and scenes.  [default: output/<name of the scene file>-live]",
)
@image_option
@set_option
@arch_option
@threads_option
@click.option("--play", is_flag=True, help="Let the scene's own probes act as well.")
@click.option("--record", metavar="FILE.gif", help="Film the session instead of opening a window.")
@click.option("--seconds", type=click.FloatRange(min=0, max=3600, min_open=True), metavar="N", help="How long to film.")
@click.option("--script", metavar="EVENTS", help="Events of the film: a YAML file.")
def view(
    scene: str,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    arch: str,
    threads: int | None,
    play: bool,
    record: str | None,
    seconds: float | None,
    script: str | None,
) -> int:
    """Press the tissue of SCENE with the mouse."""
    from taichi_msm.scenefile.load import load_scene

    if (record is None) != (seconds is None):
        raise click.UsageError("--record FILE.gif and --seconds N go together")
    if record is None and script is not None:
        raise click.UsageError("--script needs --record; in the window you press with the mouse")
    if seconds is not None and math.isnan(seconds):
        raise click.BadParameter("nan is not a number of seconds", param_hint="--seconds")
    if record is not None and Path(record).suffix.lower() != ".gif":
        raise click.BadParameter(f"{record} is not the name of a GIF; let it end in .gif", param_hint="--record")
    loaded = load_scene(scene, overrides, image)
    directory = result_directory(out, f"{Path(scene).stem}-live")

    from taichi_msm.render.drawing_notes import drawing_notes
    from taichi_msm.viewer.script import film, load_script, timed

    done = load_script(script, loaded.render.size) if script is not None else None

    from taichi_msm.console import Progress
    from taichi_msm.viewer.captures import Captures
    from taichi_msm.viewer.session import Session

    tell([*drawing_notes(loaded)])
    captures, interruption = Captures(directory, scene), Interruption()
    notices: list[str] = []

    def begin() -> Session:
        with Progress(quiet=False) as bar:
            progress = interruptible(bar, interruption)
            return Session(loaded, captures, arch, threads, play=play, progress=lambda stage: progress(stage, 0, 0))

    try:
        with naming(scene):
            if record is None or seconds is None:
                from taichi_msm.viewer.window import Window, show

                with Window(f"taichi-msm {scene}", loaded.render.size) as window:
                    window.say("one moment: compiling")
                    with begin() as session:
                        show(session, window, interruption.grant)
            else:
                with begin() as session, Progress(quiet=False) as bar:
                    events = timed(done, session.rate, loaded.render.size) if done else ()
                    progress = partial(interruptible(bar, interruption), "film")
                    film(session, Path(record), seconds, events, progress, notices.append)
                click.echo(printable(record))
    except KeyboardInterrupt:
        return interrupted(interruption, False, "interrupted" if record is None else "interrupted; no film was written")
    finally:
        tell(notices)
        for path in captures.saved:
            click.echo(printable(str(path)))
    return DIVERGED if record is not None and session.fault else DONE


@program.command()
@click.argument("directories", metavar="DIR ...", nargs=-1, required=True)
@click.option(
    "--format",
    "name",
    type=Choice(FORMATS),
    metavar="FORMAT",
    required=True,
    help="; ".join(f"{name}: {row.means}" for name, row in FORMATS.items()) + ".",
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

    from taichi_msm.console import Progress
    from taichi_msm.exports import convert

    interruption = Interruption()
    try:
        with Progress(quiet=quiet or as_json) as bar:
            done = convert.export(runs, name, folder, partial(interruptible(bar, interruption), "export"), camera)
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


@program.command()
@click.argument("file", metavar="SWEEP")
@click.option("--out", metavar="DIR", help="Directory for the runs.  [default: output/<name of the sweep file>]")
@workers_option(help="Processes that take the runs.  [default: one for each core, as far as memory goes]")
@click.option("--dask", metavar="ADDRESS", help="Let the workers of a dask scheduler take the runs.")
@click.option("--shard", type=Shard(), metavar="I/N", help="Take only part I of N of the runs; write no table.")
@click.option("--dry-run", is_flag=True, help="Print the values of all runs, and what they take; run nothing.")
@click.option("--yes", is_flag=True, help=f"Take more than {MANY_RUNS} runs, or longer than a day.")
@json_option
def sweep(
    file: str,
    out: str | None,
    workers: int | None,
    dask: str | None,
    shard: tuple[int, int] | None,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> int:
    """Run a scene many times with varied values, as SWEEP says, and write a table of the results."""
    from taichi_msm.console import Progress
    from taichi_msm.sweeps.cost import choose_workers, estimate
    from taichi_msm.sweeps.folder import begin_sweep
    from taichi_msm.sweeps.summary import cost_line, count, summary_lines
    from taichi_msm.sweeps.sweep import finish, go_on, opened
    from taichi_msm.sweeps.sweepfile import load_sweep

    if workers is not None and dask is not None:
        raise click.UsageError("--workers are processes here, and --dask has its own; leave out one of them")
    described = load_sweep(file)
    directory = result_directory(out, Path(file).stem)
    cost = estimate(described)
    chosen = choose_workers(cost, described.runs, workers)
    if dry_run:
        return print_plan(described, cost, shard or (1, 1), workers, as_json)
    if not yes and (described.runs > MANY_RUNS or cost.seconds > LONG):
        raise click.UsageError(f"{cost_line(described.runs, cost, chosen)}; add --yes if that is meant")
    under_way = begin_sweep(described, directory, shard or (1, 1))
    outcomes, missing, total = under_way.done, len(under_way.missing), under_way.total
    chosen = choose_workers(cost, missing, workers)
    if not as_json:
        tell([f"{len(outcomes)} of {total} runs have ended before"] if outcomes else [])
        here = chosen if dask is None else None
        tell([cost_line(missing, cost.of(missing / described.runs), here)] if missing else [])
    interruption = Interruption()
    files: list[str] = []
    notes: list[str] = []
    try:
        with Progress(quiet=as_json) as bar:
            progress = interruptible(bar, interruption)
            where = dask if missing else None  # Nothing else needs a cluster.
            with opened(where, chosen.number, under_way, progress) as executor:
                for _ in go_on(under_way, executor, progress):
                    pass
                if shard is None:
                    files, notes = finish(under_way, executor, progress)
    except KeyboardInterrupt:
        return interrupted(interruption, as_json, f"interrupted; {so_far(len(outcomes), total)}")
    except LostExecutorError as error:
        report("error", [f"{error}; {so_far(len(outcomes), total)}"], as_json)
        return FILES
    if as_json:
        counts = count(outcomes)
        print_json({"directory": str(directory), "runs": len(outcomes), **counts, "outputs": files, "notes": notes})
    else:
        click.echo("\n".join(map(printable, summary_lines(directory, outcomes, shard, files, notes))))
    return DONE


@program.command()
@scene_argument
@click.argument("observed", metavar="OBSERVED")
@click.argument("more", metavar="", nargs=-1)
@click.option("--free", metavar="KEY ...", multiple=True, help="Numbers of the scene that are fitted, by dotted path.")
@click.option("--bounds", metavar="KEY=LOW,HIGH ...", multiple=True, help="Smallest and largest value of a number.")
@set_option
@click.option(
    "--forces",
    metavar="FILE,SIGMA",
    help="Forces of the tools that were seen too, as in forces.csv, and the standard deviation of their errors [N].",
)
@click.option("--sigma", type=float, metavar="SIGMA", help="Standard deviation of what was seen [m] or [px].")
@click.option("--robust", is_flag=True, help="Let numbers that are far off count less.")
@click.option(
    "--correlation", type=float, metavar="PX", help="How far apart in the picture errors of tracks are alike [px]."
)
@click.option("--drift", type=float, metavar="SECONDS", help="How long errors of one track are alike [s].")
@click.option("--profile", is_flag=True, help="Find intervals by going to their ends; takes more runs.")
@click.option("--resolution", type=int, metavar="R", help="Fields along a side of a map that is fitted.")
@click.option("--out", metavar="DIR", help="Directory for the fit.  [default: output/<name of the scene file>-fit]")
@workers_option(help="Processes that take runs side by side.  [default: as many as pay]")
@json_option
def fit(
    scene: str,
    observed: str,
    more: tuple[str, ...],
    free: tuple[str, ...],
    bounds: tuple[str, ...],
    overrides: tuple[str, ...],
    forces: str | None,
    sigma: float | None,
    robust: bool,
    correlation: float | None,
    drift: float | None,
    profile: bool,
    resolution: int | None,
    out: str | None,
    workers: int | None,
    as_json: bool,
) -> int:
    """Find numbers of SCENE from what was seen of the tissue, OBSERVED, and how well they are known."""
    from taichi_msm.scenefile.load import load_scene

    # Both options take several words.
    free = (*free, *(word for word in more if "=" not in word))
    limits: dict[str, tuple[float, float]] = {}
    for key, ends in map(read_bounds, (*bounds, *(word for word in more if "=" in word))):
        if key in limits:
            raise click.BadParameter(f"{key}: given twice; leave one of them out", param_hint="--bounds")
        limits[key] = ends
    loaded = load_scene(scene, overrides)
    directory = result_directory(out, f"{Path(scene).stem}-fit")

    from taichi_msm.console import Progress
    from taichi_msm.fitting.fit import fit as find

    interruption = Interruption()
    try:
        with Progress(quiet=as_json) as bar:
            found = find(
                loaded,
                observed,
                free,
                bounds=limits,
                forces=None if forces is None else read_forces_option(forces),
                directory=directory,
                workers=workers,
                progress=interruptible(bar, interruption),
                sigma=sigma,
                robust=robust,
                profile=profile,
                correlation=correlation,
                drift=drift,
                resolution=resolution,
            )
    except KeyboardInterrupt:
        return interrupted(interruption, as_json)
    except DivergedError as error:
        report("diverged", [f"{scene}: where the search begins: {error}"], as_json)
        return DIVERGED
    if as_json:
        print_json({"directory": str(directory), **found.as_json()})
    else:
        click.echo("\n".join(map(printable, [f"{directory}: fit of {observed}", *found.summary()])))
    return DONE


def read_bounds(text: str) -> tuple[str, tuple[float, float]]:
    """Read KEY=LOW,HIGH; an end that is left out is infinite."""
    key, _, ends = text.partition("=")
    low, comma, high = ends.partition(",")
    try:
        if not comma:
            raise ValueError
        return key.strip(), (float(low or "-inf"), float(high or "inf"))
    except ValueError:
        said = f"{text}: expected KEY=LOW,HIGH, such as tissue.young=5e3,1e5"
        raise click.BadParameter(said, param_hint="--bounds") from None


def read_forces_option(text: str) -> tuple[str, float]:
    """Read FILE,SIGMA."""
    name, _, sigma = text.rpartition(",")
    try:
        if not name:
            raise ValueError
        return name, float(sigma)
    except ValueError:
        said = f"{text}: expected FILE,SIGMA, such as forces.csv,0.01"
        raise click.BadParameter(said, param_hint="--forces") from None


def print_plan(described: Sweep, cost: Cost, shard: tuple[int, int], workers: int | None, as_json: bool) -> int:
    """Print the values of the runs of a shard, and what they take."""
    from taichi_msm.sweeps.cost import choose_workers
    from taichi_msm.sweeps.summary import cost_line
    from taichi_msm.sweeps.sweepfile import cell
    from taichi_msm.sweeps.table import csv_line

    (part, parts), values = shard, described.values()
    runs = range(part - 1, len(values), parts)
    cost = cost.of(len(runs) / len(values))
    chosen = choose_workers(cost, len(runs), workers)
    if as_json:
        rows = {"keys": described.keys, "runs": list(runs), "values": [values[run] for run in runs]}
        print_json({**rows, **cost._asdict(), "workers": chosen.number})
        return DONE
    click.echo(csv_line(["run", *described.keys]))
    for run in runs:
        click.echo(printable(csv_line([run, *map(cell, values[run])])))
    click.echo(cost_line(len(runs), cost, chosen))
    return DONE


def so_far(done: int, total: int) -> str:
    """Say how much of a sweep is done, and how to go on."""
    return f"{done} of {total} runs have ended; the same command goes on"


def require_alone(context: click.Context, does: str, allowed: Sequence[str]) -> None:
    """Make sure that no scene and no settings were given with an option that takes those of an earlier run."""
    for option in context.command.params:
        typed = context.get_parameter_source(str(option.name)) is click.core.ParameterSource.COMMANDLINE
        if typed and option.name not in allowed:
            name = option.opts[0] if isinstance(option, click.Option) else "SCENE"
            raise click.UsageError(f"{does} a run with its own settings; leave out {name}")


def repeated(directory: str) -> tuple[Plan, list[str]]:
    """Plan the scene of an earlier run, with its pictures where they are, and the overrides that made it."""
    from taichi_msm.results.finished_run import read_run
    from taichi_msm.scenefile.validation import checked

    earlier = read_run(result_directory(directory, option="--again"))
    earlier.require_pictures(drawn=earlier.scene.draws or "image" in earlier.sha256)
    return checked(earlier.scene), earlier.overrides


def result_directory(out: str | None, default: str = "", option: str = "--out") -> Path:
    """Choose where results go."""
    if out == "":
        raise click.BadParameter("is empty; name a directory", param_hint=option)
    if out is not None:
        return Path(out)
    if default in (".", ".."):
        raise click.BadParameter(f"the scene's name gives the folder output/{default}; name another", param_hint=option)
    return without_link(without_link(Path("output"), option) / default, option)


def going_on(directory: Path) -> str:
    """Say how to continue the unfinished run in a directory; empty if there is none."""
    from taichi_msm.results.checkpoint import is_unfinished

    if not is_unfinished(directory):
        return ""
    return f"; continue with: taichi-msm run --resume {shlex.quote(str(directory))}"


@contextmanager
def resumable(directory: Path) -> Iterator[None]:
    """Add to errors how to continue a run that has begun."""
    try:
        yield
    except FilesError as error:
        # What cannot be written now may be written later; trying again does not help if a file is damaged or locked.
        raise FilesError(f"{error}{going_on(directory) if isinstance(error.__cause__, OSError) else ''}") from None


@contextmanager
def naming(scene: str) -> Iterator[None]:
    """Add the name of the scene to errors that are found after it was loaded."""
    try:
        yield
    except SceneError as error:
        raise SceneError([f"{scene}: {line}" for line in error.lines]) from None


def interruptible(bar: Progress, interruption: Interruption) -> Callable[[str, int, int], None]:
    """Show the progress of some work, and stop it after an interruption when it next reports its progress."""

    def progress(stage: str, done: int, total: int) -> None:
        bar.update(stage, done, total)
        # Before the first stage, the process may end at once. While results are put in place, nothing interrupts that.
        interruption.listen()
        if stage != "write":
            interruption.grant()

    return progress


def print_json(value: Any) -> None:
    """Print one JSON object."""
    click.echo(json.dumps(value, indent=2, allow_nan=False))


def interrupted(interruption: Interruption, as_json: bool, said: str = "interrupted; nothing was written") -> int:
    """Say that there are no results, and give the exit code."""
    report("interrupted", [said], as_json)
    return interruption.code


def report(status: str, lines: Sequence[str], as_json: bool) -> None:
    """Say why there are no results."""
    tell(lines)
    if as_json:
        print_json({"status": status, "errors": list(lines)})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, with arguments instead of the process's, and give the exit code.

    0 done, 1 a bug, 2 wrong scene or arguments, 3 diverged, 4 files, 130 Ctrl-C, 143 SIGTERM.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code, lines = _run(words)
        if lines:
            report("error", lines, "--json" in words)
        return code
    except OSError as error:
        # The reader of stdout is gone, or its disk is full.
        mute(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            where = f" {error.filename}" if error.filename else ""
            tell([f"taichi-msm: cannot read or write{where}: {error.strerror or error}"])
        return FILES


def _run(words: list[str]) -> tuple[int, Sequence[str]]:
    """Run a command; returns the exit code, and the message of a failure."""
    try:
        Path.cwd()
    except OSError:
        return FILES, ["taichi-msm: the current folder is gone; change to another"]
    try:
        return int(program.main(words, prog_name="taichi-msm", standalone_mode=False) or DONE), ()
    except SystemExit:
        # This is how click ends when the reader of stdout is gone.
        raise BrokenPipeError from None
    except SceneError as error:
        return WRONG_INPUT, error.lines
    except (ArgumentError, DeviceError, ExecutorError, NotInstalledError) as error:
        return WRONG_INPUT, [str(error)]
    except FilesError as error:
        return FILES, [str(error)]
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return WRONG_INPUT, ()
    except click.ClickException as error:
        said = " ".join(error.format_message().split())
        if "--set" in words and "unexpected extra argument" in said:
            said = f'{said.rstrip(".")}; a value with blanks needs quotes: --set "KEY=VALUE"'
        return WRONG_INPUT, [f"taichi-msm: {said} (see taichi-msm --help)"]
    except OSError:
        raise
    except Exception as error:
        if os.environ.get("TAICHI_MSM_TRACEBACK"):
            raise
        said = f"a bug: {type(error).__name__}: {' '.join(str(error).split())}"
        return BUG, [f"taichi-msm: {said}; please report it with what TAICHI_MSM_TRACEBACK=1 prints"]
