"""The examples do what they say; those that need packages that the program does not are skipped without them."""

from __future__ import annotations

import runpy
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import taichi_msm
from taichi_msm.system.runtime import Device


def test_the_environment_passes_gymnasiums_checks_and_reaches_its_force(
    device: Device, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checker = pytest.importorskip("gymnasium.utils.env_checker")
    # A process has one number of threads.
    monkeypatch.setattr(taichi_msm, "Simulation", partial(_simulation, device.threads), raising=False)
    made = runpy.run_path(str(root / "examples" / "gym_env.py"))["Palpation"]()
    checker.check_env(made, skip_render_check=True)
    picture, _ = made.reset(seed=1)
    assert picture.std() > 10
    down, ended, rewards = np.ones(1, np.float32), False, []
    while not ended:
        _, reward, ended, late, info = made.step(down)
        rewards.append(reward)
        assert not late
    # The force was below 0.5 N one frame, half a millimetre, before.
    assert 0.5 <= info["force"] < 0.6
    assert rewards[-1] == pytest.approx(0.5 - info["force"])
    assert rewards[-1] > min(rewards) == rewards[0]
    made.simulation.close()


def _simulation(device_threads: int, scene: taichi_msm.Scene, threads: int) -> taichi_msm.Simulation:
    from taichi_msm.runs.simulation import Simulation

    assert threads == 1
    return Simulation(scene, threads=device_threads)


@pytest.mark.slow
def test_four_environments_run_in_spawned_processes(root: Path) -> None:
    pytest.importorskip("gymnasium")
    done = subprocess.run(
        [sys.executable, "examples/gym_env.py"], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("four fingers feel 0.5"), done.stderr
    # A process may end with an open simulation.
    code = "from examples.gym_env import Palpation; made = Palpation(); made.reset(seed=0)"
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
