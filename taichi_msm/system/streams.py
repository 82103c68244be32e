"""The process's standard streams, which may be closed, full, or read by nobody."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import TextIO

import click

from taichi_msm.errors import printable


def open_missing() -> None:
    """Open streams that the process was started without, so that no file of ours takes their place."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(descriptor, "w", closefd=False), "utf-8"))


def tell(lines: Iterable[str]) -> None:
    """Write lines on stderr, whatever characters the user's names hold; where nobody can read them, nowhere."""
    try:
        for line in lines:
            click.echo(printable(line), err=True)
    except OSError:
        mute(sys.stderr)


def mute(stream: TextIO) -> None:
    """Let what is still to be written to a stream go nowhere; the interpreter would try again when it ends."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
