"""The labels of a run agree with each other, with its trajectory and with its cameras, to their bounds."""

from __future__ import annotations

from pathlib import Path

import pytest

from taichi_msm import run
from taichi_msm.system.runtime import Device
from tests.consistency import AGREEMENTS, CAMERAS, STEREO, measured, scene


# The other cameras are compared with the twin in tests/render.
@pytest.mark.default_cases("rational", "moving")
@pytest.mark.parametrize("camera", CAMERAS)
def test_labels_agree(camera: str, tmp_path: Path, device: Device) -> None:
    run(scene(CAMERAS[camera]), tmp_path, threads=device.threads, estimate_error=False)
    worst = measured(tmp_path, camera, device.threads)
    assert len(worst) == 9 + (camera in STEREO) * (3 if camera == "intrinsics" else 2)
    # Written so that NaN is found too.
    assert not {what: apart for what, apart in worst.items() if not apart <= AGREEMENTS[what].bound}
