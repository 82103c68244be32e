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
from taichi_msm.machines.reader import read_machine_test
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
def test_table_of_a_ball(device: Device, root: Path) -> None:
    """Its intervals contain the values of the script that made it, and the values of the scene that it kept."""
    made = runpy.run_path(str(root / "examples" / "make_ball.py"))
    truth = made["TRUTH"] | {
        "tissue.relaxation.1.share": 0.2,
        "tissue.relaxation.1.time": 4,
        "contact": made["CONTACT"],
    }
    table = root / "examples" / "ball.csv"
    noise = read_machine_test(table).force - made["OFFSET"] - made["forces"]()
    assert noise.std() == pytest.approx(made["NOISE"], rel=0.2)  # of 281 numbers, 4.7 standard deviations
    result = taichi_msm.fit(root / "examples" / "ball.yaml", table, list(truth), workers=1)
    assert not result.model_rejected
    for key, value in truth.items():
        low, high = result.parameters[key].interval
        assert low < value < high, key
    assert abs(result.tests[0].loading.offset - made["OFFSET"]) < 3 * result.tests[0].offset_error


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
