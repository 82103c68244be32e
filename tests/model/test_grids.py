"""Even grids kept in memory and in the user's folder, and their progress."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.model import grids
from taichi_msm.model.grids import MAX_FILES, kept_grid, report_grids, user_folder
from taichi_msm.scene.surface import Frame
from taichi_msm.surfaces.even_grid import even_grid
from taichi_msm.surfaces.surface import Surface, given_grid, point_surface
from taichi_msm.system import array_cache

POINTS = (5, 6)
FRAME = Frame((), (0, 0), (0, 0, 0, 0), POINTS)


@pytest.fixture
def surface() -> Surface:
    """A wavy wall, on which an even grid has other fractions than (u, v)."""
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 7))
    return point_surface(np.stack([0.1 * u, -0.08 * v, 0.02 * np.sin(4 * u * v)], axis=-1))


@pytest.fixture
def computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """An item for every minimisation; the folder of the user is temporary."""
    calls: list[int] = []

    def count(*arguments: object) -> NDArray[np.float64]:
        calls.append(len(calls))
        return even_grid(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(grids, "even_grid", count)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return calls


def grid(surface: Surface, key: str = "wall", *, forget: bool = True) -> NDArray[np.float64]:
    """The grid of a surface, as another process has it."""
    if forget:
        array_cache._arrays.clear()
    return kept_grid(surface, FRAME, POINTS, (key,))


def test_kept_by_key(surface: Surface, computed: list[int]) -> None:
    first = grid(surface)
    assert len(computed) == 1
    assert np.abs(first - given_grid(POINTS)).max() > 0.001
    np.testing.assert_array_equal(grid(surface, forget=False), first)
    np.testing.assert_array_equal(grid(surface), first)
    assert len(computed) == 1
    grid(surface, "another")
    assert len(computed) == 2
    assert sorted(path.suffix for path in user_folder().iterdir()) == [".npz", ".npz"]


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped", "another shape", "turned over", "a folder"])
def test_damaged_files_are_ignored(damage: str, surface: Surface, computed: list[int]) -> None:
    first = grid(surface)
    (file,) = user_folder().iterdir()
    content = file.read_bytes()
    # A bit of the last number, in front of the directory of the archive.
    at = content.index(b"PK\x01\x02") - 4
    flipped = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
    file.unlink()
    if damage == "a folder":
        file.mkdir()
    elif damage == "another shape":
        np.savez(file, grid=np.zeros((3, 3, 2)))
    elif damage == "turned over":
        np.savez(file, grid=first[::-1])
    else:
        file.write_bytes({"empty": b"", "truncated": content[: len(content) // 2], "flipped": flipped}[damage])
    np.testing.assert_array_equal(grid(surface), first)
    assert len(computed) == 2


def test_folder_that_cannot_be_written(surface: Surface, computed: list[int], tmp_path: Path) -> None:
    """A file in place of the folder, as permissions do not bind an administrator."""
    (tmp_path / "taichi_msm").write_text("")
    np.testing.assert_array_equal(grid(surface), grid(surface))
    assert len(computed) == 2


def test_least_recently_used_files_are_deleted(surface: Surface, computed: list[int]) -> None:
    user_folder().mkdir(parents=True)
    for n in range(MAX_FILES):
        path = user_folder() / f"{n}.npz"
        path.write_text("")
        os.utime(path, (n, n))
    grid(surface)
    names = {path.name for path in user_folder().iterdir()}
    assert len(names) == MAX_FILES
    assert "0.npz" not in names
    assert "1.npz" in names
    # A read grid becomes the most recent one.
    for n in range(MAX_FILES):
        grid(surface, str(n))
        grid(surface)
    assert len(list(user_folder().iterdir())) == MAX_FILES
    assert len(computed) == MAX_FILES + 1


def test_finer_grids_stay_on_the_sides(surface: Surface, computed: list[int]) -> None:
    """Cubic splines through the own points, with the sides of the picture exactly."""
    own, finer = grid(surface), kept_grid(surface, FRAME, (17, 21), ("wall",))
    np.testing.assert_allclose(finer[::4, ::4], own, rtol=0, atol=1e-15)
    for side, value in ((finer[:, 0, 0], 0), (finer[:, -1, 0], 1), (finer[0, :, 1], 0), (finer[-1, :, 1], 1)):
        assert (side == value).all()
    assert len(computed) == 1


def test_progress(surface: Surface, computed: list[int]) -> None:
    """The completed iterations do not decrease, and end complete; kept grids have none."""
    reports: list[tuple[int, int]] = []
    with report_grids(lambda *report: reports.append(report)):
        grid(surface)
        done = [report[0] for report in reports]
        assert done == sorted(done)
        assert reports[-1][0] == reports[-1][1] > 0
        reports.clear()
        grid(surface)
    assert not reports
