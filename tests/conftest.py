from __future__ import annotations

import os
from pathlib import Path

import pytest
from PIL import Image

from taichi_msm import runtime
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
    os.environ["TI_OFFLINE_CACHE_FILE_PATH"] = str(tmp_path_factory.mktemp("ticache"))


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory to work in, with small.yaml and its picture."""
    Image.fromarray(speckle(30, 40)).save(tmp_path / "speckle.png")
    (tmp_path / "small.yaml").write_text(SMALL)
    monkeypatch.chdir(tmp_path)
    return tmp_path
