"""Observer of the minimisation of even grids, which takes seconds; a module of its own, as it needs no NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from taichi_msm.errors import ProgressCallback

_observer: ContextVar[ProgressCallback | None] = ContextVar("observer", default=None)


@contextmanager
def report_grids(progress: ProgressCallback) -> Iterator[None]:
    """Report the progress of even grids within the block, by the completed and the largest number of iterations."""
    token = _observer.set(progress)
    try:
        yield
    finally:
        _observer.reset(token)


def grid_observer() -> ProgressCallback | None:
    """Return the observer of the innermost block of `report_grids`; None outside."""
    return _observer.get()
