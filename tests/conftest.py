from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from PIL import Image

from taichi_msm.cli.main import main
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs.run import run
from taichi_msm.system import runtime
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.process import SIGNALS
from tests import golden
from tests.golden import Messages
from tests.scenes import SMALL, speckle

# These files take longest.
LONGEST = {f"test_{name}" for name in ("docs", "vulkan", "lens", "rest", "cluster", "sweep", "contact", "study", "fit")}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--write-messages", action="store_true", help="write tests/messages.yaml in place of comparing")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but the default cases as slow, and begin with the files that take longest."""
    for item in items:
        chosen = item.get_closest_marker("default_cases")
        if isinstance(item, pytest.Function) and chosen and item.callspec.id not in chosen.args:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: item.path.stem not in LONGEST)


@pytest.fixture(scope="session")
def device() -> runtime.Device:
    """Taichi on the CPU with two threads, started once: a process has one device."""
    return runtime.start("cpu", 2)


@pytest.fixture(scope="session")
def root() -> Path:
    return Path(__file__).parent.parent


@pytest.fixture(scope="session", autouse=True)
def own_kernel_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Kernels compiled by the tests, also in child processes, come from this tree and no earlier one."""
    base = tmp_path_factory.getbasetemp()
    # All workers of pytest-xdist share one.
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    os.environ[active_compiler().folder_variable] = str(shared / "kernels")


@pytest.fixture(scope="session")
def written_messages(request: pytest.FixtureRequest) -> Iterator[golden.Golden | None]:
    """The messages that the session writes, or None where it compares."""
    written: golden.Golden | None = {} if request.config.getoption("--write-messages") else None
    yield written
    if written:
        golden.write(written)


@pytest.fixture
def message(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, written_messages: golden.Golden | None
) -> Messages:
    """Compare messages with the golden file, tests/messages.yaml."""
    return Messages(request.node.nodeid, tmp_path_factory.getbasetemp(), written_messages)


def write_small(folder: Path, height: int = 30, width: int = 40) -> None:
    """Write small.yaml and its picture, of a height and width, into a folder."""
    Image.fromarray(speckle(height, width)).save(folder / "speckle.png")
    (folder / "small.yaml").write_text(SMALL)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory to work in, with small.yaml and its picture."""
    write_small(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def ran(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run of small.yaml, in `output/small` beside its scene; to be read only."""
    here = tmp_path_factory.mktemp("ran")
    write_small(here)
    run(load_scene(here / "small.yaml"), here / "output" / "small", threads=device.threads, estimate_error=False)
    return here / "output" / "small"


@pytest.fixture
def results(ran: Path, tmp_path: Path) -> Path:
    """A copy of these results, to be changed."""
    return Path(shutil.copytree(ran, tmp_path / "results"))


@pytest.fixture(scope="session")
def seen_by_two(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run as two cameras beside each other have seen it, in `left` and `right`, to be read only; of 320 x 256 px."""
    here = tmp_path_factory.mktemp("stereo")
    write_small(here, 60, 80)
    left = "{eye: [-0.004, -0.1, 0.5], target: [-0.004, 0, 0], fov: 38}"
    cameras = f"render.cameras={{left: {left}, right: {{beside: left, baseline: 0.008}}}}"
    overrides = [cameras, "render.size=[320, 256]", "render.tracks=6", "output=[png, trajectory, forces, tracks]"]
    run(load_scene(here / "small.yaml", overrides), here / "stereo", threads=device.threads, estimate_error=False)
    return here / "stereo"


@pytest.fixture(scope="session")
def labelled_in_motion(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a drawn tool that a moving, centred camera has seen, with its labels; to be read only."""
    here = tmp_path_factory.mktemp("labelled")
    write_small(here)
    eye = "[[0, 0, -0.1, 0.5], [0.4, 0.02, -0.1, 0.45]]"
    overrides = [
        f"render.camera={{eye: {eye}, intrinsics: {{fx: 45, fy: 45, cx: 20, cy: 16}}}}",
        "render.size=[40, 32]",
        "render.tracks=6",
        "probes.0.instrument={radius: 0.02, shaft: [0.5, -0.6, 0.9], length: 0.2}",
        "time.duration=0.2",
        "output=[png, trajectory, depth, flow, instrument, tracks]",
    ]
    run(load_scene(here / "small.yaml", overrides), here / "labelled", threads=device.threads, estimate_error=False)
    return here / "labelled"


@pytest.fixture
def stereo(seen_by_two: Path, tmp_path: Path) -> Path:
    """A copy of these results, to be changed."""
    return Path(shutil.copytree(seen_by_two, tmp_path / "stereo"))


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Restore the handlers of signals, which the command line replaces, before the next test."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


Program = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def program(device: runtime.Device, capfd: pytest.CaptureFixture[str]) -> Program:
    """The program in this process, for what needs none of its own."""

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        takes_threads = arguments[0] in ("run", "study", "view")
        capfd.readouterr()
        code = main([*arguments, *(("--threads", str(device.threads)) if takes_threads else ())])
        said = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, code, said.out, said.err)

    return call
