"""The form for GPUs, on a Vulkan that needs none: Mesa's lavapipe."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import run
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_capsules
from taichi_msm.render.camera import view
from taichi_msm.render.labels import track_grid
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.runs.arrays import read_flo
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.outputs import results
from tests.render.test_rasterizer import dented, drawable, with_instruments
from tests.scenes import speckle
from tests.terms.test_contact import moved, touching

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
from taichi_msm.accuracy import diagnosis
from taichi_msm import load_scene, resume, run
from tests.runs.test_resume import Stop

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


# A run in the current directory.
TOUCHING = """
from taichi_msm import run
from tests.render.test_vulkan import touched
print(run(touched(), "there", arch="vulkan")["arch"])
"""


def touched() -> Scene:
    """A tool that presses, rubs, grips and lets go."""
    keys = [0, 0.4, 0.5, 0.0], [0.1, 0.4, 0.5, -0.03], [0.2, 0.6, 0.45, -0.03], [0.4, 0.6, 0.5, 0.03]
    made = touching([moved(*keys, friction=0.3, grip=[[0.2, 0.3]])], time={"precision": "f32"})
    return made.model_copy(update={"output": ("trajectory", "forces")})


def test_tools_touch_on_a_gpu_as_on_the_cpu(
    tmp_path: Path, root: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = vulkan(str(DRIVERS[0]), "-c", TOUCHING, root=root)
    assert (done.returncode, done.stdout) == (0, "vulkan\n"), done.stderr
    run(touched(), "here", threads=device.threads)
    there, here = (np.load(f"{name}/trajectory.npz")["position"] for name in ("there", "here"))
    # 60 steps of a sheet of 0.4 m.
    assert np.abs(there - here).max() < 60 * 0.4 * 2.0**-24
    assert np.abs(here - here[0]).max() > 0.02
    there, here = (np.loadtxt(f"{name}/forces.csv", delimiter=",", skiprows=1)[:, 5:] for name in ("there", "here"))
    # Either is within 2e-3 of the twin's (tests/runs/test_forces.py).
    assert np.abs(there - here).max() < 4e-3 * np.abs(here).max()


# Prints what `looks` gives, by name, into a file.
LOOKS = """
import sys
import numpy as np
from taichi_msm.system import runtime
from tests.render.test_vulkan import bent_looks, looks
runtime.start("vulkan")
np.savez(sys.argv[1], **(bent_looks() if "bent" in sys.argv else looks()))
"""

# Prints by how much the process grows while it draws and finds as often as before [bytes].
AGAIN = """
import os
from pathlib import Path
from tests.render.test_vulkan import Rasterizer, drawable, locate_points, rest_positions, speckle, track_grid, view
from taichi_msm.system import runtime

def again():
    for _ in range(3):
        drawing.draw(position)
        locate_points(made, track_grid(2), position, view(made))
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

runtime.start("vulkan")
made = drawable((200, 200), size=[128, 96], refine=0)
drawing, position = Rasterizer(made, speckle(8, 8)), rest_positions(made.sheet)
print(-again() + again())
"""

# A run with threads that have no bound.
CUT_SHORT = """
import sys
from taichi_msm.cli.main import main
from taichi_msm.system import launches
launches.MAX_ROUNDS = 1 << 30
sys.exit(main(sys.argv[1:]))
"""

# All of the sheet is in the middle four of 4 x 4 pixels.
TINY = {"eye": [0, 0, 4], "fov": 10}


def looks() -> dict[str, NDArray[Any]]:
    """Draw and find, on the device that was started, what one thread alone would take long for."""
    seen: dict[str, NDArray[Any]] = {}
    made = with_instruments(
        drawable(
            (121, 121), size=[512, 512], camera="oblique", supersample=2, wireframe=True, shading="tissue",
            light={"relief": -0.2, "vignette": 0.3},
        )
    )  # fmt: skip
    position, view_now = draped(made), view(made)
    placed, texture = place_capsules(made, position, 0), speckle(300, 400)
    seen["picture"] = Rasterizer(made, texture).draw(position, rods=placed)
    labels = (
        Rasterizer(made, texture, drawing_config(made, picture=False, labels=True)).look(position, rods=placed).labels
    )
    assert labels is not None
    seen |= {f"label_{name}": value for name, value in labels._asdict().items()}
    moved = position + np.array([0.002, 0.001, 0])
    seen["flow"], seen["occlusion"] = compute_flow(
        made, labels.coordinates, moved, view_now, place_capsules(made, moved, 0)
    )
    rough = position + np.random.default_rng(5).normal(0, 0.004, position.shape)
    seen["pixels"], seen["hidden"] = locate_points(made, track_grid(60), rough, view_now, placed)
    # One cell, larger than the picture, which is a single row.
    made = drawable((2, 2), size=[1400, 1], refine=0, supersample=4, camera={"eye": [0, 0, 1e-4]})
    seen["row"] = Rasterizer(made, texture).draw(rest_positions(made.sheet))
    # More cells in a bin than a thread may try.
    made = drawable((200, 200), size=[4, 4], refine=0, camera=TINY)
    seen["dot"] = Rasterizer(made, texture).draw(dented(made))
    return seen


def bent_looks() -> dict[str, NDArray[Any]]:
    """Draw and find what lenses bend, on the device that was started; one shows nothing beyond its limit."""
    seen: dict[str, NDArray[Any]] = {}
    intrinsics = {"fx": 240, "fy": 248, "cx": 148, "cy": 124}
    for model, k1 in (("pinhole", -0.5), ("fisheye", -0.05)):
        camera = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "intrinsics": intrinsics, "outside": "background"}
        camera["distortion"] = {"model": model, "k1": k1, "k2": 0.01}
        made = with_instruments(drawable((41, 41), size=[320, 240], camera=camera, shading="tissue", wireframe=True))
        position, view_now, texture = draped(made), view(made), speckle(300, 400)
        placed = place_capsules(made, position, 0)
        drawn = Rasterizer(made, texture, drawing_config(made, labels=True)).look(position, rods=placed)
        assert drawn.labels is not None
        seen[f"{model}_picture"] = np.asarray(drawn.picture)
        seen |= {f"{model}_{name}": value for name, value in drawn.labels._asdict().items()}
        moved = position + np.array([0.002, 0.001, 0])
        placed_then = place_capsules(made, moved, 0)
        flow = compute_flow(made, drawn.labels.coordinates, moved, view_now, placed_then)
        seen[f"{model}_flow"], seen[f"{model}_occlusion"] = flow
        seen[f"{model}_pixels"], seen[f"{model}_hidden"] = locate_points(
            made, track_grid(60), position, view_now, placed
        )
    return seen


def draped(made: Scene) -> NDArray[np.float64]:
    """A sheet with a dent, whose right third is folded over the middle."""
    position = rest_positions(made.sheet)
    x, y = position[..., 0], position[..., 1]
    position[..., 2] = -0.05 * np.exp(-((x + 0.1) ** 2 + y**2) / 0.005) + 0.06 / (1 + np.exp((0.08 - x) / 0.005))
    position[..., 0] = np.where(x > 0.08, 0.16 - x, x)
    return position


@pytest.mark.slow
def test_large_pictures_labels_and_tracks_are_those_of_the_cpu(tmp_path: Path, root: Path, device: Device) -> None:
    done = vulkan(str(DRIVERS[0]), "-c", LOOKS, str(tmp_path / "seen.npz"), root=root)
    assert done.returncode == 0, done.stderr
    there, here = np.load(tmp_path / "seen.npz"), looks()
    # f32 has a place in 512 pixels to 2^-15 px. So of all outlines, some 5,000 px long, less than a pixel's centre lies
    # where they may be drawn otherwise, and in the picture four samples; 26 pixels are allowed.
    for name in ("picture", "row", "dot"):
        same_picture(there[name], here[name])
    for name in ("label_coordinates", "label_depth", "flow", "pixels"):
        same_numbers(there[name], here[name])
    for name in ("label_instrument", "occlusion", "hidden"):
        same_mask(there[name], here[name])


def test_bent_pictures_labels_and_tracks_are_those_of_the_cpu(tmp_path: Path, root: Path, device: Device) -> None:
    done = vulkan(str(DRIVERS[0]), "-c", LOOKS, str(tmp_path / "seen.npz"), "bent", root=root)
    assert done.returncode == 0, done.stderr
    there, here = np.load(tmp_path / "seen.npz"), bent_looks()
    for model in ("pinhole", "fisheye"):
        same_picture(there[f"{model}_picture"], here[f"{model}_picture"])
        for name in ("coordinates", "depth", "flow", "pixels"):
            same_numbers(there[f"{model}_{name}"], here[f"{model}_{name}"])
        for name in ("instrument", "occlusion", "hidden"):
            same_mask(there[f"{model}_{name}"], here[f"{model}_{name}"])
    assert np.isnan(here["pinhole_coordinates"][0, 0]).all(), "beyond the limit"


def same_picture(there: NDArray[Any], here: NDArray[Any]) -> None:
    assert here.std() > 20, "something is drawn"
    apart = np.abs(there.astype(int) - here.astype(int)).max(axis=-1)
    assert (apart > 1).mean() < 1e-4
    assert (apart == 1).mean() < 1e-3


def same_numbers(there: NDArray[Any], here: NDArray[Any]) -> None:
    # NaN where no sheet is seen.
    assert (~np.isclose(there, here, rtol=1e-5, atol=1e-5, equal_nan=True)).mean() < 1e-4


def same_mask(there: NDArray[Any], here: NDArray[Any]) -> None:
    assert 0 < (here > 0).mean() < 1, "some are, some are not"
    assert (there != here).mean() < 1e-4


@pytest.mark.slow
def test_what_a_picture_takes_is_given_back(root: Path) -> None:
    done = vulkan(str(DRIVERS[0]), "-c", AGAIN, root=root)
    assert done.returncode == 0, done.stderr
    # Bounds and owners of 199 x 199 cells alone are 24 bytes each, and were kept 3 times.
    assert int(done.stdout) < 3 * 24 * 199**2 / 2


@pytest.mark.parametrize("output", ["png", *(pytest.param(one, marks=pytest.mark.slow) for one in ("depth", "tracks"))])
def test_a_kernel_that_is_cut_short_is_an_error_of_one_line(output: str, small: Path, root: Path) -> None:
    """And nothing of it is kept."""
    settings = [
        # More cells than llvmpipe's 65,535 rounds.
        "sheet.points=[300, 300]",
        "time.duration=0.1",
        f"output=[{output}]",
        f"render={{size: [4, 4], refine: 0, camera: {json.dumps(TINY)}}}",
    ]
    words = ["run", "small.yaml", "--arch", "vulkan", *(word for setting in settings for word in ("--set", setting))]
    done = vulkan(str(DRIVERS[0]), "-c", CUT_SHORT, *words, root=root)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert done.stderr.startswith("--arch vulkan: the device left out part of the work")
    assert done.stderr.endswith("take --arch cpu\n")
    assert done.stderr.count("\n") == 1
    assert not [path for path in (small / "output").rglob("*") if path.is_file()]


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
