from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from taichi_msm.cli import main
from taichi_msm.system import runtime
from taichi_msm.system.signals import SIGNALS
from tests.scenes import SMALL, speckle


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
    os.environ["TI_OFFLINE_CACHE_FILE_PATH"] = str(shared / "ticache")


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory to work in, with small.yaml and its picture."""
    Image.fromarray(speckle(30, 40)).save(tmp_path / "speckle.png")
    (tmp_path / "small.yaml").write_text(SMALL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


Program = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def program(device: runtime.Device, capfd: pytest.CaptureFixture[str]) -> Program:
    """The program in this process, for what needs none of its own."""

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        takes_threads = arguments[0] in ("run", "study", "view")
        before = {number: signal.getsignal(number) for number in SIGNALS}
        capfd.readouterr()
        try:
            code = main([*arguments, *(("--threads", str(device.threads)) if takes_threads else ())])
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        said = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, code, said.out, said.err)

    return run
