"""taichi_msm.cli.main.session."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from taichi_msm.errors import (
    FilesError,
    SceneError,
)
from taichi_msm.runs.directory import require_no_link
from taichi_msm.system.process import Interruption, tell

if TYPE_CHECKING:
    from taichi_msm.cli.console import Progress
    from taichi_msm.model.plan import Plan


DONE, BUG, WRONG_INPUT, DIVERGED, FILES = 0, 1, 2, 3, 4

EXIT_CODES = {"complete": DONE, "diverged": DIVERGED}


def repeated(directory: str) -> tuple[Plan, list[str]]:
    """Plan the scene of an earlier run, with its pictures where they are, and the overrides that made it."""
    from taichi_msm.load.check import checked
    from taichi_msm.runs.finished import read_run

    earlier = read_run(result_directory(directory, option="--again"))
    earlier.require_same_pictures(drawn=earlier.scene.draws or "image" in earlier.sha256)
    return checked(earlier.scene), earlier.overrides


def result_directory(out: str | None, default: str = "", option: str = "--out") -> Path:
    """Choose where results go."""
    if out == "":
        raise click.BadParameter("is empty; name a directory", param_hint=option)
    if out is not None:
        return Path(out)
    if default in (".", ".."):
        raise click.BadParameter(f"the scene's name gives the folder output/{default}; name another", param_hint=option)
    return require_no_link(require_no_link(Path("output"), option) / default, option)


def going_on(directory: Path) -> str:
    """Say how to continue the unfinished run in a directory; empty if there is none."""
    from taichi_msm.runs.checkpoint import is_unfinished

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
