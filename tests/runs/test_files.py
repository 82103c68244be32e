from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from _thread import interrupt_main
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.render.labels import Flow, FrameOutputs
from taichi_msm.runs import encoder, media
from taichi_msm.runs.checkpoint import is_unfinished
from taichi_msm.runs.encoder import Encoder, PictureWriter
from taichi_msm.runs.writer import ResultWriter
from taichi_msm.scene.scene import Scene
from tests.golden import Messages
from tests.outputs import files
from tests.scenes import plan_of, scene, speckle

ROWS, COLS = 3, 4
WIDTH, HEIGHT = 40, 24

# An endless run; prints the process id of its encoder at the tenth frame.
ENDLESS = """
import itertools
import sys
from pathlib import Path
from taichi_msm.render.labels import FrameOutputs
from taichi_msm.runs.writer import ResultWriter
from tests.scenes import plan_of
from tests.runs.test_files import picture, position, small_scene

with ResultWriter(Path(sys.argv[1]), plan_of(small_scene()), {}) as writer:
    for frame in itertools.count():
        writer.add(position(frame), {"": FrameOutputs(picture(frame))})
        if frame == 10:
            print(writer._encoder._process.pid, flush=True)
"""


def results(folder: Path) -> dict[str, bytes]:
    """Content of the results by path, without the checkpoint of a run that is not complete."""
    return {path: content for path, content in files(folder).items() if not path.startswith(".partial/checkpoint/")}


def small_scene(*output: str, precision: str = "f32", **render: Any) -> Scene:
    return scene(
        image="texture.png",
        sheet={"points": [ROWS, COLS], "size": [0.3, 0.4], "mass": 1e-3},
        time={"precision": precision},
        render={"size": [WIDTH, HEIGHT], **render},
        probes=[],
        output=list(output or ("png", "gif", "trajectory")),
    )


def position(frame: int) -> NDArray[np.float64]:
    return np.random.default_rng(frame).normal(size=(ROWS, COLS, 3))


def picture(frame: int) -> NDArray[np.uint8]:
    return speckle(HEIGHT, WIDTH, frame)


def observed(frame: int) -> dict[str, FrameOutputs]:
    """A picture and a label."""
    flow = Flow(np.full((HEIGHT, WIDTH, 2), frame, np.float32), np.zeros((HEIGHT, WIDTH), np.uint8))
    return {"": FrameOutputs(picture(frame), flow=flow)}


def write(directory: Path, frames: int, scene: Scene, *, in_subprocess: bool = True) -> list[str]:
    with ResultWriter(directory, plan_of(scene), {}, threads=1 + in_subprocess) as writer:
        for frame in range(frames):
            writer.add(position(frame), observed(frame) if scene.draws else {"": FrameOutputs()})
        names: list[str] = writer.publish({})["outputs"]
        assert writer.frames == frames
        assert 0 < writer.encode_seconds < 60 or not scene.draws
    return names


def test_results_of_a_run(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    names = write(out, 11, small_scene())
    assert names == ["frames", "animation.gif", "trajectory.npz", "run.json"]
    frames = [f"frames/{frame:04}.png" for frame in range(11)]
    assert sorted(results(out)) == sorted([*frames, *names[1:]])
    for number, frame in enumerate(frames):
        with Image.open(out / frame) as image:
            np.testing.assert_array_equal(np.asarray(image), picture(number))
    with Image.open(out / "animation.gif") as image:
        assert (image.size, getattr(image, "n_frames", 1)) == ((WIDTH, HEIGHT), 11)
    assert json.loads((out / "run.json").read_bytes()) == {"frames": 11, "outputs": names}


@pytest.mark.parametrize("in_subprocess", [True, False])
def test_equal_runs_write_equal_bytes(in_subprocess: bool, tmp_path: Path) -> None:
    write(tmp_path / "first", 7, small_scene())
    write(tmp_path / "second", 7, small_scene(), in_subprocess=in_subprocess)
    assert results(tmp_path / "first") == results(tmp_path / "second")


def test_only_requested_outputs_remain(tmp_path: Path) -> None:
    """Other outputs of an earlier run are deleted, foreign files are kept."""
    write(tmp_path, 4, small_scene())
    (tmp_path / "notes.txt").write_text("mine")
    for made, names in (
        (small_scene("png"), ["frames", "run.json"]),
        (small_scene("gif"), ["animation.gif", "run.json"]),
        (scene(output=[]), ["run.json"]),
    ):
        assert write(tmp_path, 3, made) == names
        assert {name.partition("/")[0] for name in results(tmp_path)} == {*names, "notes.txt"}
        assert len(list((tmp_path / "frames").glob("*"))) == (3 if "frames" in names else 0)


@pytest.mark.parametrize(("precision", "dtype"), [("f32", np.float32), ("f64", np.float64)])
def test_trajectory_file(
    precision: str, dtype: type[np.floating[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may exceed 4 GiB: zipfile writes beyond its limit only if ZIP64 is chosen before the first byte."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 100)
    write(tmp_path, 6, small_scene("trajectory", precision=precision))
    with np.load(tmp_path / "trajectory.npz") as trajectory:
        assert (trajectory["position"].dtype, trajectory["time"].dtype) == (dtype, np.float64)
        np.testing.assert_array_equal(trajectory["time"], np.arange(6) / 25)
        np.testing.assert_array_equal(trajectory["position"], [position(f).astype(dtype) for f in range(6)])


@pytest.mark.parametrize("light", [1.25, 0.25])
def test_animation_colours_under_changing_light(tmp_path: Path, light: float) -> None:
    """The palette of the first frame covers later frames in other light, and the background."""
    first = np.empty((16, 16, 3), np.uint8)
    first[:, ::2], first[:, 1::2] = (200, 100, 90), (180, 130, 100)
    later = first.copy()
    later[:8] = (first[:8] * light).astype(np.uint8)
    background = (1, 99, 255)
    first[:, 0] = later[:, 0] = background
    with ResultWriter(tmp_path, plan_of(small_scene("gif", background=background, size=[16, 16])), {}) as writer:
        writer.add(position(0), {"": FrameOutputs(first)})
        writer.add(position(1), {"": FrameOutputs(later)})
        writer.publish({})
    with Image.open(tmp_path / "animation.gif") as image:
        image.seek(1)
        shown = np.asarray(image.convert("RGB")).astype(float)
    assert (shown[:, 0] == background).all()
    # Brightnesses are at most a quarter apart: half of that, of 200, plus 2 of the lookup and 1 of rounding.
    assert np.abs(shown - later).max() <= 28


@pytest.mark.parametrize("in_subprocess", [True, False])
def test_unpublished_results_are_discarded(in_subprocess: bool, tmp_path: Path) -> None:
    write(tmp_path / "out", 3, small_scene())
    before = results(tmp_path / "out")
    for directory in (tmp_path / "out", tmp_path / "fresh"):
        with ResultWriter(directory, plan_of(small_scene()), {}, threads=1 + in_subprocess) as writer:
            writer.add(position(9), {"": FrameOutputs(picture(9))})
    assert results(tmp_path / "out") == before
    assert results(tmp_path / "fresh") == {}


@pytest.mark.parametrize(("rows", "frames"), [(HEIGHT // 2, 1), (HEIGHT, 2)])
def test_interruption_between_positions_and_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int, frames: int
) -> None:
    """Ctrl-C after the encoder has received the positions of a frame and some rows of its picture."""

    def interrupted(encoder: Encoder, pictures: NDArray[np.uint8]) -> None:
        add(encoder, pictures[:, :rows])
        raise KeyboardInterrupt

    add, made = Encoder.add, small_scene("png", "gif", "trajectory", "flow")
    with ResultWriter(tmp_path / "interrupted", plan_of(made), {}) as writer:
        writer.add(position(0), observed(0))
        with monkeypatch.context() as patch:
            patch.setattr(Encoder, "add", interrupted)
            with pytest.raises(KeyboardInterrupt):
                writer.add(position(1), observed(1))
        writer.finish()
        assert writer.frames == frames
        writer.publish({})
    write(tmp_path / "whole", frames, made)
    assert results(tmp_path / "interrupted") == results(tmp_path / "whole")


@pytest.mark.parametrize(("owner", "part"), [(Image.Image, "save"), (media.GifWriter, "_write_last")])
def test_interruption_during_encoding_in_threads(
    owner: type, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C during a still, and at the end of the film."""
    original = getattr(owner, part)

    def interrupted(*arguments: Any, **keywords: Any) -> Any:
        interrupt_main()
        time.sleep(0.3)  # until the main thread is interrupted
        return original(*arguments, **keywords)

    with ResultWriter(tmp_path / "interrupted", plan_of(small_scene()), {}, threads=1) as writer:
        writer.add(position(0), {"": FrameOutputs(picture(0))})
        with monkeypatch.context() as patch:
            patch.setattr(owner, part, interrupted)
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012
                writer.add(position(1), {"": FrameOutputs(picture(1))})
                writer.finish()
        writer.finish()
        writer.publish({})
        frames = writer.frames
    write(tmp_path / "whole", frames, small_scene())
    assert results(tmp_path / "interrupted") == results(tmp_path / "whole")


def test_interruption_between_still_and_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The still is written late, after the interruption."""

    def write_late(*arguments: Any) -> float:
        time.sleep(0.1)
        return write_still(*arguments)

    write_still = encoder._write_still
    with ResultWriter(tmp_path / "interrupted", plan_of(small_scene()), {}, threads=1) as writer:
        writer.add(position(0), observed(0))
        assert isinstance(writer._encoder, PictureWriter)
        with monkeypatch.context() as patch:
            patch.setattr(writer._encoder._video_executor, "submit", Mock(side_effect=KeyboardInterrupt))
            patch.setattr(encoder, "_write_still", write_late)
            with pytest.raises(KeyboardInterrupt):
                writer.add(position(1), observed(1))
        writer.finish()
        time.sleep(0.2)
        writer.publish({})
    write(tmp_path / "whole", 1, small_scene())
    assert results(tmp_path / "interrupted") == results(tmp_path / "whole")


def test_published_run_is_finished(tmp_path: Path) -> None:
    """Even if it is killed before its checkpoint is deleted."""
    with ResultWriter(tmp_path, plan_of(small_scene()), {}) as writer:
        writer.add(position(0), observed(0))
        assert is_unfinished(tmp_path)
        assert isinstance(writer._encoder, Encoder)
        assert os.getsid(writer._encoder._process.pid) != os.getsid(0), "Ctrl-C does not reach the encoder"
        writer.publish({"status": "complete"})
        assert not is_unfinished(tmp_path)


def test_killed_run_and_its_successor(tmp_path: Path, root: Path, message: Messages) -> None:
    write(tmp_path, 3, small_scene())
    before = results(tmp_path)
    command = [sys.executable, "-c", ENDLESS, str(tmp_path)]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        assert run.stdout
        encoder = int(run.stdout.readline())
        with message.raises(FilesError):
            write(tmp_path, 2, small_scene())
        os.kill(encoder, signal.SIGSTOP)
        run.kill()
        run.wait()
        with message.raises(FilesError):
            write(tmp_path, 2, small_scene())
        os.kill(encoder, signal.SIGCONT)
        run.communicate()  # until the encoder has ended
    assert {name: data for name, data in results(tmp_path).items() if ".partial" not in name} == before
    write(tmp_path, 2, small_scene())
    assert len(list((tmp_path / "frames").iterdir())) == 2
    assert not any(".partial" in name for name in results(tmp_path))


def full_disk(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("target", ["checkpoint.create_file", "checkpoint.write_arrays", "writer.write_new_file"])
def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, message: Messages) -> None:
    """While positions, manifest or record are written; results are unchanged."""
    write(tmp_path, 3, small_scene())
    before = results(tmp_path)
    monkeypatch.setattr(f"taichi_msm.runs.{target}", full_disk)
    with message.raises(FilesError, "--out"):
        write(tmp_path, 2, small_scene())
    assert results(tmp_path) == before


def file_error(
    directory: Path, meanwhile: Callable[[ResultWriter], object] = lambda _: None, *, in_subprocess: bool = True
) -> str:
    """Error message of a run that an event interrupts."""

    def run() -> None:
        with ResultWriter(directory, plan_of(small_scene()), {}, threads=1 + in_subprocess) as writer:
            meanwhile(writer)
            for frame in range(1000):
                writer.add(position(frame), {"": FrameOutputs(picture(frame))})
            writer.publish({})

    with pytest.raises(FilesError) as caught:
        run()
    return str(caught.value)


def test_file_at_the_path_of_the_directory(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "out").write_text("mine")
    message(file_error(tmp_path / "out"), "--out")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_directory(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert "Permission denied" in file_error(tmp_path / "out")


def test_errors_of_the_encoder(tmp_path: Path, message: Messages) -> None:
    """A file in the way of the pictures, and a killed process."""
    blocked = tmp_path / ".partial" / "new" / "frames"
    for in_subprocess in (True, False):
        message(file_error(tmp_path, lambda _: blocked.write_text("mine"), in_subprocess=in_subprocess), "--out")
        assert blocked.read_text() == "mine"
        blocked.unlink()

    def kill(writer: ResultWriter) -> None:
        assert isinstance(writer._encoder, Encoder)
        writer._encoder._process.kill()

    message(file_error(tmp_path, kill), "encoder")
    assert results(tmp_path) == {}


def test_deleted_directory(tmp_path: Path, message: Messages) -> None:
    message(file_error(tmp_path / "out", lambda _: shutil.rmtree(tmp_path / "out")), "--out")
    assert not (tmp_path / "out").exists()


def test_record_is_strict_json(tmp_path: Path) -> None:
    with ResultWriter(tmp_path, plan_of(scene()), {}) as writer:
        with pytest.raises(ValueError, match="JSON"):
            writer.publish({"step": float("nan")})
        writer.publish({"image": "Schleimhaut-Ä.png", "odd": "\udcff.png"})
    text = (tmp_path / "run.json").read_bytes().decode()
    assert text == (
        '{\n  "image": "Schleimhaut-Ä.png",\n  "odd": "\\udcff.png",\n  "frames": 0,\n'
        '  "outputs": [\n    "run.json"\n  ]\n}\n'
    )
    assert json.loads(text)["odd"] == "\udcff.png"
