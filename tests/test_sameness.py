"""Reproducibility: equal scenes give equal bytes in any process and locale; a run has no side effects."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from taichi_msm.system.compiler import active_compiler
from tests.outputs import results

# Large enough for two workers to step it.
SETTINGS = ("sheet.points=[95,95]", "time.duration=0.08", "render.size=[64,48]", "render.refine=1")

# Two runs in one process.
TWICE = """
import sys
from taichi_msm import load_scene, run
scene = load_scene(sys.argv[1], sys.argv[4:])
for directory in sys.argv[2:4]:
    run(scene, directory, threads=1)
"""

# Imported by every Python process at its start: logs network events, and files opened for writing.
WATCH = """
import os, sys
log = open(os.environ["WATCH"], "a", buffering=1, encoding="ascii", errors="backslashreplace")
def note(event, given):
    if event.startswith("socket."):
        print(event, *given, file=log)
    elif event == "open" and not isinstance(given[0], int) and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        print("write", os.path.abspath(os.fsdecode(given[0])), file=log)
sys.addaudithook(note)
"""

# Names of files may be other than text, and other than ASCII.
ODD = "two \udcff" if sys.platform == "linux" else "two"
NAMES = ("one é🧠", ODD, "three", "four")


class Runs(NamedTuple):
    """Results of four runs of a scene."""

    folder: Path  # with `cwd`, the current directory of the runs, `home`, `temporary`, and `log`, the audit log
    printed: Sequence[bytes]  # output of the first two, which ran at the same time

    @property
    def log(self) -> list[str]:
        """Lines of the audit log."""
        return (self.folder / "log").read_text().splitlines()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, root: Path) -> Runs:
    """Run a scene in two processes at once, both without compiled kernels, and then twice in a third one."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("cwd", "home", "temporary", "watch"):
        (folder / name).mkdir()
    (folder / "watch" / "sitecustomize.py").write_text(WATCH)
    removed = ("TI_", "QD_", "PYTHON", "LC_", "XDG_")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(removed)}
    kept |= {"HOME": str(folder / "home"), "TMPDIR": str(folder / "temporary"), "WATCH": str(folder / "log")}
    kept |= {"PYTHONPATH": os.pathsep.join((str(folder / "watch"), str(root))), "PYTHONDONTWRITEBYTECODE": "1"}
    plain = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    environments = (
        {"PYTHONHASHSEED": "0", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "1"},
        {"PYTHONHASHSEED": "1", "PYTHONIOENCODING": "utf-8:strict", **plain},
    )
    scene = str(root / "scenes" / "press.yaml")
    overrides = [word for setting in SETTINGS for word in ("--set", setting)]
    command = [sys.executable, "-m", "taichi_msm", "run", scene, "--threads", "2", *overrides, "--out"]
    processes = [
        subprocess.Popen(
            [*command, name],
            cwd=folder / "cwd",
            env={**kept, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        for name, environment in zip(NAMES, environments, strict=False)
    ]
    printed = [process.communicate(timeout=120)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], printed
    code = [sys.executable, "-c", TWICE, scene, *NAMES[2:], *SETTINGS]
    subprocess.run(code, cwd=folder / "cwd", env=kept, check=True)
    return Runs(folder, printed)


@pytest.mark.parametrize("name", NAMES[1:], ids=["processes at once", "another number of threads", "same process"])
def test_same_bytes(name: str, runs: Runs) -> None:
    first = results(runs.folder / "cwd" / NAMES[0])
    assert sorted(first) == ["animation.gif", *(f"frames/000{n}.png" for n in range(3)), "trajectory.npz"]
    assert results(runs.folder / "cwd" / name) == first


def run_press(out: Path, settings: Sequence[str], root: Path, debug: str) -> dict[str, bytes]:
    """Results of scenes/press.yaml with Taichi's debug mode, "0" or "1": it stops at an access outside a field."""
    overrides = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "taichi_msm", "run", str(root / "scenes" / "press.yaml"), *overrides]
    environment = {**os.environ, f"{active_compiler().prefix}_DEBUG": debug}
    subprocess.run([*command, "--out", str(out)], env=environment, check=True)
    return results(out)


TISSUE = (
    "sheet.points=[33, 35]",
    "tissue.map={image: textures/tumour.png, range: [1, 13]}",
    "probes.0.at=[[0, 0.1, 0.1], [0.05, 0.9, 0.95]]",
    "time.duration=0.08",
    "output=[trajectory]",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        (*TISSUE, "sheet.fixed=border", "tissue.bending=plate"),
        (*TISSUE, "sheet.fixed=[left]", "tissue.pretension=0"),
    ],
    ids=["pictures", "map and bending", "map and free edges"],
)
def test_same_bytes_with_bounds_checks(settings: Sequence[str], root: Path, tmp_path: Path) -> None:
    assert run_press(tmp_path / "0", settings, root, "0") == run_press(tmp_path / "1", settings, root, "1")


def test_any_name_in_any_locale(runs: Runs) -> None:
    # In an ASCII terminal click assumes a wrong setting, and writes UTF-8.
    assert f"{NAMES[0]}: 3 frames, " in runs.printed[0].decode()
    assert (b"two \\udcff: 3 frames, " if ODD != "two" else b"two: 3 frames, ") in runs.printed[1]


def test_only_out_and_the_cache_are_written(runs: Runs) -> None:
    cwd, home, temporary = (runs.folder / name for name in ("cwd", "home", "temporary"))
    assert sorted(path.name for path in cwd.iterdir()) == sorted(NAMES)
    for name in NAMES:
        names = sorted(path.name for path in (cwd / name).iterdir())
        assert names == ["animation.gif", "frames", "run.json", "trajectory.npz"]
    files = [path.relative_to(home).parts for path in home.rglob("*") if path.is_file()]
    assert {parts[:3] for parts in files} == {Path(active_compiler().cache).parts}
    assert list(temporary.iterdir()) == []
    written = [Path(line.removeprefix("write ")) for line in runs.log if line.startswith("write ")]
    assert any(path.name == "run.json" for path in written)
    elsewhere = [path for path in written if not any(map(path.is_relative_to, (cwd, home, temporary)))]
    assert set(elsewhere) <= {Path(os.devnull)}


def test_no_run_opens_a_socket(runs: Runs) -> None:
    assert runs.log
    assert not [line for line in runs.log if line.startswith("socket.")]
