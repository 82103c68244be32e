"""Choice of the compiler, its patches, and equal bits of both compilers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from taichi_msm import load_scene, run
from taichi_msm.cli.main import main
from taichi_msm.errors import MsmError
from taichi_msm.system import runtime
from taichi_msm.system.compiler import COMPILERS, Compiler, active_compiler, compiler_label, result_versions
from tests.golden import Messages
from tests.outputs import results
from tests.system import python

PROGRAM = "import sys; from taichi_msm.__main__ import main; sys.exit(main())"

# Compiles a kernel of this package, then a kernel of a user with an error.
ERROR = """
import numpy as np
from taichi_msm.system import runtime
from taichi_msm.system.runtime import ti
runtime.start("cpu", 1)

@ti.kernel
def good(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    out[0] = 1.0

@ti.kernel
def wrong(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    out[0] = nowhere

array = np.zeros(2, np.float32)
with runtime.compilation_options():
    good(array)
try:
    wrong(array)
except Exception as error:
    print(error)
"""


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """Names of installed compilers, in place of those of this environment."""
    names = {"taichi", "quadrants"}
    monkeypatch.setattr(Compiler, "version", property(lambda self: self.tested_version if self.name in names else ""))
    monkeypatch.delenv("TAICHI_MSM_COMPILER", raising=False)
    active_compiler.cache_clear()
    yield names
    active_compiler.cache_clear()


@pytest.mark.parametrize(
    ("wanted", "available", "expected"),
    [("", {"taichi", "quadrants"}, "taichi"), ("", {"quadrants"}, "quadrants"), ("quadrants", set(), "quadrants")],
    ids=["both", "one", "named"],
)
def test_active_compiler(
    wanted: str, available: set[str], expected: str, installed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed.intersection_update(available or installed)
    monkeypatch.setenv("TAICHI_MSM_COMPILER", wanted)
    assert active_compiler().name == expected


@pytest.mark.parametrize("wanted", ["qadrants", "quadrants", ""])
def test_missing_compiler(wanted: str, installed: set[str], monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    installed.clear()
    installed.update(["taichi"] if wanted else [])
    monkeypatch.setenv("TAICHI_MSM_COMPILER", wanted)
    with message.raises(MsmError, "quadrants"):
        active_compiler()


@pytest.mark.parametrize(
    ("command", "code", "shown"), [("run", 2, ""), ("--version", 2, "taichi-msm 0.1.0\n"), ("check", 0, "image: ")]
)
def test_commands_with_an_unknown_compiler(
    command: str, code: int, shown: str, tmp_path: Path, root: Path, message: Messages
) -> None:
    arguments = () if command == "--version" else (str(root / "scenes" / "press.yaml"),)
    done = python(tmp_path, PROGRAM, command, *arguments, TAICHI_MSM_COMPILER="numba")
    assert (done.returncode, done.stdout[: len(shown) or None]) == (code, shown)
    message(done.stderr)


def test_compiler_that_cannot_be_imported(tmp_path: Path, root: Path, message: Messages) -> None:
    (tmp_path / active_compiler().name).mkdir()
    (tmp_path / active_compiler().name / "__init__.py").write_text("raise ImportError('libfoo.so is missing')")
    done = python(tmp_path, PROGRAM, "run", str(root / "scenes" / "press.yaml"))
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "libfoo.so is missing", hide=f"{active_compiler().title}|(?<=; ).*")


def test_versions_of_compilers(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    version = ".".join(str(part) for part in runtime.ti.__version__)
    assert capsys.readouterr().out == f"taichi-msm 0.1.0\n{active_compiler().title} {version}\n"
    assert compiler_label({"taichi-msm": "0.1.0", "quadrants": "1.4.0", "python": "3.14.0"}) == "Quadrants 1.4.0"
    project = (root / "pyproject.toml").read_text()
    assert all(f'"{compiler.name}=={compiler.tested_version}' in project for compiler in COMPILERS.values())
    assert replace(active_compiler(), tested_version="0.0.1").patches == [], "untested versions are not patched"


def test_versions_that_affect_results() -> None:
    """Tested compilers have the same bits on a CPU."""
    taichi, quadrants, untested = (
        {"python": "3.13.0", **pair} for pair in ({"taichi": "1.7.4"}, {"quadrants": "1.4.0"}, {"taichi": "1.7.3"})
    )
    assert result_versions(taichi, "cpu") == result_versions(quadrants, "cpu") != result_versions(untested, "cpu")
    assert result_versions(taichi, "vulkan") == taichi


# Prints the folder of compiled kernels according to this package and to the compiler.
FOLDERS = """
from taichi_msm.system.compiler import active_compiler
ti = active_compiler().load()
ti.init(log_level=ti.ERROR)
print(active_compiler().folder(), ti.lang.impl.current_cfg().offline_cache_file_path, sep="|")
"""


@pytest.mark.parametrize("named", [True, False])
def test_folder_of_compiled_kernels(named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variable = active_compiler().folder_variable
    monkeypatch.delenv(variable)
    monkeypatch.delenv("XDG_CACHE_HOME")
    done = python(tmp_path, FOLDERS, HOME=str(tmp_path), **({variable: str(tmp_path / "kernels")} if named else {}))
    expected, actual = done.stdout.split("\n")[-2].split("|")
    assert expected == actual == str(tmp_path / "kernels" if named else tmp_path / active_compiler().cache)


def test_errors_of_kernels_of_a_user(tmp_path: Path) -> None:
    """They contain source lines; patches apply to kernels of this package only."""
    done = python(tmp_path, ERROR)
    assert 'Name "nowhere" is not defined' in done.stdout
    assert "kernels.py" in done.stdout
    assert "^^^^" in done.stdout


SECOND = next(compiler for compiler in COMPILERS.values() if compiler is not active_compiler())

both = pytest.mark.skipif(find_spec(SECOND.name) is None, reason="needs both compilers")


@both
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("press", ["output=[png, trajectory]", "time.precision=f32"]),
        ("tumour", ["output=[png, trajectory]", "time.precision=f64", "time.frames_per_second=50"]),
        ("two-tools", ["output=[png, trajectory]"]),
        ("grasp", ["output=[png, trajectory, coordinates, depth, normals, flow, occlusion, instrument, tracks]"]),
    ],
)
def test_results_of_both_compilers(
    name: str, settings: list[str], device: runtime.Device, tmp_path: Path, root: Path
) -> None:
    """Dynamic and quasi-static scenes, pictures and labels, springs and tissue."""
    scene, settings = root / "scenes" / f"{name}.yaml", [*settings, "time.duration=0.12", "render.size=[160, 120]"]
    run(load_scene(scene, settings), tmp_path / "first", threads=device.threads)
    words = [word for setting in settings for word in ("--set", setting)]
    command = ["run", str(scene), "--threads", str(device.threads), *words, "--out", str(tmp_path / "second")]
    assert python(tmp_path, PROGRAM, *command, TAICHI_MSM_COMPILER=SECOND.name).returncode == 0
    expected = results(tmp_path / "first")
    assert len(expected) > 3
    assert results(tmp_path / "second") == expected


@both
def test_resume_with_the_second_compiler(small: Path, device: runtime.Device) -> None:
    made = load_scene("small.yaml", ["time.duration=1", "output=[png, trajectory]"])
    run(made, small / "whole", threads=device.threads)

    def stop(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("frames", 5):
            raise KeyboardInterrupt

    assert run(made, small / "parts", threads=device.threads, progress=stop)["status"] == "interrupted"
    command = ["run", "--resume", "parts", "--threads", str(device.threads)]
    assert python(small, PROGRAM, *command, TAICHI_MSM_COMPILER=SECOND.name).returncode == 0
    assert results(small / "parts") == results(small / "whole")
    record = json.loads((small / "parts" / "run.json").read_text())
    assert {active_compiler().name, SECOND.name} <= set(record["versions"])
