"""The form for GPUs, on a Vulkan that needs none: Mesa's lavapipe."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from taichi_msm import run
from taichi_msm.results.flo import read_flo
from taichi_msm.scenefile.load import load_scene
from taichi_msm.system.runtime import Device
from tests.outputs import results

DRIVERS = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))

pytestmark = pytest.mark.skipif(not DRIVERS, reason="needs mesa-vulkan-drivers")

SETTINGS = [
    "probes.0.at=[[0, 0.2, 0.5], [0.2, 0.8, 0.5], [0.2, 0.4, 0.4]]",
    "sheet.fixed=[top, left]",
    "render={size: [80, 60], camera: oblique, wireframe: true, shading: tissue}",
    "probes.0.instrument={radius: 0.01, shaft: [1, -0.4, 0.7], length: 0.1}",
    "output=[png, trajectory, coordinates, depth, flow, occlusion]",
]

# A run, one that is interrupted and resumed, and one that diverges, in one process.
RUNS = """
import json, sys
from taichi_msm.physics import diagnosis
from taichi_msm import load_scene, resume, run
from tests.test_resume import Stop

# Finer steps, with all of which it diverges, take long here.
diagnosis.CUTS = (2,)
settings = json.loads(sys.argv[1])
made = load_scene("small.yaml", settings)
records = [run(made, "whole", arch="vulkan")]
records.append(run(made, "parts", arch="vulkan", progress=Stop(8)))
records.append(resume("parts"))
wild = load_scene("small.yaml", [*settings, "probes.0.force=[0, 0, -1.0e+12]"])
records.append(run(wild, "wild", arch="vulkan"))
facts = ("status", "arch", "device", "error")
json.dump([[record.get(key) for key in facts] for record in records], sys.stdout)
"""


def vulkan(driver: str, *command: str, root: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "VK_DRIVER_FILES": driver, "VK_ICD_FILENAMES": driver, "PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False, timeout=300, env=environment
    )


def test_runs_on_a_gpu_are_those_on_the_cpu(small: Path, root: Path, device: Device) -> None:
    """To rounding and one grey level; to the bit when one is resumed; and one that diverges is found."""
    done = vulkan(str(DRIVERS[0]), "-c", RUNS, json.dumps(SETTINGS), root=root)
    assert done.returncode == 0, done.stderr
    whole, parts, resumed, wild = json.loads(done.stdout)
    statuses = ["complete", "interrupted", "complete", "diverged"]
    assert [record[:2] for record in (whole, parts, resumed, wild)] == [[status, "vulkan"] for status in statuses]
    assert whole[2].startswith("llvmpipe")
    assert "likely cause: probes.0.force" in wild[3]
    assert results(small / "parts") == results(small / "whole")

    run(load_scene("small.yaml", SETTINGS), "cpu", threads=device.threads)
    there, here = (np.load(small / name / "trajectory.npz")["position"] for name in ("whole", "cpu"))
    # Some 164 steps of a sheet of 0.4 m, each of which may round otherwise.
    assert np.abs(there - here).max() < 164 * 0.4 * 2.0**-24
    assert np.abs(here - here[0]).max() > 0.01
    for frame in range(len(here)):
        pictures = [np.asarray(Image.open(f"{name}/frames/{frame:04}.png")).astype(int) for name in ("whole", "cpu")]
        # A point that rounds otherwise may move an edge past a pixel's centre.
        assert (np.abs(pictures[0] - pictures[1]) > 1).mean() < 0.002
        depths = [np.asarray(Image.open(f"{name}/depth/{frame:04}.tiff")) for name in ("whole", "cpu")]
        assert (np.abs(depths[0] - depths[1]) > 1e-5).mean() < 0.002
    for frame in range(len(here) - 1):
        flows = [read_flo(small / f"{name}/flow/{frame:04}.flo", (80, 60)) for name in ("whole", "cpu")]
        assert (np.abs(flows[0] - flows[1]).max(axis=-1) > 0.01).mean() < 0.002
        masks = [np.asarray(Image.open(f"{name}/occlusion/{frame:04}.png")) for name in ("whole", "cpu")]
        assert (masks[0] != masks[1]).mean() < 0.002


def test_without_a_gpu_it_is_one_line(small: Path, root: Path) -> None:
    done = vulkan("/nonexistent", "-m", "taichi_msm", "run", "small.yaml", "--arch", "vulkan", root=root)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "--arch vulkan: not available on this machine; take --arch cpu\n"


def test_what_it_cannot_do_is_one_line(small: Path, root: Path) -> None:
    settings = ["--set", SETTINGS[0], "--set", "time.precision=f64"]
    done = vulkan(str(DRIVERS[0]), "-m", "taichi_msm", "run", "small.yaml", "--arch", "vulkan", *settings, root=root)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("--arch vulkan: has no exp in f64, which control points that move need; take time.")
    assert done.stderr.count("\n") == 1
