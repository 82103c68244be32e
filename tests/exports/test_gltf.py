"""Motion, picture, tools and cameras in a .glb, which Khronos's validator accepts."""

from __future__ import annotations

import io
import json
import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from taichi_msm.exports import gltf
from taichi_msm.exports.export import export
from taichi_msm.exports.gltf import key_frames
from taichi_msm.exports.inputs import unit_normals
from taichi_msm.model.surface import place_instruments
from taichi_msm.render.camera import view_at
from taichi_msm.runs.finished import read_run
from tests.golden import Messages
from tests.runs.test_finished import change, change_scene
from tests.scenes import speckle

Array = NDArray[Any]

# Relative rounding error of float32.
ROUNDING = 2.0**-24

# Reads a .glb from stdin; the package is in NODE_PATH, where .ci/run installs it.
VALIDATE = """
const validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(require("fs").readFileSync(0)))
    .then(report => console.log(JSON.stringify(report)), error => console.log(JSON.stringify({error: `${error}`})));
"""


class Glb(NamedTuple):
    """Content of a .glb file, decoded by its specification."""

    document: dict[str, Any]
    binary: bytes

    def view(self, number: int) -> bytes:
        view = self.document["bufferViews"][number]
        return self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def accessor(self, number: int) -> Array:
        accessor = self.document["accessors"][number]
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        size = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(self.view(accessor["bufferView"]), dtype).reshape(accessor["count"], size)

    @property
    def primitive(self) -> dict[str, Any]:
        (mesh,) = self.document["meshes"]
        (primitive,) = mesh["primitives"]
        return dict(primitive)

    def picture(self) -> Array:
        (image,) = self.document["images"]
        return np.asarray(Image.open(io.BytesIO(self.view(image["bufferView"]))))

    def attribute(self, name: str) -> Array:
        return self.accessor(self.primitive["attributes"][name])

    def at(self, time: float, name: str = "POSITION") -> Array:
        """Return the interpolated vertices or normals at a time [s]."""
        (animation,) = self.document["animations"]
        (sampler,), (channel,) = animation["samplers"], animation["channels"]
        assert channel == {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        times, targets = self.accessor(sampler["input"])[:, 0], self.primitive["targets"]
        weights = self.accessor(sampler["output"]).reshape(len(times), len(targets))
        values = self.attribute(name).astype(float)
        for number, target in enumerate(targets):
            values += np.interp(time, times, weights[:, number]) * self.accessor(target[name])
        return values


def read_glb(path: Path) -> Glb:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_length, text_kind = struct.unpack_from("<I4s", data, 12)
    binary_length, binary_kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert (text_kind, binary_kind) == (b"JSON", b"BIN\0")
    assert length == 28 + text_length + binary_length
    return Glb(json.loads(data[20 : 20 + text_length]), data[28 + text_length :])


@pytest.fixture(scope="module")
def glb(ran: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gltf")
    assert export(ran, "gltf", out).notes == []
    return out / "surface.glb"


def positions(ran: Path) -> Array:
    return np.asarray(np.load(ran / "trajectory.npz")["position"])


def test_positions_and_normals_of_every_frame(ran: Path, glb: Path) -> None:
    content, expected = read_glb(glb), positions(ran)
    largest = np.abs(expected).max()
    for frame, position in enumerate(expected):
        # Positions and differences are rounded to float32.
        np.testing.assert_allclose(content.at(frame / 10), position.reshape(-1, 3), rtol=0, atol=3 * ROUNDING * largest)
        np.testing.assert_allclose(content.at(frame / 10, "NORMAL"), unit_normals(position), rtol=0, atol=4 * ROUNDING)
    between = (expected[2] + expected[3]) / 2
    # So are times, by some 1e-8 s, 1e-7 of the frame interval.
    atol = (3 * ROUNDING + 1e-6) * largest
    np.testing.assert_allclose(content.at(0.25), between.reshape(-1, 3), rtol=0, atol=atol)


def test_orientation_and_texture_coordinates(glb: Path) -> None:
    content = read_glb(glb)
    corners = content.attribute("POSITION")[content.accessor(content.primitive["indices"]).reshape(-1, 3)]
    assert len(corners) == 2 * 8 * 10
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (area[:, 2] > 0).all(), "counter-clockwise from above"
    np.testing.assert_array_equal(content.attribute("NORMAL"), np.tile([0, 0, 1], (99, 1)))
    # Coincident points have no normal; z replaces it.
    np.testing.assert_array_equal(unit_normals(np.zeros((3, 4, 3), np.float32)), np.tile([0, 0, 1], (12, 1)))
    # From the upper left.
    corner = dict(zip(map(tuple, content.attribute("TEXCOORD_0").tolist()), content.attribute("POSITION"), strict=True))
    for texture, position in (((0, 0), (-0.2, 0.15, 0)), ((1, 0), (0.2, 0.15, 0)), ((0, 1), (-0.2, -0.15, 0))):
        np.testing.assert_allclose(corner[texture], position, atol=ROUNDING)


def test_material(glb: Path) -> None:
    content = read_glb(glb)
    (material,), (texture,) = content.document["materials"], content.document["textures"]
    (image,), (sampler,) = content.document["images"], content.document["samplers"]
    assert material["doubleSided"]
    assert material["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert (texture["source"], texture["sampler"], content.primitive["material"]) == (0, 0, 0)
    assert (image["mimeType"], sampler["wrapS"], sampler["wrapT"]) == ("image/png", 33071, 33071)
    np.testing.assert_array_equal(content.picture(), speckle(30, 40))


def test_region_of_the_picture(results: Path) -> None:
    change_scene(results, region=[5, 7, 20, 10])
    export(results, "gltf", results / "out")
    content = read_glb(results / "out" / "surface.glb")
    np.testing.assert_array_equal(content.picture(), speckle(30, 40)[7:17, 5:25])


def without_picture(results: Path) -> Path:
    change_scene(results, image=None, output=["trajectory"])
    export(results, "gltf", results / "bare")
    return results / "bare" / "surface.glb"


def with_one_frame(results: Path) -> Path:
    first = positions(results)[:1]
    np.savez(results / "trajectory.npz", time=np.zeros(1), position=first)
    change(results, frames=1)
    export(results, "gltf", results / "still")
    return results / "still" / "surface.glb"


ROD = {"radius": 0.02, "shaft": [0.3, -0.4, 1], "length": 0.1}
FINGER = {"path": [[0, 0.5, 0.5, 0.02], [0.4, 0.6, 0.4, -0.01]], "instrument": ROD}
HELD = {"at": [0.3, 0.6], "force": [0, 0, 1], "load": [[0, 100]], "instrument": {**ROD, "shaft": [-1, 0, 0]}}


def with_tools_and_cameras(results: Path) -> Path:
    """Export a run with two tools, a moving and an orthographic camera."""
    moving = {"eye": [[0, 0.1, -0.3, 0.4], [0.4, 0.3, 0.1, 0.5]], "up": [0.2, 1, 0], "fov": 50}
    render = {"camera": None, "cameras": {"left": moving, "above": "top"}}
    change_scene(results, probes=[FINGER, HELD], render=render, output=["trajectory"])
    assert export(results, "gltf", results / "out").notes == []
    return results / "out" / "surface.glb"


@pytest.fixture
def furnished(results: Path) -> Glb:
    return read_glb(with_tools_and_cameras(results))


def test_without_picture_or_motion(results: Path) -> None:
    bare = read_glb(without_picture(results)).document
    assert {"images", "textures", "samplers"}.isdisjoint(bare)
    still = read_glb(with_one_frame(results))
    assert "animations" not in still.document
    assert "targets" not in still.primitive


def validate(data: bytes) -> dict[str, Any]:
    """Return the report of Khronos's validator."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    done = subprocess.run([node, "-e", VALIDATE], input=data, capture_output=True, check=False)
    if done.returncode != 0 and b"Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("needs the npm package gltf-validator, in NODE_PATH")
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@pytest.mark.parametrize("make", [without_picture, with_one_frame, with_tools_and_cameras, None])
def test_khronos_validator(make: Callable[[Path], Path] | None, glb: Path, results: Path) -> None:
    report = validate((make(results) if make else glb).read_bytes())
    assert make or (report["info"]["animationCount"], report["info"]["totalTriangleCount"]) == (1, 160)
    issues = report["issues"]
    # WebGL 2 supports pictures whose sides are not powers of two.
    assert {issue["code"] for issue in issues["messages"]} <= {"IMAGE_NPOT_DIMENSIONS"}
    assert (issues["numErrors"], issues["numWarnings"], issues["numHints"]) == (0, 0, 0)


def motion(frames: int) -> Array:
    """Return positions of a sheet that rises slowly, falls within a frame, and rings."""
    time = np.arange(frames) / frames
    height = np.where(time < 0.4, time, 0.1 * np.sin(40 * time) * np.exp(-5 * time))
    shape = np.random.default_rng(0).random((3, 4, 3))
    return height[:, None, None, None] * shape


def error_of(position: Array, frames: list[int]) -> float:
    """Return the largest interpolation error, computed point by point."""
    worst = 0.0
    for index in np.ndindex(position.shape[1:3]):
        path = position[:, index[0], index[1]]
        lines = [np.interp(np.arange(len(path)), frames, path[frames, axis]) for axis in range(3)]
        worst = max(worst, float(np.linalg.norm(path - np.stack(lines, axis=-1), axis=-1).max()))
    return worst


def test_keyframes_of_a_sudden_motion() -> None:
    position = motion(300)
    keys = key_frames(position, 25)
    assert len(keys.frames) == 25
    assert keys.frames == sorted(set(keys.frames))
    assert (keys.frames[0], keys.frames[-1]) == (0, 299)
    assert {119, 120} <= set(keys.frames), "before and after the fall"
    assert keys.error == pytest.approx(error_of(position, keys.frames), rel=1e-12)
    evenly = np.linspace(0, 299, 25).round().astype(int).tolist()
    assert keys.error < error_of(position, evenly) / 5


def test_keyframes_of_simple_motions() -> None:
    straight = np.linspace(0, 1, 50)[:, None, None, None] * np.ones((2, 2, 3))
    assert key_frames(np.zeros((50, 2, 2, 3)), 10) == ([0, 49], 0.0)
    assert key_frames(straight, 10).error <= 2 * ROUNDING**2 * 50
    assert key_frames(motion(20), 20) == (list(range(20)), 0.0)


@pytest.mark.parametrize(
    ("limit", "value", "targets"),
    [("MAX_TARGETS", 2, 2), ("MAX_TARGETS_BYTES", 3 * 99 * 24, 3)],
    ids=["frames", "points"],
)
def test_limits_of_the_morph_targets(
    limit: str, value: int, targets: int, ran: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setattr(gltf, limit, value)
    done = export(ran, "gltf", tmp_path)
    content, expected = read_glb(tmp_path / "surface.glb"), positions(ran)
    keys = key_frames(expected, targets + 1)
    assert len(content.primitive["targets"]) == targets
    assert f" {keys.error:.2g} m" in done.notes[0]
    message(done.notes, hide=r"(?<=most )\S+")
    errors = [content.at(frame / 10) - expected[frame].reshape(-1, 3) for frame in range(5)]
    assert np.linalg.norm(errors, axis=-1).max() == pytest.approx(keys.error, rel=1e-5)


def pose_at(content: Glb, name: str, frame: int) -> tuple[Array, Array]:
    """Return translation and rotation matrix of a node in a frame."""
    (number,) = [number for number, node in enumerate(content.document["nodes"]) if node["name"] == name]
    values = {"rotation": np.array([0, 0, 0, 1.0])} | content.document["nodes"][number]
    (animation,) = content.document["animations"]
    for channel in animation["channels"]:
        if channel["target"]["node"] == number:
            sampler = animation["samplers"][channel["sampler"]]
            np.testing.assert_allclose(content.accessor(sampler["input"])[:, 0], np.arange(5) / 10, rtol=1e-6)
            values[channel["target"]["path"]] = content.accessor(sampler["output"])[frame]
    return np.array(values["translation"]), Rotation.from_quat(values["rotation"]).as_matrix()


def test_tools(furnished: Glb, results: Path) -> None:
    run = read_run(results)
    for index, name in enumerate(("probes.0", "probes.1")):
        (mesh,) = [mesh for mesh in furnished.document["meshes"] if mesh["name"] == name]
        (primitive,) = mesh["primitives"]
        vertices, normals = (
            furnished.accessor(primitive["attributes"][key]).astype(float) for key in ("POSITION", "NORMAL")
        )
        triangles = vertices[furnished.accessor(primitive["indices"]).reshape(-1, 3)]
        outward = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        for frame in (0, 4):
            capsule = place_instruments(run.scene, run.positions()[frame], frame / 10)[index]
            np.testing.assert_allclose(pose_at(furnished, name, frame)[0], capsule.tip, atol=1e-7)
        nearest = np.clip(vertices @ capsule.axis, 0, capsule.length)[:, None] * capsule.axis
        np.testing.assert_allclose(vertices - nearest, capsule.radius * normals, atol=1e-7)
        middle = triangles.mean(axis=1)
        nearest = np.clip(middle @ capsule.axis, 0, capsule.length)[:, None] * capsule.axis
        assert (np.einsum("ij,ij->i", outward, middle - nearest) > 0).all()
        ends = np.ptp(vertices @ capsule.axis)
        assert ends == pytest.approx(capsule.length + 2 * capsule.radius, abs=1e-7)


def test_cameras(furnished: Glb, results: Path) -> None:
    run, points = read_run(results), np.array([[0.1, 0.05, 0], [-0.15, 0.1, 0.02], [0, -0.1, -0.03]])
    optics = {camera["name"]: camera for camera in furnished.document["cameras"]}
    for name, frame in (("left", 0), ("left", 3), ("above", 3)):
        eye, rotation = pose_at(furnished, name, frame)
        x, y, z = ((points - eye) @ rotation).T
        if name == "left":
            lens = optics[name]["perspective"]
            scale_y = 1 / np.tan(lens["yfov"] / 2) / -z
            scale_x = scale_y / lens["aspectRatio"]
        else:
            lens = optics[name]["orthographic"]
            scale_x, scale_y = 1 / lens["xmag"], 1 / lens["ymag"]
            assert (lens["znear"] < -z).all()
            assert (-z < lens["zfar"]).all()
        pixels = np.stack([20 * (1 + x * scale_x), 15 * (1 - y * scale_y)], axis=-1)
        # Poses are rounded to single precision.
        np.testing.assert_allclose(pixels, view_at(run.scene, frame / 10, name).pixels(points), atol=1e-4)


def test_distortion_warning(results: Path, message: Messages) -> None:
    intrinsics = {"fx": 40, "fy": 40, "cx": 19.5, "cy": 14.5}
    camera = {"eye": [0, 0, 0.5], "intrinsics": intrinsics, "distortion": {"k1": 0.01}}
    change_scene(results, render={"camera": camera})
    message(export(results, "gltf", results / "out").notes, "camera")
