from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
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

# The slowest test files, which begin.
SLOWEST = {f"test_{name}" for name in ("docs", "vulkan", "lens", "rest", "cluster", "sweep", "contact", "study", "fit")}
# Test files that start processes.
WITH_PROCESSES = {f"test_{name}" for name in ("cli", "compiler", "datasets", "files", "runtime", "sameness", "sweep")}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--write-messages", action="store_true", help="write tests/messages.yaml in place of comparing")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but the default cases as slow, and the quick tests; begin with the slowest files.

    Quick are tests without a device and without processes, and those that compare a kernel with its twin.
    """
    for item in items:
        chosen = item.get_closest_marker("default_cases")
        if isinstance(item, pytest.Function) and chosen and item.callspec.id not in chosen.args:
            item.add_marker(pytest.mark.slow)
        is_default = not (item.get_closest_marker("slow") or item.get_closest_marker("fuzz"))
        is_light = "device" not in getattr(item, "fixturenames", ()) and item.path.stem not in WITH_PROCESSES
        if is_default and (is_light or "_twin" in item.name):
            item.add_marker(pytest.mark.quick)
    items.sort(key=lambda item: item.path.stem not in SLOWEST)


@pytest.fixture(scope="session")
def device() -> runtime.Device:
    """Taichi on the CPU with two threads, started once: a process has one device."""
    return runtime.start("cpu", 2)


@pytest.fixture(scope="session")
def root() -> Path:
    return Path(__file__).parent.parent


@pytest.fixture(scope="session", autouse=True)
def caches(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Caches of compiled kernels and grids for this session, its child processes and all workers of pytest-xdist."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    os.environ[active_compiler().folder_variable] = str(shared / "kernels")
    # Even grids would be stored in the folder of the user.
    os.environ["XDG_CACHE_HOME"] = str(shared / "cache")


@pytest.fixture(scope="session")
def written_messages(request: pytest.FixtureRequest) -> Iterator[golden.Golden | None]:
    """The messages that the session writes, or None if it compares them."""
    written: golden.Golden | None = {} if request.config.getoption("--write-messages") else None
    yield written
    if written:
        golden.write(written)


@pytest.fixture
def message(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, written_messages: golden.Golden | None
) -> Iterator[Messages]:
    """Compare messages with the golden file, tests/messages.yaml; all of a test's entries must occur."""
    messages = Messages(request.node.nodeid, tmp_path_factory.getbasetemp(), written_messages)
    failed = request.session.testsfailed
    yield messages
    if request.session.testsfailed == failed:
        messages.require_all()


def write_small(folder: Path, height: int = 30, width: int = 40) -> None:
    """Write small.yaml and its picture, of a height and width, into a folder."""
    Image.fromarray(speckle(height, width)).save(folder / "speckle.png")
    (folder / "small.yaml").write_text(SMALL)


def _run_small(device: runtime.Device, folder: Path, out: str, overrides: Sequence[str] = ()) -> Path:
    """Run small.yaml in a folder without an error estimate; returns the folder of the results."""
    run(load_scene(folder / "small.yaml", overrides), folder / out, threads=device.threads, estimate_error=False)
    return folder / out


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with small.yaml and its picture."""
    write_small(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def ran(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run of small.yaml, in `output/small` next to its scene; read-only."""
    folder = tmp_path_factory.mktemp("ran")
    write_small(folder)
    return _run_small(device, folder, "output/small")


@pytest.fixture
def results(ran: Path, tmp_path: Path) -> Path:
    """A copy of these results, to be changed."""
    return Path(shutil.copytree(ran, tmp_path / "results"))


@pytest.fixture(scope="session")
def stereo_run(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a stereo pair of cameras, `left` and `right`, of 320 x 256 px; read-only."""
    folder = tmp_path_factory.mktemp("stereo")
    write_small(folder, 60, 80)
    left = "{eye: [-0.004, -0.1, 0.5], target: [-0.004, 0, 0], fov: 38}"
    cameras = f"render.cameras={{left: {left}, right: {{beside: left, baseline: 0.008}}}}"
    overrides = [cameras, "render.size=[320, 256]", "render.tracks=6", "output=[png, trajectory, forces, tracks]"]
    return _run_small(device, folder, "stereo", overrides)


@pytest.fixture(scope="session")
def labelled_in_motion(device: runtime.Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with labels, a drawn tool and a moving, centred camera; read-only."""
    folder = tmp_path_factory.mktemp("labelled")
    write_small(folder)
    eye = "[[0, 0, -0.1, 0.5], [0.4, 0.02, -0.1, 0.45]]"
    overrides = [
        f"render.camera={{eye: {eye}, intrinsics: {{fx: 45, fy: 45, cx: 20, cy: 16}}}}",
        "render.size=[40, 32]",
        "render.tracks=6",
        "probes.0.instrument={radius: 0.02, shaft: [0.5, -0.6, 0.9], length: 0.2}",
        "time.duration=0.2",
        "output=[png, trajectory, depth, flow, instrument, tracks]",
    ]
    return _run_small(device, folder, "labelled", overrides)


@pytest.fixture
def stereo(stereo_run: Path, tmp_path: Path) -> Path:
    """A copy of the results of `stereo_run`, to be changed."""
    return Path(shutil.copytree(stereo_run, tmp_path / "stereo"))


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handle signals as in a shell's foreground, and restore the handlers, which the command line replaces."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        # A shell's background, and nohup, ignore signals in all processes that they start.
        if before[number] is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


Program = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def program(device: runtime.Device, capfd: pytest.CaptureFixture[str]) -> Program:
    """The program, called in this process."""

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        takes_threads = arguments[0] in ("run", "study", "view")
        capfd.readouterr()
        code = main([*arguments, *(("--threads", str(device.threads)) if takes_threads else ())])
        printed = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, code, printed.out, printed.err)

    return call
