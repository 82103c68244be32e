"""The commands `study` and `view`."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.cli import common, options
from taichi_msm.errors import FilesError, NotInstalledError, printable, truncate
from taichi_msm.runs.directory import require_no_link
from taichi_msm.system.process import Interruption, write_stderr

if TYPE_CHECKING:
    from taichi_msm.view.session import Session


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


@options.program.command()
@options.scene_argument
@options.out_option("Directory for saved images, films and scenes.", "output/<name of the scene file>-live")
@options.device_options
@click.option("--play", is_flag=True, help="Let the scene's own probes act, too.")
@click.option(
    "--browser", is_flag=True, expose_value=False, help="Show the session on a page in a browser, the default."
)
@click.option(
    "--port", type=click.IntRange(0, 65535), metavar="N", help="Port of the page.  [default: a free one]", default=0
)
@click.option(
    "--origin", "origins", multiple=True, metavar="URL", help="Origin of the page behind a proxy; may be repeated."
)
@click.option("--record", metavar="FILE", help="Film the session as .gif or .mp4.")
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, max=3600, min_open=True),
    metavar="N",
    help="With --record: film without a page, for this time [s].",
)
@click.option("--script", metavar="EVENTS", help="With --seconds: YAML file of events in the film.")
def view(
    scene: str,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    port: int,
    origins: tuple[str, ...],
    record: str | None,
    seconds: float | None,
    script: str | None,
    **settings: Any,
) -> int:
    """Press the tissue of SCENE with the mouse or a finger, on a page in a browser."""
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.view.origin import parse_origin

    if seconds is not None and record is None:
        raise click.UsageError("--seconds N needs --record FILE")
    if script is not None and seconds is None:
        raise click.UsageError("--script needs --record FILE and --seconds N: a script drives a film without a page")
    if (port or origins) and seconds is not None:
        raise click.UsageError("--seconds films without a page; leave out either --seconds, or --port and --origin")
    if seconds is not None and math.isnan(seconds):
        raise click.BadParameter("nan is not a number of seconds", param_hint="--seconds")
    film = None if record is None else _film_path(record)
    for origin in origins:
        if parse_origin(origin) is None:
            expected = "give only the scheme, host and port of the page, as https://hub.example.org"
            raise click.BadParameter(f"{truncate(origin)} is not an origin; {expected}", param_hint="--origin")
    loaded = load_scene(scene, overrides, image)
    directory = common.result_directory(out, f"{Path(scene).stem}-live")

    from taichi_msm.render.notes import drawing_warnings
    from taichi_msm.view.script import load_script, record_film, schedule_events

    loaded_script = load_script(script, loaded.render.size) if script is not None else None

    from taichi_msm.view.recording import Captures
    from taichi_msm.view.session import Session

    write_stderr([*drawing_warnings(loaded)])
    captures, interruption = Captures(directory, scene), Interruption()
    notices: list[str] = []

    def begin() -> Session:
        with common.show_progress(interruption, quiet=False) as progress:
            return Session(loaded, captures, progress=lambda stage: progress(stage, 0, 0), **settings)

    try:
        with (
            common.report_interruption(interruption, False, lambda: "; no film was written" if seconds else ""),
            common.prefix_errors(scene),
        ):
            if film is not None and seconds is not None:
                with begin() as live, common.show_progress(interruption, quiet=False) as progress:
                    rate, size = live.frame_rate, loaded.render.size
                    events = schedule_events(loaded_script, rate, size) if loaded_script else ()
                    record_film(live, film, seconds, events, partial(progress, "film"), notices.append)
                click.echo(printable(str(film)))
                return common.DIVERGED if live.divergence_error else common.DONE

            import asyncio

            from taichi_msm.view.server import Server, listen

            with listen(port) as listener, begin() as live:
                server = Server(live, listener, scene, origins, lambda line: write_stderr([line]))
                if film is not None:
                    live.start_film(film)
                click.echo(server.url)
                write_stderr(["open this address in a browser; Ctrl-C ends the session"])
                asyncio.run(server.run(interruption.raise_if_requested))
            return common.DONE
    finally:
        write_stderr(notices)
        for path in captures.saved:
            click.echo(printable(str(path)))


def _film_path(record: str) -> Path:
    """Check the option --record; return its path."""
    from taichi_msm.scene.outputs import PYAV_NOT_INSTALLED, is_pyav_installed

    path = Path(record)
    if path.suffix.lower() not in (".gif", ".mp4"):
        message = f"{record} is not a GIF or MP4; take a name with .gif or .mp4"
        raise click.BadParameter(message, param_hint="--record")
    if path.suffix.lower() == ".mp4" and not is_pyav_installed():
        raise NotInstalledError(f"--record {record}: {PYAV_NOT_INSTALLED}")
    if path.is_dir():
        raise FilesError(f"{path}: a directory; choose another --record")
    return path
