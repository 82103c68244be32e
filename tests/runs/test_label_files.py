"""Label files of a run, read without this package, against the NumPy reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import ArgumentError, Playback, run
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.surface import place_instruments
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.conftest import write_small
from tests.golden import Messages
from tests.outputs import results
from tests.reference import labels as twin

ALL = "output=[png, coordinates, depth, normals, flow, occlusion, instrument, tracks, trajectory]"
OBLIQUE = "render.camera=oblique"
ROD = "probes.0.instrument={radius: 0.01, shaft: [1, -0.5, 0.6], length: 0.2}"

Results = tuple[Path, dict[str, NDArray[Any]]]


def small_scene(*overrides: str) -> Scene:
    return load_scene("small.yaml", ["render.tracks=5", *overrides])


def read_flow(path: Path) -> NDArray[np.float32]:
    """Read a .flo file by the description of its authors."""
    data = path.read_bytes()
    assert data[:4] == b"PIEH"
    width, height = np.frombuffer(data, "<i4", 2, 4)
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)


def made(directory: str, device: Device, *overrides: str) -> Results:
    """Directory and trajectory of a run."""
    record = run(small_scene(*overrides), directory, threads=device.threads, estimate_error=False)
    assert record["status"] == "complete"
    with np.load(f"{directory}/trajectory.npz") as archive:
        return Path(directory), dict(archive)


@pytest.fixture(scope="module")
def labelled(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Directory and trajectory of a run with all labels of an instrument, from an oblique camera; read-only."""
    folder = tmp_path_factory.mktemp("labelled")
    write_small(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        directory, trajectory = made("out", device, ALL, OBLIQUE, ROD)
    return folder / directory, trajectory


def test_labels_against_the_reference(labelled: Results, small: Path) -> None:
    done, trajectory = labelled
    scene, position = small_scene(OBLIQUE, ROD), trajectory["position"].astype(float)
    for frame in range(5):
        placed = place_instruments(scene, position[frame], trajectory["time"][frame])
        coordinates, depth, instrument = twin.labels(scene, position[frame], placed)
        written = np.load(done / f"coordinates/{frame:04}.npy")
        assert (written.dtype, written.shape) == (np.float32, (30, 40, 2))
        np.testing.assert_allclose(written, coordinates, atol=1e-5)
        with Image.open(done / f"depth/{frame:04}.tiff") as image:
            assert image.mode == "F"
            np.testing.assert_allclose(np.array(image), depth, rtol=1e-5)
        with Image.open(done / f"instrument/{frame:04}.png") as image:
            assert image.mode == "L"
            np.testing.assert_array_equal(np.array(image), instrument * 255)
        if frame < 4:
            flow = read_flow(done / f"flow/{frame:04}.flo")
            sheet = ~np.isnan(coordinates[..., 0])
            pixels, _ = twin.project(scene, coordinates[sheet], position[frame + 1])
            assert np.abs(flow[sheet] - (pixels - np.argwhere(sheet)[:, ::-1] - 0.5)).max() < 0.01
            assert (flow[~sheet] == 1e10).all()
            with Image.open(done / f"occlusion/{frame:04}.png") as image:
                occlusion = np.array(image)
            assert set(np.unique(occlusion)) <= {0, 255}
            assert not occlusion[~sheet].any()
    assert not (done / "flow/0004.flo").exists()
    assert not (done / "occlusion/0004.png").exists()


def test_layout_of_tracks(labelled: Results) -> None:
    with np.load(labelled[0] / "tracks.npz") as archive:
        tracks = dict(archive)
    middle = (np.arange(5) + 0.5) / 5
    np.testing.assert_allclose(tracks["coordinates"], [[x, y] for y in middle for x in middle], rtol=1e-6)
    layout = {name: (array.dtype.str[1:], array.shape) for name, array in tracks.items()}
    assert layout == {
        "coordinates": ("f4", (25, 2)),
        "points": ("f4", (25, 5, 2)),
        "occluded": ("b1", (25, 5)),
        "position": ("f4", (25, 5, 3)),
    }


def test_labels_are_independent_of_supersampling(labelled: Results, small: Path, device: Device) -> None:
    twice, _ = made("twice", device, ALL, ROD, OBLIQUE, "render.supersample=2")
    first, second = results(labelled[0]), results(twice)
    assert {name for name in first if first[name] != second[name]} == {f"frames/{n:04}.png" for n in range(5)}


def test_labels_without_picture_or_camera(small: Path, device: Device) -> None:
    scene = small_scene("output=[flow, tracks]").model_copy(update={"image": None})
    record = run(scene, "out", threads=device.threads, estimate_error=False)
    assert record["outputs"] == ["flow", "tracks.npz", "camera.json", "run.json"]
    assert sorted(results(Path("out"))) == ["camera.json", *(f"flow/{n:04}.flo" for n in range(4)), "tracks.npz"]
    masks = small_scene("output=[occlusion, instrument]")
    run(masks, "masks", threads=device.threads, estimate_error=False)
    assert not Path("masks/camera.json").exists()


def test_playback(labelled: Results, device: Device, message: Messages) -> None:
    done, trajectory = labelled
    with Playback(done, threads=device.threads) as playback:
        np.testing.assert_array_equal(playback.positions, trajectory["position"])
        np.testing.assert_array_equal(playback.time, trajectory["time"])
        with Image.open(done / "frames/0002.png") as image:
            np.testing.assert_array_equal(playback.draw(2), np.array(image))
        np.testing.assert_array_equal(playback.labels(3).coordinates, np.load(done / "coordinates/0003.npy"))
        np.testing.assert_array_equal(playback.flow(1, 2).flow, read_flow(done / "flow/0001.flo"))
        # The flow from a frame to itself is 0.
        still = playback.flow(4, 4).flow
        assert np.abs(still[still[..., 0] < 1e9]).max() < 1e-3
        for frame in (-1, 5, 1.0, True):
            with message.raises(ArgumentError, "frame"):
                playback.draw(frame)  # type: ignore[arg-type]
