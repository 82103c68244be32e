"""Flow in KITTI's pictures, decoded as by its development kit."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import png
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.exports.export import export
from taichi_msm.exports.kitti import encode_flow
from taichi_msm.runs.arrays import read_flo
from tests.golden import Messages
from tests.outputs import files
from tests.runs.test_finished import change

WIDTH, HEIGHT, PAIRS = 40, 30, 4
BACKGROUND = 1e10


def made_up_flow(seed: int) -> NDArray[np.float32]:
    """Return flow of all magnitudes, with a background."""
    rng = np.random.default_rng(seed)
    flow = rng.normal(0, 1, (HEIGHT, WIDTH, 2)) * 10 ** rng.uniform(-3, 2.6, (HEIGHT, WIDTH, 1))
    flow[rng.random((HEIGHT, WIDTH)) < 0.2] = BACKGROUND
    return flow.astype(np.float32)


def write_flo(path: Path, flow: NDArray[np.float32]) -> None:
    """Write a .flo file by Middlebury's description."""
    height, width, _ = flow.shape
    path.write_bytes(np.float32(202021.25).tobytes() + struct.pack("<ii", width, height) + flow.astype("<f4").tobytes())


@pytest.fixture
def labelled(results: Path) -> Path:
    """Results with flow and occlusion."""
    for name in ("flow", "occlusion"):
        (results / name).mkdir()
    for pair in range(PAIRS):
        write_flo(results / "flow" / f"{pair:04}.flo", made_up_flow(pair))
        Image.fromarray(hidden(pair).astype(np.uint8) * 255).save(results / "occlusion" / f"{pair:04}.png")
    return results


def hidden(pair: int) -> NDArray[np.bool_]:
    return np.random.default_rng(100 + pair).random((HEIGHT, WIDTH)) < 0.3


def read_png(path: Path) -> NDArray[np.uint16]:
    """Read a PNG with pypng."""
    width, height, rows, about = png.Reader(bytes=path.read_bytes()).read()
    assert (about["bitdepth"], about["planes"]) == (16, 3)
    return np.array([list(row) for row in rows], np.uint16).reshape(height, width, 3)


def decode(colours: NDArray[np.uint16]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return flow and validity, as flow_read of KITTI's development kit."""
    return (colours[..., :2].astype(float) - 2**15) / 64, colours[..., 2] > 0


def test_flow_round_trip(labelled: Path) -> None:
    done = export(labelled, "kitti", labelled / "out")
    training = labelled / "out" / "training"
    assert done.notes == []
    for pair in range(PAIRS):
        flow, name = made_up_flow(pair).astype(float), f"{pair:06}_10.png"
        fits = ((flow >= -512) & (flow <= 511.98)).all(axis=-1)
        assert 0.5 < fits.mean() < 0.8
        decoded, valid = decode(read_png(training / "flow_occ" / name))
        np.testing.assert_array_equal(valid, fits)
        # To the nearest 1/64 px.
        np.testing.assert_allclose(decoded[valid], flow[valid], rtol=0, atol=1 / 128)
        visible, valid = decode(read_png(training / "flow_noc" / name))
        np.testing.assert_array_equal(valid, fits & ~hidden(pair))
        np.testing.assert_array_equal(visible[valid], decoded[valid])
    written, frames = files(training), files(labelled / "frames")
    kinds = ["flow_noc/{}_10.png", "flow_occ/{}_10.png", "image_2/{}_10.png", "image_2/{}_11.png"]
    assert sorted(written) == sorted(kind.format(f"{pair:06}") for pair in range(PAIRS) for kind in kinds)
    for pair, number in np.ndindex(PAIRS, 2):
        assert written[f"image_2/{pair:06}_1{number}.png"] == frames[f"{pair + number:04}.png"]


@pytest.mark.parametrize(
    ("flow", "colours"),
    [
        ((0, 0), (32768, 32768, 1)),
        ((1, -2.5), (32832, 32608, 1)),
        # Rounded to the nearest, also at both ends.
        ((0.0156, 0.0079), (32769, 32769, 1)),
        ((-512.007, 511.99), (0, 65535, 1)),
        ((-512.008, 0), (0, 0, 0)),
        ((0, 511.993), (0, 0, 0)),
        ((BACKGROUND, BACKGROUND), (0, 0, 0)),
        ((np.nan, 0), (0, 0, 0)),
    ],
)
def test_encoded_flow(flow: tuple[float, float], colours: tuple[int, ...]) -> None:
    assert encode_flow(np.array([[flow]], np.float32)).ravel().tolist() == list(colours)
    assert encode_flow(np.array([[flow]], np.float32), np.array([[False]])).ravel().tolist() == [0, 0, 0]


def test_missing_outputs_are_reported(labelled: Path, message: Messages) -> None:
    shutil.rmtree(labelled / "occlusion")
    shutil.rmtree(labelled / "frames")
    done = export(labelled, "kitti", labelled / "out")
    assert [path.name for path in (labelled / "out" / "training").iterdir()] == ["flow_occ"]
    message(done.notes, "flow_noc", "image_2")


def test_single_frame(labelled: Path, message: Messages) -> None:
    change(labelled, frames=1)
    with message.raises(FilesError, "frame"):
        export(labelled, "kitti", labelled / "out")


FLO = b"PIEH" + struct.pack("<ii", WIDTH, HEIGHT) + bytes(8 * WIDTH * HEIGHT)
DAMAGE: dict[str, tuple[str, Callable[[Path], object]]] = {
    "truncated flow": ("flow/0001.flo", lambda path: path.write_bytes(b"PIEH")),
    "longer flow": ("flow/0001.flo", lambda path: path.write_bytes(FLO + b"\0")),
    "magic number": ("flow/0001.flo", lambda path: path.write_bytes(b"HEIP" + FLO[4:])),
    "rotated flow": ("flow/0001.flo", lambda path: path.write_bytes(FLO[:4] + FLO[8:12] + FLO[4:8] + FLO[12:])),
    "huge flow": ("flow/0001.flo", lambda path: path.write_bytes(FLO[:4] + struct.pack("<ii", 1 << 30, 1 << 30))),
    "missing flow": ("flow/0002.flo", Path.unlink),
    "small frame": ("frames/0000.png", lambda path: Image.new("RGB", (8, 6)).save(path)),
    "not a picture": ("occlusion/0000.png", lambda path: path.write_bytes(b"?")),
    "truncated picture": ("frames/0001.png", lambda path: path.write_bytes(path.read_bytes()[:200])),
}


@pytest.mark.parametrize(("name", "change"), DAMAGE.values(), ids=DAMAGE)
def test_damaged_results(name: str, change: Callable[[Path], object], labelled: Path, message: Messages) -> None:
    change(labelled / name)
    # The reason is in Pillow's words.
    with message.raises(FilesError, name, hide=r"(?<=decoded )\(.*\)"):
        export(labelled, "kitti", labelled / "out")
    assert not (labelled / "out").exists()


def test_flow_of_another_size(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "0001.flo").write_bytes(FLO)
    with message.raises(ValueError, "0001.flo"):
        read_flo(tmp_path / "0001.flo", (HEIGHT, WIDTH))
