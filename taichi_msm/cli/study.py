"""The commands `study` and `view`."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import click

from taichi_msm.cli.options import (
    arch_option,
    image_option,
    json_option,
    program,
    scene_argument,
    set_option,
    threads_option,
)
from taichi_msm.cli.session import (
    DIVERGED,
    DONE,
    EXIT_CODES,
    interruptible_progress,
    prefix_errors,
    print_json,
    report_interruption,
    result_directory,
)
from taichi_msm.errors import printable
from taichi_msm.runs.directory import require_no_link
from taichi_msm.system.process import Interruption, write_stderr


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
    """Measure the speed and error of every setting of SCENE, and recommend one."""
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.scene.section import MAX_TOLERANCE, MIN_TOLERANCE

    loaded = load_scene(scene, overrides, image)
    directory = result_directory(out, f"{Path(scene).stem}-study")
    if tolerance is not None and not MIN_TOLERANCE <= tolerance <= MAX_TOLERANCE:
        expected = f"expected a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}"
        raise click.BadParameter(f"{tolerance:g} is not allowed; {expected}", param_hint="--tolerance")

    from taichi_msm.cli.console import ProgressDisplay
    from taichi_msm.study.report import RECORD_FILE, format_summary, require_writable, study_record, write_report
    from taichi_msm.study.study import run_study

    require_writable(directory)
    interruption = Interruption()
    with ProgressDisplay(quiet=as_json) as bar, prefix_errors(scene):
        results = run_study(
            loaded,
            Path(scene).stem,
            tolerance=tolerance,
            quick=quick,
            arch=arch,
            threads=threads,
            progress=interruptible_progress(bar, interruption),
        )
    if not results.stepping:
        return report_interruption(interruption, as_json)
    if results.status == "interrupted" and (directory / RECORD_FILE).exists():
        # A partial study must not replace a complete one.
        directory = require_no_link(directory / "interrupted", "--out")
    outputs = write_report(results, directory)
    if as_json:
        print_json({"directory": str(directory), **study_record(results), "outputs": outputs})
    else:
        click.echo(format_summary(results))
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
    from taichi_msm.load.scene_file import load_scene

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

    from taichi_msm.render.notes import drawing_warnings
    from taichi_msm.view.script import load_script, record_film, schedule_events

    loaded_script = load_script(script, loaded.render.size) if script is not None else None

    from taichi_msm.cli.console import ProgressDisplay
    from taichi_msm.view.recording import Captures
    from taichi_msm.view.session import Session

    write_stderr([*drawing_warnings(loaded)])
    captures, interruption = Captures(directory, scene), Interruption()
    notices: list[str] = []

    def begin() -> Session:
        with ProgressDisplay(quiet=False) as bar:
            progress = interruptible_progress(bar, interruption)
            return Session(loaded, captures, arch, threads, play=play, progress=lambda stage: progress(stage, 0, 0))

    try:
        with prefix_errors(scene):
            if record is None or seconds is None:
                from taichi_msm.view.window import Window, run_session

                with Window(f"taichi-msm {scene}", loaded.render.size) as window:
                    window.announce("one moment: compiling")
                    with begin() as session:
                        run_session(session, window, interruption.raise_if_requested)
            else:
                with begin() as session, ProgressDisplay(quiet=False) as bar:
                    events = (
                        schedule_events(loaded_script, session.frame_rate, loaded.render.size) if loaded_script else ()
                    )
                    progress = partial(interruptible_progress(bar, interruption), "film")
                    record_film(session, Path(record), seconds, events, progress, notices.append)
                click.echo(printable(record))
    except KeyboardInterrupt:
        return report_interruption(
            interruption, False, "interrupted" if record is None else "interrupted; no film was written"
        )
    finally:
        write_stderr(notices)
        for path in captures.saved:
            click.echo(printable(str(path)))
    return DIVERGED if record is not None and session.divergence_error else DONE
