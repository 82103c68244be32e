"""Smoothing of depth maps against direct least squares, and on planes, which it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from taichi_msm.arithmetic import Array
from taichi_msm.surfaces import smoothing
from taichi_msm.surfaces.smoothing import smooth_inverse_depth
from tests.surfaces.walls import HEIGHT, WIDTH, X, Y, folds, plane


def with_holes(seed: int = 0) -> np.ndarray:
    """Pixels with a depth: without 20 % at random, a block, and three rows at the border."""
    is_known = np.random.default_rng(seed).random(X.shape) > 0.2
    is_known[40:75, 60:100] = False
    is_known[:3] = False
    return is_known


def least_squares(e: Array, is_known: np.ndarray, x: Array, y: Array, deviation: float, at: tuple[int, int]) -> float:
    """Value at a pixel of the plane that fits best with the weights ok G, twice as wide until they suffice."""
    down, across = (np.arange(count) - place for count, place in zip(e.shape, at, strict=True))
    while True:
        one, two = (
            np.where(np.abs(d) <= int(8 * deviation + 0.5), np.exp(-0.5 * (d / deviation) ** 2), 0)
            for d in (down, across)
        )
        full = np.exp(-0.5 * (np.arange(-int(8 * deviation + 0.5), int(8 * deviation + 0.5) + 1) / deviation) ** 2)
        weights = one[:, None] * two / full.sum() ** 2 * is_known
        if weights.sum() >= 1e-3:
            break
        deviation *= 2
    used = weights > 0
    root = np.sqrt(weights[used])
    design = np.stack([np.ones_like(root), x[used] - x[at], y[used] - y[at]], axis=1)
    # Columns of one size: the condition number is then that of the pixels' places.
    scale = np.abs(design).max(axis=0)
    return float(np.linalg.lstsq(design / scale * root[:, None], root * e[used], rcond=None)[0][0])


@pytest.mark.parametrize("deviation", [0.1, 0.2, 0.7, 3.0])
def test_fit_is_that_of_least_squares(deviation: float) -> None:
    # Coordinates as of a lens with distortion, and noise of a tenth.
    x, y = X * (1 + 0.2 * (X * X + Y * Y)), Y * (1 + 0.2 * (X * X + Y * Y))
    is_known = with_holes()
    e = folds(0.002, 0.02) * (1 + 0.1 * np.random.default_rng(1).standard_normal(X.shape))
    smooth = smooth_inverse_depth(np.where(is_known, e, np.nan), is_known, x, y, deviation)
    for at in ((0, 0), (0, 70), (30, 159), (57, 80), (50, 62), (100, 20), (127, 159)):
        # Moments are sums of numbers up to (80 px)^2, with a rounding of 1e-16 each: 1e-12 of a variance of 0.5 px^2.
        assert smooth[at] == pytest.approx(least_squares(e, is_known, x, y, deviation, at), rel=1e-10)


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.5, 4.0])
@pytest.mark.parametrize("degrees", [0, 40])
def test_planes_stay_planes(deviation: float, degrees: float) -> None:
    e, is_known = plane(degrees, 0.7), with_holes()
    smooth = smooth_inverse_depth(np.where(is_known, e, np.nan), is_known, X, Y, deviation)
    assert np.abs(smooth / e - 1).max() < 1e-9


def test_pixels_with_depth_stay_without_smoothing() -> None:
    e, is_known = folds(0.002, 0.02), with_holes()
    smooth = smooth_inverse_depth(e, is_known, X, Y, 0.0)
    assert (smooth[is_known] == e[is_known]).all()
    assert (smooth[~is_known] != e[~is_known]).all()
    expected = least_squares(e, is_known, X, Y, 1.0, (57, 80))
    assert smooth[57, 80] == pytest.approx(expected, rel=1e-10)


def test_a_small_mask_fills_the_whole_picture() -> None:
    """Outside a few pixels no filter has the weight, and the last one takes all of them."""
    e, is_known = plane(30, 0.7), np.zeros(X.shape, bool)
    is_known[4:8, 3:7] = True
    assert np.abs(smooth_inverse_depth(e, is_known, X, Y, 2.0) / e - 1).max() < 1e-8


def test_single_pixel_stays() -> None:
    """The fit in the middle of its own hole is its depth, whatever the slope."""
    e, is_known = folds(0.002, 0.02), np.ones(X.shape, bool)
    is_known[20:50, 30:60] = False
    is_known[35, 45] = True
    smooth = smooth_inverse_depth(e, is_known, X, Y, 1.0)
    assert smooth[35, 45] == pytest.approx(e[35, 45], rel=1e-12)
    assert np.abs(smooth[34:37, 44:47] / e[35, 45] - 1).max() < 0.1


def test_pixels_in_a_line_are_level_across() -> None:
    """They have no slope across: rows are alike, and the mean is theirs."""
    e, is_known = np.random.default_rng(3).random((30, 40)), np.zeros((30, 40), bool)
    is_known[7, 5:9] = True
    smooth = smooth_inverse_depth(e, is_known, X[:30, :40], Y[:30, :40], 2.0)
    assert np.ptp(smooth, axis=0).max() < 1e-9
    assert smooth[:, 5:9].mean() == pytest.approx(e[7, 5:9].mean(), rel=1e-2)  # by nearly equal weights


@pytest.mark.parametrize("deviation", [0.5, 3.0, 40.0])
def test_filter_is_gaussian(deviation: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the rows and columns of the targets, also in blocks, it is SciPy's filter with zeros outside."""
    monkeypatch.setattr(smoothing, "BLOCK_ROWS", 7)
    random = np.random.default_rng(2)
    is_source, is_target = (random.random((HEIGHT, WIDTH)) < 0.01 for _ in range(2))
    is_source[:20], is_target[:, 70:110] = False, False
    values = np.where(is_source, random.random(is_source.shape), 0)
    gaussian = smoothing._Gaussian(deviation, is_source, is_target)
    expected = gaussian_filter(values, deviation, mode="constant", truncate=8)
    # Sums of about 200 numbers below 1.
    assert np.abs(gaussian.filter(values) - expected[gaussian.at]).max() < 1e-14
    assert gaussian.at[0].size < HEIGHT
