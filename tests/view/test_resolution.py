"""Size of the picture of a page."""

from __future__ import annotations

import math

from taichi_msm.view.resolution import LEVELS, MAX_PIXELS, MEASURED, MIN_RATE, Resolution


def settled(resolution: Resolution, cost: float, load: float) -> tuple[int, int]:
    """Return the size after many pictures with a cost [s/px]."""
    for _ in range(2 * LEVELS * MEASURED):
        resolution.measure(cost * math.prod(resolution.size), load)
    return resolution.size


def test_fast_machine_draws_the_pixels_of_the_screen() -> None:
    resolution = Resolution((512, 384))
    resolution.set_width(800)
    assert resolution.size == (512, 384), "at the start"
    assert settled(resolution, 1e-9, 0.5) == (800, 600)
    resolution.set_width(300)
    assert resolution.size == (512, 384), "never smaller than the scene's"


def test_slow_machine_draws_in_time() -> None:
    resolution = Resolution((512, 512))
    resolution.set_width(1024)
    # At 640 x 640 a picture takes half of the time that is left; at 1024 x 1024, 1.28 of it.
    cost = 0.5 * 0.5 / MIN_RATE / 640**2
    width, height = settled(resolution, cost, 0.5)
    assert 512 < width < 1024
    assert cost * width * height <= 0.5 / MIN_RATE
    assert settled(resolution, cost, 1.2) == (512, 512), "no time is left"


def test_pages_cannot_ask_for_more_pixels() -> None:
    resolution = Resolution((512, 512))
    resolution.set_width(1e12)
    assert math.prod(settled(resolution, 1e-12, 0.0)) <= MAX_PIXELS * (1 + 1e-3)
    resolution.set_width(-1e12)
    assert resolution.size == (512, 512)
