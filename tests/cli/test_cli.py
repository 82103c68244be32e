"""The command line as a person meets it: files, texts, exit codes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from taichi_msm.cli import console
from taichi_msm.cli.main import main
from taichi_msm.load.scene_file import load_scene
from taichi_msm.system.compiler import active_compiler
from tests import reference
from tests.conftest import Program
from tests.outputs import files
from tests.scenes import SMALL, speckle
from tests.telling import Telling


def own_process(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own: for its start and end, its threads and what it finds around it."""
    return subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments], capture_output=True, text=True, check=False, **options
    )


def test_run_writes_everything(small: Path) -> None:
    done = own_process("run", "small.yaml", "--threads", "2")
    assert (done.returncode, done.stderr) == (0, "")
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


def test_another_picture_on_the_same_sheet(small: Path, program: Program) -> None:
    (small / "elsewhere").mkdir()
    Image.new("RGB", (8, 6), (10, 200, 30)).save(small / "elsewhere" / "green.png")
    settings = ["--set", "output=[png]", "--set", "render.shading=none", "--set", "render.background=[10,200,30]"]
    done = program("run", "small.yaml", "--image", "elsewhere/green.png", *settings, "--out", "green")
    assert done.returncode == 0, done.stderr
    assert (np.array(Image.open(small / "green" / "frames" / "0002.png")) == [10, 200, 30]).all()
    record = json.loads((small / "green" / "run.json").read_text())
    assert record["overrides"][-1] == "image=elsewhere/green.png"


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
    # The step as run.json gives it makes the same run without pilot runs, whose error it is.
    settings = ["--set", "output=[]", "--set", f"time.step={record['step']!r}"]
    again = program("run", "small.yaml", *settings, "--estimate-error", "--json", "--out", "again")
    # A coarse pilot tells it then, whose next power of h is 4 times that of the finer one: w h < 1 of it, over 12.
    assert json.loads(again.stdout)["error_estimate"] == pytest.approx(estimate, rel=4 / 12)
    assert json.loads(again.stdout)["steps"] == record["steps"]


def test_a_tolerance_out_of_reach_is_refused_and_keeps_earlier_results(small: Path, program: Program) -> None:
    (small / "kept").mkdir()
    (small / "kept" / "run.json").write_text("earlier")
    settings = ["--set", "output=[]", "--set", "time.tolerance=1e-9", "--set", "time.precision=f32"]
    done = program("run", "small.yaml", *settings, "--out", "kept")
    assert done.returncode == 2
    assert done.stderr.startswith(
        "small.yaml: time.tolerance: 1e-09 is out of reach of f32, whose rounding alone makes"
    )
    assert done.stderr.count("\n") == 1
    assert (small / "kept" / "run.json").read_text() == "earlier"


def test_check_says_that_a_tolerance_may_take_more_steps(small: Path, program: Program) -> None:
    done = program("check", "small.yaml", "--set", "time.tolerance=1e-4")
    assert "or longer, as time.tolerance may ask for more" in done.stdout


def test_springs_that_are_pressed_together_are_told_of(small: Path, program: Program) -> None:
    settings = ["--set", "output=[]", "--set", "probes.0.force=[40000,0,0]", "--set", "time.duration=0.1"]
    done = program("run", "small.yaml", *settings, "--out", "here")
    record = json.loads((small / "here" / "run.json").read_text())
    assert record["shortest_spring"] < 0.5
    assert f"a spring was pressed to {record['shortest_spring']:.2g} of its rest length" in done.stdout


@pytest.mark.slow
def test_a_study_ends_in_lines_that_the_scene_takes(small: Path) -> None:
    done = own_process(
        "study",
        "small.yaml",
        "--quick",
        "--json",
        "--tolerance",
        "2e-3",
        "--set",
        "damping=0.02",
        "--set",
        "image=null",
        "--set",
        "output=[]",
    )
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads(done.stdout)
    assert found["directory"] == "output/small-study"
    assert found["outputs"] == ["study.png", "study.md", "study.json"]
    assert sorted(path.name for path in (small / "output" / "small-study").iterdir()) == sorted(found["outputs"])
    assert (found["status"], found["tolerance"]) == ("complete", 2e-3)
    assert found["notes"] == ["drawing was left out: the scene names no image"]
    assert all(found[part] for part in ("stepping", "peers", "terms", "reference", "machine"))
    assert max(peer["error"] for peer in found["peers"]) < 1e-2, "two methods agree"
    # The lines, put into the scene, make a run as right as they promise.
    recommended = yaml.safe_load("\n".join(found["recommendation"]))
    settings = [f"time.{key}={value}" for key, value in recommended["time"].items()]
    overrides = [word for setting in ["damping=0.02", "output=[]", *settings] for word in ("--set", setting)]
    again = own_process("run", "small.yaml", *overrides, "--estimate-error", "--json", "--out", "again")
    promised = next(
        one["error"]
        for one in found["stepping"]
        if f"{one['step']:.12g}" == f"{recommended['time']['step']:.12g}"
        and (one["damping_difference"], one["precision"]) == tuple(recommended["time"].values())[1:]
    )
    assert promised <= 2e-3
    assert json.loads(again.stdout)["error_estimate"]["error"] == pytest.approx(promised, rel=0.3)


def test_a_study_that_could_not_be_written_is_not_begun(
    small: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("taichi_msm.study.study.run_study", begun)
    (small / "file").touch()
    for out in ("file", "file/below"):
        done = program("study", "small.yaml", "--out", out)
        assert done.returncode == 4
        assert done.stderr.startswith(f"{out}: cannot write: ")
        assert done.stderr.count("\n") == 1


def test_a_study_refuses_a_tolerance_that_is_none(small: Path, program: Program) -> None:
    for given, said in (
        ("2", "2 is not allowed; expected a number, 1e-10 to 0.5"),
        ("abc", "'abc' is not a valid float"),
    ):
        done = program("study", "small.yaml", "--tolerance", given)
        assert done.returncode == 2
        assert said in done.stderr


@pytest.mark.slow
def test_an_interrupted_study_does_not_replace_an_earlier_one(small: Path) -> None:
    (small / "here").mkdir()
    (small / "here" / "study.json").write_text("earlier")
    outlets = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with Telling("study", "small.yaml", "--out", "here", **outlets) as process:
        process.until("drawing")
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    assert (small / "here" / "study.json").read_text() == "earlier"
    part = json.loads((small / "here" / "interrupted" / "study.json").read_text())
    assert part["status"] == "interrupted"


@pytest.mark.parametrize(("stage", "runs"), [("heard", 0), ("stepping", 0), ("stepping", 20)])
def test_ctrl_c_leaves_what_a_study_has_done(stage: str, runs: int, small: Path) -> None:
    outlets = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Telling("study", "small.yaml", "--out", "here", **outlets) as process:
        process.until(stage, runs)
        process.send_signal(signal.SIGINT)
        printed, error = process.communicate(timeout=60)
    assert process.returncode == 130
    if runs:
        assert ("interrupted" in error, "interrupted" in printed) == (False, True)
        assert json.loads((small / "here" / "study.json").read_text())["status"] == "interrupted"
    else:
        # On a slow machine lines of progress come first.
        assert error.splitlines()[-1] == "interrupted; nothing was written"
        assert not (small / "here").exists()


def test_a_simulation_that_runs_away_stops_with_3(small: Path, program: Program) -> None:
    # Within the step's limit, but pressed with a force that folds the springs over.
    done = program("run", "small.yaml", "--set", "probes.0.force=[0,0,-1e12]", "--out", "wild")
    assert done.returncode == 3
    assert done.stderr.startswith("small.yaml: diverged at 0.00243902 s, step 1: point (4, 5) is ")
    assert "; likely cause: probes.0.force, which reaches 4.54e+07 N at this point; " in done.stderr
    assert done.stderr.endswith("; frames in wild: 1; last good state: wild/.partial/checkpoint/state.npz\n")
    assert done.stderr.count("\n") == 1
    with np.load(small / "wild/.partial/checkpoint/state.npz") as dump:
        assert dump["steps"] == 0
        assert np.isfinite(dump["displacement"]).all()
    again = program("run", "--resume", "wild")
    assert (again.returncode, again.stderr) == (3, done.stderr.replace("small.yaml", "wild"))
    record = json.loads((small / "wild" / "run.json").read_text())
    assert (record["status"], record["frames"]) == ("diverged", 1)
    assert [path.name for path in (small / "wild" / "frames").iterdir()] == ["0000.png"]
    assert np.isfinite(np.load(small / "wild" / "trajectory.npz")["position"]).all()


@pytest.mark.parametrize(
    ("number", "code", "threads", "stopped"),
    [
        (signal.SIGINT, 130, "1", False),
        (signal.SIGINT, 130, "2", False),
        (signal.SIGTERM, 143, "2", False),
        (signal.SIGTERM, 143, "2", True),
    ],
)
def test_a_signal_keeps_the_frames_so_far(
    number: signal.Signals, code: int, threads: str, stopped: bool, small: Path
) -> None:
    """Also while the encoder, stopped by somebody, takes no more pictures; with one thread there is no encoder."""
    settings = ["--set", "time.duration=2000", "--set", "render.size=[400,300]", "--set", "output=[png, trajectory]"]
    command = ["run", "small.yaml", "--out", "long", "--threads", threads, *settings]
    with Telling(*command, stderr=subprocess.PIPE) as process:
        process.until("frames", 9)
        assert len(children(process.pid)) == (threads != "1")
        if stopped:
            for child in children(process.pid):
                os.kill(child, signal.SIGSTOP)
            time.sleep(0.5)
        elif number == signal.SIGTERM:
            # A service's processes all get it, the encoder too.
            for child in children(process.pid):
                os.kill(child, number)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == code
    record = json.loads((small / "long" / "run.json").read_text())
    assert record["status"] == "interrupted"
    frames = record["frames"]
    assert 3 < frames < 20000
    then = "continue with: taichi-msm run --resume long"
    # On a slow machine lines of progress come first.
    assert error.splitlines()[-1] == f"small.yaml: interrupted; frames in long: {frames}; {then}"
    assert len(list((small / "long" / "frames").iterdir())) == frames
    assert np.load(small / "long" / "trajectory.npz")["position"].shape == (frames, 9, 11, 3)


def children(process: int) -> list[int]:
    """List the processes that another one started."""
    listed = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in listed.read_text().split()] if listed.exists() else []


@pytest.mark.parametrize(
    ("number", "stage", "delay"),
    [
        *((number, "heard", 0.0) for number in (signal.SIGINT, signal.SIGTERM)),
        *((number, "compile", 0.0) for number in (signal.SIGINT, signal.SIGTERM)),
        (signal.SIGINT, "heard", 0.2),
        *(pytest.param(signal.SIGINT, "heard", delay, marks=pytest.mark.fuzz) for delay in (0.1, 0.3, 0.5, 0.7, 0.9)),
    ],
)
def test_a_signal_before_the_first_frame_changes_nothing(
    number: signal.Signals, stage: str, delay: float, small: Path
) -> None:
    # A large picture, so that no frame is done in the time.
    (small / "kept").mkdir()
    earlier = '{"outputs": ["run.json"], "frames": 0}'
    (small / "kept" / "run.json").write_text(earlier)
    settings = ["--set", "render.size=[2048,2048]", "--set", "render.supersample=4", "--set", "output=[png]"]
    with Telling("run", "small.yaml", "--out", "kept", *settings, stderr=subprocess.PIPE) as process:
        process.until(stage)
        time.sleep(delay)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert (process.returncode, error.splitlines()[-1]) == (128 + number, "interrupted; nothing was written")
    assert [path.name for path in (small / "kept").iterdir()] == ["run.json"]
    assert (small / "kept" / "run.json").read_text() == earlier


def test_without_a_place_for_compiled_kernels(small: Path) -> None:
    (small / "file").touch()
    environment = {**os.environ, active_compiler().folder_variable: str(small / "file" / "below")}
    settings = ["--set", "output=[]", "--set", "springs={structural: 20}", "--set", "probes=[]"]
    done = own_process("run", "small.yaml", *settings, env=environment)
    assert (done.returncode, done.stderr) == (0, "")


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


def test_more_threads_than_cores_are_no_harm(small: Path) -> None:
    settings = ["--set", "sheet.points=[200,200]", "--set", "time.duration=0.1", "--set", "output=[]", "--out", "many"]
    done = own_process("run", "small.yaml", "--threads", "16", *settings, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("as_json", [[], ["--json"]])
def test_stdout_on_a_full_disk_is_4(as_json: list[str], small: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "taichi_msm", "check", "small.yaml", *as_json],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert (done.returncode, done.stderr) == (4, "taichi-msm: cannot read or write: No space left on device\n")


def test_a_picture_that_breaks_off_is_one_line(small: Path, program: Program) -> None:
    whole = (small / "speckle.png").read_bytes()
    (small / "speckle.png").write_bytes(whole[: len(whole) // 2])
    done = program("run", "small.yaml")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("small.yaml: image: speckle.png cannot be decoded (")
    assert done.stderr.count("\n") == 1


def test_a_killed_run_leaves_the_results_before_it(small: Path, program: Program) -> None:
    assert program("run", "small.yaml", "--out", "kept").returncode == 0
    before = {path: path.read_bytes() for path in (small / "kept").rglob("*") if path.is_file()}
    endless = ["--quiet", "--set", "time.duration=2000"]
    with Telling("run", "small.yaml", "--out", "kept", *endless, stderr=subprocess.PIPE) as process:
        process.until("frames", 1)
        process.kill()
        # Its encoder ends soon after, without a word.
        assert process.communicate(timeout=60)[1] == ""
    assert {path: path.read_bytes() for path in before} == before
    assert program("run", "small.yaml", "--out", "kept").returncode == 0
    assert not (small / "kept" / ".partial").exists()


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command that needs no device."""
    code = main(arguments)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["run", "nowhere.yaml"], "nowhere.yaml: no such file or directory\n"),
        (
            ["check", "small.yaml", "--set", "springs.shaer=3", "--set", "sheet.mass=0"],
            "--set springs.shaer=3: springs.shaer: unknown key; did you mean 'shear'?\n"
            "--set sheet.mass=0: sheet.mass: 0 is not allowed; expected a number above 0, in kg\n",
        ),
        (
            ["check", "small.yaml", "--set", "time.step=0.1"],
            "--set time.step=0.1: time.step: 0.1 s is above the stability limit 0.00499221 s; "
            "try 0.00476190476, or auto\n",
        ),
        (
            ["run", "small.yaml", "--out", ""],
            "taichi-msm: Invalid value for --out: is empty; name a directory (see taichi-msm --help)\n",
        ),
        (
            ["run", "--resume", "nowhere"],
            "taichi-msm: Invalid value for --resume: there is no unfinished run in nowhere (see taichi-msm --help)\n",
        ),
        (
            ["run", "small.yaml", "--resume", "there"],
            "taichi-msm: --resume continues a run with its own settings; leave out SCENE (see taichi-msm --help)\n",
        ),
        (
            ["run", "--resume", "there", "--set", "damping=1"],
            "taichi-msm: --resume continues a run with its own settings; leave out --set (see taichi-msm --help)\n",
        ),
        (["run"], "taichi-msm: Missing argument 'SCENE'. (see taichi-msm --help)\n"),
        (["run", "a.yaml", "b.yaml"], "taichi-msm: Got unexpected extra argument (b.yaml) (see taichi-msm --help)\n"),
        (
            ["check", "a.yaml", "--set", "sheet.points=[61,", "61]"],
            "taichi-msm: Got unexpected extra argument (61]); a value with blanks needs quotes: "
            '--set "KEY=VALUE" (see taichi-msm --help)\n',
        ),
        (
            ["export", "results"],
            "taichi-msm: Missing option '--format'. Choose from: kitti, tapvid, tapvid3d, stir, vtk, gltf, obj, csv "
            "(see taichi-msm --help)\n",
        ),
        (
            ["export", "results", "--format", "glft"],
            "taichi-msm: Invalid value for '--format': 'glft' is not one of 'kitti', 'tapvid', 'tapvid3d', 'stir', "
            "'vtk', 'gltf', 'obj', 'csv'; did you mean 'gltf'? (see taichi-msm --help)\n",
        ),
        (
            ["run", "small.yaml", "--arch", "cuda1"],
            "--arch cuda1: not supported; take one of: cpu, cuda, vulkan; did you mean 'cuda'?\n",
        ),
        (["jump"], "taichi-msm: No such command 'jump'. (see taichi-msm --help)\n"),
        (
            ["check", "small.yaml", "--sett=1"],
            "taichi-msm: No such option '--sett'. Did you mean '--set'? (see taichi-msm --help)\n",
        ),
        (
            ["run", "small.yaml", "--threads", "0"],
            "taichi-msm: Invalid value for '--threads': 0 is not in the range 1<=x<=1024. (see taichi-msm --help)\n",
        ),
        (
            ["run", "small.yaml", "--arch", "metal"],
            "--arch metal: not supported; take one of: cpu, cuda, vulkan\n",
        ),
    ],
)
def test_wrong_input_is_one_clear_text(
    arguments: list[str], error: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(capsys, *arguments) == (2, "", error)
    assert sorted(path.name for path in small.iterdir()) == ["small.yaml", "speckle.png"], "nothing is left behind"


def test_a_log_shows_what_is_done_and_left(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a run that goes on with frame 40: 5 s for the frames that were finished, then 3 s for each."""
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with console.ProgressDisplay(quiet=False) as progress, console.ProgressDisplay(quiet=True) as silent:
        for shown in (progress, silent):
            now = 100.0
            for frame in range(40):
                shown.update("redraw", frame, 40)
                now += 0.125
            for frame in range(40, 101):
                for _ in range(3):
                    shown.update("frames", frame, 101)
                    now += 1
            shown.update("frames", 101, 101)
            now += 10
            shown.update("frames", 101, 101)
            shown.update("compile", 0, 0)
            now += 10
            shown.update("compile", 0, 0)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:4] == [
        "simulating: 41 of 101 done, about 3 min left",
        "simulating: 45 of 101 done, about 3 min left",
        "simulating: 48 of 101 done, about 3 min left",
        "simulating: 51 of 101 done, about 2 min left",
    ]
    assert lines[-4:] == [
        "simulating: 95 of 101 done, about 18 s left",
        "simulating: 98 of 101 done, about 8 s left",
        "simulating: 101 of 101 done",
        "compiling the kernels",
    ]
    assert len(lines) == 20, "one in ten seconds"


def test_a_frame_that_is_being_stepped_counts_as_time(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with console.ProgressDisplay(quiet=False) as progress:
        for now, frame in ((0, 1), (11, 1), (50, 2), (51, 2), (61, 2), (250, 2)):  # noqa: B007
            progress.update("frames", frame, 4)
        # A pilot begins again from its first frame.
        for now, frame in ((260, 1), (270, 2), (280, 1), (290, 2)):  # noqa: B007
            progress.update("pilot", frame, 4)
    assert capsys.readouterr().err.splitlines() == [
        "simulating: 1 of 4 done",
        "simulating: 2 of 4 done, about 2 min left",
        "simulating: 2 of 4 done, about 89 s left",
        "simulating: 2 of 4 done, about 1 s left",
        "pilot runs: 1 of 4 done",
        "pilot runs: 2 of 4 done, about 20 s left",
        "pilot runs: 1 of 4 done",
        "pilot runs: 2 of 4 done, about 20 s left",
    ]


@pytest.mark.parametrize(
    "stem",
    [
        "with a space",
        "Schleimhaut Ä🧠",
        "-dash",
        pytest.param("\udcff", marks=pytest.mark.skipif(sys.platform != "linux", reason="names are text there")),
    ],
    ids=ascii,
)
def test_scenes_of_any_name(stem: str, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (small / "small.yaml").rename(f"{stem}.yaml")
    code, out, err = call(capsys, "check", "--", f"{stem}.yaml")
    assert (code, out[:19], err) == (0, "image: speckle.png\n", "")
    Path(f"{stem}.yaml").write_text(SMALL.replace("shear", "shaer"))
    shown = "\\udcff" if stem == "\udcff" else stem
    error = f"{shown}.yaml:3:27: springs.shaer: unknown key; did you mean 'shear'?\n"
    assert call(capsys, "check", "--", f"{stem}.yaml") == (2, "", error)


@pytest.mark.skipif(
    sys.version_info >= (3, 14), reason="there these names have no suffix and give folders of their own"
)
@pytest.mark.parametrize(("name", "folder"), [("...yaml", ".."), ("..yaml", ".")])
def test_a_name_that_is_no_folder_of_its_own_is_refused(
    name: str, folder: str, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results would replace those of the folder above."""
    (small / name).write_bytes((small / "small.yaml").read_bytes())
    before = files(small)
    code, _, error = call(capsys, "run", name)
    said = f"Invalid value for --out: the scene's name gives the folder output/{folder}; name another"
    assert (code, error) == (2, f"taichi-msm: {said} (see taichi-msm --help)\n")
    assert files(small) == before


def test_a_locale_without_letters(small: Path) -> None:
    """No name of a file but ASCII can be decoded there, nor one in a scene be encoded."""
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONIOENCODING"} | plain
    (small / "é.yaml").write_text(SMALL.replace("speckle", "ü").replace("shear", "shaer"), encoding="utf-8")
    done = own_process("check", "é.yaml", env=environment)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "\\udcc3\\udca9.yaml:1:1: image: ü.png is not a path; name a picture\n"
        "\\udcc3\\udca9.yaml:3:27: springs.shaer: unknown key; did you mean 'shear'?\n"
    )


def test_an_arch_that_is_not_there_is_one_clear_text(small: Path) -> None:
    done = own_process("run", "small.yaml", "--arch", "cuda")
    if done.returncode == 0:
        pytest.skip("this machine has CUDA")
    error = "--arch cuda: not available on this machine; take --arch cpu\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", error)
    assert not (small / "output").exists()


def test_errors_as_json(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(capsys, "check", "small.yaml", "--json", "--set", "damping=-1")
    line = "--set damping=-1: damping: -1 is not allowed; expected a number, 0 or more, in N s/m"
    assert (code, err) == (2, line + "\n")
    assert json.loads(out) == {"status": "error", "errors": [line]}


def test_check_prints_the_resolved_scene_and_what_it_takes(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(capsys, "check", "small.yaml")
    assert (code, err) == (0, "")
    assert "falloff: 20.0" in out
    assert "\n99 points, 5 frames, 164 steps of 0.00243902 s (limit 0.00499221 s), 41 a frame, in f64\n" in out
    assert re.search(r"\nabout \d.* to run \(estimated from", out)
    assert " of memory, at most 0.1 MiB on disk, " in out
    assert not (small / "output").exists()
    facts = json.loads(call(capsys, "check", "small.yaml", "--json")[1])
    assert facts["scene"]["time"]["damping_difference"] == "central"
    assert (facts["steps"], facts["frames"], facts["steps_per_frame"]) == (164, 5, 41)


def test_check_decodes_the_picture_as_run_does(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = Path("speckle.png").read_bytes()
    Path("speckle.png").write_bytes(whole[: len(whole) // 2])
    assert main(["check", "small.yaml"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("small.yaml: image: speckle.png cannot be decoded (")
    assert main(["run", "small.yaml", "--quiet"]) == 2
    assert capsys.readouterr().err == said


def test_check_without_springs_has_no_limit(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "check", "small.yaml", "--json", "--set", "springs={}")
    assert (code, json.loads(out)["stable_step"]) == (0, None)


def test_schema_is_a_json_schema(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "schema")
    assert code == 0
    assert json.loads(out)["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_a_file_in_the_way_is_4(small: Path, program: Program) -> None:
    (small / "taken").write_text("mine")
    done = program("run", "small.yaml", "--out", "taken")
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.startswith("taken: cannot write: ")
    assert done.stderr.count("\n") == 1
    assert (small / "taken").read_text() == "mine"


def test_a_bug_is_one_line(small: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("by zero\nin two lines")

    monkeypatch.delenv("TAICHI_MSM_TRACEBACK", raising=False)
    monkeypatch.setattr("taichi_msm.load.scene_file.load_plan", broken)
    code, _, err = call(capsys, "check", "small.yaml")
    assert code == 1
    assert err == (
        "taichi-msm: a bug: ZeroDivisionError: by zero in two lines; "
        "please report it with what TAICHI_MSM_TRACEBACK=1 prints\n"
    )


def test_warnings_of_libraries_end_no_command(small: Path, root: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONWARNINGS": "error"}
    command = [sys.executable, "-m", "taichi_msm", "run", "small.yaml", "--quiet", "--set", "output=[gif]"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
