"""Keep libraries from writing to the terminal what an exception says anyway, or what nobody needs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def silenced(*descriptors: int, into: str = os.devnull) -> Iterator[None]:
    """Discard what is written to some file descriptors within a with block.

    Args:
        descriptors: 1 for stdout, 2 for stderr; a closed one stays closed.
        into: path of a file that takes the output instead.
    """
    with Path(into).open("wb") as nowhere:
        kept = {descriptor: copy for descriptor in descriptors if (copy := _copy(descriptor)) is not None}
        for descriptor in kept:
            os.dup2(nowhere.fileno(), descriptor)
        try:
            yield
        finally:
            for descriptor, copy in kept.items():
                os.dup2(copy, descriptor)
                os.close(copy)


def _copy(descriptor: int) -> int | None:
    try:
        return os.dup(descriptor)
    except OSError:
        return None
