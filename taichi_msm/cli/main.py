"""Entry point of the command line: exit codes and messages of errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from taichi_msm.cli import common, example, export, fit, options, palpation, run, study, sweep, view  # noqa: F401  # each registers its commands
from taichi_msm.errors import DivergedError, FilesError, MsmError, SceneError, out_of_memory
from taichi_msm.system.process import discard_buffer, write_stderr


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, by default that of sys.argv; return an exit code of `common`, or 128 + a signal."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code, lines = _run(words)
        if lines:
            common.report_failure("error", lines, "--json" in words)
        return code
    except OSError as error:
        # The reader of stdout has exited, or its disk is full.
        discard_buffer(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            name = f" {error.filename}" if error.filename else ""
            write_stderr([f"taichi-msm: cannot read or write{name}: {error.strerror or error}"])
        return common.FILES


def _run(words: list[str]) -> tuple[int, Sequence[str]]:
    """Run a command; return the exit code, and the lines of an error."""
    try:
        Path.cwd()
    except OSError:
        return common.FILES, ["taichi-msm: the current folder is gone; change to another"]
    try:
        with common.show_grids("--quiet" in words or "--json" in words):
            return int(options.program.main(words, prog_name="taichi-msm", standalone_mode=False) or common.DONE), ()
    except SystemExit as ended:
        # click exits with 0 after completions for a shell, and with 1 when the reader of stdout has exited.
        if ended.code == common.DONE:
            return common.DONE, ()
        raise BrokenPipeError from None
    except SceneError as error:
        return common.INVALID_INPUT, error.lines
    except FilesError as error:
        return common.FILES, [str(error)]
    except DivergedError as error:
        return common.DIVERGED, [str(error)]
    except MsmError as error:
        return common.INVALID_INPUT, [str(error)]
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return common.INVALID_INPUT, ()
    except click.ClickException as error:
        message = " ".join(error.format_message().split())
        if "--set" in words and "unexpected extra argument" in message:
            message = f'{message.rstrip(".")}; a value with blanks needs quotes: --set "KEY=VALUE"'
        return common.INVALID_INPUT, [f"taichi-msm: {message} (see taichi-msm --help)"]
    except OSError:
        raise
    except Exception as error:
        if os.environ.get("TAICHI_MSM_TRACEBACK"):
            raise
        if message := out_of_memory(error):
            return common.INVALID_INPUT, [f"taichi-msm: {message}"]
        message = f"a bug: {type(error).__name__}: {' '.join(str(error).split())}"
        return common.BUG, [f"taichi-msm: {message}; please report it, with the output of TAICHI_MSM_TRACEBACK=1"]
