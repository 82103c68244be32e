"""Exit codes, result directories, interruption and error messages of all commands."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.errors import FilesError, SceneError, printable
from taichi_msm.runs.directory import require_no_link
from taichi_msm.system.process import Interruption, write_stderr

if TYPE_CHECKING:
    from taichi_msm.cli.console import ProgressDisplay

# Exit codes; FILES: files cannot be read or written.
DONE, BUG, INVALID_INPUT, DIVERGED, FILES = 0, 1, 2, 3, 4

# Exit code by the status of a run.
EXIT_CODES = {"complete": DONE, "diverged": DIVERGED}


def result_directory(out: str | None, default: str = "", option: str = "--out") -> Path:
    """Return the directory of results: the value `out` of an option, or a default in output/.

    An empty value, or a default that is not the name of a directory, raises a BadParameter; a symbolic link in the path
    of the default raises a FilesError.
    """
    if out == "":
        raise click.BadParameter("is empty; give a directory", param_hint=option)
    if out is not None:
        return Path(out)
    if default in (".", ".."):
        raise click.BadParameter(f"the scene's name gives the folder output/{default}; name another", param_hint=option)
    return require_no_link(require_no_link(Path("output"), option) / default, option)


def resume_hint(directory: Path) -> str:
    """Return a hint with the command that continues the unfinished run in a directory; empty without one."""
    from taichi_msm.runs.checkpoint import is_unfinished

    if not is_unfinished(directory):
        return ""
    return f"; continue with: taichi-msm run --resume {shlex.quote(str(directory))}"


@contextmanager
def add_resume_hint(directory: Path) -> Iterator[None]:
    """Append the hint of `resume_hint` to file errors of the block."""
    try:
        yield
    except FilesError as error:
        # A resumed run can help after a failed write, but not with a damaged or locked file.
        raise FilesError(f"{error}{resume_hint(directory) if isinstance(error.__cause__, OSError) else ''}") from None


@contextmanager
def prefix_errors(scene: str) -> Iterator[None]:
    """Prefix the scene errors of the block with the name of the scene, as in errors of loading."""
    try:
        yield
    except SceneError as error:
        raise SceneError([f"{scene}: {line}" for line in error.lines]) from None


@contextmanager
def show_progress(interruption: Interruption, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of the block, by a callback for the stage, and the finished and total number of its items.

    The callback raises a KeyboardInterrupt after an interruption, which is listened to from the first stage on.
    """
    from taichi_msm.cli.console import ProgressDisplay
    from taichi_msm.model.grids import report_grids

    def progress(stage: str, done: int, total: int) -> None:
        bar.update(stage, done, total)
        # Until the first stage, a signal ends the process at once. The stage "write" cannot be interrupted.
        interruption.listen()
        if stage != "write":
            interruption.raise_if_requested()

    with closing(ProgressDisplay(quiet=quiet)) as bar, report_grids(partial(progress, "grid")):
        yield progress


@contextmanager
def show_grids(quiet: bool) -> Iterator[None]:
    """Show the progress of even grids in the block, unless `show_progress` within it does."""
    from taichi_msm.model.grids import report_grids

    displays: list[ProgressDisplay] = []

    def progress(done: int, total: int) -> None:
        from taichi_msm.cli.console import ProgressDisplay

        if not displays:
            displays.append(ProgressDisplay(quiet=False))
        displays[0].update("grid", done, total)
        if done == total:
            displays.pop().close()

    try:
        with nullcontext() if quiet else report_grids(progress):
            yield
    finally:
        for display in displays:
            display.close()


@contextmanager
def report_interruption(interruption: Interruption, as_json: bool, rest: Callable[[], str]) -> Iterator[None]:
    """Turn a KeyboardInterrupt of the block into an exit with a message, in which `rest` follows "interrupted"."""
    try:
        yield
    except KeyboardInterrupt:
        report_failure("interrupted", [f"interrupted{rest()}"], as_json)
        raise click.exceptions.Exit(interruption.code) from None


@contextmanager
def interruptible(
    as_json: bool,
    quiet: bool = False,
    interruption: Interruption | None = None,
    rest: Callable[[], str] = lambda: "; nothing was written",
) -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of the block, with `show_progress` and `report_interruption`."""
    interruption = interruption or Interruption()
    with report_interruption(interruption, as_json, rest), show_progress(interruption, quiet or as_json) as progress:
        yield progress


def print_json(value: Any) -> None:
    """Print a JSON object on stdout."""
    click.echo(format_json(value), nl=False)


def format_json(value: Any) -> str:
    """Format a JSON object as text, with a line break at the end."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def print_result(as_json: bool, record: Mapping[str, Any], lines: Iterable[str], quiet: bool = False) -> None:
    """Print a result on stdout: a JSON object, or lines with any characters, unless `quiet`."""
    if as_json:
        print_json(record)
    elif not quiet:
        click.echo("\n".join(map(printable, lines)))


def report_failure(status: str, lines: Sequence[str], as_json: bool) -> None:
    """Print a failure on stderr; as JSON also on stdout, with its status: error, diverged or interrupted."""
    write_stderr(lines)
    if as_json:
        print_json({"status": status, "errors": list(lines)})
