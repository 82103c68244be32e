"""The command `view`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.cli import common, options
from taichi_msm.cli.example import scenes_folder, shipped_scenes, summary
from taichi_msm.errors import FilesError, NotInstalledError, SceneError, printable, truncate
from taichi_msm.system.process import Interruption, write_stderr

if TYPE_CHECKING:
    from taichi_msm.view.script import Script
    from taichi_msm.view.session import Session
    from taichi_msm.view.web import Address

OPEN_HINT = "open this address in a browser; Ctrl-C ends the session"


@options.program.command()
@click.argument("scene", metavar="[SCENE]", required=False)
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
    scene: str | None,
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
    """Press the tissue of SCENE with the mouse or a finger, on a page in a browser; without SCENE, choose one there."""
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.view.origin import parse_origin
    from taichi_msm.view.script import load_script

    if seconds is not None and record is None:
        raise click.UsageError("--seconds N needs --record FILE")
    if seconds is not None and scene is None:
        raise click.UsageError("--seconds films without a page, on which scenes are chosen; name a SCENE")
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
    interruption = Interruption()

    def open_session(scene: str) -> AbstractContextManager[Session]:
        return _open(scene, out, image, overrides, interruption, settings)

    with common.report_interruption(interruption, False, lambda: "; no film was written" if seconds else ""):
        if scene is not None and film is not None and seconds is not None:
            loaded_script = load_script(script, load_scene(scene, overrides, image).render.size) if script else None
            return _film(open_session(scene), film, seconds, loaded_script, interruption)

        from taichi_msm.view.web import Address

        with Address(port, origins) as address:
            if scene is None:
                click.echo(address.url)
                write_stderr([OPEN_HINT])
                _serve_scenes(open_session, address, film, interruption)
            else:
                with open_session(scene) as live:
                    click.echo(address.url)
                    write_stderr([OPEN_HINT])
                    _serve(live, address, scene, film, interruption)
    return common.DONE


@contextmanager
def _open(
    scene: str,
    out: str | None,
    image: str | None,
    overrides: tuple[str, ...],
    interruption: Interruption,
    settings: dict[str, Any],
) -> Iterator[Session]:
    """Open a session of a scene file; print the paths of its files at the end."""
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.render.notes import drawing_warnings

    loaded = load_scene(scene, overrides, image)
    directory = common.result_directory(out, f"{Path(scene).stem}-live")

    from taichi_msm.view.recording import Captures
    from taichi_msm.view.session import Session

    write_stderr([*drawing_warnings(loaded)])
    captures = Captures(directory, scene)
    try:
        with common.prefix_errors(scene), common.show_progress(interruption, quiet=False) as progress:
            session = Session(loaded, captures, progress=lambda stage: progress(stage, 0, 0), **settings)
        with session:
            yield session
    finally:
        for path in captures.saved:
            click.echo(printable(str(path)))


def _serve(
    live: Session, address: Address, scene: str, film: Path | None, interruption: Interruption, has_scenes: bool = False
) -> bool:
    """Serve a session; return whether a page wants another scene."""
    import asyncio

    from taichi_msm.view.server import Server

    if film is not None:
        live.start_film(film)
    server = Server(live, address, scene, lambda line: write_stderr([line]), has_scenes=has_scenes)
    return asyncio.run(server.run(interruption.raise_if_requested))


def _serve_scenes(
    open_session: Callable[[str], AbstractContextManager[Session]],
    address: Address,
    film: Path | None,
    interruption: Interruption,
) -> None:
    """Serve the shipped scenes that a page chooses, one after another, until a page quits."""
    import asyncio

    from taichi_msm.view.chooser import choose

    interruption.listen()
    scenes, fault, wants_scenes = shipped_scenes(), "", True
    summaries = {name: summary(path) for name, path in scenes.items() if path.parent == scenes_folder()}
    while wants_scenes:
        chosen = choose(address, summaries, interruption.raise_if_requested, lambda line: write_stderr([line]), fault)
        name = asyncio.run(chosen)
        try:
            with open_session(str(scenes[name])) as live:
                wants_scenes, fault = _serve(live, address, name, film, interruption, True), ""
        except SceneError as error:
            fault = str(error)


def _film(
    session: AbstractContextManager[Session],
    film: Path,
    seconds: float,
    script: Script | None,
    interruption: Interruption,
) -> int:
    """Film a session without a page; return the exit code."""
    from taichi_msm.view.script import record_film, schedule_events

    notices: list[str] = []
    try:
        with session as live, common.show_progress(interruption, quiet=False) as progress:
            rate, size = live.frame_rate, live.scene.render.size
            events = schedule_events(script, rate, size) if script else ()
            record_film(live, film, seconds, events, partial(progress, "film"), notices.append)
            click.echo(printable(str(film)))
    finally:
        write_stderr(notices)
    return common.DIVERGED if live.divergence_error else common.DONE


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
