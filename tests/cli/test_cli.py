"""The command line: files, texts, exit codes."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from taichi_msm.cli import console
from taichi_msm.cli.main import main
from taichi_msm.errors import DivergedError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.system import runtime
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.process import Interruption
from tests import reference
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files
from tests.reporting_process import ReportingProcess
from tests.scenes import SMALL


def separate_process(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the program in a separate process, for tests of its start, its end and its environment."""
    return subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments], capture_output=True, text=True, check=False, **options
    )


def test_run_writes_all_outputs(small: Path, program: Program) -> None:
    done = program("run", "small.yaml")
    assert done.returncode == 0
    summary = "output/small: 5 frames, 164 steps of 0.002439 s in f64, 9 x 11 points, largest displacement 0.0"
    assert done.stdout.startswith(summary)

    out = small / "output" / "small"
    assert sorted(path.name for path in out.iterdir()) == ["animation.gif", "frames", "run.json", "trajectory.npz"]
    assert sorted(path.name for path in (out / "frames").iterdir()) == [f"000{n}.png" for n in range(5)]
    trajectory = np.load(out / "trajectory.npz")
    np.testing.assert_allclose(trajectory["position"], reference.simulate(load_scene("small.yaml")), atol=1e-6)
    np.testing.assert_allclose(trajectory["time"], [0, 0.1, 0.2, 0.3, 0.4])
    record = json.loads((out / "run.json").read_text())
    assert record["status"] == "complete"
    assert record["steps"] == record["steps_per_frame"] * 4 == 164
    assert set(record["timings"]) == {"startup", "pilot", "compile", "simulate", "render", "encode", "total"}
    assert record["outputs"] == ["frames", "animation.gif", "trajectory.npz", "run.json"]
    assert (record["arch"], record["threads"], record["overrides"]) == ("cpu", 2, [])


@pytest.mark.parametrize(("typed", "completed"), [("ru", "run"), ("run --estimate", "--estimate-error")])
def test_completion_in_a_shell(typed: str, completed: str, program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_TAICHI_MSM_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", f"taichi-msm {typed}")
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split())))
    done = program("--version")  # ignored
    assert (done.returncode, done.stdout) == (0, f"plain,{completed}\n")


def test_json_output_of_run(small: Path, program: Program) -> None:
    done = program("run", "small.yaml", "--json", "--set", "output=[]", "--out", "out")
    record = json.loads(done.stdout)
    assert done.stderr == ""
    assert (record["directory"], record["overrides"], record["outputs"]) == ("out", ["output=[]"], ["run.json"])
    assert [path.name for path in (small / "out").iterdir()] == ["run.json"]


def test_tolerance_chooses_the_step(small: Path, program: Program) -> None:
    done = program("run", "small.yaml", "--set", "output=[]", "--set", "time.tolerance=1e-4", "--out", "out")
    assert (done.returncode, done.stderr) == (0, "")
    record = json.loads((small / "out" / "run.json").read_text())
    assert record["steps_per_frame"] > 41
    assert (record["scene"]["time"]["step"], record["scene"]["time"]["tolerance"]) == (record["step"], None)
    assert record["asked"] == {"time.step": "auto", "time.precision": "auto", "time.tolerance": 1e-4}
    estimate = record["error_estimate"]
    assert set(estimate) == {"error", "rounding", "in_f64", "order", "at_least"}
    assert 0 == estimate["rounding"] < estimate["error"] <= 1e-4
    assert "error: time step 0.0" in done.stdout


def test_study_without_a_writable_directory(
    small: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("taichi_msm.study.study.run_study", begun)
    (small / "file").touch()
    for out in ("file", "file/below"):
        done = program("study", "small.yaml", "--out", out)
        assert done.returncode == 4
        message(done.stderr, out)


@pytest.mark.slow
def test_interrupted_study_keeps_its_measurements(small: Path) -> None:
    """They are in a separate folder next to an earlier study."""
    (small / "out").mkdir()
    (small / "out" / "study.json").write_text("earlier")
    outlets = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with ReportingProcess("study", "small.yaml", "--out", "out", **outlets) as process:
        process.until("stepping", 20)
        process.send_signal(signal.SIGINT)
        output, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert (small / "out" / "study.json").read_text() == "earlier"
    assert ("interrupted" in error, "interrupted" in output) == (False, True)
    assert json.loads((small / "out/interrupted/study.json").read_text())["status"] == "interrupted"


def test_divergence_has_exit_code_3(small: Path, program: Program, message: Messages) -> None:
    """The step is stable; the force folds the springs over."""
    done = program("run", "small.yaml", "--set", "probes.0.force=[0,0,-1e12]", "--out", "out", "--quiet")
    assert done.returncode == 3
    message(done.stderr, "step 1", "point (4, 5)", "probes.0.force", "out/.partial/checkpoint/state.npz")
    with np.load(small / "out/.partial/checkpoint/state.npz") as dump:
        assert dump["steps"] == 0
        assert np.isfinite(dump["displacement"]).all()
    again = program("run", "--resume", "out", "--quiet")
    assert (again.returncode, again.stderr) == (3, done.stderr.replace("small.yaml", "out"))
    record = json.loads((small / "out" / "run.json").read_text())
    assert (record["status"], record["frames"]) == ("diverged", 1)
    assert [path.name for path in (small / "out" / "frames").iterdir()] == ["0000.png"]
    assert np.isfinite(np.load(small / "out" / "trajectory.npz")["position"]).all()


@pytest.mark.default_cases("encoder")
@pytest.mark.parametrize(
    ("number", "code", "threads"),
    [(signal.SIGINT, 130, "1"), (signal.SIGTERM, 143, "2")],
    ids=["no encoder", "encoder"],
)
def test_signal_keeps_the_finished_frames(
    number: signal.Signals, code: int, threads: str, small: Path, message: Messages
) -> None:
    """A run with one thread has no encoder process."""
    settings = ["--set", "time.duration=2000", "--set", "render.size=[200,150]", "--set", "output=[png, trajectory]"]
    command = ["run", "small.yaml", "--out", "long", "--threads", threads, *settings]
    with ReportingProcess(*command, stderr=subprocess.PIPE) as process:
        process.until("frames", 9)
        assert len(children(process.pid)) == (threads != "1")
        if number == signal.SIGTERM:
            # All processes of a service get the signal, also the encoder, which ignores both.
            for child in children(process.pid):
                os.kill(child, number)
                os.kill(child, signal.SIGINT)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == code
    record = json.loads((small / "long" / "run.json").read_text())
    assert record["status"] == "interrupted"
    frames = record["frames"]
    assert 3 < frames < 20000
    # On a slow machine lines of progress precede it.
    assert f"long: {frames};" in error
    message(error.splitlines()[-1], "--resume long", hide=rf"\b{frames}\b")
    assert len(list((small / "long" / "frames").iterdir())) == frames
    assert np.load(small / "long" / "trajectory.npz")["position"].shape == (frames, 9, 11, 3)


def children(process: int) -> list[int]:
    """Return the child processes of a process."""
    file = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in file.read_text().split()] if file.exists() else []


@pytest.mark.parametrize(("number", "stage"), [(signal.SIGINT, "heard"), (signal.SIGTERM, "compile")])
def test_signal_before_the_first_frame_changes_nothing(
    number: signal.Signals, stage: str, small: Path, message: Messages
) -> None:
    # The picture is so large that no frame is finished before the signal.
    (small / "out").mkdir()
    earlier = '{"outputs": ["run.json"], "frames": 0}'
    (small / "out" / "run.json").write_text(earlier)
    settings = ["--set", "render.size=[2048,2048]", "--set", "render.supersample=4", "--set", "output=[png]"]
    with ReportingProcess("run", "small.yaml", "--out", "out", *settings, stderr=subprocess.PIPE) as process:
        process.until(stage)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    message(error.splitlines()[-1])
    assert [path.name for path in (small / "out").iterdir()] == ["run.json"]
    assert (small / "out" / "run.json").read_text() == earlier


@pytest.mark.parametrize("command", ["check", "view"])
def test_interrupted_command_without_results(command: str, small: Path, message: Messages) -> None:
    with ReportingProcess(command, "small.yaml", stderr=subprocess.PIPE) as process:
        process.until("heard")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT
    message(error, "interrupted")


def test_second_signal_ends_the_process(message: Messages) -> None:
    listening = "import signal; from taichi_msm.system.process import Interruption; Interruption().listen()"
    program = f"{listening}; signal.raise_signal(signal.SIGTERM); signal.raise_signal(signal.SIGINT)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGINT
    message(done.stderr, "twice")


def test_ignored_signals_stay_ignored() -> None:
    """A shell's background ignores SIGINT, and nohup SIGHUP."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interruption = Interruption()
    interruption.listen()
    signal.raise_signal(signal.SIGINT)
    interruption.raise_if_requested()
    signal.raise_signal(signal.SIGHUP)
    with pytest.raises(KeyboardInterrupt):
        interruption.raise_if_requested()
    assert interruption.code == 128 + signal.SIGHUP


@pytest.mark.slow
def test_stale_lock_of_the_cache(small: Path) -> None:
    environment = {**os.environ, active_compiler().folder_variable: str(small / "cache")}
    lock = small / "cache" / active_compiler().lock
    lock.parent.mkdir(parents=True)

    def kernels() -> list[Path]:
        return [path for path in lock.parent.iterdir() if path.suffix in (".tic", ".qdc")]

    # These settings have few kernels.
    bare = ["--set", "output=[]", "--set", "springs={structural: 20}", "--set", "probes=[]", "--set", "damping=0"]
    for age, used in ((3600, True), (0, False)):
        lock.touch()
        os.utime(lock, (time.time() - age, time.time() - age))
        for path in kernels():
            path.unlink()
        done = separate_process("run", "small.yaml", *bare, "--out", "out", env=environment)
        assert done.returncode == 0, done.stderr
        assert bool(kernels()) == used, "only a recent lock is respected"


Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    """Return a function that runs a command without a device, and returns its exit code, stdout and stderr."""

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def test_nothing_to_continue_in_a_complete_run(results: Path, program: Program, message: Messages) -> None:
    resumed = program("run", "--resume", str(results))
    assert resumed.returncode == 2
    message(resumed.stderr, "complete run")


WRONG: dict[str, list[str]] = {
    "no scene": ["run", "nowhere.yaml"],
    "keys": ["check", "small.yaml", "--set", "springs.shaer=3", "--set", "sheet.mass=0"],
    "step": ["check", "small.yaml", "--set", "time.step=0.1"],
    "empty folder": ["run", "small.yaml", "--out", ""],
    "again and scene": ["run", "--again", "out", "small.yaml"],
    "nothing to resume": ["run", "--resume", "nowhere"],
    "unfinished run in an empty folder": ["run", "--resume", "."],
    "resume and scene": ["run", "small.yaml", "--resume", "out"],
    "no argument": ["run"],
    "blank in a value": ["check", "a.yaml", "--set", "sheet.points=[61,", "61]"],
    "no folder to export": ["export", "--format", "obj"],
    "no format": ["export", "results"],
    "unknown format": ["export", "results", "--format", "glft"],
    "unknown arch": ["run", "small.yaml", "--arch", "cuda1"],
    "unknown command": ["jump"],
    "threads": ["run", "small.yaml", "--threads", "0"],
    "tolerance": ["study", "small.yaml", "--tolerance", "2"],
}


@pytest.mark.parametrize("arguments", WRONG.values(), ids=WRONG)
def test_invalid_arguments(arguments: list[str], small: Path, call: Call, message: Messages) -> None:
    code, out, error = call(*arguments)
    assert (code, out) == (2, "")
    message(error)
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"]


def test_remaining_time_within_a_frame(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with closing(console.ProgressDisplay(False)) as progress, closing(console.ProgressDisplay(True)) as silent:
        for now, frame in ((0, 1), (11, 1), (50, 2), (51, 2), (61, 2), (250, 2)):  # noqa: B007
            progress.update("frames", frame, 4)
            silent.update("frames", frame, 4)
        # The next companion run begins at its first frame.
        for now, frame in ((260, 1), (270, 2), (280, 1), (290, 2)):  # noqa: B007
            progress.update("pilot", frame, 4)
    message(capsys.readouterr().err)


@pytest.mark.parametrize(
    "stem",
    [
        "with a space",
        "Schleimhaut Ä🧠",
        "-dash",
        pytest.param("\udcff", marks=pytest.mark.skipif(sys.platform != "linux", reason="names are text")),
    ],
    ids=["blank", "letters", "dash", "bytes"],
)
def test_scenes_of_any_name(stem: str, small: Path, call: Call, message: Messages) -> None:
    (small / "small.yaml").rename(f"{stem}.yaml")
    code, out, err = call("check", "--", f"{stem}.yaml")
    assert (code, out[:19], err) == (0, "image: speckle.png\n", "")
    Path(f"{stem}.yaml").write_text(SMALL.replace("shear", "shaer"))
    code, out, err = call("check", "--", f"{stem}.yaml")
    assert (code, out) == (2, "")
    message(err, "\\udcff" if stem == "\udcff" else stem, "springs.shaer")


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="these names have no suffix, and are names of folders")
@pytest.mark.parametrize("name", ["...yaml", "..yaml"])
def test_scene_names_without_a_folder(name: str, small: Path, call: Call, message: Messages) -> None:
    """Results would replace those of the parent folder."""
    (small / name).write_bytes((small / "small.yaml").read_bytes())
    before = files(small)
    code, _, error = call("run", name)
    assert code == 2
    message(error, "--out")
    assert files(small) == before


def test_locale_without_unicode(small: Path, message: Messages) -> None:
    """Only ASCII names of files can be decoded and encoded."""
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONIOENCODING"} | plain
    (small / "é.yaml").write_text(SMALL.replace("speckle", "ü").replace("shear", "shaer"), encoding="utf-8")
    done = separate_process("check", "é.yaml", env=environment)
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "\\udcc3\\udca9.yaml:1:1: image", "ü.png")


def test_missing_arch(small: Path, message: Messages) -> None:
    done = separate_process("run", "small.yaml", "--arch", "cuda")
    if done.returncode == 0:
        pytest.skip("this machine has CUDA")
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "--arch")
    assert not (small / "output").exists()


def test_errors_as_json(small: Path, call: Call, message: Messages) -> None:
    code, out, err = call("check", "small.yaml", "--json", "--set", "damping=-1")
    assert code == 2
    message(err, "damping")
    assert json.loads(out) == {"status": "error", "errors": err.splitlines()}


def test_check_prints_the_scene_and_its_cost(small: Path, call: Call, message: Messages) -> None:
    code, out, err = call("check", "small.yaml")
    assert (code, err) == (0, "")
    assert "falloff: 20.0" in out
    cost = out[out.index("99 points") :]
    message(
        cost,
        "5 frames, 164 steps of 0.00243902 s (limit 0.00499221 s), 41 a frame",
        hide=r"(?<=about )\d+( \w+(?= to))?",
    )
    assert not (small / "output").exists()
    report = json.loads(call("check", "small.yaml", "--json")[1])
    assert report["scene"]["time"]["damping_difference"] == "central"
    assert (report["steps"], report["frames"], report["steps_per_frame"]) == (164, 5, 41)
    report = json.loads(call("check", "small.yaml", "--json", "--set", "springs={}")[1])
    assert report["stable_step"] is None


def test_fit_that_diverges_at_its_start(
    small: Path, call: Call, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    diverged = Mock(side_effect=DivergedError("diverged at 1 s", 1, 1.0, (0, 0)))
    monkeypatch.setattr("taichi_msm.fitting.fit.fit", diverged)
    code, _, err = call("fit", "small.yaml", "tracks.npz", "--free", "damping")
    assert code == 3
    message(err, "small.yaml")


def test_check_decodes_the_picture(small: Path, call: Call, message: Messages) -> None:
    content = Path("speckle.png").read_bytes()
    Path("speckle.png").write_bytes(content[: len(content) // 2])
    code, out, error = call("check", "small.yaml")
    assert (code, out) == (2, "")
    message(error, "image", hide=r"(?<=decoded )\(.*\)")
    assert call("run", "small.yaml", "--quiet") == (2, "", error)


def test_check_prints_the_baseline_of_a_stereo_pair(small: Path, call: Call, message: Messages) -> None:
    pose = "rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation: [-0.003, 0.004, 0]"
    lens = "intrinsics: {fx: 20, fy: 15, cx: 19.5, cy: 14.5}"
    cameras = (
        f"{{left: {{eye: [0, 0, 1]}}, a: {{beside: left, baseline: -0.004}}, b: {{beside: left, {pose}, {lens}}}}}"
    )
    out = call("check", "small.yaml", "--set", f"render.cameras={cameras}")[1]
    message((line for line in out.splitlines() if line.startswith("render.")), "0.004 m", "0.005 m")


def test_bug_is_one_line(small: Path, call: Call, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("by zero\nin two lines")

    monkeypatch.delenv("TAICHI_MSM_TRACEBACK", raising=False)
    monkeypatch.setattr("taichi_msm.load.scene_file.load_plan", broken)
    code, _, err = call("check", "small.yaml")
    assert code == 1
    message(err, "TAICHI_MSM_TRACEBACK=1")


needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")


# Environment variable of the folder of compiled kernels.
FOLDER = active_compiler().folder_variable

RUN = "run small.yaml --set output=[trajectory]"

# Commands that write on stderr and on stdout, and their exit codes if all can be written.
STDERR_CODES = {RUN: 0, "check bad.yaml": 2, "nothing": 2}
STDOUT_CODES = {RUN: 0, "check small.yaml --json": 0, "--help": 0, "run none.yaml --json": 2}


@pytest.fixture
def folder(small: Path) -> Path:
    (small / "bad.yaml").write_text(SMALL.replace("shear", "shaer"))
    return small


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a line of shell in which `msm` is the program."""
    program = f"{shlex.quote(sys.executable)} -W error::RuntimeWarning -m taichi_msm"
    script = f'set -o pipefail; msm() {{ {program} "$@"; }}; {line}'
    inherited = {name: value for name, value in os.environ.items() if environment.get(name) != ""}
    return subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, check=False, timeout=60, env=inherited | environment
    )


@pytest.mark.slow
@needs_full
@pytest.mark.parametrize("command", STDERR_CODES)
def test_closed_or_full_stderr(command: str, folder: Path) -> None:
    for outlet in ("2>&-", "2>/dev/full", "2> >(true)") if command == "check bad.yaml" else ("2>&-",):
        assert shell(f"msm {command} >/dev/null {outlet}").returncode == STDERR_CODES[command]
    assert (folder / "output" / "small" / "trajectory.npz").exists() == (command == RUN)


@pytest.mark.default_cases("run small.yaml --set output=[trajectory]")
@needs_full
@pytest.mark.parametrize("command", STDOUT_CODES)
def test_closed_or_full_stdout(command: str, folder: Path, message: Messages) -> None:
    """A closed stream is not an error, in contrast to a full disk or a reader that has exited."""
    full = shell(f"msm {command} >/dev/full")
    assert full.returncode == 4
    message(full.stderr.splitlines()[-1], "No space left on device")
    assert full.stderr.count("\n") <= 2
    assert "Traceback" not in full.stderr
    if command != "--help":
        piped = shell(f"msm {command} | true")
        assert piped.returncode in (4, STDOUT_CODES[command])
        assert "Traceback" not in piped.stderr
    if command == RUN:
        assert (piped.returncode, piped.stderr) == (4, "")
        assert (folder / "output" / "small" / "run.json").exists()
    else:
        assert shell(f"msm {command} >&-").returncode == STDOUT_CODES[command]


@pytest.mark.default_cases("no folder")
@pytest.mark.parametrize(
    "environment",
    [{"HOME": "", FOLDER: ""}, {"HOME": "/proc/none", FOLDER: ""}, {FOLDER: "/dev/null/below"}],
    ids=["unset", "no folder", "no cache"],
)
def test_missing_home_or_cache(environment: dict[str, str], folder: Path) -> None:
    done = shell(f"{'unset HOME; ' if environment.get('HOME') == '' else ''}msm {RUN}", **environment)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit addresses")
def test_insufficient_address_space(folder: Path, message: Messages) -> None:
    done = shell(f"ulimit -v 1200000; msm {RUN}")
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "ulimit -v", hide=active_compiler().title)


def test_missing_current_folder(folder: Path, message: Messages) -> None:
    done = shell(f"mkdir gone; cd gone; rmdir ../gone; msm run {shlex.quote(str(folder / 'small.yaml'))}")
    assert done.returncode == 4
    message(done.stderr)


@pytest.mark.parametrize(
    ("files", "free_files", "free_blocks", "used"),
    [(100, 3, 10**6, False), (100, 99, 10, False), (0, 0, 10**6, True), (100, 99, 10**6, True)],
)
def test_cache_without_space(
    files: int, free_files: int, free_blocks: int, used: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Taichi would abort the process at its end. Some file systems do not count files."""
    system = SimpleNamespace(f_files=files, f_favail=free_files, f_bavail=free_blocks, f_frsize=4096)
    monkeypatch.setattr(os, "statvfs", lambda folder: system, raising=False)
    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert (runtime._cache_options() == {}) == used
