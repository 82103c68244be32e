"""The pickle of TAP-Vid holds the tracks and frames of a run, as TAP-Vid's own readers see them."""

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
    """Tracks some of whose points are outside of the picture, and one of which is behind the eye in a frame."""
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
    # It names nothing but what all versions of NumPy have, and its arrays can be changed.
    named = {text for operation, text, _ in pickletools.genops(written) if operation.name == "SHORT_BINUNICODE"}
    of_numpy = {"numpy", "ndarray", "dtype", "u1", "f4", "b1", "|", "<"}
    assert named == {"results", "video", "points", "occluded"} | of_numpy
    assert data["results"]["points"].flags.writeable
    assert list(data) == ["results"]
    found, expected = data["results"], made_up()
    assert set(found) == {"video", "points", "occluded"}
    assert (found["video"].dtype, found["points"].dtype, found["occluded"].dtype) == (np.uint8, np.float32, np.bool_)
    assert found["video"].shape == (FRAMES, HEIGHT, WIDTH, 3)
    for frame in range(FRAMES):
        picture = np.asarray(Image.open(tracked / "frames" / f"000{frame}.png"))
        np.testing.assert_array_equal(found["video"][frame], picture)
    np.testing.assert_array_equal(found["occluded"], expected["occluded"])
    # As create_davis_dataset does, to the pixels that visualize.py paints; two roundings to single precision.
    pixels = found["points"] * np.array([WIDTH, HEIGHT])
    somewhere = np.isfinite(expected["points"])
    np.testing.assert_allclose(pixels[somewhere], expected["points"][somewhere], rtol=2**-23)
    assert (pixels[~somewhere] == 0).all()


DAMAGE: dict[str, dict[str, Any]] = {
    "no points": {"points": None},
    "doubles": {"points": made_up()["points"].astype(np.float64)},
    "fewer tracks": {"occluded": made_up()["occluded"][:-1]},
    "seen nowhere": {"occluded": np.zeros((TRACKS, FRAMES), bool)},
    "objects": {"points": np.array([None, {}])},
    "compressed": {},  # of any size then, whatever the file says
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_tracks(name: str, tracked: Path, message: Messages) -> None:
    arrays = {key: value for key, value in {**made_up(), **DAMAGE[name]}.items() if value is not None}
    (np.savez_compressed if name == "compressed" else np.savez)(tracked / "tracks.npz", **arrays)
    with message.raises(FilesError, "tracks.npz"):
        export(tracked, "tapvid", tracked / "out")
    assert not (tracked / "out").exists()


def test_memory_limit(tracked: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr(tapvid, "available_memory", lambda: 6 * FRAMES * WIDTH * HEIGHT - 1)
    with message.raises(FilesError, "render.size"):
        export(tracked, "tapvid", tracked / "out")
    monkeypatch.setattr(tapvid, "available_memory", lambda: 6 * FRAMES * WIDTH * HEIGHT)
    export(tracked, "tapvid", tracked / "out")


def test_missing_frames(tracked: Path, message: Messages) -> None:
    (tracked / "frames").rename(tracked / "elsewhere")
    with message.raises(FilesError, "png"):
        export(tracked, "tapvid", tracked / "out")
