"""The program in a process of its own that tells how far it is, so that a signal is sent when handlers stand for it."""

from __future__ import annotations

import os
import subprocess
import sys
from types import TracebackType
from typing import Any

# Writes a line when signals are heard, and whenever some work reports its progress; lines that nobody reads are lost.
PROGRAM = """
import os, runpy, sys
from contextlib import contextmanager, suppress
from taichi_msm.system import process

pipe = int(sys.argv.pop(1))
os.set_blocking(pipe, False)

def tell(stage, done):
    with suppress(OSError):
        os.write(pipe, f"{stage} {done}\\n".encode())

def exit_on_signals(original=process.exit_on_signals):
    original()
    tell("heard", 0)
    from taichi_msm.cli import common  # as the program does next

    @contextmanager
    def show_progress(*arguments, original=common.show_progress, **named):
        with original(*arguments, **named) as progress:
            def telling(stage, done, total):
                tell(stage, done)
                progress(stage, done, total)
            yield telling

    common.show_progress = show_progress

process.exit_on_signals = exit_on_signals
runpy.run_module("taichi_msm", run_name="__main__")
"""


class Telling(subprocess.Popen[str]):
    """`taichi-msm` with these arguments; its output is text. A `with` ends it when a test fails."""

    def __init__(self, *arguments: str, **options: Any) -> None:
        read, write = os.pipe()
        self._pipe = os.fdopen(read)
        command = [sys.executable, "-c", PROGRAM, str(write), *arguments]
        super().__init__(command, pass_fds=[write], text=True, **options)
        os.close(write)

    def until(self, stage: str, done: int = 0) -> None:
        """Wait until the work has come to a stage, and in it so far; the first stage is `heard`: signals are."""
        for line in self._pipe:
            reached, count = line.split()
            if reached == stage and int(count) >= done:
                return
        raise AssertionError(f"it ended with {self.wait()} before it came to {stage} {done}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipe.close()
        if error:
            self.kill()
        super().__exit__(kind, error, trace)
