"""Even grids, whose minimisation takes seconds: kept in memory, in the folder of a run, and in a folder of the user."""

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
from taichi_msm.scene.surface import Frame
from taichi_msm.surfaces.even_grid import FoldedGridError, even_grid
from taichi_msm.surfaces.grid_objective import is_unfolded
from taichi_msm.surfaces.splines import GridSpline
from taichi_msm.surfaces.surface import Surface
from taichi_msm.system.array_cache import cached_arrays

# Largest number of files in the user's folder.
MAX_FILES = 50

# Changes with the method.
VERSION = 1

_progress: ContextVar[ProgressCallback | None] = ContextVar("progress", default=None)


@contextmanager
def report_grids(progress: ProgressCallback) -> Iterator[None]:
    """Report the progress of even grids within the block, by the completed and the largest number of iterations."""
    token = _progress.set(progress)
    try:
        yield
    finally:
        _progress.reset(token)


def kept_grid(surface: Surface, frame: Frame, points: tuple[int, int], key: tuple[Any, ...]) -> Array:
    """Return the even grid of (rows, cols) mass points: that of `frame.points`, interpolated by cubic splines.

    `key` has all that the surface depends on. A PictureError reports a surface on which no grid is even.
    """
    own = frame.points
    digest = hashlib.sha256(repr((VERSION, key, own)).encode()).hexdigest()
    if frame.grid is not None:
        grid = frame.grid.fractions
    else:
        (grid,) = cached_arrays(("grid", digest), lambda: (_read_or_compute(surface, own, digest),))
    if points == own:
        return grid
    places = (np.linspace(0, count - 1, n) for count, n in zip(own, points, strict=True))
    row, column = np.meshgrid(*places, indexing="ij")
    interpolated = GridSpline(grid)(row.ravel(), column.ravel())[0].reshape(*points, 2)
    # Rounding may move points off the sides of the picture.
    interpolated[:, 0, 0] = interpolated[0, :, 1] = 0
    interpolated[:, -1, 0] = interpolated[-1, :, 1] = 1
    return interpolated


def _read_or_compute(surface: Surface, points: tuple[int, int], digest: str) -> Array:
    """Return a grid from the user's folder, without which it is computed and stored there."""
    path = user_folder() / f"{digest}.npz"
    with suppress(Exception):  # a damaged file may raise any type
        # NumPy would leave a damaged file open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            grid = archive["grid"]
        if grid.shape == (*points, 2) and grid.dtype == np.float64 and is_unfolded(grid):
            path.touch()
            return grid
    try:
        grid = even_grid(surface, points, _progress.get())
    except FoldedGridError as error:
        across, down = error.place
        place = f"{across:.3g} across and {down:.3g} down"
        remedy = "take grid: given, or a file without that part"
        raise PictureError(f"no even grid: the surface has no area at {place}", remedy) from None
    with suppress(OSError):
        _store(path, grid)
    return grid


def _store(path: Path, grid: Array) -> None:
    """Store a grid with its checksum, and delete the least recently used files beyond MAX_FILES."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    with temporary.open("wb") as file:
        np.savez(file, grid=grid)
    temporary.replace(path)
    files = sorted(path.parent.glob("*.npz"), key=lambda each: each.stat().st_mtime)
    for old in files[:-MAX_FILES]:
        old.unlink(missing_ok=True)


def user_folder() -> Path:
    """Return the folder of the user's grids."""
    default = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}.get(sys.platform, "~/.cache")
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(default)) / "taichi_msm" / "grids"  # noqa: PTH111
