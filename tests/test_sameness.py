"""The same scene gives the same bytes, whoever runs it where; and a run leaves nothing else behind."""

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

# Loaded by every Python that starts: notes what it does on the network, and every file that it opens to write.
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

# Names of files need be no text, nor ASCII.
ODD = "two \udcff" if sys.platform == "linux" else "two"
NAMES = ("one é🧠", ODD, "three", "four")


class Runs(NamedTuple):
    """What four runs did."""

    folder: Path  # holds `here`, the current directory of the runs, `home`, `temporary`, and `watched`, what they did
    printed: Sequence[bytes]  # by the first two, which ran at the same time


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, root: Path) -> Runs:
    """Run a scene in two processes at once, of which neither finds compiled kernels, and then twice in a third one."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("here", "home", "temporary", "watch"):
        (folder / name).mkdir()
    (folder / "watch" / "sitecustomize.py").write_text(WATCH)
    ours = ("TI_", "QD_", "PYTHON", "LC_", "XDG_")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    kept |= {"HOME": str(folder / "home"), "TMPDIR": str(folder / "temporary"), "WATCH": str(folder / "watched")}
    kept |= {"PYTHONPATH": os.pathsep.join((str(folder / "watch"), str(root))), "PYTHONDONTWRITEBYTECODE": "1"}
    plain = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    scene = str(root / "scenes" / "press.yaml")
    overrides = [word for setting in SETTINGS for word in ("--set", setting)]
    command = [sys.executable, "-m", "taichi_msm", "run", scene, "--threads", "2", *overrides, "--out"]
    processes = [
        subprocess.Popen(
            [*command, directory],
            cwd=folder / "here",
            env={**kept, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        for directory, environment in (
            (NAMES[0], {"PYTHONHASHSEED": "0", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "1"}),
            (NAMES[1], {"PYTHONHASHSEED": "1", "PYTHONIOENCODING": "utf-8:strict", **plain}),
        )
    ]
    printed = [process.communicate(timeout=120)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], printed
    subprocess.run(
        [sys.executable, "-c", TWICE, scene, *NAMES[2:], *SETTINGS], cwd=folder / "here", env=kept, check=True
    )
    return Runs(folder, printed)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(NAMES[1], id="in two processes at once"),
        pytest.param(NAMES[2], id="with another number of threads"),
        pytest.param(NAMES[3], id="again in the same process"),
    ],
)
def test_the_same_bytes(name: str, runs: Runs) -> None:
    first = results(runs.folder / "here" / NAMES[0])
    assert sorted(first) == ["animation.gif", *(f"frames/000{n}.png" for n in range(3)), "trajectory.npz"]
    assert results(runs.folder / "here" / name) == first


def run_press(out: Path, settings: Sequence[str], root: Path, debug: str) -> dict[str, bytes]:
    """The results of a shipped scene, with or without Taichi's debug mode."""
    overrides = [word for setting in settings for word in ("--set", setting)]
    command = [sys.executable, "-m", "taichi_msm", "run", str(root / "scenes" / "press.yaml"), *overrides]
    environment = {**os.environ, f"{active_compiler().prefix}_DEBUG": debug}
    subprocess.run([*command, "--out", str(out)], env=environment, check=True)
    return results(out)


@pytest.mark.slow
def test_the_same_bytes_while_bounds_are_checked(runs: Runs, root: Path, tmp_path: Path) -> None:
    """Taichi stops at an access outside a field; what its debug mode cannot compile would show here, too."""
    assert run_press(tmp_path / "out", SETTINGS, root, "1") == results(runs.folder / "here" / NAMES[0])


@pytest.mark.slow
@pytest.mark.parametrize("fixed", ["border", "[left]"])
def test_tissue_gives_the_same_bytes_while_bounds_are_checked(fixed: str, root: Path, tmp_path: Path) -> None:
    """A map, bands, a tool that moves, and bending or edges that move."""
    settings = [
        "sheet.points=[33, 35]",
        f"sheet.fixed={fixed}",
        "tissue.map={image: textures/tumour.png, range: [1, 13]}",
        "tissue.bending=plate" if fixed == "border" else "tissue.pretension=0",
        "probes.0.at=[[0, 0.1, 0.1], [0.05, 0.9, 0.95]]",
        "time.duration=0.08",
        "output=[trajectory]",
    ]
    assert run_press(tmp_path / "0", settings, root, "0") == run_press(tmp_path / "1", settings, root, "1")


def test_any_name_in_any_locale(runs: Runs) -> None:
    # click takes a terminal that is said to know ASCII alone for one that is set up wrongly, and speaks UTF-8 to it.
    assert f"{NAMES[0]}: 3 frames, " in runs.printed[0].decode()
    assert (b"two \\udcff: 3 frames, " if ODD != "two" else b"two: 3 frames, ") in runs.printed[1]


def test_nothing_is_written_elsewhere(runs: Runs) -> None:
    here, home = runs.folder / "here", runs.folder / "home"
    assert sorted(path.name for path in here.iterdir()) == sorted(NAMES)
    for name in NAMES:
        names = sorted(path.name for path in (here / name).iterdir())
        assert names == ["animation.gif", "frames", "run.json", "trajectory.npz"]
    files = [path.relative_to(home).parts for path in home.rglob("*") if path.is_file()]
    assert {parts[:3] for parts in files} == {Path(active_compiler().cache).parts}
    assert list((runs.folder / "temporary").iterdir()) == []
    lines = (runs.folder / "watched").read_text().splitlines()
    written = [Path(line.removeprefix("write ")) for line in lines if line.startswith("write ")]
    assert any(path.name == "run.json" for path in written)
    allowed = (here, home, runs.folder / "temporary")
    assert [path for path in written if not any(map(path.is_relative_to, allowed)) and path != Path(os.devnull)] == []


def test_no_run_opens_a_socket(runs: Runs) -> None:
    lines = (runs.folder / "watched").read_text().splitlines()
    assert lines
    assert [line for line in lines if line.startswith("socket.")] == []
