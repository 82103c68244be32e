"""Tracks and frames in TAP-Vid's pickle, decoded as by its own readers."""

from __future__ import annotations

import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.exports import tapvid
from taichi_msm.exports.export import export
from tests.golden import Messages

WIDTH, HEIGHT, FRAMES, TRACKS = 40, 30, 5, 6


def made_up() -> dict[str, Any]:
    """Tracks with positions outside the picture and one behind the eye."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 45, (TRACKS, FRAMES, 2)).astype(np.float32)
    outside = ((points < 0) | (points > (WIDTH, HEIGHT))).any(axis=-1)
    occluded = outside | (rng.random((TRACKS, FRAMES)) < 0.2)
    points[3, 2], occluded[3, 2] = np.nan, True
    return {"coordinates": rng.random((TRACKS, 2)), "points": points, "occluded": occluded}


@pytest.fixture
def tracked(results: Path) -> Path:
    np.savez(results / "tracks.npz", **made_up())
    return results


def test_tracks_round_trip(tracked: Path) -> None:
    done = export(tracked, "tapvid", tracked / "out")
    assert (done.files, done.notes) == (["index.csv", "tapvid.pkl"], [])
    written = (tracked / "out" / "tapvid.pkl").read_bytes()
    data = pickle.loads(written)
    # Only names of all versions of NumPy; the arrays are writeable.
    named = {text for operation, text, _ in pickletools.genops(written) if operation.name == "SHORT_BINUNICODE"}
    of_numpy = {"numpy", "ndarray", "dtype", "u1", "f4", "b1", "|", "<"}
    assert named == {"results", "video", "points", "occluded"} | of_numpy
    assert data["results"]["points"].flags.writeable
    assert list(data) == ["results"]
    exported, expected = data["results"], made_up()
    dtypes = {"video": np.uint8, "points": np.float32, "occluded": np.bool_}
    assert {name: array.dtype for name, array in exported.items()} == dtypes
    assert exported["video"].shape == (FRAMES, HEIGHT, WIDTH, 3)
    for frame in range(FRAMES):
        picture = np.asarray(Image.open(tracked / "frames" / f"000{frame}.png"))
        np.testing.assert_array_equal(exported["video"][frame], picture)
    np.testing.assert_array_equal(exported["occluded"], expected["occluded"])
    # Pixels of create_davis_dataset and visualize.py; two roundings to single precision.
    pixels = exported["points"] * np.array([WIDTH, HEIGHT])
    is_finite = np.isfinite(expected["points"])
    np.testing.assert_allclose(pixels[is_finite], expected["points"][is_finite], rtol=2**-23)
    assert (pixels[~is_finite] == 0).all()


DAMAGE: dict[str, dict[str, Any]] = {
    "no points": {"points": None},
    "fewer tracks": {"occluded": made_up()["occluded"][:-1]},
    "visible at NaN": {"occluded": np.zeros((TRACKS, FRAMES), bool)},
    "objects": {"points": np.array([None, {}])},
    "compressed": {},  # of unlimited size
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_tracks(name: str, tracked: Path, message: Messages) -> None:
    arrays = {key: value for key, value in {**made_up(), **DAMAGE[name]}.items() if value is not None}
    (np.savez_compressed if name == "compressed" else np.savez)(tracked / "tracks.npz", **arrays)
    with message.raises(FilesError, "tracks.npz"):
        export(tracked, "tapvid", tracked / "out")
    assert not (tracked / "out").exists()


def test_memory_limit(tracked: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Writing takes twice the memory of all videos."""
    video = 3 * FRAMES * WIDTH * HEIGHT
    for runs, word in ((tracked, "render.size"), ([tracked, tracked], "2 runs")):
        need = 2 * video * (1 if runs == tracked else 2)
        monkeypatch.setattr(tapvid, "available_memory", lambda need=need: need - 1)
        with message.raises(FilesError, word):
            export(runs, "tapvid", tracked / "out")
        monkeypatch.setattr(tapvid, "available_memory", lambda need=need: need)
        export(runs, "tapvid", tracked / "out")
