"""Streams that are closed, full or read by nobody, and a process that lacks what others have."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from taichi_msm.system import runtime
from taichi_msm.system.compiler import active_compiler
from tests.scenes import SMALL
from tests.telling import Telling

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a shell and a device that is always full")

RUN = "run small.yaml --set output=[trajectory]"

# What is done, and the exit code where all can be written.
GOOD = [RUN, "check small.yaml", "check small.yaml --json", "schema", "--help", "run --help"]
BAD = [f"{command} bad.yaml" for command in ("run", "check", "study", "view")] + [
    "run",
    "nothing",
    "run none.yaml --json",
]
CODES = {**dict.fromkeys(GOOD, 0), **dict.fromkeys(BAD, 2)}

# Commands that write in a way of their own, on stderr and on stdout; the others are tried by -m fuzz.
TELLING = [RUN, "--help", "check bad.yaml", "run", "nothing"]
PRINTING = [RUN, "schema", "--help", "run none.yaml --json", "run", "nothing"]


def commands(default: list[str]) -> pytest.MarkDecorator:
    """Give a test every command as its argument `command`."""
    return pytest.mark.parametrize(
        "command",
        [pytest.param(command, marks=() if command in default else pytest.mark.fuzz) for command in CODES],
    )


@pytest.fixture
def here(small: Path) -> Path:
    (small / "bad.yaml").write_text(SMALL.replace("shear", "shaer"))
    return small


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a line of shell in which `msm` is the program."""
    program = f"{shlex.quote(sys.executable)} -W error::RuntimeWarning -m taichi_msm"
    made = f'set -o pipefail; msm() {{ {program} "$@"; }}; {line}'
    kept = {name: value for name, value in os.environ.items() if environment.get(name) != ""}
    return subprocess.run(
        ["bash", "-c", made], capture_output=True, text=True, check=False, timeout=60, env={**kept, **environment}
    )


@commands(TELLING)
def test_errors_that_nobody_can_read_do_not_change_the_exit_code(command: str, here: Path) -> None:
    for outlet in ("2>&-", "2>/dev/full", "2> >(true)") if command != RUN else ("2>&-",):
        assert shell(f"msm {command} >/dev/null {outlet}").returncode == CODES[command]
    assert (here / "output" / "small" / "trajectory.npz").exists() == (command == RUN)


@commands(PRINTING)
def test_results_that_nobody_can_read_are_4(command: str, here: Path) -> None:
    """A stream that was closed is one that nobody wants; what was wrong with the input goes to stderr."""
    said_on_stdout = command in GOOD or "--json" in command
    code = 4 if said_on_stdout else CODES[command]
    full = shell(f"msm {command} >/dev/full")
    assert full.returncode == code
    assert ("No space left on device" in full.stderr) == said_on_stdout
    assert full.stderr.count("\n") <= 2
    assert "Traceback" not in full.stderr
    if command != RUN:
        assert shell(f"msm {command} | true").returncode in (code, CODES[command])
        assert shell(f"msm {command} >&-").returncode == CODES[command]


@pytest.mark.parametrize("stage", ["heard", "compile", "frames"])
def test_a_signal_is_heard_though_nobody_can_read_of_it(stage: str, here: Path) -> None:
    command = ["run", "small.yaml", "--set", "render.size=[2048,2048]"]
    with Path("/dev/full").open("w") as full, Telling(*command, stdout=full, stderr=full) as process:
        process.until(stage)
        process.terminate()
        assert process.wait(timeout=60) == 143


def test_results_into_a_pipe_that_nobody_reads(here: Path) -> None:
    done = shell(f"msm {RUN} | true")
    assert (done.returncode, done.stderr) == (4, "")
    assert (here / "output" / "small" / "run.json").exists()


@pytest.mark.parametrize("environment", [{"HOME": ""}, {"HOME": "/proc/none"}, {active_compiler().folder_variable: ""}])
def test_without_a_home(environment: dict[str, str], here: Path) -> None:
    done = shell(f"{'unset HOME; ' if environment.get('HOME') == '' else ''}msm {RUN}", **environment)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit addresses")
def test_too_little_address_space_is_one_clear_line(here: Path) -> None:
    done = shell(f"ulimit -v 1200000; msm {RUN}")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        f"{active_compiler().title} needs 1900 MiB of address space, and this process may have 1171 MiB; "
        "raise its limit (ulimit -v)\n"
    )


def test_a_current_folder_that_is_gone_is_one_clear_line(here: Path) -> None:
    done = shell(f"mkdir gone; cd gone; rmdir ../gone; msm run {shlex.quote(str(here / 'small.yaml'))}")
    assert (done.returncode, done.stderr) == (4, "taichi-msm: the current folder is gone; change to another\n")


def test_numbers_too_large_are_no_warning(here: Path) -> None:
    force = "--set probes.0.force=[0,0,1e30] --set probes.0.load=[[0,1e30]] --set probes.0.offset=-50"
    done = shell(f"msm {RUN} {force}")
    assert done.returncode == 3
    assert done.stderr.startswith("small.yaml: diverged at ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("files", "left", "blocks", "kept"),
    [(100, 0, 10**6, False), (100, 3, 10**6, False), (100, 99, 10, False), (0, 0, 10**6, True), (100, 99, 10**6, True)],
)
def test_a_cache_that_has_no_room_is_not_used(
    files: int, left: int, blocks: int, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Taichi would abort the process at its end. Some file systems do not count files."""
    room = SimpleNamespace(f_files=files, f_favail=left, f_bavail=blocks, f_frsize=4096)
    monkeypatch.setattr(os, "statvfs", lambda folder: room, raising=False)
    monkeypatch.setenv(active_compiler().folder_variable, str(tmp_path))
    assert (runtime._cache() == {}) == kept
