from __future__ import annotations

from collections.abc import Iterator

import pytest

from taichi_msm.sweeps.pool import Pool

# Files of a camera with pictures of 40 x 30 pixels.
CALIBRATION = "K: [50, 0, 20, 0, 50, 15, 0, 0, 1]\nD: [0, 0, 0, 0]\nwidth: 40\nheight: 30\n"
POSES = "0 0 0 0.4 1 0 0 0\n999 0 0 0.5 1 0 0 0\n"


@pytest.fixture(scope="package")
def pool() -> Iterator[Pool]:
    """A process that executes the runs of many sweeps."""
    pool = Pool(1)
    yield pool
    pool.shutdown()
