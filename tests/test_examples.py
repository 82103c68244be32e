"""The examples; skipped without packages that the program does not need."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taichi_msm
from taichi_msm.runs.simulation import Simulation
from taichi_msm.system.runtime import Device


def test_gymnasium_environment(device: Device, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checker = pytest.importorskip("gymnasium.utils.env_checker")

    def simulation(scene: taichi_msm.Scene, threads: int) -> Simulation:
        assert threads == 1
        # A process has a single number of threads.
        return Simulation(scene, threads=device.threads)

    monkeypatch.setattr(taichi_msm, "Simulation", simulation, raising=False)
    environment: Any = runpy.run_path(str(root / "examples" / "gym_env.py"))["Palpation"]()
    checker.check_env(environment, skip_render_check=True)
    picture, _ = environment.reset(seed=1)
    assert picture.std() > 10
    terminated, rewards = False, []
    while not terminated:
        _, reward, terminated, truncated, info = environment.step(np.ones(1, np.float32))
        rewards.append(reward)
        assert not truncated
    # The force was below 0.5 N in the frame before, half a millimetre higher.
    assert 0.5 <= info["force"] < 0.6
    assert rewards[-1] == pytest.approx(0.5 - info["force"])
    assert rewards[-1] > min(rewards) == rewards[0]
    environment.simulation.close()


@pytest.mark.slow
def test_four_environments_in_spawned_processes(root: Path) -> None:
    pytest.importorskip("gymnasium")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, *arguments], cwd=root, capture_output=True, text=True, check=False)

    done = run("examples/gym_env.py")
    assert done.stdout.startswith("four fingers feel 0.5"), done.stderr
    # A process may end with an open simulation.
    done = run("-c", "from examples.gym_env import Palpation; made = Palpation(); made.reset(seed=0)")
    assert (done.returncode, done.stderr) == (0, "")
