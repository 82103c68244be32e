from __future__ import annotations

from collections.abc import Iterator

import pytest

from taichi_msm.sweeps.pool import Pool


@pytest.fixture(scope="package")
def pool() -> Iterator[Pool]:
    """A process that has started once for many sweeps."""
    pool = Pool(1)
    yield pool
    pool.shutdown()
