from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from taichi_msm.system import process
from taichi_msm.system.runtime import Device


@pytest.fixture(scope="module", autouse=True)
def threads_of_the_device(device: Device) -> Iterator[None]:
    """By default a fit takes all cores, but a process has a single device."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "available_threads", lambda: device.threads)
        yield


def with_keys(data: dict[str, Any], **keys: Any) -> dict[str, Any]:
    """Data of a scene with changed values, by dotted paths with __ for the dots."""
    data = json.loads(json.dumps(data))
    for key, value in keys.items():
        *sections, name = key.split("__")
        holder: Any = data
        for section in sections:
            holder = holder[int(section) if section.isdigit() else section]
        holder[name] = value
    return data
