"""The shipped sweep files, and their pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes.textures.make_mucosa import FOLDER, PICTURES, paint
from taichi_msm.load.scene_file import plan_file
from taichi_msm.sweeps.spec import load_sweep


def test_runs_of_the_data_set_are_valid(root: Path) -> None:
    sweep = load_sweep(root / "scenes/sweeps/tracking.yaml")
    plans = [plan_file(sweep.scene, sweep.overrides(values)) for values in sweep.values()]
    assert len(plans) == 64
    assert {plan.scene.time.frames for plan in plans} == {30}
    assert {Path(str(plan.scene.image)).name for plan in plans} | {"mucosa.png"} == {
        Path(name).name for name in PICTURES
    }


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if "pale" in name else pytest.mark.slow) for name in PICTURES]
)
def test_shipped_pictures_are_those_of_their_script(name: str) -> None:
    painted, shipped = (
        np.asarray(image.convert("RGB"), dtype=float) for image in (paint(PICTURES[name]), Image.open(FOLDER / name))
    )
    # Rounding on other machines may change a colour by one, and with it the choice of 256 colours.
    assert np.abs(painted - shipped).mean() < 1
