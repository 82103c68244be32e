"""Cache of arrays: bounds, and order of removal."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.system import array_cache
from taichi_msm.system.array_cache import cached_arrays


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_cache, "_arrays", OrderedDict())


def is_cached(key: int, size: int) -> bool:
    """Request an array of this size [bytes]."""
    computed = False

    def compute() -> tuple[NDArray[Any]]:
        nonlocal computed
        computed = True
        return (np.zeros(size, np.uint8),)

    (array,) = cached_arrays(key, compute)
    assert array.nbytes == size
    assert not array.flags.writeable
    return not computed


def test_least_recently_used_arrays_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_cache, "MAX_BYTES", 100)
    assert [is_cached(key, 40) for key in (1, 2, 1)] == [False, False, True]
    # 2 was used before 1; 80 + 40 bytes exceed the limit.
    assert [is_cached(key, 40) for key in (3, 1, 2)] == [False, True, False]
    # Larger than the limit: returned, but not kept.
    assert [is_cached(4, 101) for _ in range(2)] == [False, False]
    assert not array_cache._arrays


def test_number_of_keys_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_cache, "MAX_KEYS", 2)
    assert [is_cached(key, 0) for key in (1, 2, 3, 2, 1)] == [False, False, False, True, False]
