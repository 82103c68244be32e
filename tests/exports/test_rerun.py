"""Recordings for Rerun's viewer, read back with rerun-sdk."""

from __future__ import annotations

import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import NotInstalledError, export
from taichi_msm.cameras.lens import IDENTITY_LENS
from taichi_msm.model.surface import place_instruments
from taichi_msm.render.camera import view_at
from taichi_msm.runs.arrays import read_flo
from taichi_msm.runs.finished import read_run
from tests.golden import Messages

FRAMES, WIDTH, HEIGHT = 3, 40, 32


def test_rerun_is_not_installed(
    labelled_in_motion: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "taichi_msm.exports.rerun", raising=False)
    with message.raises(NotInstalledError):
        export(labelled_in_motion, "rerun", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def logged(path: Path) -> dict[str, dict[int, Any]]:
    """Return the values of all components by entity and component, then by frame; frame -1 is static."""
    chunk: Any = pytest.importorskip("rerun.chunk")
    log: dict[str, dict[int, Any]] = {}
    for each in chunk.RrdReader(path).stream():
        columns = each.to_record_batch().to_pydict()
        frames = columns.pop("frame", [-1] * each.num_rows)
        for name, values in columns.items():
            for frame, value in zip(frames, values, strict=True):
                log.setdefault(f"{each.entity_path} {name}", {})[frame] = value
    return log


def test_recording_round_trip(labelled_in_motion: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun.chunk")
    run, finished = labelled_in_motion, read_run(labelled_in_motion)
    done = export(run, "rerun", tmp_path / "out")
    assert (done.files, done.notes) == (["000000.rrd", "index.csv"], [])
    log = logged(tmp_path / "out/000000.rrd")
    tracks, camera = np.load(run / "tracks.npz"), json.loads((run / "camera.json").read_text())
    positions, poses = finished.positions(), np.array(camera["poses"])
    sheet = "/world/sheet Mesh3D:"
    rows, cols = positions.shape[1:3]
    assert np.array(log[sheet + "triangle_indices"][0]).shape == (2 * (rows - 1) * (cols - 1), 3)
    assert np.array(log[sheet + "albedo_texture_buffer"][0]).size == 30 * 40 * 3
    corners = np.array(log[sheet + "vertex_texcoords"][0])[[0, cols - 1, -1]]
    np.testing.assert_array_equal(corners, [[0, 0], [1, 0], [1, 1]])
    for frame in range(FRAMES):
        assert log["/world/sheet time"][frame].total_seconds() == pytest.approx(frame / 10)
        np.testing.assert_allclose(log[sheet + "vertex_positions"][frame], positions[frame].reshape(-1, 3), atol=1e-7)
        (capsule,) = place_instruments(finished.scene, positions[frame], frame / 10)
        np.testing.assert_allclose(log["/world/tools/0 Transform3D:translation"][frame][0], capsule.tip, atol=1e-6)
        np.testing.assert_allclose(log["/world/tracks Points3D:positions"][frame], tracks["position"][:, frame])
        # Column by column, from the camera to the world.
        matrix = np.array(log["/world/camera Transform3D:mat3x3"][frame]).reshape(3, 3).T
        eye = np.array(log["/world/camera Transform3D:translation"][frame][0])
        np.testing.assert_allclose(matrix.T, poses[frame, :, :3], atol=1e-6)
        np.testing.assert_allclose(-matrix.T @ eye, poses[frame, :, 3], atol=1e-6)
        intrinsics = np.array(log["/world/camera Pinhole:image_from_camera"][frame]).reshape(3, 3).T
        np.testing.assert_allclose(intrinsics, camera["intrinsics"])
        assert log["/world/camera Pinhole:resolution"][frame] == [[WIDTH, HEIGHT]]
        picture = Image.open(io.BytesIO(bytes(log["/world/camera/picture EncodedImage:blob"][frame][0])))
        np.testing.assert_array_equal(np.array(picture), np.array(Image.open(run / f"frames/{frame:04}.png")))
        depth = np.frombuffer(bytes(log["/world/camera/depth DepthImage:buffer"][frame][0]), np.float32)
        np.testing.assert_array_equal(
            depth.reshape(HEIGHT, WIDTH), np.array(Image.open(run / f"depth/{frame:04}.tiff"))
        )
    assert log["/world/camera/depth DepthImage:meter"][0] == [1.0]
    flow = log["/world/camera/flow Tensor:data"]
    assert sorted(flow) == [0, 1]
    values = np.array(flow[1][0]["buffer"], np.float32).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_array_equal(values, read_flo(run / "flow/0001.flo", (WIDTH, HEIGHT)))


def test_warning_of_distortion(
    labelled_in_motion: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    pytest.importorskip("rerun.chunk")
    distorted = lambda *arguments: view_at(*arguments)._replace(lens=IDENTITY_LENS)  # noqa: E731
    monkeypatch.setattr("taichi_msm.exports.rerun.view_at", distorted)
    message(export(labelled_in_motion, "rerun", tmp_path / "out").notes, "distortion")


def test_entities_of_several_cameras(stereo: Path, message: Messages) -> None:
    pytest.importorskip("rerun.chunk")
    shutil.rmtree(stereo / "right/frames")
    done = export(stereo, "rerun")
    message(done.notes)
    entities = {name.split()[0] for name in logged(done.directory / "000000.rrd")}
    assert {"/world/cameras/left/picture", "/world/cameras/left", "/world/cameras/right", "/world/tracks"} <= entities
    assert "/world/cameras/right/picture" not in entities
