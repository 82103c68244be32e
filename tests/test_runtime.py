"""What Taichi is told at its start and around a launch."""

from __future__ import annotations

import os

import pytest

from taichi_msm import runtime
from taichi_msm.runtime import Device


@pytest.mark.parametrize(("cores", "pinned"), [({4, 7}, {11: {4}, 12: {7}}), ({4, 5, 7}, {})])
def test_threads_that_take_all_cores_have_one_each(
    cores: set[int], pinned: dict[int, set[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a core to spare another program's threads may be there, and the system should choose."""
    found: dict[int, set[int]] = {}
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: cores, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", found.__setitem__, raising=False)
    runtime._pin([11, 12])
    assert found == pinned


def test_a_quick_compilation_is_for_one_kernel(device: Device) -> None:
    config = runtime.ti.lang.impl.current_cfg()
    with pytest.raises(KeyboardInterrupt), runtime.quick_compilation():
        assert not config.advanced_optimization
        raise KeyboardInterrupt
    assert config.advanced_optimization
