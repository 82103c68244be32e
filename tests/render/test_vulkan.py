"""The form for GPUs, on a Vulkan that needs none: Mesa's lavapipe."""

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
from taichi_msm.render.camera import view
from taichi_msm.render.labels import requested_labels, track_grid
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.runs.arrays import read_flo
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.outputs import results
from tests.render.test_rasterizer import dented, drawable, with_instruments
from tests.scenes import SMALL, speckle
from tests.terms.test_contact import moved, touching

# Any driver of Mesa; an empty path without one.
DRIVER = next(map(str, Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")), "")

pytestmark = pytest.mark.skipif(not DRIVER, reason="needs mesa-vulkan-drivers")

SETTINGS = [
    "probes.0.at=[[0, 0.2, 0.5], [0.2, 0.8, 0.5], [0.2, 0.4, 0.4]]",
    "sheet.fixed=[top, left]",
    "render={size: [80, 60], camera: oblique}",
    "probes.0.instrument={radius: 0.01, shaft: [1, -0.4, 0.7], length: 0.1}",
    "output=[png, trajectory, coordinates, depth, flow, occlusion]",
]

# In one process a run, one that is interrupted and resumed, one with contact, and one that diverges.
RUNS = """
import json, sys
from taichi_msm import DivergedError, Simulation, load_scene, resume, run
from tests.render.test_vulkan import SETTINGS, touched
from tests.runs.test_resume import Stop

made, options = load_scene("small.yaml", SETTINGS), {"arch": "vulkan", "estimate_error": False}
records = [run(made, "whole", **options), run(made, "parts", **options, progress=Stop(8)), resume("parts")]
records.append(run(touched(), "touching", **options))
facts = [[record.get(key) for key in ("status", "arch", "device")] for record in records]
wild = load_scene("small.yaml", [*SETTINGS, "probes.0.force=[0, 0, -1.0e+12]"])
try:
    Simulation(wild, arch="vulkan").advance(4)
except DivergedError as error:
    facts.append(["diverged", error.time])
json.dump(facts, sys.stdout)
"""


def vulkan(driver: str, *command: str, root: Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "VK_DRIVER_FILES": driver, "VK_ICD_FILENAMES": driver, "PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False, timeout=300, env=environment, cwd=cwd
    )


@pytest.fixture(scope="module")
def runs(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    """The folder of the runs, and facts of their records."""
    here = tmp_path_factory.mktemp("vulkan")
    Image.fromarray(speckle(30, 40)).save(here / "speckle.png")
    (here / "small.yaml").write_text(SMALL)
    done = vulkan(DRIVER, "-c", RUNS, root=root, cwd=here)
    assert done.returncode == 0, done.stderr
    return here, json.loads(done.stdout)


@pytest.mark.slow
def test_runs_on_a_gpu_are_those_on_the_cpu(
    runs: tuple[Path, list[Any]], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To rounding and one grey level; to the bit when one is resumed; and one that diverges is found."""
    folder, records = runs
    monkeypatch.chdir(folder)
    *done, diverged = records
    statuses = ["complete", "interrupted", "complete", "complete"]
    assert [record[:2] for record in done] == [[status, "vulkan"] for status in statuses]
    assert done[0][2].startswith("llvmpipe")
    assert diverged[0] == "diverged"
    assert results(Path("parts")) == results(Path("whole"))

    run(load_scene("small.yaml", SETTINGS), "cpu", threads=device.threads, estimate_error=False)
    there, here = (np.load(f"{name}/trajectory.npz")["position"] for name in ("whole", "cpu"))
    # Some 164 steps of a sheet of 0.4 m, each of which may round otherwise.
    assert np.abs(there - here).max() < 164 * 0.4 * 2.0**-24
    assert np.abs(here - here[0]).max() > 0.01

    def apart(file: str, read: Callable[[str], Any]) -> NDArray[np.float64]:
        return np.abs(np.subtract(read(f"whole/{file}"), read(f"cpu/{file}"), dtype=float))

    def pixels(path: str) -> NDArray[Any]:
        return np.asarray(Image.open(path))

    # A point that rounds otherwise may move an edge past a pixel's centre.
    for frame in range(len(here)):
        assert (apart(f"frames/{frame:04}.png", pixels) > 1).mean() < 0.002
        assert (apart(f"depth/{frame:04}.tiff", pixels) > 1e-5).mean() < 0.002
    for frame in range(len(here) - 1):
        flow = apart(f"flow/{frame:04}.flo", lambda path: read_flo(Path(path), (80, 60)))
        assert (flow.max(axis=-1) > 0.01).mean() < 0.002
        assert (apart(f"occlusion/{frame:04}.png", pixels) > 0).mean() < 0.002


def touched() -> Scene:
    """A tool that presses, rubs, grips and lets go."""
    keys = [0, 0.4, 0.5, 0.0], [0.1, 0.4, 0.5, -0.03], [0.2, 0.6, 0.45, -0.03], [0.4, 0.6, 0.5, 0.03]
    made = touching([moved(*keys, friction=0.3, grip=[[0.2, 0.3]])], time={"precision": "f32"})
    return made.model_copy(update={"output": ("trajectory", "forces")})


@pytest.mark.slow
def test_tools_touch_on_a_gpu_as_on_the_cpu(
    runs: tuple[Path, list[Any]], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(runs[0])
    run(touched(), "here", threads=device.threads, estimate_error=False)
    there, here = (np.load(f"{name}/trajectory.npz")["position"] for name in ("touching", "here"))
    # 60 steps of a sheet of 0.4 m.
    assert np.abs(there - here).max() < 60 * 0.4 * 2.0**-24
    assert np.abs(here - here[0]).max() > 0.02
    there, here = (np.loadtxt(f"{name}/forces.csv", delimiter=",", skiprows=1)[:, 5:] for name in ("touching", "here"))
    # Either is within 2e-3 of the twin's (tests/runs/test_forces.py).
    assert np.abs(there - here).max() < 4e-3 * np.abs(here).max()


# Puts what is drawn and found into a file, by name.
LOOKS = """
import sys
import numpy as np
from taichi_msm.system import runtime
from tests.render.test_vulkan import LOOKED_AT
runtime.start("vulkan")
np.savez(sys.argv[1], **LOOKED_AT[sys.argv[2]]())
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


def looks(made: Scene, texture: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Draw and find, on the device that was started."""
    position, view_now = draped(made), view(made)
    placed = place_instruments(made, position, 0)
    found = Rasterizer(
        made, texture, drawing_config(made, labels=requested_labels(()) if made.render.supersample == 1 else ())
    ).look(position, instruments=placed)
    seen: dict[str, NDArray[Any]] = {"picture": np.asarray(found.picture)}
    labels = found.labels
    if labels is None:  # Several samples a pixel.
        config = drawing_config(made, picture=False, labels=requested_labels(()))
        labels = Rasterizer(made, texture, config).look(position, instruments=placed).labels
    assert labels is not None
    seen |= {name: value for name, value in labels._asdict().items() if value.size}
    moved = position + np.array([0.002, 0.001, 0])
    placed_then = place_instruments(made, moved, 0)
    seen["flow"], seen["occlusion"] = compute_flow(made, labels.coordinates, moved, view_now, placed_then)
    rough = position + np.random.default_rng(5).normal(0, 0.004, position.shape)
    seen["pixels"], seen["hidden"] = locate_points(made, track_grid(60), rough, view_now, placed)
    return seen


def large_looks() -> dict[str, NDArray[Any]]:
    """What one thread alone would take long for."""
    render = {"shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}, "wireframe": True, "supersample": 2}
    texture = speckle(300, 400)
    seen = looks(with_instruments(drawable((121, 121), size=[512, 512], camera="oblique", **render)), texture)
    # One cell, larger than the picture, which is a single row.
    made = drawable((2, 2), size=[1400, 1], refine=0, supersample=4, camera={"eye": [0, 0, 1e-4]})
    seen["picture_row"] = Rasterizer(made, texture).draw(rest_positions(made.sheet))
    # More cells in a bin than a thread may try.
    made = drawable((200, 200), size=[4, 4], refine=0, camera=TINY)
    seen["picture_dot"] = Rasterizer(made, texture).draw(dented(made))
    return seen


def bent_looks(model: str, k1: float) -> dict[str, NDArray[Any]]:
    """What a lens bends; that of a pinhole shows nothing beyond its limit."""
    camera = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "outside": "background"}
    camera["intrinsics"] = {"fx": 240, "fy": 248, "cx": 148, "cy": 124}
    camera["distortion"] = {"model": model, "k1": k1, "k2": 0.01}
    made = drawable((41, 41), size=[320, 240], camera=camera, shading="tissue", wireframe=True)
    return looks(with_instruments(made), speckle(300, 400))


LOOKED_AT: dict[str, Callable[[], dict[str, NDArray[Any]]]] = {
    "large": large_looks,
    "pinhole": partial(bent_looks, "pinhole", -0.5),
    "fisheye": partial(bent_looks, "fisheye", -0.05),
}


def draped(made: Scene) -> NDArray[np.float64]:
    """A sheet with a dent, whose right third is folded over the middle."""
    position = rest_positions(made.sheet)
    x, y = position[..., 0], position[..., 1]
    position[..., 2] = -0.05 * np.exp(-((x + 0.1) ** 2 + y**2) / 0.005) + 0.06 / (1 + np.exp((0.08 - x) / 0.005))
    position[..., 0] = np.where(x > 0.08, 0.16 - x, x)
    return position


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=() if case == "pinhole" else pytest.mark.slow) for case in LOOKED_AT]
)
def test_pictures_labels_and_tracks_are_those_of_the_cpu(case: str, tmp_path: Path, root: Path, device: Device) -> None:
    done = vulkan(DRIVER, "-c", LOOKS, str(tmp_path / "seen.npz"), case, root=root)
    assert done.returncode == 0, done.stderr
    there, here = np.load(tmp_path / "seen.npz"), LOOKED_AT[case]()
    # f32 has a place in 512 pixels to 2^-15 px. So of all outlines, some 5,000 px long, less than a pixel's centre lies
    # where they may be drawn otherwise, and in the picture four samples; 26 pixels are allowed.
    for name, expected in here.items():
        if name.startswith("picture"):
            assert expected.std() > 20, "something is drawn"
            apart = np.abs(there[name].astype(int) - expected.astype(int)).max(axis=-1)
            assert (apart > 1).mean() < 1e-4
            assert (apart == 1).mean() < 1e-3
        elif name in ("instrument", "occlusion", "hidden"):
            assert 0 < (expected > 0).mean() < 1, "some are, some are not"
            assert (there[name] != expected).mean() < 1e-4
        else:
            # NaN where no sheet is seen.
            alike = np.isclose(there[name], expected, rtol=1e-5, atol=1e-5, equal_nan=True)
            assert (~alike).mean() < 1e-4
    assert case != "pinhole" or np.isnan(here["coordinates"][0, 0]).all(), "beyond the limit"


@pytest.mark.slow
def test_what_a_picture_takes_is_given_back(root: Path) -> None:
    done = vulkan(DRIVER, "-c", AGAIN, root=root)
    assert done.returncode == 0, done.stderr
    # Bounds and owners of 199 x 199 cells alone are 24 bytes each, and were kept 3 times.
    assert int(done.stdout) < 3 * 24 * 199**2 / 2


@pytest.mark.slow
@pytest.mark.parametrize("output", ["png", *(pytest.param(one, marks=pytest.mark.slow) for one in ("depth", "tracks"))])
def test_a_kernel_that_is_cut_short_is_an_error_of_one_line(
    output: str, small: Path, root: Path, message: Messages
) -> None:
    """And nothing of it is kept."""
    settings = [
        # More cells than llvmpipe's 65,535 rounds.
        "sheet.points=[300, 300]",
        "time.duration=0.1",
        f"output=[{output}]",
        f"render={{size: [4, 4], refine: 0, camera: {json.dumps(TINY)}}}",
    ]
    words = ["run", "small.yaml", "--arch", "vulkan", *(word for setting in settings for word in ("--set", setting))]
    done = vulkan(DRIVER, "-c", CUT_SHORT, *words, root=root)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    # A line on the progress of compiling comes before it on a slow machine.
    message(done.stderr.splitlines()[-1], "--arch vulkan", "take --arch cpu", hide=r"(?<=work ).*(?=, so)")
    assert not [path for path in (small / "output").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("driver", "precision"), [("/nonexistent", "f32"), (DRIVER, "f64")], ids=["no GPU", "no exp in f64"]
)
def test_what_a_gpu_cannot_do_is_one_line(
    driver: str, precision: str, small: Path, root: Path, message: Messages
) -> None:
    settings = ["--arch", "vulkan", "--set", SETTINGS[0], "--set", f"time.precision={precision}"]
    done = vulkan(driver, "-m", "taichi_msm", "run", "small.yaml", *settings, root=root)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    message(done.stderr, "--arch vulkan")
