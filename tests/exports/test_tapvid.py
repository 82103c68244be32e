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


def test_tracks_come_back(tracked: Path) -> None:
    done = export(tracked, "tapvid", tracked / "out")
    assert (done.files, done.notes) == (["index.csv", "tapvid.pkl"], [])
    with (tracked / "out" / "tapvid.pkl").open("rb") as file:
        data = pickle.load(file)
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


def test_a_point_at_the_corner_of_the_picture_is_at_1(tracked: Path) -> None:
    """And the centre of its first pixel half a pixel from 0."""
    points = np.zeros((2, FRAMES, 2), np.float32)
    points[0], points[1] = (0.5, 0.5), (WIDTH, HEIGHT)
    np.savez(tracked / "tracks.npz", points=points, occluded=np.zeros((2, FRAMES), bool))
    export(tracked, "tapvid", tracked / "out")
    with (tracked / "out" / "tapvid.pkl").open("rb") as file:
        found = pickle.load(file)["results"]["points"]
    np.testing.assert_array_equal(found[:, 0], np.array([[0.5 / WIDTH, 0.5 / HEIGHT], [1, 1]], np.float32))


def test_any_numpy_reads_the_pickle(tracked: Path) -> None:
    """It names nothing but what all versions have, and its arrays can be changed."""
    export(tracked, "tapvid", tracked / "out")
    data = (tracked / "out" / "tapvid.pkl").read_bytes()
    named = [text for operation, text, _ in pickletools.genops(data) if operation.name == "SHORT_BINUNICODE"]
    of_numpy = {"numpy", "ndarray", "dtype", "u1", "f4", "b1", "|", "<"}
    assert set(named) == {"results", "video", "points", "occluded"} | of_numpy
    pickle.loads(data)["results"]["points"] *= 2


def altered(**arrays: Any) -> dict[str, Any]:
    return {name: value for name, value in {**made_up(), **arrays}.items() if value is not None}


@pytest.mark.parametrize(
    "arrays",
    [
        altered(points=None),
        altered(occluded=None),
        altered(points=made_up()["points"].astype(np.float64)),
        altered(points=made_up()["points"][:, :-1]),
        altered(occluded=made_up()["occluded"][:-1]),
        altered(occluded=made_up()["occluded"].astype(np.uint8) + 2),
        altered(occluded=np.zeros((TRACKS, FRAMES), bool)),
        altered(points=np.array([None, {}])),
    ],
    ids=["no points", "unknown", "doubles", "fewer frames", "fewer tracks", "no bools", "seen nowhere", "objects"],
)
def test_damaged_tracks_are_one_line(arrays: dict[str, Any], tracked: Path) -> None:
    np.savez(tracked / "tracks.npz", **arrays)
    with pytest.raises(FilesError) as caught:
        export(tracked, "tapvid", tracked / "out")
    assert str(caught.value) == f"{tracked / 'tracks.npz'}: damaged, or not of this run; run the scene again"
    assert not (tracked / "out").exists()


def test_compressed_tracks_are_refused(tracked: Path) -> None:
    """What is compressed may be of any size, whatever the file says."""
    np.savez_compressed(tracked / "tracks.npz", **made_up())
    with pytest.raises(FilesError, match="damaged"):
        export(tracked, "tapvid", tracked / "out")


def test_a_video_that_does_not_fit_is_told_of(tracked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tapvid, "available_memory", lambda: 6 * FRAMES * WIDTH * HEIGHT - 1)
    with pytest.raises(FilesError, match=r"its video takes 0\.0 GiB of memory.*a smaller render\.size or fewer frames"):
        export(tracked, "tapvid", tracked / "out")
    monkeypatch.setattr(tapvid, "available_memory", lambda: 6 * FRAMES * WIDTH * HEIGHT)
    export(tracked, "tapvid", tracked / "out")


def test_frames_are_needed(tracked: Path) -> None:
    (tracked / "frames").rename(tracked / "elsewhere")
    with pytest.raises(FilesError) as caught:
        export(tracked, "tapvid", tracked / "out")
    again = 'run the scene again with --set "output=[png,gif,trajectory,tracks]"'
    assert str(caught.value) == f"{tracked}: tapvid needs png; {again}"
