"""How far the files of a run contradict each other: found from them alone, in float64, with OpenCV's cameras.

Nothing of the program is used but `run` and, for a second camera, `Simulation`. Pixels are OpenCV's: the centre of the
first one is at (0, 0). What hides a point is found by trying all triangles on its line of sight.
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

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Found = Iterator[tuple[str, float]]


class Agreement(NamedTuple):
    """Two things that must agree."""

    said: str
    unit: str
    bound: float  # how far they may be apart


# Single precision leaves 2^-24 of a number: 4e-6 px in 64 to 128 px, 9e-9 m in 0.15 m; more where the sheet is seen
# nearly edge-on.
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

PLACE = {"eye": [0.03, -0.06, 0.1], "target": [0, 0, 0.01]}
INTRINSICS = {"fx": 97.0, "fy": 96.0, "cx": 58.2, "cy": 45.6}
RATIONAL = {"k1": -0.34, "k2": 0.12, "p1": 0.001, "p2": -0.002, "k3": -0.01, "k4": 0.02}
SWAY = [[0, 0.03, -0.06, 0.1], [0.25, 0.0, -0.07, 0.11], [0.5, 0.02, -0.05, 0.1]]
CAMERAS: dict[str, Any] = {
    "top": "top",
    "pinhole": {**PLACE, "fov": 50},
    "intrinsics": {**PLACE, "intrinsics": INTRINSICS},
    "rational": {**PLACE, "intrinsics": INTRINSICS, "distortion": RATIONAL},
    "fisheye": {**PLACE, "intrinsics": INTRINSICS, "distortion": {"model": "fisheye", "k1": -0.05, "k2": 0.01}},
    "moving": {**PLACE, "eye": SWAY, "intrinsics": INTRINSICS, "distortion": RATIONAL},
}

# The cameras that are beside some of them, as OpenCV's stereoCalibrate finds them or parallel.
STEREO: dict[str, dict[str, Any]] = {
    "intrinsics": {"beside": "left", "baseline": 0.005},
    "rational": {
        "beside": "left",
        # From the other side, where the tool hides itself and the fold hides its tip.
        "rotation": cv2.Rodrigues(np.array([-0.24, 1.26, 1.24]))[0].tolist(),
        "translation": [-0.065, -0.081, 0.064],
        "intrinsics": {"fx": 101.0, "fy": 102.0, "cx": 57.0, "cy": 43.0},
        "distortion": {"k1": -0.3, "k2": 0.09, "p1": -0.001},
    },
}

# The frames that are compared, while the sheet is pulled over itself; there is one after each.
FRAMES = (5, 9)

# What is in front of a point by less than this counts as the point's own place [m].
TOUCHING = 1e-9 * SIDE


def scene(camera: Any) -> Scene:
    """A sheet that is held on the left; a tool grips its right, lifts it and pulls it over to the left."""
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
            "output": [
                *("trajectory", "forces", "coordinates", "depth", "normals", "flow", "occlusion", "instrument"),
                "tracks",
            ],
        }
    )


class Camera(NamedTuple):
    """A camera of camera.json in one frame; of the orthographic one the eye is as documented, above the sheet."""

    turn: Array  # right, down and forward, as rows
    shift: Array  # the world's origin [m]
    project: Callable[[Array], Array]  # places, shape (n, 2), to pixels
    unproject: Callable[[Array], Array]  # and back
    pinhole: bool

    def within(self, points: Array) -> Array:
        """Points of the world in its axes [m], shape (n, 3)."""
        return points @ self.turn.T + self.shift

    def places(self, points: Array) -> Array:
        """Points in its axes, at depth 1 if it is a pinhole, shape (n, 2)."""
        return points[:, :2] / points[:, 2:] if self.pinhole else points[:, :2]

    def pixels(self, points: Array) -> Array:
        """Where points of the world are seen [px], shape (n, 2)."""
        return np.asarray(self.project(self.places(self.within(points))))

    def points(self, pixels: Array, depth: Array) -> Array:
        """The points of the world at a depth [m] that pixels show [m], shape (n, 3)."""
        place = self.unproject(pixels)
        there = np.concatenate([place * depth[:, None] if self.pinhole else place, depth[:, None]], axis=1)
        return np.asarray((there - self.shift) @ self.turn)


def read_camera(written: dict[str, Any], frame: int) -> Camera:
    """Read what camera.json says of a frame."""
    if "pose" not in written:
        rows = np.array(written["projection"])
        scale, centre = np.linalg.norm(rows[:2, :3], axis=1), rows[:2, 3] - 0.5
        right, down = rows[:2, :3] / scale[:, None]
        turn, shift = np.array([right, down, np.cross(right, down)]), np.array([0, 0, SIDE])
        return Camera(turn, shift, lambda place: place * scale + centre, lambda at: (at - centre) / scale, False)
    pose = np.array(written["poses"][frame] if "poses" in written else written["pose"])
    matrix, lens, none = np.array(written["calibration"]), np.array(written["distortion"]), np.zeros(3)

    def project(place: Array) -> Array:
        points = np.concatenate([place, np.ones((len(place), 1))], axis=1)[:, None]
        opencv = cv2.fisheye.projectPoints if written["model"] == "fisheye" else cv2.projectPoints
        return np.asarray(opencv(points, none, none, matrix, lens)[0][:, 0])

    def unproject(pixels: Array) -> Array:
        focal, place = matrix.diagonal()[:2], np.zeros_like(pixels)
        for _ in range(60):  # A lens bends a place by less than its distance, so that this converges.
            place += (pixels - project(place)) / focal
        assert far(project(place), pixels) < 1e-9
        return place

    return Camera(pose[:, :3], pose[:, 3], project, unproject, True)


def surface(position: Array) -> Array:
    """The vertices between the mass points, shape (n, n, 3)."""
    count = (POINTS - 1) * (REFINE + 1) + 1
    hats = np.maximum(0, 1 - np.abs(np.arange(count)[:, None] / (REFINE + 1) - np.arange(POINTS)))
    return np.asarray(np.einsum("ai,ijk,bj->abk", hats, position, hats))


def triangles(vertices: Array) -> Array:
    """All triangles, shape (n, 3, 3)."""
    a, b, c, d = vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, :-1], vertices[1:, 1:]
    return np.concatenate([np.stack(three, axis=2).reshape(-1, 3, 3) for three in ((a, c, d), (a, d, b))])


def material(vertices: Array, coordinates: Array) -> Array:
    """The points of the surface at coordinates, shape (n, 3)."""
    place = coordinates * (len(vertices) - 1)
    j, i = np.minimum(place.astype(int), len(vertices) - 2).T
    s, t = (place - np.stack([j, i], axis=1)).T[:, :, None]
    a, b, c, d = vertices[i, j], vertices[i, j + 1], vertices[i + 1, j], vertices[i + 1, j + 1]
    return np.where(t > s, a * (1 - t) + c * (t - s) + d * s, a * (1 - s) + b * (s - t) + d * t)


def triangle_of(coordinates: Array) -> Array:
    """A number for the triangle that coordinates are on; NaN for none."""
    place = coordinates * ((POINTS - 1) * (REFINE + 1))
    corner = np.floor(place)
    s, t = np.moveaxis(place - corner, -1, 0)
    return np.asarray(corner @ [2.0, 1000.0] + (t > s))


def behind_sheet(places: Array, depth: Array, camera: Camera, vertices: Array) -> Mask:
    """Tell which points are behind a triangle, given their places and depths, by trying all triangles.

    With corners c_i in the camera's axes, a ray of places p meets the triangle where sum b_i c_i = depth (p, 1), or
    without an eye where sum b_i c_i = (p, depth), with sum b_i = 1.
    """
    found, rays = np.zeros(len(places), bool), np.concatenate([places, np.ones((len(places), 1))], axis=1)
    corners = triangles(vertices)
    seen = camera.within(corners.reshape(-1, 3))
    outlines = camera.places(seen).reshape(-1, 3, 2)
    seen = seen.reshape(corners.shape)
    low, high = outlines.min(axis=1), outlines.max(axis=1)
    columns = np.moveaxis(seen if camera.pinhole else np.insert(outlines, 2, 1, axis=2), 1, 2)
    # One that is seen edge-on hides nothing.
    flat = np.linalg.det(columns) == 0
    inverses = np.linalg.inv(np.where(flat[:, None, None], np.eye(3), columns))
    for triangle in np.flatnonzero(~flat):
        near = np.flatnonzero(((places >= low[triangle]) & (places <= high[triangle])).all(axis=1))
        if len(near):
            shares = inverses[triangle] @ rays[near].T
            with np.errstate(divide="ignore"):
                met = 1 / shares.sum(axis=0) if camera.pinhole else seen[triangle, :, 2] @ shares
            found[near] |= (shares >= 0).all(axis=0) & (met < depth[near] - TOUCHING)
    return found


def behind_rod(points: Array, eye: Array, middle: Array) -> Mask:
    """Tell which lines from points to their eyes come nearer than RADIUS to the rod's middle line."""
    axis = SHAFT / np.linalg.norm(SHAFT)
    low, high = np.zeros(len(points)), np.full(len(points), LENGTH)

    def distance(along: Array) -> Array:
        away = middle + along[:, None] * axis - points
        way = eye - points
        share = np.clip((away * way).sum(axis=1) / (way * way).sum(axis=1), 0, 1)
        return np.asarray(np.linalg.norm(away - share[:, None] * way, axis=1))

    for _ in range(60):  # Between two lines the distance is convex: its least is found by thirds.
        left, right = low + (high - low) / 3, high - (high - low) / 3
        nearer = distance(left) < distance(right)
        low, high = np.where(nearer, low, left), np.where(nearer, right, high)
    return distance(low) < RADIUS


class Files:
    """The results of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written = json.loads((folder / "camera.json").read_text())
        with np.load(folder / "trajectory.npz") as archive:
            self.time, self.positions = archive["time"], archive["position"]
        self.vertices = [surface(position) for position in self.positions]
        with np.load(folder / "tracks.npz") as archive:
            self.tracks = dict(archive)
        with (folder / "forces.csv").open() as file:
            tips = [[float(row[f"tip_{axis}"]) for axis in "xyz"] for row in csv.DictReader(file)]
        # A tip is the lowest point of the round end.
        self.middles = np.add(tips, [0, 0, RADIUS])

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
        """Tell which points of the surface a camera does not see in a frame."""
        pixels, there = camera.pixels(points), camera.within(points)
        outside = ((pixels < -0.5) | (pixels >= [WIDTH - 0.5, HEIGHT - 0.5])).any(axis=1)
        eye = np.broadcast_to(-camera.shift @ camera.turn, points.shape)
        if not camera.pinhole:
            eye = points - (there[:, 2:] + 1) * camera.turn[2]
        behind = behind_sheet(camera.places(there), there[:, 2], camera, self.vertices[frame])
        return np.asarray(outside | behind | behind_rod(points, eye, self.middles[frame]))


def centres() -> Array:
    """The pixels, shape (height, width, 2)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    return np.stack([x, y], axis=-1)


def far(a: Any, b: Any) -> float:
    """The largest distance between points."""
    return float(np.linalg.norm(np.subtract(a, b), axis=-1).max())


def of_pixels(files: Files) -> Found:
    """What pixels show, and how it moves, against the surface under the poses of both frames."""
    for frame in FRAMES:
        now, then = files.camera(frame), files.camera(frame + 1)
        coordinates, flow = files.read("coordinates", frame), files.read("flow", frame)
        sheet = np.isfinite(coordinates[..., 0])
        pixels, coordinates = centres()[sheet], coordinates[sheet]
        shown, moved = (material(files.vertices[n], coordinates) for n in (frame, frame + 1))
        yield "coordinates", far(now.pixels(shown), pixels)
        yield "depth", far(now.points(pixels, files.read("depth", frame)[sheet]), shown)
        yield "flow", far(pixels + flow[sheet], then.pixels(moved))
        hidden = files.hidden(moved, frame + 1, then)
        yield "occlusion", float(np.mean((files.read("occlusion", frame)[sheet] == 255) != hidden))
        assert 0.01 < hidden.mean() < 0.2, "the sheet folds"
        assert np.linalg.norm(flow[sheet], axis=1).max() > 5, "it moves"
        assert (files.read("instrument", frame) == 255).mean() > 0.01


def of_normals(files: Files) -> Found:
    """Normals against the gradient of depth, where a pixel and the next ones are on one triangle."""
    for frame in FRAMES:
        triangle = triangle_of(files.read("coordinates", frame))
        middle, right, below = np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1]
        one = (triangle[middle] == triangle[right]) & (triangle[middle] == triangle[below])
        assert one.sum() > 300
        depth, camera = files.read("depth", frame), files.camera(frame)
        a, b, c = (camera.points(centres()[part][one], depth[part][one]) for part in (middle, right, below))
        across = np.cross(c - a, b - a) @ camera.turn.T
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        yield "normals", float(np.degrees(far(across, files.read("normals", frame)[middle][one])))


def of_tracks(files: Files) -> Found:
    """Tracks against the projection, the line of sight, and depth and normal of the pixel around them."""
    coordinates = files.tracks["coordinates"].astype(float)
    for frame in FRAMES:
        camera = files.camera(frame)
        points, position = (files.tracks[name][:, frame].astype(float) for name in ("points", "position"))
        occluded = files.tracks["occluded"][:, frame]
        pixels = points - 0.5
        yield "tracks", far(pixels, camera.pixels(position))
        hidden = files.hidden(material(files.vertices[frame], coordinates), frame, camera)
        yield "occluded", float(np.mean(occluded != hidden))
        # The line of sight meets the plane of the triangle, of which depth and normal of the pixel tell.
        x, y = np.round(pixels).astype(int).clip(0, [WIDTH - 1, HEIGHT - 1]).T
        same = ~occluded & (triangle_of(files.read("coordinates", frame))[y, x] == triangle_of(coordinates))
        assert same.sum() > 50
        x, y = x[same], y[same]
        shown = camera.points(np.stack([x, y], axis=1).astype(float), files.read("depth", frame)[y, x])
        normal = files.read("normals", frame)[y, x] @ camera.turn
        near, beyond = (camera.points(pixels[same], np.full(len(x), depth)) for depth in (0.0, 1.0))
        share = ((shown - near) * normal).sum(axis=1) / ((beyond - near) * normal).sum(axis=1)
        yield "position", far(near + share[:, None] * (beyond - near), position[same])


def of_stereo(files: Files, name: str, threads: int) -> Found:
    """The labels of a pair: one of CAMERAS, and the one of STEREO that is beside it."""
    beside = STEREO[name]
    render = {"size": [WIDTH, HEIGHT], "refine": REFINE, "cameras": {"left": CAMERAS[name], "right": beside}}
    output = ["stereo", *(["disparity"] if "baseline" in beside else [])]
    pair = Scene.model_validate({**scene(CAMERAS[name]).model_dump(exclude={"render"}), "render": render})
    with Simulation(pair.model_copy(update={"output": output}), threads=threads) as simulation:
        for frame in FRAMES:
            seen = simulation.observe(None, "left", files.positions[frame], float(files.time[frame]))
            assert seen.labels is not None
            assert seen.stereo is not None
            stereo, covered = seen.stereo.stereo, seen.stereo.stereo_occlusion
            assert stereo is not None
            assert covered is not None
            left, depth = files.camera(frame), seen.labels.depth.astype(float)
            right = read_camera(right_of(files.written, beside), frame)
            sheet, tool = np.isfinite(seen.labels.coordinates[..., 0]), seen.labels.instrument > 0
            shown = material(files.vertices[frame], seen.labels.coordinates[sheet].astype(float))
            metal, outside = on_rod(left, centres()[tool], depth[tool], files.middles[frame])
            for part, points, bare in ((sheet, shown, shown), (tool, metal, outside)):
                known = stereo[part][:, 0] < 1e9  # within the limit of the lens
                yield "stereo", far(centres()[part][known] + stereo[part][known], right.pixels(points[known]))
                hidden = ~known
                hidden[known] = files.hidden(bare[known], frame, right)
                assert hidden.any() or "baseline" in beside
                yield "stereo occlusion", float(np.mean((covered[part] == 255) != hidden))
            assert (stereo[~sheet & ~tool] == 1e10).all()
            assert not covered[~sheet & ~tool].any()
            if seen.stereo.disparity is not None:
                across = seen.stereo.disparity[depth > 0]
                yield "disparity", far(stereo[depth > 0], np.stack([-across, 0 * across], axis=1))


def on_rod(camera: Camera, pixels: Array, depth: Array, middle: Array) -> tuple[Array, Array]:
    """The points of the rod at pixels, from their depths in f32 by Newton's method; and points just outside it."""
    axis = SHAFT / np.linalg.norm(SHAFT)
    eye, beyond = (camera.points(pixels, np.full(len(depth), far)) for far in (0.0, 1.0))
    for _ in range(4):
        away = eye + depth[:, None] * (beyond - eye) - middle
        foot = np.clip(away @ axis, 0, LENGTH)[:, None] * axis
        distance = np.linalg.norm(away - foot, axis=1)
        depth = depth - (distance - RADIUS) * distance / ((away - foot) * (beyond - eye)).sum(axis=1)
    return middle + away, middle + foot + (away - foot) * (1 + 1e-7)


def right_of(left: dict[str, Any], beside: dict[str, Any]) -> dict[str, Any]:
    """What camera.json of the camera beside another one must say: X_right = R X_left + T."""
    if "baseline" in beside:
        rotation, translation, lens = np.eye(3), np.array([-beside["baseline"], 0, 0]), {}
    else:
        rotation, translation = np.array(beside["rotation"]), np.array(beside["translation"])
        fx, fy, cx, cy = beside["intrinsics"].values()
        distortion = [beside["distortion"].get(key, 0.0) for key in ("k1", "k2", "p1", "p2")]
        lens = {"calibration": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "model": "pinhole", "distortion": distortion}
    pose = rotation @ np.array(left["pose"])
    pose[:, 3] += translation
    return {**left, **lens, "pose": pose.tolist()}


def measured(folder: Path, name: str, threads: int) -> dict[str, float]:
    """How far things are apart at most in the results of a run with a camera of CAMERAS, by the names of AGREEMENTS."""
    files = Files(folder)
    worst: dict[str, float] = {}
    parts = [of_pixels(files), of_normals(files), of_tracks(files)]
    for part in [*parts, *([of_stereo(files, name, threads)] if name in STEREO else [])]:
        for what, apart in part:
            # Written so that NaN is kept.
            worst[what] = apart if not apart <= worst.get(what, 0.0) else worst.get(what, 0.0)
    return worst


# The other cameras are compared with the twin in tests/render.
@pytest.mark.default_cases("rational", "moving")
@pytest.mark.parametrize("camera", CAMERAS)
def test_labels_agree(camera: str, tmp_path: Path, device: Device) -> None:
    run(scene(CAMERAS[camera]), tmp_path, threads=device.threads, estimate_error=False)
    worst = measured(tmp_path, camera, device.threads)
    assert len(worst) == 8 + (camera in STEREO) * (3 if camera == "intrinsics" else 2)
    # Written so that NaN is found too.
    assert not {what: apart for what, apart in worst.items() if not apart <= AGREEMENTS[what].bound}
