"""The scene's camera -> one matrix from the sheet to the picture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Problem, SceneError
from taichi_msm.faults import SMALLEST
from taichi_msm.scene import MAX_SUPERSAMPLE, Camera, Scene

Array = NDArray[np.float64]

# The oblique preset looks from the near side, 50 degrees above the sheet, through a moderate lens.
OBLIQUE_DIRECTION = np.array([0.0, -0.64, 0.77])
OBLIQUE_FOV = 32.0
OBLIQUE_MARGIN = 1.04

# The near plane: only what is farther from the eye than this fraction of the sheet's diagonal is drawn.
NEAR = 1e-6

# The largest number of a camera's matrix that kernels can hold, in f32 and multiplied by the samples along a pixel.
LARGEST_NUMBER = float(np.finfo(np.float32).max) / MAX_SUPERSAMPLE


class View(NamedTuple):
    """A camera that was set up: the map from points to pixels.

    A point's place in the camera's frame is (right, up, -depth) [m] from the eye. It is seen at

        x = centre_x + right / w scale,    y = centre_y - up / w scale    [px]

    from the top-left corner, with w = depth for a pinhole camera, and w = 1 for the orthographic one, whose eye may be
    anywhere on its plane.
    """

    matrix: Array  # maps (x, y, z, 1) [m] to (X, Y, w, depth) with x = X / w, y = Y / w, shape (4, 4)
    near: float  # only what has a larger w than this is drawn [m]
    axes: Array  # unit vectors right, up and toward the camera and its headlight, as rows, shape (3, 3)
    eye: Array  # origin of depth and of the camera's frame [m], shape (3,)
    scale: float  # pixels per metre at w = 1
    centre: Array  # the middle of the picture [px], shape (2,)
    distance: float  # from the eye to the point that it looks at [m]
    pinhole: bool

    def project(self, points: Array) -> Array:
        """Map points [m], shape (..., 3), to (X, Y, w, depth), shape (..., 4)."""
        return points @ self.matrix[:, :3].T + self.matrix[:, 3]

    def sight(self, pixel: tuple[float, float]) -> View:
        """Give a view in which what is seen at the centre of a pixel, right and down from (0, 0), has X = Y = 0."""
        matrix = self.matrix.copy()
        for row in (0, 1):
            matrix[row] -= (pixel[row] + 0.5) * matrix[2]
        return self._replace(matrix=matrix)


def calibration(camera: View) -> dict[str, list[list[float]]]:
    """Describe a camera by the matrices that other programs use.

    Returns:
        projection: 3 x 4, with pixel = (P [x y z 1])_12 / (P [x y z 1])_3 from the picture's upper left corner. For a
        pinhole also, in OpenCV's convention (x right, y down, z forward): intrinsics, 3 x 3; pose, 3 x 4, from the
        world to the camera.
    """
    matrices = {"projection": camera.matrix[:3].tolist()}
    if camera.pinhole:
        turn = camera.axes * np.array([[1.0], [-1.0], [-1.0]])
        x, y = camera.centre.tolist()
        matrices["intrinsics"] = [[camera.scale, 0.0, x], [0.0, camera.scale, y], [0.0, 0.0, 1.0]]
        matrices["pose"] = np.concatenate([turn, -turn @ camera.eye[:, None]], axis=1).tolist()
    return matrices


def view(scene: Scene) -> View:
    """Set up the scene's camera; raises a SceneError when it sees nothing."""
    if blind := [str(problem) for problem in camera_problems(scene)]:
        raise SceneError(blind)
    camera = scene.render.camera
    if camera == "top":
        return _top(scene)
    if isinstance(camera, Camera):
        return _pinhole(camera, scene)
    return _pinhole(_oblique(scene), scene)


def camera_problems(scene: Scene) -> Iterator[Problem]:
    """Say why a pinhole camera sees nothing, or cannot be computed, if so."""
    camera = scene.render.camera
    if not isinstance(camera, Camera):
        return
    sight, up = _unit(np.subtract(camera.eye, camera.target)), _unit(np.array(camera.up))
    if math.dist(camera.eye, camera.target) < SMALLEST:
        yield Problem(("render", "camera", "eye"), f"{list(camera.eye)} is also the target; move one of them")
    elif not np.linalg.norm(np.cross(sight, up)) > 1e-9:
        yield Problem(
            ("render", "camera", "up"),
            f"{list(camera.up)} is zero or along the line of sight; take a direction across it",
        )
    elif np.abs(_pinhole(camera, scene).matrix).max() > LARGEST_NUMBER:
        yield Problem(
            ("render", "camera", "eye"),
            f"{list(camera.eye)} is too far away for {camera.fov:g} degrees; move it nearer or widen fov",
        )


def pinhole(scene: Scene) -> Camera:
    """Give the scene's camera as a pinhole camera; the orthographic one becomes one above the sheet, at equal scale."""
    camera = scene.render.camera
    if isinstance(camera, Camera):
        return camera
    if camera == "oblique":
        return _oblique(scene)
    half_height = scene.render.size[1] / 2 / _top_scale(scene)
    return Camera(eye=(0.0, 0.0, half_height / math.tan(math.radians(OBLIQUE_FOV) / 2)), fov=OBLIQUE_FOV)


def turned(camera: Camera, right: float, up: float) -> Camera:
    """Orbit a camera around its target: right about the sheet's normal, up about its own horizontal axis [rad]."""
    across, _, toward = _axes(camera)
    turn = _rotation(np.array([0.0, 0.0, 1.0]), right) @ _rotation(across, -up)
    eye = np.array(camera.target) + turn @ np.subtract(camera.eye, camera.target)
    above = turn @ np.cross(toward, across)
    return camera.model_copy(update={"eye": tuple(eye.tolist()), "up": tuple(above.tolist())})


def _rotation(axis: Array, angle: float) -> Array:
    """Rotate about a unit vector: Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _top_scale(scene: Scene) -> float:
    """Give the pixels per metre at which the rest rectangle fits into the picture."""
    (height, width), (columns, lines) = scene.sheet.size, scene.render.size
    return min(columns / width, lines / height)


def _top(scene: Scene) -> View:
    """Look straight down; the rest rectangle is centred in the picture and fits it, at one scale for both axes.

    The eye, where depth is 0, is as far above the sheet as the sheet's larger side is long.
    """
    (columns, lines), scale, distance = scene.render.size, _top_scale(scene), max(scene.sheet.size)
    rows = [[scale, 0, 0, columns / 2], [0, -scale, 0, lines / 2], [0, 0, 0, 1], [0, 0, -1, distance]]
    centre, eye = np.array([columns / 2, lines / 2]), np.array([0.0, 0.0, distance])
    return View(np.array(rows, dtype=float), 0.0, np.eye(3), eye, scale, centre, distance, pinhole=False)


def _axes(camera: Camera) -> Array:
    """Give the camera's unit vectors right, up and toward the eye, as rows, shape (3, 3)."""
    toward = _unit(np.subtract(camera.eye, camera.target))
    right = _unit(np.cross(_scaled(np.array(camera.up)), toward))
    return np.stack([right, np.cross(toward, right), toward])


def _unit(vector: Array) -> Array:
    """Give a vector the length 1; a vector of zeros stays."""
    scaled = _scaled(vector)
    return scaled / (float(np.linalg.norm(scaled)) or 1.0)


def _scaled(vector: Array) -> Array:
    """Multiply a vector by a power of 2, which is exact, so that squares of it neither overflow nor vanish."""
    return np.ldexp(vector, -math.frexp(float(np.abs(vector).max()))[1])


def _pinhole(camera: Camera, scene: Scene) -> View:
    """Look from the eye to the target; fov is the angle from the picture's bottom to its top."""
    columns, lines = scene.render.size
    axes = _axes(camera)
    right, up, depth = axes * np.array([[1.0], [1.0], [-1.0]])
    eye = np.array(camera.eye)
    focal = lines / 2 / np.tan(np.radians(camera.fov) / 2)
    rows = [focal * right + columns / 2 * depth, -focal * up + lines / 2 * depth, depth, depth]
    matrix = np.array([[*row, -row @ eye] for row in rows])
    near, distance = NEAR * math.hypot(*scene.sheet.size), math.dist(camera.eye, camera.target)
    return View(matrix, near, axes, eye, focal, np.array([columns / 2, lines / 2]), distance, pinhole=True)


def _oblique(scene: Scene) -> Camera:
    """Tilt the camera and move it as near as the whole rest rectangle allows."""
    (height, width), (columns, lines) = scene.sheet.size, scene.render.size
    toward = OBLIQUE_DIRECTION / np.linalg.norm(OBLIQUE_DIRECTION)
    axes = _axes(Camera(eye=tuple(toward), fov=OBLIQUE_FOV))
    corners = np.array([[x, y, 0.0] for x in (-width / 2, width / 2) for y in (-height / 2, height / 2)]) @ axes.T
    half_height = np.tan(np.radians(OBLIQUE_FOV) / 2)
    half = np.array([half_height * columns / lines, half_height])
    distance = float((corners[:, 2:] + np.abs(corners[:, :2]) / half).max()) * OBLIQUE_MARGIN
    return Camera(eye=tuple(distance * toward), fov=OBLIQUE_FOV)
