"""The command line: arguments, exit codes, printing. No other module prints or exits."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from taichi_msm.cli import export, fit, run, study, sweep  # noqa: F401, each adds its commands
from taichi_msm.cli.options import program
from taichi_msm.cli.session import BUG, DONE, FILES, WRONG_INPUT, report
from taichi_msm.errors import (
    ArgumentError,
    DeviceError,
    ExecutorError,
    FilesError,
    NotInstalledError,
    SceneError,
)
from taichi_msm.system.process import mute, tell

if TYPE_CHECKING:
    pass


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
