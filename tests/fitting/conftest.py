from __future__ import annotations

from collections.abc import Iterator

import pytest

from taichi_msm.system import process
from taichi_msm.system.runtime import Device


@pytest.fixture(scope="module", autouse=True)
def one_device(device: Device) -> Iterator[None]:
    """A fit takes every core, and a process has one device."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "available_threads", lambda: device.threads)
        yield
