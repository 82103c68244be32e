"""GPU kernels on a CPU, by Mesa's Vulkan driver lavapipe."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import run
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.render.camera import Shot, view
from taichi_msm.render.labels import requested_labels, track_grid
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.runs.arrays import read_flo
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import write_small
from tests.golden import Messages
from tests.outputs import results
from tests.render.test_rasterizer import dented, drawable, with_instruments
from tests.scenes import speckle
from tests.terms.test_contact import moved, touching

# Mesa's driver; empty if it is not installed.
DRIVER = next(map(str, Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")), "")

pytestmark = pytest.mark.skipif(not DRIVER, reason="needs mesa-vulkan-drivers")

SETTINGS = [
    "probes.0.at=[[0, 0.2, 0.5], [0.2, 0.8, 0.5], [0.2, 0.4, 0.4]]",
    "sheet.fixed=[top, left]",
    "render={size: [80, 60], camera: oblique}",
    "probes.0.instrument={radius: 0.01, shaft: [1, -0.4, 0.7], length: 0.1}",
    "output=[png, trajectory, coordinates, depth, flow, occlusion]",
]

# Four runs in one process: complete, interrupted and resumed, with contact, diverging.
RUNS = """
import json, sys
from taichi_msm import DivergedError, Simulation, load_scene, resume, run
from tests.render.test_vulkan import SETTINGS, contact_scene
from tests.runs.test_resume import Stop

made, options = load_scene("small.yaml", SETTINGS), {"arch": "vulkan", "estimate_error": False}
records = [run(made, "complete", **options), run(made, "resumed", **options, progress=Stop(8)), resume("resumed")]
records.append(run(contact_scene(), "contact", **options))
summary = [[record.get(key) for key in ("status", "arch", "device")] for record in records]
diverging = load_scene("small.yaml", [*SETTINGS, "probes.0.force=[0, 0, -1.0e+12]"])
try:
    Simulation(diverging, arch="vulkan").advance(4)
except DivergedError as error:
    summary.append(["diverged", error.time])
json.dump(summary, sys.stdout)
"""


def vulkan(driver: str, *command: str, root: Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "VK_DRIVER_FILES": driver, "VK_ICD_FILENAMES": driver, "PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False, timeout=300, env=environment, cwd=cwd
    )


@pytest.fixture(scope="module")
def runs(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    """The folder of the runs, and status, arch and device of each."""
    folder = tmp_path_factory.mktemp("vulkan")
    write_small(folder)
    done = vulkan(DRIVER, "-c", RUNS, root=root, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.slow
def test_runs_match_the_cpu(runs: tuple[Path, list[Any]], device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """To rounding and one grey level; a resumed run has the same bits; a diverging one is found."""
    folder, records = runs
    monkeypatch.chdir(folder)
    statuses = ["complete", "interrupted", "complete", "complete"]
    assert [record[:2] for record in records[:-1]] == [[status, "vulkan"] for status in statuses]
    assert records[0][2].startswith("llvmpipe")
    assert records[-1][0] == "diverged"
    assert results(Path("resumed")) == results(Path("complete"))

    run(load_scene("small.yaml", SETTINGS), "cpu", threads=device.threads, estimate_error=False)
    found, expected = (np.load(f"{name}/trajectory.npz")["position"] for name in ("complete", "cpu"))
    # Some 164 steps of a sheet of 0.4 m, each of which may round differently.
    assert np.abs(found - expected).max() < 164 * 0.4 * 2.0**-24
    assert np.abs(expected - expected[0]).max() > 0.01

    def error(file: str, read: Callable[[str], Any]) -> NDArray[np.float64]:
        return np.abs(np.subtract(read(f"complete/{file}"), read(f"cpu/{file}"), dtype=float))

    def pixels(path: str) -> NDArray[Any]:
        return np.asarray(Image.open(path))

    # A point that rounds differently may move an edge past a pixel's centre.
    for frame in range(len(expected)):
        assert (error(f"frames/{frame:04}.png", pixels) > 1).mean() < 0.002
        assert (error(f"depth/{frame:04}.tiff", pixels) > 1e-5).mean() < 0.002
    for frame in range(len(expected) - 1):
        flow = error(f"flow/{frame:04}.flo", lambda path: read_flo(Path(path), (80, 60)))
        assert (flow.max(axis=-1) > 0.01).mean() < 0.002
        assert (error(f"occlusion/{frame:04}.png", pixels) > 0).mean() < 0.002


def contact_scene() -> Scene:
    """A tool that presses, rubs, grips and lets go."""
    keys = [0, 0.4, 0.5, 0.0], [0.1, 0.4, 0.5, -0.03], [0.2, 0.6, 0.45, -0.03], [0.4, 0.6, 0.5, 0.03]
    made = touching([moved(*keys, friction=0.3, grip=[[0.2, 0.3]])], time={"precision": "f32"})
    return made.model_copy(update={"output": ("trajectory", "forces")})


@pytest.mark.slow
def test_contact_matches_the_cpu(runs: tuple[Path, list[Any]], device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs[0])
    run(contact_scene(), "contact-cpu", threads=device.threads, estimate_error=False)
    found, expected = (np.load(f"{name}/trajectory.npz")["position"] for name in ("contact", "contact-cpu"))
    # 60 steps of a sheet of 0.4 m.
    assert np.abs(found - expected).max() < 60 * 0.4 * 2.0**-24
    assert np.abs(expected - expected[0]).max() > 0.02
    tables = (np.loadtxt(f"{name}/forces.csv", delimiter=",", skiprows=1) for name in ("contact", "contact-cpu"))
    found, expected = (table[:, 5:] for table in tables)
    # Each is within 2e-3 of the twin's (tests/runs/test_forces.py).
    assert np.abs(found - expected).max() < 4e-3 * np.abs(expected).max()


# Writes arrays of a case into a file, by name.
DRAW = """
import sys
import numpy as np
from taichi_msm.system import runtime
from tests.render.test_vulkan import CASES
runtime.start("vulkan")
np.savez(sys.argv[1], **CASES[sys.argv[2]]())
"""

# Prints the growth of the process during the second of two equal series of pictures and tracks [bytes].
GROWTH = """
import os
from pathlib import Path
from tests.render.test_vulkan import (
    Rasterizer, Shot, drawable, locate_points, rest_positions, speckle, track_grid, view,
)
from taichi_msm.system import runtime

def memory():
    for _ in range(3):
        rasterizer.draw(position)
        locate_points(made, track_grid(2), Shot(position, view(made)))
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

runtime.start("vulkan")
made = drawable((200, 200), size=[128, 96], refine=0)
rasterizer, position = Rasterizer(made, speckle(8, 8)), rest_positions(made.sheet)
print(-memory() + memory())
"""

# A run with threads that have no bound.
UNBOUNDED = """
import sys
from taichi_msm.cli.main import main
from taichi_msm.system import launches
launches.MAX_ROUNDS = 1 << 30
sys.exit(main(sys.argv[1:]))
"""

# The whole sheet is in the middle four of 4 x 4 pixels.
TINY = {"eye": [0, 0, 4], "fov": 10}


def draw_all(made: Scene, texture: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Picture, labels, flow and tracks on the started device, of a dented sheet with a fold."""
    position = rest_positions(made.sheet)
    x, y = position[..., 0], position[..., 1]
    position[..., 2] = -0.05 * np.exp(-((x + 0.1) ** 2 + y**2) / 0.005) + 0.06 / (1 + np.exp((0.08 - x) / 0.005))
    position[..., 0] = np.where(x > 0.08, 0.16 - x, x)
    camera, placed = view(made), place_instruments(made, position, 0)
    result: dict[str, NDArray[Any]] = {"picture": Rasterizer(made, texture).draw(position, instruments=placed)}
    config = drawing_config(made, picture=False, labels=requested_labels(()))
    labels = Rasterizer(made, texture, config).render(position, instruments=placed).labels
    assert labels is not None
    result |= {name: value for name, value in labels._asdict().items() if value.size}
    shifted = position + np.array([0.002, 0.001, 0])
    result["flow"], result["occlusion"] = compute_flow(
        made, labels.coordinates, Shot(shifted, camera, place_instruments(made, shifted, 0))
    )
    rough = position + np.random.default_rng(5).normal(0, 0.004, position.shape)
    result["pixels"], result["hidden"] = locate_points(made, track_grid(60), Shot(rough, camera, placed))
    return result


def large_case() -> dict[str, NDArray[Any]]:
    """Pictures whose samples would take long in a single launch."""
    render = {"shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}, "wireframe": True, "supersample": 2}
    texture = speckle(300, 400)
    result = draw_all(with_instruments(drawable((121, 121), size=[512, 512], camera="oblique", **render)), texture)
    # A cell larger than the picture, which is a single row.
    made = drawable((2, 2), size=[1400, 1], refine=0, supersample=4, camera={"eye": [0, 0, 1e-4]})
    result["picture_row"] = Rasterizer(made, texture).draw(rest_positions(made.sheet))
    # More cells in a bin than a thread may process.
    made = drawable((200, 200), size=[4, 4], refine=0, camera=TINY)
    result["picture_dot"] = Rasterizer(made, texture).draw(dented(made))
    return result


def lens_case(model: str, k1: float) -> dict[str, NDArray[Any]]:
    """Lens distortion; the pinhole's limit is within the picture."""
    camera = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "outside": "background"}
    camera["intrinsics"] = {"fx": 240, "fy": 248, "cx": 148, "cy": 124}
    camera["distortion"] = {"model": model, "k1": k1, "k2": 0.01}
    made = drawable((41, 41), size=[320, 240], camera=camera, shading="tissue", wireframe=True)
    return draw_all(with_instruments(made), speckle(300, 400))


CASES: dict[str, Callable[[], dict[str, NDArray[Any]]]] = {
    "large": large_case,
    "pinhole": partial(lens_case, "pinhole", -0.5),
    "fisheye": partial(lens_case, "fisheye", -0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_pictures_labels_and_tracks_match_the_cpu(case: str, tmp_path: Path, root: Path, device: Device) -> None:
    done = vulkan(DRIVER, "-c", DRAW, str(tmp_path / "arrays.npz"), case, root=root)
    assert done.returncode == 0, done.stderr
    found, expected_arrays = np.load(tmp_path / "arrays.npz"), CASES[case]()
    # f32 has a coordinate in 512 pixels to 2^-15 px. So along all outlines, some 5,000 px long, less than one pixel's
    # centre is within rounding, and in the picture four samples; 26 pixels are allowed.
    for name, expected in expected_arrays.items():
        if name.startswith("picture"):
            assert expected.std() > 20, "something is drawn"
            error = np.abs(found[name].astype(int) - expected.astype(int)).max(axis=-1)
            assert (error > 1).mean() < 1e-4
            assert (error == 1).mean() < 1e-3
        elif name in ("instrument", "occlusion", "hidden"):
            assert 0 < (expected > 0).mean() < 1
            assert (found[name] != expected).mean() < 1e-4
        else:
            # NaN where the sheet is not visible.
            assert (~np.isclose(found[name], expected, rtol=1e-5, atol=1e-5, equal_nan=True)).mean() < 1e-4
    assert case != "pinhole" or np.isnan(expected_arrays["coordinates"][0, 0]).all(), "beyond the limit"


@pytest.mark.slow
def test_memory_of_pictures_is_freed(root: Path) -> None:
    done = vulkan(DRIVER, "-c", GROWTH, root=root)
    assert done.returncode == 0, done.stderr
    # Bounds and owners of 199 x 199 cells alone are 24 bytes each, and were kept 3 times.
    assert int(done.stdout) < 3 * 24 * 199**2 / 2


@pytest.mark.slow
@pytest.mark.parametrize("output", ["png", "depth", "tracks"])
def test_error_when_the_device_ends_threads_early(output: str, small: Path, root: Path, message: Messages) -> None:
    # More cells than llvmpipe's 65,535 rounds.
    camera = f"render={{size: [4, 4], refine: 0, camera: {json.dumps(TINY)}}}"
    settings = ["sheet.points=[300, 300]", "time.duration=0.1", f"output=[{output}]", camera]
    changes = [word for setting in settings for word in ("--set", setting)]
    done = vulkan(DRIVER, "-c", UNBOUNDED, "run", "small.yaml", "--arch", "vulkan", *changes, root=root)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    # On a slow machine, a line on the progress of compiling precedes it.
    message(done.stderr.splitlines()[-1], "--arch vulkan", "take --arch cpu", hide=r"\d+ of \d+")
    assert not [path for path in (small / "output").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("driver", "precision"), [("/nonexistent", "f32"), (DRIVER, "f64")], ids=["no GPU", "no exp in f64"]
)
def test_unsupported_devices(driver: str, precision: str, small: Path, root: Path, message: Messages) -> None:
    settings = ["--arch", "vulkan", "--set", SETTINGS[0], "--set", f"time.precision={precision}"]
    done = vulkan(driver, "-m", "taichi_msm", "run", "small.yaml", *settings, root=root)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    message(done.stderr, "--arch vulkan")
