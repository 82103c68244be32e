"""Even grids, which take seconds: kept in memory, in the folder of a run, and in a folder of the user."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import ProgressCallback
from taichi_msm.images import PictureError
from taichi_msm.surfaces.even_grid import FoldedGridError, even_grid
from taichi_msm.surfaces.splines import GridSpline
from taichi_msm.surfaces.surface import Surface
from taichi_msm.system.array_cache import cached_arrays

# Largest number of files in the user's folder.
MAX_FILES = 50

# Changes with the method.
VERSION = 1

_progress: ContextVar[ProgressCallback | None] = ContextVar("progress", default=None)
# Grids of a run, by (rows, cols); of finished and unfinished runs, which are read again.
_of_run: ContextVar[Array | None] = ContextVar("of_run", default=None)


@contextmanager
def report_grids(progress: ProgressCallback) -> Iterator[None]:
    """Report the progress of even grids within the block."""
    token = _progress.set(progress)
    try:
        yield
    finally:
        _progress.reset(token)


@contextmanager
def use_grid(fractions: Array | None) -> Iterator[None]:
    """Take the grid of a run, shape (rows, cols, 2), in place of a minimisation with as many points in the block."""
    token = _of_run.set(fractions)
    try:
        yield
    finally:
        _of_run.reset(token)


def kept_grid(surface: Surface, own: tuple[int, int], points: tuple[int, int], key: tuple[Any, ...]) -> Array:
    """Return the even grid of (rows, cols) mass points: that of `own` points, interpolated by cubic splines.

    `key` has all that the surface depends on. A PictureError reports a surface on which no grid is even.
    """
    digest = hashlib.sha256(repr((VERSION, key, own)).encode()).hexdigest()
    given = _of_run.get()
    if given is not None and given.shape[:2] == own:
        grid = given
    else:
        (grid,) = cached_arrays(("grid", digest), lambda: (_read_or_compute(surface, own, digest),))
    if points == own:
        return grid
    places = (np.linspace(0, count - 1, n) for count, n in zip(own, points, strict=True))
    row, column = np.meshgrid(*places, indexing="ij")
    return GridSpline(grid)(row.ravel(), column.ravel())[0].reshape(*points, 2)


def _read_or_compute(surface: Surface, points: tuple[int, int], digest: str) -> Array:
    path = user_folder() / f"{digest}.npy"
    with suppress(OSError, ValueError):
        grid = np.load(path, allow_pickle=False)
        if grid.shape == (*points, 2) and np.isfinite(grid).all():
            path.touch()
            return grid
    try:
        grid = even_grid(surface, points, _progress.get()).fractions
    except FoldedGridError:
        remedy = "cut the region, leave a part out by sheet.mask, or take grid: given"
        raise PictureError("no even grid: cells of the picture have no area on the surface", remedy) from None
    with suppress(OSError):
        _store(path, grid)
    return grid


def _store(path: Path, grid: Array) -> None:
    """Store a grid, and delete the least recently used ones beyond MAX_FILES."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    with temporary.open("wb") as file:
        np.save(file, grid)
    temporary.replace(path)
    files = sorted(path.parent.glob("*.npy"), key=lambda each: each.stat().st_mtime)
    for old in files[:-MAX_FILES]:
        old.unlink(missing_ok=True)


def user_folder() -> Path:
    """Return the folder of the user's grids."""
    default = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}.get(sys.platform, "~/.cache")
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(default)) / "taichi_msm" / "grids"  # noqa: PTH111
