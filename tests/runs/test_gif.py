from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from taichi_msm.runs.media import MAX_GIF_DELAY, MIN_GIF_DELAY, TRANSPARENT_INDEX, GifWriter, Palette
from tests.scenes import speckle

Picture = NDArray[np.uint8]

HEIGHT, WIDTH = 12, 16
BACKGROUND = (7, 9, 3)
GREYS = np.repeat(np.arange(16, 240, 8, dtype=np.uint8)[:, None, None], 3, axis=2)


@pytest.fixture
def palette() -> Palette:
    return Palette(GREYS, BACKGROUND)


def grey(number: int) -> Picture:
    """A picture of a grey that is unique to its number and exact in the palette."""
    return np.full((HEIGHT, WIDTH, 3), GREYS[number % len(GREYS), 0], np.uint8)


def write(path: Path, pictures: list[Picture], rate: float, palette: Palette) -> None:
    height, width, _ = pictures[0].shape
    with closing(GifWriter(path.open("wb"), (width, height), rate, palette)) as gif:
        for picture in pictures:
            gif.add(picture)


def read(path: Path) -> tuple[list[Picture], list[int]]:
    """The pictures of an animation and their delays [ms], as Pillow plays it."""
    pictures, delays = [], []
    with Image.open(path) as image:
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            pictures.append(np.asarray(image.convert("RGB")))
            delays.append(image.info["duration"])
    return pictures, delays


@pytest.mark.parametrize("rate", [12.5, 24, 29.97, 60, 120, 1000])
@pytest.mark.parametrize("frames", [1, 2, 3, 38])
def test_duration_and_last_frame(tmp_path: Path, palette: Palette, rate: float, frames: int) -> None:
    path = tmp_path / "a.gif"
    write(path, [grey(f) for f in range(frames)], rate, palette)
    shown, delays = read(path)
    # Half of GIF's unit of 10 ms; the shortest animation lasts for a unit.
    assert abs(sum(delays) - max(10, 1000 * frames / rate)) <= 5
    assert len(delays) == 1 or min(delays) >= 10 * MIN_GIF_DELAY
    np.testing.assert_array_equal(shown[-1], grey(frames - 1))
    if rate <= 50:
        ends = [10 * round(100 * (f + 1) / rate) for f in range(frames)]
        np.testing.assert_array_equal(np.cumsum(delays), ends)


def test_dropped_frames(tmp_path: Path, palette: Palette) -> None:
    """At 100 frames per second, every second frame is shown at its time."""
    write(tmp_path / "a.gif", [grey(f) for f in range(20)], 100, palette)
    shown, delays = read(tmp_path / "a.gif")
    assert delays == [20] * 10
    np.testing.assert_array_equal(shown, [grey(f) for f in [*range(0, 18, 2), 19]])


@pytest.mark.parametrize(
    ("numbers", "rate", "delays"),
    [
        pytest.param([0, 0, 0, 1, 1, 2, 2, 2, 2], 25, [120, 80, 160], id="merged equal frames"),
        # The last frame lasts 1/100 s; its predecessor is shortened for the minimum of 2/100 s.
        pytest.param([0] * 120 + [1], 120, [990, 20], id="late change"),
        pytest.param([0] * 121, 120, [1010], id="constant"),
    ],
)
def test_delays(numbers: list[int], rate: float, delays: list[int], tmp_path: Path, palette: Palette) -> None:
    write(tmp_path / "a.gif", [grey(n) for n in numbers], rate, palette)
    assert read(tmp_path / "a.gif")[1] == delays


def test_delay_above_the_maximum(tmp_path: Path, palette: Palette) -> None:
    """The frame is repeated; the animation loops endlessly."""
    write(tmp_path / "a.gif", [grey(0), grey(1)], 0.001, palette)
    shown, delays = read(tmp_path / "a.gif")
    assert sum(delays) == 2_000_000
    assert max(delays) <= 10 * MAX_GIF_DELAY
    np.testing.assert_array_equal([shown[0], shown[-1]], [grey(0), grey(1)])
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0


def test_decoded_colours(tmp_path: Path) -> None:
    """Changes of a pixel at each corner, a rectangle and all pixels."""
    palette = Palette(speckle(40, 40), BACKGROUND)
    pictures = [speckle(HEIGHT, WIDTH, 1)]
    for area in [np.s_[0, 0], np.s_[0, -1], np.s_[-1, 0], np.s_[-1, -1], np.s_[3:6, 2:9], np.s_[:, :]]:
        picture = pictures[-1].copy()
        picture[area] = 255 - picture[area]
        pictures.append(picture)
    write(tmp_path / "a.gif", pictures, 25, palette)
    shown, _ = read(tmp_path / "a.gif")
    assert len(shown) == len(pictures)
    for picture, decoded in zip(pictures, shown, strict=True):
        np.testing.assert_array_equal(decoded, palette.table[palette.indices(picture)])


def test_error_of_the_lookup() -> None:
    """The lookup replaces a colour by the middle of its cell, at most 2 levels away along each axis.

    By the triangle inequality, the error exceeds that of the nearest colour by at most twice this distance. Its mean is
    half a level; with the darkest corner of a cell in place of its middle it would be 1.5 levels.
    """
    y, x = np.mgrid[0:96, 0:96] / 95
    skin = np.stack([225 - 60 * x * y, 150 - 80 * x + 20 * y, 130 - 50 * y], axis=-1).astype(np.uint8)
    palette = Palette(skin, BACKGROUND)
    error = palette.table[palette.indices(skin)].astype(float) - skin
    nearest, _ = cKDTree(palette.table[:TRANSPARENT_INDEX]).query(skin)
    assert (np.sqrt(np.square(error).sum(axis=2)) <= nearest + 2 * np.sqrt(3 * 2**2)).all()
    assert np.abs(error.mean(axis=(0, 1))).max() < 1


@pytest.mark.parametrize("background", [(0, 0, 0), (255, 255, 255), (200, 101, 99)])
def test_exact_colours_of_a_palette(background: tuple[int, int, int]) -> None:
    """The background is exact among similar colours, and so are few colours; transparency is not a colour."""
    similar = np.array(background) + np.random.default_rng(0).integers(-4, 5, (64, 64, 3))
    few = np.array([[[250, 3, 3], [10, 200, 30], [20, 20, 130], [128, 128, 128]]], np.uint8)
    for samples, picture in (
        (np.clip(similar, 0, 255).astype(np.uint8), np.full((HEIGHT, WIDTH, 3), background, np.uint8)),
        (np.repeat(few, 16, axis=0), few),
    ):
        palette = Palette(samples, background)
        np.testing.assert_array_equal(palette.table[palette.indices(picture)], picture)
        assert palette.indices(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).max() < TRANSPARENT_INDEX
