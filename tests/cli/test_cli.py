"""The command line as a person meets it: files, texts, exit codes."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from taichi_msm.cli import console
from taichi_msm.cli.main import main
from taichi_msm.load.scene_file import load_scene
from taichi_msm.system import runtime
from taichi_msm.system.compiler import active_compiler
from tests import reference
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files
from tests.reporting_process import ReportingProcess
from tests.scenes import SMALL, speckle


def own_process(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own: for its start and end, its threads and what it finds around it."""
    return subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments], capture_output=True, text=True, check=False, **options
    )


def test_run_writes_everything(small: Path, program: Program) -> None:
    done = program("run", "small.yaml")
    assert done.returncode == 0
    said = "output/small: 5 frames, 164 steps of 0.002439 s in f64, 9 x 11 points, largest displacement 0.0"
    assert done.stdout.startswith(said)

    out = small / "output" / "small"
    assert sorted(path.name for path in out.iterdir()) == ["animation.gif", "frames", "run.json", "trajectory.npz"]
    assert sorted(path.name for path in (out / "frames").iterdir()) == [f"000{n}.png" for n in range(5)]
    scene = load_scene("small.yaml")
    twin = reference.simulate(scene)
    trajectory = np.load(out / "trajectory.npz")
    assert trajectory["position"].dtype == np.float64
    np.testing.assert_allclose(trajectory["position"], twin, atol=1e-6)
    np.testing.assert_allclose(trajectory["time"], [0, 0.1, 0.2, 0.3, 0.4])
    for frame in (0, 2):
        expected = reference.draw(scene, trajectory["position"][frame].astype(float), speckle(30, 40))
        apart = np.abs(np.array(Image.open(out / "frames" / f"000{frame}.png")).astype(int) - expected)
        assert (apart > 1).mean() < 0.01
    record = json.loads((out / "run.json").read_text())
    assert record["status"] == "complete"
    assert record["scene"]["render"]["camera"] == "top"
    assert record["steps"] == record["steps_per_frame"] * 4 == 164
    assert record["max_displacement"] == pytest.approx(np.linalg.norm(twin - twin[0], axis=-1).max(), rel=1e-4)
    assert set(record["timings"]) == {"startup", "pilot", "compile", "simulate", "render", "encode", "total"}
    assert record["outputs"] == ["frames", "animation.gif", "trajectory.npz", "run.json"]
    assert (record["arch"], record["threads"], record["overrides"]) == ("cpu", 2, [])


def test_json_is_all_there_is_on_stdout(small: Path, program: Program) -> None:
    done = program("run", "small.yaml", "--json", "--set", "output=[]", "--out", "here")
    record = json.loads(done.stdout)
    assert done.stderr == ""
    assert record["directory"] == "here"
    assert record["overrides"] == ["output=[]"]
    assert record["outputs"] == ["run.json"]
    assert sorted(path.name for path in (small / "here").iterdir()) == ["run.json"]


def test_a_tolerance_chooses_the_step_and_is_reported(small: Path, program: Program) -> None:
    done = program("run", "small.yaml", "--set", "output=[]", "--set", "time.tolerance=1e-4", "--out", "here")
    assert (done.returncode, done.stderr) == (0, "")
    record = json.loads((small / "here" / "run.json").read_text())
    assert record["steps_per_frame"] > 41
    assert record["steps"] == 4 * record["steps_per_frame"]
    assert (record["scene"]["time"]["step"], record["scene"]["time"]["tolerance"]) == (record["step"], None)
    assert record["asked"] == {"time.step": "auto", "time.precision": "auto", "time.tolerance": 1e-4}
    estimate = record["error_estimate"]
    assert set(estimate) == {"error", "rounding", "in_f64", "order", "at_least"}
    assert 0 == estimate["rounding"] < estimate["error"] <= 1e-4
    assert "error: time step 0.0" in done.stdout
    assert "mesh error unknown: another number of points is another sheet" in done.stdout
    assert record["timings"]["pilot"] > 0


def test_a_tolerance_out_of_reach_is_refused_and_keeps_earlier_results(
    small: Path, program: Program, message: Messages
) -> None:
    (small / "kept").mkdir()
    (small / "kept" / "run.json").write_text("earlier")
    settings = ["--set", "output=[]", "--set", "time.tolerance=1e-9", "--set", "time.precision=f32"]
    done = program("run", "small.yaml", *settings, "--out", "kept")
    assert done.returncode == 2
    message(done.stderr, "time.tolerance", "f32", hide=r"(?<=makes ).*?(?=;|$)")
    assert (small / "kept" / "run.json").read_text() == "earlier"


@pytest.mark.slow
def test_a_study_ends_in_lines_that_the_scene_takes(small: Path, program: Program) -> None:
    """And a run of it is as right as they promise."""
    common = ["--set", "damping=0.02", "--set", "image=null", "--set", "output=[]"]
    done = program("study", "small.yaml", "--quick", "--json", "--tolerance", "2e-3", *common)
    found = json.loads(done.stdout)
    assert (done.returncode, found["status"], found["tolerance"]) == (0, "complete", 2e-3)
    assert max(peer["error"] for peer in found["peers"]) < 1e-2, "two methods agree"
    step, *method = yaml.safe_load("\n".join(found["recommendation"]))["time"].items()
    settings = [word for key, value in (step, *method) for word in ("--set", f"time.{key}={value}")]
    again = program("run", "small.yaml", *common, *settings, "--estimate-error", "--json", "--out", "again")
    (promised,) = (
        one["error"]
        for one in found["stepping"]
        if (f"{one['step']:.12g}", one["damping_difference"], one["precision"])
        == (f"{step[1]:.12g}", *(value for _, value in method))
    )
    assert promised <= 2e-3
    assert json.loads(again.stdout)["error_estimate"]["error"] == pytest.approx(promised, rel=0.3)


def test_a_study_that_could_not_be_written_is_not_begun(
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
@pytest.mark.parametrize(("stage", "runs"), [("heard", 0), ("stepping", 20)])
def test_ctrl_c_leaves_what_a_study_has_done(stage: str, runs: int, small: Path, message: Messages) -> None:
    """In a folder of its own where there is an earlier study."""
    (small / "here").mkdir()
    (small / "here" / "study.json").write_text("earlier")
    outlets = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with ReportingProcess("study", "small.yaml", "--out", "here", **outlets) as process:
        process.until(stage, runs)
        process.send_signal(signal.SIGINT)
        printed, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert (small / "here" / "study.json").read_text() == "earlier"
    if runs:
        assert ("interrupted" in error, "interrupted" in printed) == (False, True)
        assert json.loads((small / "here/interrupted/study.json").read_text())["status"] == "interrupted"
    else:
        # On a slow machine lines of progress come first.
        message(error.splitlines()[-1])
        assert [path.name for path in (small / "here").iterdir()] == ["study.json"]


def test_a_simulation_that_runs_away_stops_with_3(small: Path, program: Program, message: Messages) -> None:
    # Within the step's limit, but pressed with a force that folds the springs over.
    done = program("run", "small.yaml", "--set", "probes.0.force=[0,0,-1e12]", "--out", "wild", "--quiet")
    assert done.returncode == 3
    message(done.stderr, "step 1", "point (4, 5)", "probes.0.force", "wild/.partial/checkpoint/state.npz")
    with np.load(small / "wild/.partial/checkpoint/state.npz") as dump:
        assert dump["steps"] == 0
        assert np.isfinite(dump["displacement"]).all()
    again = program("run", "--resume", "wild", "--quiet")
    assert (again.returncode, again.stderr) == (3, done.stderr.replace("small.yaml", "wild"))
    record = json.loads((small / "wild" / "run.json").read_text())
    assert (record["status"], record["frames"]) == ("diverged", 1)
    assert [path.name for path in (small / "wild" / "frames").iterdir()] == ["0000.png"]
    assert np.isfinite(np.load(small / "wild" / "trajectory.npz")["position"]).all()


@pytest.mark.default_cases("encoder")
@pytest.mark.parametrize(
    ("number", "code", "threads"),
    [(signal.SIGINT, 130, "1"), (signal.SIGTERM, 143, "2")],
    ids=["no encoder", "encoder"],
)
def test_a_signal_keeps_the_frames_so_far(
    number: signal.Signals, code: int, threads: str, small: Path, message: Messages
) -> None:
    """With one thread there is no encoder."""
    settings = ["--set", "time.duration=2000", "--set", "render.size=[200,150]", "--set", "output=[png, trajectory]"]
    command = ["run", "small.yaml", "--out", "long", "--threads", threads, *settings]
    with ReportingProcess(*command, stderr=subprocess.PIPE) as process:
        process.until("frames", 9)
        assert len(children(process.pid)) == (threads != "1")
        if number == signal.SIGTERM:
            # A service's processes all get it, the encoder too, which ignores SIGINT likewise.
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
    # On a slow machine lines of progress come first.
    assert f"long: {frames};" in error
    message(error.splitlines()[-1], "--resume long", hide=rf"\b{frames}\b")
    assert len(list((small / "long" / "frames").iterdir())) == frames
    assert np.load(small / "long" / "trajectory.npz")["position"].shape == (frames, 9, 11, 3)


def children(process: int) -> list[int]:
    """List the processes that another one started."""
    listed = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in listed.read_text().split()] if listed.exists() else []


@pytest.mark.parametrize(
    ("number", "stage", "delay"),
    [
        (signal.SIGINT, "heard", 0.0),
        (signal.SIGTERM, "compile", 0.0),
        (signal.SIGINT, "heard", 0.2),
        *(pytest.param(signal.SIGINT, "heard", delay, marks=pytest.mark.fuzz) for delay in (0.1, 0.3, 0.5, 0.7, 0.9)),
    ],
)
def test_a_signal_before_the_first_frame_changes_nothing(
    number: signal.Signals, stage: str, delay: float, small: Path, message: Messages
) -> None:
    # A large picture, so that no frame is done in the time.
    (small / "kept").mkdir()
    earlier = '{"outputs": ["run.json"], "frames": 0}'
    (small / "kept" / "run.json").write_text(earlier)
    settings = ["--set", "render.size=[2048,2048]", "--set", "render.supersample=4", "--set", "output=[png]"]
    with ReportingProcess("run", "small.yaml", "--out", "kept", *settings, stderr=subprocess.PIPE) as process:
        process.until(stage)
        time.sleep(delay)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    message(error.splitlines()[-1])
    assert [path.name for path in (small / "kept").iterdir()] == ["run.json"]
    assert (small / "kept" / "run.json").read_text() == earlier


@pytest.mark.slow
def test_a_stale_lock_does_not_cost_the_cache(small: Path) -> None:
    environment = {**os.environ, active_compiler().folder_variable: str(small / "cache")}
    lock = small / "cache" / active_compiler().lock
    lock.parent.mkdir(parents=True)

    def kernels() -> list[Path]:
        return [path for path in lock.parent.iterdir() if path.suffix in (".tic", ".qdc")]

    # Soon compiled.
    bare = ["--set", "output=[]", "--set", "springs={structural: 20}", "--set", "probes=[]", "--set", "damping=0"]
    for age, kept in ((3600, True), (0, False)):
        lock.touch()
        os.utime(lock, (time.time() - age, time.time() - age))
        for path in kernels():
            path.unlink()
        done = own_process("run", "small.yaml", *bare, "--out", "here", env=environment)
        assert done.returncode == 0, done.stderr
        assert bool(kernels()) == kept, "someone else's lock is respected, a dead one's is not"


Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    """A command that needs no device; returns exit code, stdout and stderr."""

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


WRONG: dict[str, list[str]] = {
    "no scene": ["run", "nowhere.yaml"],
    "keys": ["check", "small.yaml", "--set", "springs.shaer=3", "--set", "sheet.mass=0"],
    "step": ["check", "small.yaml", "--set", "time.step=0.1"],
    "empty folder": ["run", "small.yaml", "--out", ""],
    "again and scene": ["run", "--again", "there", "small.yaml"],
    "again and set": ["run", "--again", "there", "--set", "damping=1"],
    "again and resume": ["run", "--again", "there", "--resume", "out"],
    "nothing to resume": ["run", "--resume", "nowhere"],
    "resume and scene": ["run", "small.yaml", "--resume", "there"],
    "no argument": ["run"],
    "two scenes": ["run", "a.yaml", "b.yaml"],
    "blank in a value": ["check", "a.yaml", "--set", "sheet.points=[61,", "61]"],
    "no folder to export": ["export", "--format", "obj"],
    "export to an empty folder": ["export", "results", "--format", "obj", "--out", ""],
    "no format": ["export", "results"],
    "unknown format": ["export", "results", "--format", "glft"],
    "unknown arch": ["run", "small.yaml", "--arch", "cuda1"],
    "unknown command": ["jump"],
    "threads": ["run", "small.yaml", "--threads", "0"],
    "tolerance": ["study", "small.yaml", "--tolerance", "2"],
}


@pytest.mark.parametrize("arguments", WRONG.values(), ids=WRONG)
def test_wrong_input_is_one_clear_text(arguments: list[str], small: Path, call: Call, message: Messages) -> None:
    code, out, error = call(*arguments)
    assert (code, out) == (2, "")
    message(error)
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"], "nothing is left behind"


def test_a_log_shows_what_is_done_and_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Of a run that goes on with frame 40: 5 s for the frames that were finished, then 3 s for each."""
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with console.ProgressDisplay(quiet=False) as shown, console.ProgressDisplay(quiet=True) as silent:
        calls = [("redraw", frame, 40, 0.125) for frame in range(40)]
        calls += [("frames", frame, 101, 1) for frame in range(40, 101) for _ in range(3)]
        calls += [("frames", 101, 101, 10), ("frames", 101, 101, 0), ("compile", 0, 0, 10), ("compile", 0, 0, 0)]
        for stage, done, total, seconds in calls:
            shown.update(stage, done, total)
            silent.update(stage, done, total)
            now += seconds
    lines = capsys.readouterr().err.splitlines()
    message(lines, "simulating: 48 of 101 done, about 3 min left")
    assert len(lines) == 20, "one in ten seconds"


def test_a_frame_that_is_being_stepped_counts_as_time(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with console.ProgressDisplay(quiet=False) as progress:
        for now, frame in ((0, 1), (11, 1), (50, 2), (51, 2), (61, 2), (250, 2)):  # noqa: B007
            progress.update("frames", frame, 4)
        # A pilot begins again from its first frame.
        for now, frame in ((260, 1), (270, 2), (280, 1), (290, 2)):  # noqa: B007
            progress.update("pilot", frame, 4)
    message(capsys.readouterr().err)


@pytest.mark.parametrize(
    "stem",
    [
        "with a space",
        "Schleimhaut Ä🧠",
        "-dash",
        pytest.param("\udcff", marks=pytest.mark.skipif(sys.platform != "linux", reason="names are text there")),
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


@pytest.mark.skipif(
    sys.version_info >= (3, 14), reason="there these names have no suffix and give folders of their own"
)
@pytest.mark.parametrize("name", ["...yaml", "..yaml"])
def test_a_name_that_is_no_folder_of_its_own_is_refused(name: str, small: Path, call: Call, message: Messages) -> None:
    """Results would replace those of the folder above."""
    (small / name).write_bytes((small / "small.yaml").read_bytes())
    before = files(small)
    code, _, error = call("run", name)
    assert code == 2
    message(error, "--out")
    assert files(small) == before


def test_a_locale_without_letters(small: Path, message: Messages) -> None:
    """No name of a file but ASCII can be decoded there, nor one in a scene be encoded."""
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONIOENCODING"} | plain
    (small / "é.yaml").write_text(SMALL.replace("speckle", "ü").replace("shear", "shaer"), encoding="utf-8")
    done = own_process("check", "é.yaml", env=environment)
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "\\udcc3\\udca9.yaml:1:1: image", "ü.png")


def test_an_arch_that_is_not_there_is_one_clear_text(small: Path, message: Messages) -> None:
    done = own_process("run", "small.yaml", "--arch", "cuda")
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


def test_check_prints_the_resolved_scene_and_what_it_takes(small: Path, call: Call) -> None:
    code, out, err = call("check", "small.yaml")
    assert (code, err) == (0, "")
    assert "falloff: 20.0" in out
    assert "\n99 points, 5 frames, 164 steps of 0.00243902 s (limit 0.00499221 s), 41 a frame, in f64\n" in out
    assert re.search(r"\nabout \d.* to run \(estimated from", out)
    assert "as time.tolerance may ask" in call("check", "small.yaml", "--set", "time.tolerance=1e-4")[1]
    assert " of memory, at most 0.1 MiB on disk, " in out
    assert not (small / "output").exists()
    facts = json.loads(call("check", "small.yaml", "--json")[1])
    assert facts["scene"]["time"]["damping_difference"] == "central"
    assert (facts["steps"], facts["frames"], facts["steps_per_frame"]) == (164, 5, 41)
    facts = json.loads(call("check", "small.yaml", "--json", "--set", "springs={}")[1])
    assert facts["stable_step"] is None


def test_check_decodes_the_picture_as_run_does(small: Path, call: Call, message: Messages) -> None:
    whole = Path("speckle.png").read_bytes()
    Path("speckle.png").write_bytes(whole[: len(whole) // 2])
    code, out, said = call("check", "small.yaml")
    assert (code, out) == (2, "")
    message(said, "image", hide=r"(?<=decoded )\(.*\)")
    assert call("run", "small.yaml", "--quiet") == (2, "", said)


def test_check_prints_the_baseline_of_a_stereo_pair(small: Path, call: Call, message: Messages) -> None:
    pose = "rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation: [-0.003, 0.004, 0]"
    lens = "intrinsics: {fx: 20, fy: 15, cx: 19.5, cy: 14.5}"
    cameras = (
        f"{{left: {{eye: [0, 0, 1]}}, a: {{beside: left, baseline: -0.004}}, b: {{beside: left, {pose}, {lens}}}}}"
    )
    out = call("check", "small.yaml", "--set", f"render.cameras={cameras}")[1]
    message((line for line in out.splitlines() if line.startswith("render.")), "0.004 m", "0.005 m")


def test_schema_is_a_json_schema(call: Call) -> None:
    code, out, _ = call("schema")
    assert code == 0
    assert json.loads(out)["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_a_bug_is_one_line(small: Path, call: Call, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("by zero\nin two lines")

    monkeypatch.delenv("TAICHI_MSM_TRACEBACK", raising=False)
    monkeypatch.setattr("taichi_msm.load.scene_file.load_plan", broken)
    code, _, err = call("check", "small.yaml")
    assert code == 1
    message(err, "TAICHI_MSM_TRACEBACK=1")


@pytest.mark.slow
def test_warnings_of_libraries_end_no_command(small: Path, root: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONWARNINGS": "error"}
    command = [sys.executable, "-m", "taichi_msm", "run", "small.yaml", "--quiet", "--set", "output=[gif]"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")


# Where compiled kernels are kept.
FOLDER = active_compiler().folder_variable

RUN = "run small.yaml --set output=[trajectory]"

# Commands that write in a way of their own, and their exit code where all can be written: on stderr and on stdout.
TELLING = {RUN: 0, "check bad.yaml": 2, "nothing": 2}
PRINTING = {RUN: 0, "check small.yaml --json": 0, "--help": 0, "run none.yaml --json": 2}


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


@pytest.mark.slow
@needs_full
@pytest.mark.parametrize("command", TELLING)
def test_errors_that_nobody_can_read_do_not_change_the_exit_code(command: str, here: Path) -> None:
    for outlet in ("2>&-", "2>/dev/full", "2> >(true)") if command == "check bad.yaml" else ("2>&-",):
        assert shell(f"msm {command} >/dev/null {outlet}").returncode == TELLING[command]
    assert (here / "output" / "small" / "trajectory.npz").exists() == (command == RUN)


@pytest.mark.default_cases("run small.yaml --set output=[trajectory]")
@needs_full
@pytest.mark.parametrize("command", PRINTING)
def test_results_that_nobody_can_read_are_4(command: str, here: Path) -> None:
    """A stream that was closed is one that nobody wants."""
    full = shell(f"msm {command} >/dev/full")
    assert full.returncode == 4
    assert "No space left on device" in full.stderr
    assert full.stderr.count("\n") <= 2
    assert "Traceback" not in full.stderr
    if command != "--help":
        piped = shell(f"msm {command} | true")
        assert piped.returncode in (4, PRINTING[command])
        assert "Traceback" not in piped.stderr
    if command == RUN:
        assert (piped.returncode, piped.stderr) == (4, "")
        assert (here / "output" / "small" / "run.json").exists()
    else:
        assert shell(f"msm {command} >&-").returncode == PRINTING[command]


@pytest.mark.slow
@needs_full
def test_a_signal_is_heard_though_nobody_can_read_of_it(here: Path) -> None:
    command = ["run", "small.yaml", "--set", "render.size=[2048,2048]"]
    with Path("/dev/full").open("w") as full, ReportingProcess(*command, stdout=full, stderr=full) as process:
        process.until("compile")
        process.terminate()
        assert process.wait(timeout=60) == 143


@pytest.mark.default_cases("no folder")
@pytest.mark.parametrize(
    "environment",
    [{"HOME": "", FOLDER: ""}, {"HOME": "/proc/none", FOLDER: ""}, {FOLDER: "/dev/null/below"}],
    ids=["unset", "no folder", "no cache"],
)
def test_without_a_home(environment: dict[str, str], here: Path) -> None:
    done = shell(f"{'unset HOME; ' if environment.get('HOME') == '' else ''}msm {RUN}", **environment)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit addresses")
def test_too_little_address_space_is_one_clear_line(here: Path, message: Messages) -> None:
    done = shell(f"ulimit -v 1200000; msm {RUN}")
    assert (done.returncode, done.stdout) == (2, "")
    message(done.stderr, "ulimit -v", hide=active_compiler().title)


def test_a_current_folder_that_is_gone_is_one_clear_line(here: Path, message: Messages) -> None:
    done = shell(f"mkdir gone; cd gone; rmdir ../gone; msm run {shlex.quote(str(here / 'small.yaml'))}")
    assert done.returncode == 4
    message(done.stderr)


@pytest.mark.slow
def test_numbers_too_large_are_no_warning(here: Path, message: Messages) -> None:
    force = "--set probes.0.force=[0,0,1e30] --set probes.0.load=[[0,1e30]] --set probes.0.offset=-50"
    done = shell(f"msm {RUN} --quiet {force}")
    assert done.returncode == 3
    message(done.stderr, "diverged")


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
    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert (runtime._cache_options() == {}) == kept
