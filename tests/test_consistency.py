"""Consistency of the labels of a run: deviations between its files, in float64, with OpenCV's cameras.

Of the program only `run` and, for a second camera, `Simulation` are used; of the NumPy reference, the refined surface.
Pixels are OpenCV's: the centre of the first one is at (0, 0). Occlusion is tested against all triangles.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import Simulation, run
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.reference.drawing import refine, triangles
from tests.reference.labels import interpolate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Deviations = Iterator[tuple[str, float]]  # by the keys of AGREEMENTS


class Agreement(NamedTuple):
    """Two quantities that must agree."""

    description: str
    unit: str
    bound: float  # largest deviation


# The rounding of single precision is 2^-24: 4e-6 px in 64 to 128 px, 9e-9 m in 0.15 m; more where the sheet is nearly
# edge-on.
AGREEMENTS = {
    "coordinates": Agreement("`coordinates`, projected, and the pixel's centre", "px", 1e-3),
    "depth": Agreement("`depth`, back through the lens, and the point at those coordinates", "m", 1e-6),
    "normals": Agreement("`normals` and the gradient of depth, within a triangle", "°", 1e-2),
    "flow": Agreement("`flow` and the moved point, projected in the next frame", "px", 1e-5),
    "occlusion": Agreement("`occlusion` and the line of sight among all triangles", "share of pixels", 0.0),
    "tracks": Agreement("`tracks`: `points` and `position`, projected", "px", 2e-5),
    "occluded": Agreement("`tracks`: `occluded` and the line of sight", "share of tracks", 0.0),
    "position": Agreement("`tracks`: `position` and depth, back through the lens", "m", 1e-6),
    "stereo": Agreement("`stereo` and the point, projected in the other picture", "px", 1e-5),
    "disparity": Agreement("`stereo` and `disparity`, without distortion", "px", 1e-4),
    "stereo occlusion": Agreement("`stereo-occlusion` and the line of sight", "share of pixels", 0.0),
}

WIDTH, HEIGHT, POINTS, REFINE, SIDE = 120, 90, 13, 1, 0.1
RADIUS, LENGTH, SHAFT = 0.007, 0.08, np.array([0.3, 0.5, 0.9])

POSE = {"eye": [0.03, -0.06, 0.1], "target": [0, 0, 0.01]}
INTRINSICS = {"fx": 97.0, "fy": 96.0, "cx": 58.2, "cy": 45.6}
RATIONAL = {"k1": -0.34, "k2": 0.12, "p1": 0.001, "p2": -0.002, "k3": -0.01, "k4": 0.02}
SWAY = [[0, 0.03, -0.06, 0.1], [0.25, 0.0, -0.07, 0.11], [0.5, 0.02, -0.05, 0.1]]
CAMERAS: dict[str, Any] = {
    "top": "top",
    "pinhole": {**POSE, "fov": 50},
    "intrinsics": {**POSE, "intrinsics": INTRINSICS},
    "rational": {**POSE, "intrinsics": INTRINSICS, "distortion": RATIONAL},
    "fisheye": {**POSE, "intrinsics": INTRINSICS, "distortion": {"model": "fisheye", "k1": -0.05, "k2": 0.01}},
    "moving": {**POSE, "eye": SWAY, "intrinsics": INTRINSICS, "distortion": RATIONAL},
}

# The right cameras of some of them, by OpenCV's stereoCalibrate or parallel.
STEREO: dict[str, dict[str, Any]] = {
    "intrinsics": {"beside": "left", "baseline": 0.005},
    "rational": {
        "beside": "left",
        # From the other side, with self-occlusion of the tool, and its tip behind the fold.
        "rotation": cv2.Rodrigues(np.array([-0.24, 1.26, 1.24]))[0].tolist(),
        "translation": [-0.065, -0.081, 0.064],
        "intrinsics": {"fx": 101.0, "fy": 102.0, "cx": 57.0, "cy": 43.0},
        "distortion": {"k1": -0.3, "k2": 0.09, "p1": -0.001},
    },
}

# Compared frames, while the sheet is pulled over itself; neither is the last.
FRAMES = (5, 9)

# Surfaces in front of a point by less than this do not hide it [m].
TOUCHING = 1e-9 * SIDE


LABELS = ("coordinates", "depth", "normals", "flow", "occlusion", "instrument")


def scene(camera: Any) -> Scene:
    """A sheet fixed on the left; a tool grips its right, lifts it and pulls it over to the left."""
    tool = {
        "path": [[0, 0.8, 0.5, 0.002], [0.1, 0.8, 0.5, -0.003], [0.2, 0.75, 0.5, 0.03], [0.5, 0.1, 0.5, 0.03]],
        "grip": [[0.1, 1]],
        "instrument": {"radius": RADIUS, "length": LENGTH, "shaft": SHAFT.tolist()},
    }
    tissue = {"young": 3e4, "thickness": 3e-3, "density": 1050, "foundation": 3e3, "damping": 500}
    return Scene.model_validate(
        {
            "sheet": {"points": [POINTS, POINTS], "size": [SIDE, SIDE], "fixed": ["left"]},
            "tissue": {**tissue, "foundation_active": "always"},
            "probes": [tool],
            "time": {"duration": 0.5, "frames_per_second": 20, "precision": "f64"},
            "render": {"size": [WIDTH, HEIGHT], "refine": REFINE, "camera": camera, "tracks": 19},
            "output": [*LABELS, "trajectory", "forces", "tracks"],
        }
    )


class Camera(NamedTuple):
    """A camera of camera.json in one frame; the eye of the orthographic one is above the sheet, as documented."""

    turn: Array  # right, down and forward, as rows
    shift: Array  # the world's origin [m]
    project: Callable[[Array], Array]  # image points, shape (n, 2), to pixels
    unproject: Callable[[Array], Array]  # and back
    pinhole: bool

    def to_camera(self, points: Array) -> Array:
        """Points of the world in camera axes [m], shape (n, 3)."""
        return points @ self.turn.T + self.shift

    def image_points(self, points: Array) -> Array:
        """Projections of points in camera axes, at depth 1 of a pinhole, shape (n, 2)."""
        return points[:, :2] / points[:, 2:] if self.pinhole else points[:, :2]

    def pixels(self, points: Array) -> Array:
        """Projections of points of the world [px], shape (n, 2)."""
        return np.asarray(self.project(self.image_points(self.to_camera(points))))

    def points(self, pixels: Array, depth: Array) -> Array:
        """Points of the world at pixels and depths [m], shape (n, 3)."""
        image = self.unproject(pixels)
        points = np.concatenate([image * depth[:, None] if self.pinhole else image, depth[:, None]], axis=1)
        return np.asarray((points - self.shift) @ self.turn)


def read_camera(written: dict[str, Any], frame: int) -> Camera:
    """Return the camera of a frame from the content of camera.json."""
    if "pose" not in written:
        rows = np.array(written["projection"])
        scale, centre = np.linalg.norm(rows[:2, :3], axis=1), rows[:2, 3] - 0.5
        right, down = rows[:2, :3] / scale[:, None]
        turn, shift = np.array([right, down, np.cross(right, down)]), np.array([0, 0, SIDE])
        return Camera(turn, shift, lambda image: image * scale + centre, lambda at: (at - centre) / scale, False)
    pose = np.array(written["poses"][frame] if "poses" in written else written["pose"])
    matrix, lens, zero = np.array(written["calibration"]), np.array(written["distortion"]), np.zeros(3)

    def project(image: Array) -> Array:
        points = np.concatenate([image, np.ones((len(image), 1))], axis=1)[:, None]
        opencv = cv2.fisheye.projectPoints if written["model"] == "fisheye" else cv2.projectPoints
        return np.asarray(opencv(points, zero, zero, matrix, lens)[0][:, 0])

    def unproject(pixels: Array) -> Array:
        focal, image = matrix.diagonal()[:2], np.zeros_like(pixels)
        for _ in range(60):  # a fixed-point iteration: the distortion is a contraction
            image += (pixels - project(image)) / focal
        assert distance(project(image), pixels) < 1e-9
        return image

    return Camera(pose[:, :3], pose[:, 3], project, unproject, True)


def triangle_of(coordinates: Array) -> Array:
    """A number of the triangle at coordinates; NaN in the background."""
    index = coordinates * ((POINTS - 1) * (REFINE + 1))
    corner = np.floor(index)
    s, t = np.moveaxis(index - corner, -1, 0)
    return np.asarray(corner @ [2.0, 1000.0] + (t > s))


def behind_sheet(image: Array, depth: Array, camera: Camera, vertices: Array) -> Mask:
    """Return whether points are behind any triangle.

    With corners c_i in camera axes, the ray of an image point p meets the triangle where sum b_i c_i = depth (p, 1), or
    of an orthographic camera where sum b_i c_i = (p, depth), with sum b_i = 1.
    """
    hidden, rays = np.zeros(len(image), bool), np.concatenate([image, np.ones((len(image), 1))], axis=1)
    corners = camera.to_camera(
        np.concatenate(list(triangles(vertices, np.ones(np.array(vertices.shape[:2]) - 1, bool))))
    )
    outlines, corners = camera.image_points(corners).reshape(-1, 3, 2), corners.reshape(-1, 3, 3)
    low, high = outlines.min(axis=1), outlines.max(axis=1)
    columns = np.moveaxis(corners if camera.pinhole else np.insert(outlines, 2, 1, axis=2), 1, 2)
    edge_on = np.linalg.det(columns) == 0  # hides nothing
    inverses = np.linalg.inv(np.where(edge_on[:, None, None], np.eye(3), columns))
    for triangle in np.flatnonzero(~edge_on):
        near = np.flatnonzero(((image >= low[triangle]) & (image <= high[triangle])).all(axis=1))
        if len(near):
            shares = inverses[triangle] @ rays[near].T
            with np.errstate(divide="ignore"):
                met = 1 / shares.sum(axis=0) if camera.pinhole else corners[triangle, :, 2] @ shares
            hidden[near] |= (shares >= 0).all(axis=0) & (met < depth[near] - TOUCHING)
    return hidden


def behind_rod(points: Array, eye: Array, tip_centre: Array) -> Mask:
    """Return whether lines from points to their eyes are nearer than RADIUS to the rod's middle line."""
    axis, ray = SHAFT / np.linalg.norm(SHAFT), eye - points
    low, high = np.zeros(len(points)), np.full(len(points), LENGTH)

    def distance_at(along: Array) -> Array:
        offset = tip_centre + along[:, None] * axis - points
        share = np.clip((offset * ray).sum(axis=1) / (ray * ray).sum(axis=1), 0, 1)
        return np.asarray(np.linalg.norm(offset - share[:, None] * ray, axis=1))

    for _ in range(60):  # ternary search: the distance between two lines is convex
        left, right = low + (high - low) / 3, high - (high - low) / 3
        nearer = distance_at(left) < distance_at(right)
        low, high = np.where(nearer, low, left), np.where(nearer, right, high)
    return distance_at(low) < RADIUS


class Files:
    """The results of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written = json.loads((folder / "camera.json").read_text())
        with np.load(folder / "trajectory.npz") as archive:
            self.time, self.positions = archive["time"], archive["position"]
        self.vertices = [refine(position, REFINE) for position in self.positions]
        with np.load(folder / "tracks.npz") as archive:
            self.tracks = dict(archive)
        with (folder / "forces.csv").open() as file:
            tips = [[float(row[f"tip_{axis}"]) for axis in "xyz"] for row in csv.DictReader(file)]
        # A tip is the lowest point of the round end.
        self.tip_centres = np.add(tips, [0, 0, RADIUS])

    def camera(self, frame: int) -> Camera:
        return read_camera(self.written, frame)

    def read(self, name: str, frame: int) -> Array:
        (path,) = (self.folder / name).glob(f"{frame:04}.*")
        if path.suffix == ".npy":
            return np.asarray(np.load(path), float)
        if path.suffix == ".flo":
            return np.asarray(cv2.readOpticalFlow(str(path)), float)
        with Image.open(path) as image:
            return np.asarray(image, float)

    def hidden(self, points: Array, frame: int, camera: Camera) -> Mask:
        """Return whether points of the surface are hidden or outside the picture in a frame."""
        pixels, local = camera.pixels(points), camera.to_camera(points)
        outside = ((pixels < -0.5) | (pixels >= [WIDTH - 0.5, HEIGHT - 0.5])).any(axis=1)
        eye = np.broadcast_to(-camera.shift @ camera.turn, points.shape)
        if not camera.pinhole:
            eye = points - (local[:, 2:] + 1) * camera.turn[2]
        behind = behind_sheet(camera.image_points(local), local[:, 2], camera, self.vertices[frame])
        return np.asarray(outside | behind | behind_rod(points, eye, self.tip_centres[frame]))


def centres() -> Array:
    """Centres of the pixels, shape (height, width, 2)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    return np.stack([x, y], axis=-1)


def distance(a: Any, b: Any) -> float:
    """The largest distance between points."""
    return float(np.linalg.norm(np.subtract(a, b), axis=-1).max())


def of_pixels(files: Files) -> Deviations:
    """Labels and flow of pixels against the surface and the camera in both frames."""
    for frame in FRAMES:
        first, second = files.camera(frame), files.camera(frame + 1)
        coordinates, flow = files.read("coordinates", frame), files.read("flow", frame)
        sheet = np.isfinite(coordinates[..., 0])
        pixels, coordinates = centres()[sheet], coordinates[sheet]
        visible, moved = (interpolate(files.vertices[n], coordinates) for n in (frame, frame + 1))
        yield "coordinates", distance(first.pixels(visible), pixels)
        yield "depth", distance(first.points(pixels, files.read("depth", frame)[sheet]), visible)
        yield "flow", distance(pixels + flow[sheet], second.pixels(moved))
        hidden = files.hidden(moved, frame + 1, second)
        yield "occlusion", float(np.mean((files.read("occlusion", frame)[sheet] == 255) != hidden))
        assert 0.01 < hidden.mean() < 0.2, "the sheet folds"
        assert np.linalg.norm(flow[sheet], axis=1).max() > 5, "it moves"
        assert (files.read("instrument", frame) == 255).mean() > 0.01


def of_normals(files: Files) -> Deviations:
    """Normals against the gradient of depth, where three neighbouring pixels are on the same triangle."""
    for frame in FRAMES:
        triangle = triangle_of(files.read("coordinates", frame))
        middle, right, below = np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1]
        same = (triangle[middle] == triangle[right]) & (triangle[middle] == triangle[below])
        assert same.sum() > 300
        depth, camera = files.read("depth", frame), files.camera(frame)
        a, b, c = (camera.points(centres()[part][same], depth[part][same]) for part in (middle, right, below))
        normal = np.cross(c - a, b - a) @ camera.turn.T
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        yield "normals", float(np.degrees(distance(normal, files.read("normals", frame)[middle][same])))


def of_tracks(files: Files) -> Deviations:
    """Tracks against the projection, the line of sight, and depth and normal of the surrounding pixel."""
    coordinates = files.tracks["coordinates"].astype(float)
    for frame in FRAMES:
        camera = files.camera(frame)
        points, position = (files.tracks[name][:, frame].astype(float) for name in ("points", "position"))
        occluded = files.tracks["occluded"][:, frame]
        pixels = points - 0.5
        yield "tracks", distance(pixels, camera.pixels(position))
        hidden = files.hidden(interpolate(files.vertices[frame], coordinates), frame, camera)
        yield "occluded", float(np.mean(occluded != hidden))
        # The line of sight meets the plane of the triangle, which the depth and normal of the pixel determine.
        x, y = np.round(pixels).astype(int).clip(0, [WIDTH - 1, HEIGHT - 1]).T
        same = ~occluded & (triangle_of(files.read("coordinates", frame))[y, x] == triangle_of(coordinates))
        assert same.sum() > 50
        x, y = x[same], y[same]
        visible = camera.points(np.stack([x, y], axis=1).astype(float), files.read("depth", frame)[y, x])
        normal = files.read("normals", frame)[y, x] @ camera.turn
        near, beyond = (camera.points(pixels[same], np.full(len(x), depth)) for depth in (0.0, 1.0))
        share = ((visible - near) * normal).sum(axis=1) / ((beyond - near) * normal).sum(axis=1)
        yield "position", distance(near + share[:, None] * (beyond - near), position[same])


def of_stereo(files: Files, name: str, threads: int) -> Deviations:
    """Labels of a stereo pair: one of CAMERAS and its right camera of STEREO."""
    right_keys = STEREO[name]
    render = {"size": [WIDTH, HEIGHT], "refine": REFINE, "cameras": {"left": CAMERAS[name], "right": right_keys}}
    output = ["stereo", *(["disparity"] if "baseline" in right_keys else [])]
    pair = Scene.model_validate({**scene(CAMERAS[name]).model_dump(exclude={"render"}), "render": render})
    with Simulation(pair.model_copy(update={"output": output}), threads=threads) as simulation:
        for frame in FRAMES:
            observation = simulation.observe(None, "left", files.positions[frame], float(files.time[frame]))
            labels, pair_labels = observation.labels, observation.stereo
            assert labels is not None
            assert pair_labels is not None
            stereo, occlusion = pair_labels.stereo, pair_labels.stereo_occlusion
            assert stereo is not None
            assert occlusion is not None
            left, depth = files.camera(frame), labels.depth.astype(float)
            right = read_camera(right_camera(files.written, right_keys), frame)
            sheet, tool = np.isfinite(labels.coordinates[..., 0]), labels.instrument > 0
            visible = interpolate(files.vertices[frame], labels.coordinates[sheet].astype(float))
            metal, outside = on_rod(left, centres()[tool], depth[tool], files.tip_centres[frame])
            for part, points, tested in ((sheet, visible, visible), (tool, metal, outside)):
                known = stereo[part][:, 0] < 1e9  # within the limit of the lens
                yield "stereo", distance(centres()[part][known] + stereo[part][known], right.pixels(points[known]))
                hidden = ~known
                hidden[known] = files.hidden(tested[known], frame, right)
                assert hidden.any() or "baseline" in right_keys
                yield "stereo occlusion", float(np.mean((occlusion[part] == 255) != hidden))
            assert (stereo[~sheet & ~tool] == 1e10).all()
            assert not occlusion[~sheet & ~tool].any()
            if pair_labels.disparity is not None:
                disparity = pair_labels.disparity[depth > 0]
                yield "disparity", distance(stereo[depth > 0], np.stack([-disparity, 0 * disparity], axis=1))


def on_rod(camera: Camera, pixels: Array, depth: Array, tip_centre: Array) -> tuple[Array, Array]:
    """Points of the rod at pixels, from depths in f32 by Newton's method, and points slightly outside the rod."""
    axis = SHAFT / np.linalg.norm(SHAFT)
    eye, beyond = (camera.points(pixels, np.full(len(depth), at)) for at in (0.0, 1.0))
    for _ in range(4):
        offset = eye + depth[:, None] * (beyond - eye) - tip_centre
        foot = np.clip(offset @ axis, 0, LENGTH)[:, None] * axis
        radius = np.linalg.norm(offset - foot, axis=1)
        depth = depth - (radius - RADIUS) * radius / ((offset - foot) * (beyond - eye)).sum(axis=1)
    return tip_centre + offset, tip_centre + foot + (offset - foot) * (1 + 1e-7)


def right_camera(left: dict[str, Any], right: dict[str, Any]) -> dict[str, Any]:
    """Expected camera.json of the right camera: X_right = R X_left + T."""
    if "baseline" in right:
        rotation, translation, lens = np.eye(3), np.array([-right["baseline"], 0, 0]), {}
    else:
        rotation, translation = np.array(right["rotation"]), np.array(right["translation"])
        fx, fy, cx, cy = right["intrinsics"].values()
        distortion = [right["distortion"].get(key, 0.0) for key in ("k1", "k2", "p1", "p2")]
        lens = {"calibration": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "model": "pinhole", "distortion": distortion}
    pose = rotation @ np.array(left["pose"])
    pose[:, 3] += translation
    return {**left, **lens, "pose": pose.tolist()}


def largest_deviations(folder: Path, name: str, threads: int) -> dict[str, float]:
    """Largest deviations in the results of a run with a camera of CAMERAS, by the keys of AGREEMENTS."""
    files = Files(folder)
    worst: dict[str, float] = {}
    parts = [of_pixels(files), of_normals(files), of_tracks(files)]
    for part in [*parts, *([of_stereo(files, name, threads)] if name in STEREO else [])]:
        for key, deviation in part:
            # `np.maximum` keeps NaN.
            worst[key] = float(np.maximum(deviation, worst.get(key, 0.0)))
    return worst


# tests/render compares the other cameras with the NumPy reference.
@pytest.mark.default_cases("rational", "moving")
@pytest.mark.parametrize("camera", CAMERAS)
def test_labels_agree(camera: str, tmp_path: Path, device: Device) -> None:
    run(scene(CAMERAS[camera]), tmp_path, threads=device.threads, estimate_error=False)
    worst = largest_deviations(tmp_path, camera, device.threads)
    assert len(worst) == 8 + (camera in STEREO) * (3 if camera == "intrinsics" else 2)
    # `not <=` includes NaN.
    assert not {key: deviation for key, deviation in worst.items() if not deviation <= AGREEMENTS[key].bound}
