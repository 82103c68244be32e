"""The choice of the compiler, and what is replaced in it while it reads our kernels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from taichi_msm import load_scene, run
from taichi_msm.cli.main import main
from taichi_msm.errors import DeviceError, NotInstalledError
from taichi_msm.system import runtime
from taichi_msm.system.compiler import COMPILERS, Compiler, active_compiler, compiler_label, result_versions
from tests.outputs import results

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


def test_taichi_is_taken_where_both_are_there(installed: set[str]) -> None:
    assert active_compiler().name == "taichi"


def test_quadrants_is_taken_where_it_is_alone(installed: set[str]) -> None:
    installed.remove("taichi")
    assert active_compiler().name == "quadrants"


def test_the_environment_decides(installed: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAICHI_MSM_COMPILER", "quadrants")
    assert active_compiler().name == "quadrants"


@pytest.mark.parametrize(
    ("wanted", "there", "said"),
    [
        (
            "qadrants",
            {"taichi"},
            "TAICHI_MSM_COMPILER: 'qadrants' is not a compiler; take taichi or quadrants; did you ",
        ),
        (
            "quadrants",
            {"taichi"},
            "TAICHI_MSM_COMPILER: quadrants is not installed; pip install quadrants==1.4.0 (Python 3.12 to 3.14), or "
            "unset TAICHI_MSM_COMPILER",
        ),
        (
            "",
            set(),
            "no compiler is installed; pip install taichi==1.7.4 (Python 3.10 to 3.13) or "
            "pip install quadrants==1.4.0 (Python 3.12 to 3.14)",
        ),
    ],
)
def test_a_compiler_that_is_not_there(
    wanted: str, there: set[str], said: str, installed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed.intersection_update(there)
    monkeypatch.setenv("TAICHI_MSM_COMPILER", wanted)
    with pytest.raises((DeviceError, NotInstalledError)) as caught:
        active_compiler()
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize(
    ("command", "code", "shown"), [("run", 2, ""), ("--version", 2, "taichi-msm 0.1.0\n"), ("check", 0, "image: ")]
)
def test_the_command_line_says_so_in_a_line_where_it_needs_one(command: str, code: int, shown: str, root: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "taichi_msm", command, *(() if command == "--version" else ("scenes/press.yaml",))],
        cwd=root,
        env={**os.environ, "TAICHI_MSM_COMPILER": "numba"},
        capture_output=True,
        text=True,
    )
    said = "TAICHI_MSM_COMPILER: 'numba' is not a compiler; take taichi or quadrants\n" if code else ""
    assert (done.returncode, done.stdout[: len(shown) or None], done.stderr) == (code, shown, said)


def test_a_compiler_that_cannot_be_imported(tmp_path: Path, root: Path) -> None:
    (tmp_path / active_compiler().name).mkdir()
    (tmp_path / active_compiler().name / "__init__.py").write_text("raise ImportError('libfoo.so is missing')")
    done = subprocess.run(
        [sys.executable, "-m", "taichi_msm", "run", root / "scenes" / "press.yaml"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(root)))},
        capture_output=True,
        text=True,
    )
    said = f"{active_compiler().title} cannot be imported: libfoo.so is missing; {active_compiler().remedy}\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)


def test_a_folder_with_its_name_is_no_compiler(tmp_path: Path, root: Path) -> None:
    for name in COMPILERS:
        (tmp_path / name).mkdir()
    done = subprocess.run(
        [sys.executable, "-m", "taichi_msm", "--version"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.endswith(f"\n{active_compiler().title} {active_compiler().version}\n")


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
def test_the_folder_of_compiled_kernels(named: bool, tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path)}
    del environment[active_compiler().folder_variable]
    if named:
        environment[active_compiler().folder_variable] = str(tmp_path / "kernels")
    done = subprocess.run(
        [sys.executable, "-c", FOLDERS], env=environment, capture_output=True, text=True, check=True, cwd=tmp_path
    )
    ours, its = done.stdout.split("\n")[-2].split("|")
    assert ours == its == str(tmp_path / "kernels" if named else tmp_path / active_compiler().cache)


def test_replacements_are_in_place_for_a_while(device: runtime.Device) -> None:
    patches = active_compiler().patches

    def parts() -> list[object]:
        return [getattr(owner, name) for owner, name, _ in patches]

    def interrupted() -> None:
        with runtime.compilation_options():
            assert not any(now is then for now, then in zip(parts(), before, strict=True))
            raise KeyboardInterrupt

    before = parts()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert parts() == before


def test_nothing_is_replaced_in_a_version_that_was_not_tested() -> None:
    assert replace(active_compiler(), tested_version="0.0.1").patches == []


@pytest.mark.parametrize(
    ("whose", "variables", "told"),
    [("users", {}, True), ("ours", {}, False), ("ours", {"TAICHI_MSM_TRACEBACK": "1"}, True)],
)
def test_an_error_names_its_line_where_somebody_changes_kernels(
    whose: str, variables: dict[str, str], told: bool, tmp_path: Path, root: Path
) -> None:
    (tmp_path / "kernels.py").write_text(ERRORS)
    done = subprocess.run(
        [sys.executable, tmp_path / "kernels.py", whose],
        env={**os.environ, "PYTHONPATH": str(root), **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    assert 'Name "nowhere" is not defined' in done.stdout
    assert ("kernels.py" in done.stdout and "^^^^" in done.stdout) == told


OTHER = next(one for one in COMPILERS.values() if one is not active_compiler())

both = pytest.mark.skipif(find_spec(OTHER.name) is None, reason="needs both compilers")


def by_other(*arguments: str) -> None:
    """Run the program with the other compiler."""
    subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments, "--quiet"],
        env={**os.environ, "TAICHI_MSM_COMPILER": OTHER.name},
        check=True,
    )


@both
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("press", ["output=[png, trajectory]", "time.precision=f32"]),
        ("tumour", ["output=[png, trajectory]", "time.precision=f64", "time.frames_per_second=50"]),
        ("two-tools", ["output=[png, trajectory]"]),
        ("grasp", ["output=[png, trajectory, coordinates, depth, flow, occlusion, instrument, tracks]"]),
    ],
)
def test_both_compilers_give_the_same_bytes(
    name: str, settings: list[str], device: runtime.Device, tmp_path: Path, root: Path
) -> None:
    """Motion, the sheet at rest, pictures and labels, of springs and of tissue."""
    scene, settings = root / "scenes" / f"{name}.yaml", [*settings, "time.duration=0.12", "render.size=[160, 120]"]
    run(load_scene(scene, settings), tmp_path / "mine", threads=device.threads)
    words = [word for setting in settings for word in ("--set", setting)]
    by_other("run", str(scene), "--threads", str(device.threads), *words, "--out", str(tmp_path / "other"))
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
    by_other("run", "--resume", "parts", "--threads", str(device.threads))
    assert results(small / "parts") == results(small / "whole")
    record = json.loads((small / "parts" / "run.json").read_text())
    assert {active_compiler().name, OTHER.name} <= set(record["versions"])
