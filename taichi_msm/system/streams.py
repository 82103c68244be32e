"""The standard streams of the process, which may be closed, full, or without a reader."""

from __future__ import annotations

import io
import os
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from taichi_msm.errors import printable

# Held while descriptors are redirected, which belong to all threads.
_redirecting = threading.RLock()


def open_missing() -> None:
    """Open standard streams that the process was started without, so that no other file gets their descriptors."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(descriptor, "w", closefd=False), "utf-8"))


def tell(lines: Iterable[str]) -> None:
    """Write lines to stderr, whatever characters they contain; discard them if nobody can read them."""
    # Imported here, as the library needs no command line.
    import click

    try:
        for line in lines:
            click.echo(printable(line), err=True)
    except OSError:
        mute(sys.stderr)


def mute(stream: TextIO) -> None:
    """Discard what is still buffered in a stream; otherwise the interpreter would try to write it when it ends."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextmanager
def silenced(*descriptors: int, into: str = os.devnull) -> Iterator[None]:
    """Discard, or write into a file, what libraries write to some file descriptors; a closed one stays closed."""
    with _redirecting, Path(into).open("wb") as nowhere:
        kept = {}
        for descriptor in descriptors:
            with suppress(OSError):
                kept[descriptor] = os.dup(descriptor)
        for descriptor in kept:
            os.dup2(nowhere.fileno(), descriptor)
        try:
            yield
        finally:
            for descriptor, copy in kept.items():
                os.dup2(copy, descriptor)
                os.close(copy)
