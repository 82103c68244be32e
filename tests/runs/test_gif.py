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
    """A picture of one grey, which tells its number and is exact in the palette."""
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


@pytest.mark.parametrize("rate", [12.5, 24, 25, 29.97, 60, 100, 120, 1000])
@pytest.mark.parametrize("frames", [1, 2, 3, 5, 38, 41])
def test_total_time_is_right_and_the_last_frame_is_shown(
    tmp_path: Path, palette: Palette, rate: float, frames: int
) -> None:
    path = tmp_path / "a.gif"
    write(path, [grey(f) for f in range(frames)], rate, palette)
    shown, delays = read(path)
    # Half of GIF's unit. All in less than it is shown for that unit; more than one frame, each for long enough.
    assert abs(sum(delays) - max(10, 1000 * frames / rate)) <= 5
    assert len(delays) == 1 or min(delays) >= 10 * MIN_GIF_DELAY
    np.testing.assert_array_equal(shown[-1], grey(frames - 1))
    if rate <= 50:
        ends = [10 * round(100 * (f + 1) / rate) for f in range(frames)]
        np.testing.assert_array_equal(np.cumsum(delays), ends)


def test_frames_left_out_do_not_move_the_others(tmp_path: Path, palette: Palette) -> None:
    """At 100 frames per second every second frame is shown, at its own time."""
    write(tmp_path / "a.gif", [grey(f) for f in range(20)], 100, palette)
    shown, delays = read(tmp_path / "a.gif")
    assert delays == [20] * 10
    for n in range(9):
        np.testing.assert_array_equal(shown[n], grey(2 * n))
    np.testing.assert_array_equal(shown[9], grey(19))


@pytest.mark.parametrize(
    ("numbers", "rate", "delays"),
    [
        pytest.param([0, 0, 0, 1, 1, 2, 2, 2, 2], 25, [120, 80, 160], id="equal frames are one"),
        # The last frame's slot is 1/100 s long; the rest before it makes room for 2/100 s.
        pytest.param([0] * 120 + [1], 120, [990, 20], id="a change after a long rest"),
        pytest.param([0] * 121, 120, [1010], id="no change"),
    ],
)
def test_delays(numbers: list[int], rate: float, delays: list[int], tmp_path: Path, palette: Palette) -> None:
    write(tmp_path / "a.gif", [grey(n) for n in numbers], rate, palette)
    assert read(tmp_path / "a.gif")[1] == delays


def test_a_delay_that_does_not_fit_is_shared_by_repetitions(tmp_path: Path, palette: Palette) -> None:
    write(tmp_path / "a.gif", [grey(0), grey(1)], 0.001, palette)
    shown, delays = read(tmp_path / "a.gif")
    assert sum(delays) == 2_000_000
    assert max(delays) <= 10 * MAX_GIF_DELAY
    np.testing.assert_array_equal(shown[0], grey(0))
    np.testing.assert_array_equal(shown[-1], grey(1))


def test_it_loops_for_ever(tmp_path: Path, palette: Palette) -> None:
    write(tmp_path / "a.gif", [grey(0), grey(1)], 25, palette)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0


def test_frames_decode_to_the_nearest_colours(tmp_path: Path) -> None:
    """Changes of all kinds: none, one pixel at each corner, a rectangle, everything."""
    palette = Palette(speckle(40, 40), BACKGROUND)
    pictures = [speckle(HEIGHT, WIDTH, 1)]
    for area in [np.s_[0, 0], np.s_[0, -1], np.s_[-1, 0], np.s_[-1, -1], np.s_[3:6, 2:9], np.s_[:, :]]:
        picture = pictures[-1].copy()
        picture[area] = 255 - picture[area]
        pictures.append(picture)
    write(tmp_path / "a.gif", pictures, 25, palette)
    shown, _ = read(tmp_path / "a.gif")
    assert len(shown) == len(pictures)
    for picture, seen in zip(pictures, shown, strict=True):
        np.testing.assert_array_equal(seen, palette.table[palette.indices(picture)])


def test_indices_are_those_of_the_nearest_colours_but_for_the_lookup() -> None:
    """The lookup moves a colour by at most 2 levels along each axis, to the middle of its cell.

    So, by the triangle inequality, it is off by at most twice that distance more than the nearest colour; and
    it errs to both sides: by half a level on average, where the darkest corner would err by one and a half.
    """
    y, x = np.mgrid[0:96, 0:96] / 95
    skin = np.stack([225 - 60 * x * y, 150 - 80 * x + 20 * y, 130 - 50 * y], axis=-1).astype(np.uint8)
    palette = Palette(skin, BACKGROUND)
    error = palette.table[palette.indices(skin)].astype(float) - skin
    nearest, _ = cKDTree(palette.table[:TRANSPARENT_INDEX]).query(skin)
    assert (np.sqrt(np.square(error).sum(axis=2)) <= nearest + 2 * np.sqrt(3 * 2**2)).all()
    assert np.abs(error.mean(axis=(0, 1))).max() < 1


@pytest.mark.parametrize("background", [(0, 0, 0), (255, 255, 255), (7, 9, 3), (200, 101, 99)])
def test_the_background_is_exact(background: tuple[int, int, int]) -> None:
    crowd = np.array(background) + np.random.default_rng(0).integers(-4, 5, (64, 64, 3))
    palette = Palette(np.clip(crowd, 0, 255).astype(np.uint8), background)
    picture = np.full((HEIGHT, WIDTH, 3), background, np.uint8)
    np.testing.assert_array_equal(palette.table[palette.indices(picture)], picture)


def test_the_transparent_index_is_never_a_colour() -> None:
    """Few colours leave entries free, which are black in the file."""
    for samples in (np.full((4, 4, 3), 255, np.uint8), speckle(64, 64)):
        palette = Palette(samples, (255, 255, 255))
        assert palette.indices(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).max() < TRANSPARENT_INDEX


def test_few_colours_are_kept_exactly() -> None:
    colours = np.array([[[250, 3, 3], [10, 200, 30], [20, 20, 130], [128, 128, 128]]], np.uint8)
    palette = Palette(np.repeat(colours, 16, axis=0), BACKGROUND)
    np.testing.assert_array_equal(palette.table[palette.indices(colours)], colours)
