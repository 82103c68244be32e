"""The program in a process that reports its progress, so that a test sends a signal at a known stage."""

from __future__ import annotations

import os
import subprocess
import sys
from types import TracebackType
from typing import Any

# Writes a line when signals are handled, and at each report of progress; lines that nobody reads are lost.
PROGRAM = """
import os, runpy, sys
from contextlib import contextmanager, suppress
from taichi_msm.system import process

pipe = int(sys.argv.pop(1))
os.set_blocking(pipe, False)

def report(stage, done):
    with suppress(OSError):
        os.write(pipe, f"{stage} {done}\\n".encode())

def exit_on_signals(message, original=process.exit_on_signals):
    original(message)
    report("heard", 0)
    from taichi_msm.cli import common  # as the program does next

    @contextmanager
    def show_progress(*arguments, original=common.show_progress, **named):
        with original(*arguments, **named) as progress:
            def reporting(stage, done, total):
                report(stage, done)
                progress(stage, done, total)
            yield reporting

    common.show_progress = show_progress

process.exit_on_signals = exit_on_signals
runpy.run_module("taichi_msm", run_name="__main__")
"""


class ReportingProcess(subprocess.Popen[str]):
    """`taichi-msm` with some arguments and text output; as a context manager, it is killed when a test fails."""

    def __init__(self, *arguments: str, **options: Any) -> None:
        read, write = os.pipe()
        self._pipe = os.fdopen(read)
        command = [sys.executable, "-c", PROGRAM, str(write), *arguments]
        super().__init__(command, pass_fds=[write], text=True, **options)
        os.close(write)

    def until(self, stage: str, done: int = 0) -> None:
        """Wait for a stage, and an amount of its work; the first stage, `heard`, means that signals are handled."""
        for line in self._pipe:
            reached, count = line.split()
            if reached == stage and int(count) >= done:
                return
        raise AssertionError(f"exit code {self.wait()} before {stage} {done}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipe.close()
        if error:
            self.kill()
        super().__exit__(kind, error, trace)
