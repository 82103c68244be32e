"""The choice of the compiler, and what is replaced in it while it reads our kernels."""

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

# Run kernels with an error: one of a user, after one of ours was read; and one in the place of ours.
ERRORS = """
import sys, numpy as np
from taichi_msm.system import runtime
from taichi_msm.system.runtime import ti
runtime.start("cpu", 1)

@ti.kernel
def good(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    out[0] = 1.0

@ti.kernel
def wrong(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for n in range(2):
        out[n] = nowhere

array = np.zeros(2, np.float32)
with runtime.compilation_options():
    good(array)
try:
    if sys.argv[1] == "ours":
        with runtime.compilation_options():
            wrong(array)
    else:
        wrong(array)
except Exception as error:
    print(error)
"""


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """The compilers that can be found; those of this environment are not looked for."""
    found = {"taichi", "quadrants"}
    monkeypatch.setattr(Compiler, "version", property(lambda one: one.tested_version if one.name in found else ""))
    monkeypatch.delenv("TAICHI_MSM_COMPILER", raising=False)
    active_compiler.cache_clear()
    yield found
    active_compiler.cache_clear()


@pytest.mark.parametrize(
    ("wanted", "there", "taken"),
    [("", {"taichi", "quadrants"}, "taichi"), ("", {"quadrants"}, "quadrants"), ("quadrants", set(), "quadrants")],
    ids=["both", "one", "named"],
)
def test_the_compiler_that_is_taken(
    wanted: str, there: set[str], taken: str, installed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed.intersection_update(there or installed)
    monkeypatch.setenv("TAICHI_MSM_COMPILER", wanted)
    assert active_compiler().name == taken


@pytest.mark.parametrize("wanted", ["qadrants", "quadrants", ""])
def test_a_compiler_that_is_not_there(
    wanted: str, installed: set[str], monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    installed.clear()
    installed.update(["taichi"] if wanted else [])
    monkeypatch.setenv("TAICHI_MSM_COMPILER", wanted)
    with message.raises(MsmError, "quadrants"):
        active_compiler()


@pytest.mark.parametrize(
    ("command", "code", "shown"), [("run", 2, ""), ("--version", 2, "taichi-msm 0.1.0\n"), ("check", 0, "image: ")]
)
def test_the_command_line_says_so_in_a_line_where_it_needs_one(
    command: str, code: int, shown: str, tmp_path: Path, root: Path, message: Messages
) -> None:
    arguments = () if command == "--version" else (str(root / "scenes" / "press.yaml"),)
    done = python(tmp_path, PROGRAM, command, *arguments, TAICHI_MSM_COMPILER="numba")
    assert (done.returncode, done.stdout[: len(shown) or None]) == (code, shown)
    message(done.stderr)


def test_a_compiler_that_cannot_be_imported(tmp_path: Path, root: Path, message: Messages) -> None:
    (tmp_path / active_compiler().name).mkdir()
    (tmp_path / active_compiler().name / "__init__.py").write_text("raise ImportError('libfoo.so is missing')")
    done = python(tmp_path, PROGRAM, "run", str(root / "scenes" / "press.yaml"))
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "libfoo.so is missing", hide=f"{active_compiler().title}|(?<=; ).*")


def test_the_version_names_the_compiler(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    version = ".".join(str(part) for part in runtime.ti.__version__)
    assert capsys.readouterr().out == f"taichi-msm 0.1.0\n{active_compiler().title} {version}\n"


def test_a_record_names_its_compiler() -> None:
    assert compiler_label({"taichi-msm": "0.1.0", "quadrants": "1.4.0", "python": "3.14.0"}) == "Quadrants 1.4.0"


def test_compilers_with_the_same_bits_on_a_cpu() -> None:
    one, other, older = (
        {"python": "3.13.0", **pair} for pair in ({"taichi": "1.7.4"}, {"quadrants": "1.4.0"}, {"taichi": "1.7.3"})
    )
    assert result_versions(one, "cpu") == result_versions(other, "cpu") != result_versions(older, "cpu")
    assert result_versions(one, "vulkan") == one


def test_compilers_are_those_that_the_package_installs(root: Path) -> None:
    project = (root / "pyproject.toml").read_text()
    for one in COMPILERS.values():
        assert f'"{one.name}=={one.tested_version}' in project


# Prints the folder of compiled kernels that we know of, and the one that the compiler knows of.
FOLDERS = """
from taichi_msm.system.compiler import active_compiler
ti = active_compiler().load()
ti.init(log_level=ti.ERROR)
print(active_compiler().folder(), ti.lang.impl.current_cfg().offline_cache_file_path, sep="|")
"""


@pytest.mark.parametrize("named", [True, False])
def test_the_folder_of_compiled_kernels(named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variable = active_compiler().folder_variable
    monkeypatch.delenv(variable)
    done = python(tmp_path, FOLDERS, HOME=str(tmp_path), **({variable: str(tmp_path / "kernels")} if named else {}))
    ours, its = done.stdout.split("\n")[-2].split("|")
    assert ours == its == str(tmp_path / "kernels" if named else tmp_path / active_compiler().cache)


def test_nothing_is_replaced_in_a_version_that_was_not_tested() -> None:
    assert replace(active_compiler(), tested_version="0.0.1").patches == []


@pytest.mark.default_cases("users-variables0-True")
@pytest.mark.parametrize(
    ("whose", "variables", "told"),
    [("users", {}, True), ("ours", {}, False), ("ours", {"TAICHI_MSM_TRACEBACK": "1"}, True)],
)
def test_an_error_names_its_line_where_somebody_changes_kernels(
    whose: str, variables: dict[str, str], told: bool, tmp_path: Path
) -> None:
    done = python(tmp_path, ERRORS, whose, **variables)
    assert 'Name "nowhere" is not defined' in done.stdout
    assert ("own_process.py" in done.stdout and "^^^^" in done.stdout) == told


OTHER = next(one for one in COMPILERS.values() if one is not active_compiler())

both = pytest.mark.skipif(find_spec(OTHER.name) is None, reason="needs both compilers")


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
def test_both_compilers_give_the_same_bytes(
    name: str, settings: list[str], device: runtime.Device, tmp_path: Path, root: Path
) -> None:
    """Motion, the sheet at rest, pictures and labels, of springs and of tissue."""
    scene, settings = root / "scenes" / f"{name}.yaml", [*settings, "time.duration=0.12", "render.size=[160, 120]"]
    run(load_scene(scene, settings), tmp_path / "mine", threads=device.threads)
    words = [word for setting in settings for word in ("--set", setting)]
    command = ["run", str(scene), "--threads", str(device.threads), *words, "--out", str(tmp_path / "other")]
    assert python(tmp_path, PROGRAM, *command, TAICHI_MSM_COMPILER=OTHER.name).returncode == 0
    found = results(tmp_path / "mine")
    assert len(found) > 3
    assert results(tmp_path / "other") == found


@both
def test_the_other_compiler_continues_a_run_with_the_same_bytes(small: Path, device: runtime.Device) -> None:
    made = load_scene("small.yaml", ["time.duration=1", "output=[png, trajectory]"])
    run(made, small / "whole", threads=device.threads)

    def stop(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("frames", 5):
            raise KeyboardInterrupt

    assert run(made, small / "parts", threads=device.threads, progress=stop)["status"] == "interrupted"
    command = ["run", "--resume", "parts", "--threads", str(device.threads)]
    assert python(small, PROGRAM, *command, TAICHI_MSM_COMPILER=OTHER.name).returncode == 0
    assert results(small / "parts") == results(small / "whole")
    record = json.loads((small / "parts" / "run.json").read_text())
    assert {active_compiler().name, OTHER.name} <= set(record["versions"])
