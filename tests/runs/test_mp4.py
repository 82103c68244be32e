"""MP4 files, decoded by PyAV, against the drawn pictures."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import SceneError, run
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs.media import Mp4Writer
from taichi_msm.scene import outputs
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.runs.test_resume import interrupted

av: Any = pytest.importorskip("av")

# Errors of colours: of fields, by rounding to 219 levels; of ramps, also by subsampled colours and compression.
FIELD_ERROR, RAMP_ERROR = 4, 16


def smooth(width: int, height: int, frame: int) -> NDArray[np.uint8]:
    across, down = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    colours = np.stack([across, down, np.full_like(across, frame / 10)], axis=-1)
    return (40 + 170 * colours).astype(np.uint8)


def write(path: Path, pictures: list[NDArray[np.uint8]], rate: float, quality: int = 65) -> None:
    height, width, _ = pictures[0].shape
    writer = Mp4Writer(path.open("x+b"), (width, height), rate, quality)
    for picture in pictures:
        writer.add(picture)
    writer.close()


def read(path: Path) -> tuple[Any, list[NDArray[np.uint8]], list[float]]:
    """The stream of a film, its pictures and their times [s]."""
    with av.open(str(path)) as container:
        (stream,) = container.streams
        frames = list(container.decode(stream))
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.frames == len(frames)
        pictures = [frame.to_ndarray(format="rgb24") for frame in frames]
        # The stream is invalid after the container is closed.
        names = ("width", "height", "frames", "average_rate", "time_base", "duration")
        known = SimpleNamespace(**{name: getattr(stream, name) for name in names})
        codec = stream.codec_context
        known.colours = codec.colorspace, codec.color_primaries, codec.color_trc, codec.color_range
        return known, pictures, [float(frame.pts * frame.time_base) for frame in frames]


@pytest.mark.parametrize("size", [(64, 48), (33, 31), (1, 1)])
def test_padding_of_odd_sizes(size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    drawn = [smooth(width, height, frame) for frame in range(7)]
    write(tmp_path / "a.mp4", drawn, 25)
    stream, shown, _ = read(tmp_path / "a.mp4")
    assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
    assert len(shown) == 7
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    for decoded, picture in zip(shown, drawn, strict=True):
        assert np.abs(decoded.astype(int) - np.pad(picture, padding, mode="edge")).max() <= RAMP_ERROR


@pytest.mark.parametrize("rate", [12.5, 30000 / 1001, 0.1, 1000, 1 / 3])
def test_frame_times(rate: float, tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", [smooth(32, 32, frame) for frame in range(12)], rate)
    stream, _, times = read(tmp_path / "a.mp4")
    assert float(stream.average_rate) == pytest.approx(rate, rel=1e-9)
    # Within a tick of the file.
    np.testing.assert_allclose(times, np.arange(12) / rate, rtol=0, atol=float(stream.time_base))
    assert float(stream.duration * stream.time_base) == pytest.approx(12 / rate, abs=float(stream.time_base))


def test_colour_space_is_stated(tmp_path: Path) -> None:
    """With the matrix of another standard, saturated colours would differ by up to 30."""
    drawn = [np.full((32, 32, 3), colour, np.uint8) for colour in ((200, 30, 30), (30, 200, 30), (30, 30, 200))]
    write(tmp_path / "a.mp4", drawn, 25)
    stream, shown, _ = read(tmp_path / "a.mp4")
    assert stream.colours == (1, 1, 1, 1)
    assert np.abs(np.array(shown, int) - drawn).max() <= FIELD_ERROR
    # The index precedes the pictures, so that a browser plays the film while it loads.
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_size_increases_with_quality(small: Path, program: Program) -> None:
    sizes = []
    for quality in ("1", "65", "100"):
        done = program("run", "small.yaml", "--set", "output=[mp4]", "--quality", quality, "--quiet", "--no-estimate")
        assert (done.returncode, done.stderr) == (0, "")
        sizes.append(Path("output/small/animation.mp4").stat().st_size)
        assert json.loads(Path("output/small/run.json").read_text())["overrides"][-1] == f"render.quality={quality}"
    assert sizes[0] < sizes[1] < sizes[2]


def test_film_of_a_run(small: Path, device: Device) -> None:
    scene = load_scene("small.yaml", ["output=[png, mp4]", "render.size=[41, 30]"])
    done = run(scene, "out", threads=device.threads, estimate_error=False)
    assert done["outputs"] == ["frames", "animation.mp4", "run.json"]
    stream, shown, times = read(Path("out/animation.mp4"))
    assert (stream.width, stream.height, stream.average_rate) == (42, 30, Fraction(10))
    np.testing.assert_allclose(times, np.arange(5) / 10, rtol=0, atol=1e-4)
    for frame, decoded in enumerate(shown):
        drawn = np.asarray(Image.open(f"out/frames/{frame:04}.png")).astype(int)
        # Luminance is compared, as colours are subsampled: 3 levels of noise.
        assert np.abs((decoded[:, :-1] - drawn) @ (0.2126, 0.7152, 0.0722)).mean() < 3


def test_film_of_an_interrupted_run(small: Path, device: Device) -> None:
    made = load_scene("small.yaml", ["output=[mp4, trajectory]", "time.frames_per_second=40"])
    record = interrupted(made, "part", device)
    assert 0 < read(Path("part/animation.mp4"))[0].frames == record["frames"] < 17


def test_missing_pyav(small: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr(outputs, "is_pyav_installed", lambda: False)
    with message.raises(SceneError, "output"):
        load_scene("small.yaml", ["output=[png, mp4]"])
    load_scene("small.yaml", ["output=[png]"])
