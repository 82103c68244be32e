"""Cameras: extrinsics over time, projection matrices, and lens distortion (lens.py) in pixels."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.extrinsics import (
    OPENCV_SIGNS,
    Extrinsics,
    extrinsics,
    interpolate_keyframes,
    look_at_axes,
    normalised,
)
from taichi_msm.cameras.lens import IDENTITY_LENS
from taichi_msm.cameras.view import View, companion_view, pinhole_view
from taichi_msm.errors import Key, Problem, SceneError
from taichi_msm.lenses.model import MAX_RADIUS
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import Solid
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE, MAX_SUPERSAMPLE, MIN_MAGNITUDE

# Field of view of the presets oblique and fit [degrees].
OBLIQUE_FOV = 32.0

# Maximum baseline of a stereo pair, in units of the sheet's larger side.
MAX_BASELINE_RATIO = 1e6


class Shot(NamedTuple):
    """Sheet, camera and instruments at a time."""

    positions: NDArray[Any]  # of the mass points [m], shape (rows, cols, 3)
    view: View
    instruments: Sequence[Solid] = ()  # bodies of the tools


def calibration(camera: View) -> dict[str, Any]:
    """Return the matrices of a camera in the conventions of other programs.

    "projection", 3 x 4: from the world to pixels without lens distortion, with the upper left corner at (0, 0).

    For a pinhole camera also the following, in OpenCV's axes (x right, y down, z forward). "pose", 3 x 4: from the
    world to the camera. "intrinsics", 3 x 3: from the camera to the same pixels. "calibration", 3 x 3: from the camera
    to OpenCV's pixels, where the centre of the first pixel is (0, 0). "model" and "distortion": lens model and its
    coefficients.
    """
    projection = {"projection": camera.matrix[:3].tolist()}
    if not camera.pinhole:
        return projection
    (focal_x, focal_y), (x, y), lens = camera.scale.tolist(), camera.centre.tolist(), camera.lens or IDENTITY_LENS
    return projection | {
        "intrinsics": [[focal_x, 0.0, x], [0.0, focal_y, y], [0.0, 0.0, 1.0]],
        "pose": pose(camera),
        "calibration": [[focal_x, 0.0, x - 0.5], [0.0, focal_y, y - 0.5], [0.0, 0.0, 1.0]],
        "model": lens.model,
        "distortion": list(lens.coefficients),
    }


def pose(camera: View) -> list[list[float]]:
    """Return rotation and translation from the world to a camera, in OpenCV's axes, shape (3, 4)."""
    rotation = camera.axes * OPENCV_SIGNS
    return np.concatenate([rotation, -rotation @ camera.eye[:, None]], axis=1).tolist()


def view(scene: Scene, time: float = 0.0) -> View:
    """Return the main camera of a scene at a time [s]; raise a SceneError if any camera of the scene is invalid."""
    if problems := [str(problem) for problem in camera_problems(scene)]:
        raise SceneError(problems)
    return view_at(scene, time)


def view_at(scene: Scene, time: float, name: str = "") -> View:
    """Return the view of a valid camera of a scene at a time [s]; by default of the main camera."""
    render = scene.render
    name = name or render.main
    result = _view_of(scene, time, name)
    if companion := render.companion(name):
        baseline = render.all_cameras[companion].baseline or 0.0  # type: ignore[union-attr]
        result = result._replace(companion=_view_of(scene, time, companion), baseline=baseline)
    return result if name == render.main else result._replace(light_view=_view_of(scene, time, render.main))


def _view_of(scene: Scene, time: float, name: str) -> View:
    """Return the view of a camera, without companion and light view."""
    camera, baseline = scene.render.origin(name)
    if camera == "top":
        result = _top(scene)
    elif isinstance(camera, Camera) and camera.beside is not None:
        result = companion_view(camera, _view_of(scene, time, camera.beside), _near(scene), scene.calibrated_size)
    else:
        preset = camera if isinstance(camera, Camera) else PRESET_CAMERAS[camera](scene)
        result = _pinhole(aim_camera(preset, scene), scene, time)
    if baseline:
        shift, matrix = baseline * result.axes[0], result.matrix.copy()
        matrix[:, 3] -= matrix[:, :3] @ shift
        result = result._replace(matrix=matrix, eye=result.eye + shift)
    return result


def picture_view(scene: Scene, texture_size: tuple[int, int]) -> View:
    """Return the view of the camera of a picture on the sheet, for pixels that are texels, lit at the main camera."""
    rest, surface = rest_of(scene.sheet), scene.sheet.surface
    assert isinstance(rest, PicturedRest)
    assert surface is not None
    assert surface.frame is not None
    view, distance = rest.picture.view, _distance(surface.frame.cameras[-1], scene)
    view = view._replace(near=_near(scene), distance=distance, light_view=view_at(scene, 0.0))
    return view.cropped(rest.picture.region, texture_size)


def is_moving(scene: Scene, name: str = "") -> bool:
    """Return whether a camera moves; by default the main camera."""
    camera, _ = scene.render.origin(name or scene.render.main)
    if not isinstance(camera, Camera):
        return False
    return camera.moves if camera.beside is None else is_moving(scene, camera.beside)


def camera_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the problems of the cameras of a scene, and of the labels of stereo pairs that it requests."""
    is_valid = True
    for name, camera in scene.render.all_cameras.items():
        problem = next(_single_camera_problems(camera, scene, name), None) if isinstance(camera, Camera) else None
        if problem is not None:
            key: Key = ("render", "cameras", name) if name else ("render", "camera")
            yield Problem(key + problem.path, problem.message)
            is_valid = False
    if is_valid and scene.asks_for("stereo"):
        yield from _pair_problems(scene)


def _single_camera_problems(camera: Camera, scene: Scene, name: str) -> Iterator[Problem]:
    """Yield the problems of a camera, with keys relative to its section; the first may be the cause of the others."""
    if camera.beside is None:
        yield from _extrinsics_problems(aim_camera(camera, scene), scene)
    else:
        yield from _placement_problems(camera, scene, name)
    if camera.distortion is not None and camera.outside == "refuse":
        yield from _lens_problems(view_at(scene, 0.0, name))


def _placement_problems(camera: Camera, scene: Scene, name: str) -> Iterator[Problem]:
    """Yield the problems of the rotation and translation of a camera with a reference camera."""
    key, distance = "baseline", abs(scene.render.origin(name)[1])
    if camera.rotation is not None and camera.translation is not None:
        if fault := _rotation_fault(np.array(camera.rotation)):
            yield Problem(("rotation",), fault)
        key, distance = "translation", math.hypot(*camera.translation)
    if distance > MAX_BASELINE_RATIO * rest_of(scene.sheet).extent:
        message = f"moves the camera by more than {MAX_BASELINE_RATIO:g} times the size of the sheet"
        yield Problem((key,), f"{message}; take a smaller number, in metres")


def _rotation_fault(rotation: Array) -> str:
    """Return why a matrix is not a rotation; "" for a rotation, with a tolerance of 1e-3."""
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if deviation <= 1e-3 and np.linalg.det(rotation) > 0:
        return ""
    fault = f"not a rotation: scalar products of its rows are off by {deviation:.2g}"
    if np.linalg.det(rotation) < 0:
        fault = "a reflection, not a rotation"
    return f"is {fault}; its rows are the directions to the right, down and forward, orthogonal and of length 1"


def _pair_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the problems of requested labels of stereo pairs."""
    cameras = scene.render.all_cameras
    pairs = {name: companion for name in cameras if (companion := scene.render.companion(name))}
    if not pairs:
        output_name = next(name for name in scene.output if OUTPUTS[name].needs_stereo_pair)
        message = f"{output_name} needs a stereo pair; take render.cameras with {{beside: NAME, baseline: metres}}"
        yield Problem(("output",), f"{message}, or leave it out")
    for name, companion in pairs.items() if "disparity" in scene.output else ():
        if view_at(scene, 0.0, name).lens is not None:
            message = f"disparity requires cameras without distortion, and {name} has one; leave out one of them"
        elif cameras[companion].baseline is None:  # type: ignore[union-attr]
            message = f"disparity requires a baseline, and {companion} has a rotation; take stereo instead"
        else:
            continue
        yield Problem(("output",), message)
        return


def _extrinsics_problems(camera: Camera, scene: Scene) -> Iterator[Problem]:
    """Yield the problems of a camera's extrinsics in all frames."""
    key = next((name,) for name in ("eye", "pose", "poses") if getattr(camera, name) is not None)
    if camera.pose is not None and (fault := _rotation_fault(np.array(camera.pose.rotation))):
        yield Problem(("pose", "rotation"), fault)
    if camera.poses is not None:
        assert not isinstance(camera.poses, str)
        begin, end, duration = camera.poses[0][0], camera.poses[-1][0], scene.time.duration
        tolerance = FRAME_TOLERANCE / scene.time.frames_per_second
        gap = camera.poses[min(1, len(camera.poses) - 1)][0] - max(begin, 0.0)
        # A longer gap indicates that the unit of time is not the second.
        if gap > 1e5 or (len(camera.poses) > 2 and gap > 5 * duration):
            message = f"its first poses are {gap:.6g} s apart, and the scene lasts {duration:g} s"
            yield Problem(key, f"{message}; set poses_time, the unit of its times: ms, us or ns")
        if begin > tolerance or end < duration - tolerance:
            message = f"covers {begin:.12g} s to {end:.12g} s, but the scene goes from 0 s to {duration:g} s"
            remedy = "set poses_start: 0 to begin at the first pose, or another time of the file"
            if begin <= tolerance:
                remedy = "shorten time.duration or add poses up to its end"
            yield Problem(key, f"{message}; {remedy}")
    if camera.eye is None and _distance(camera, scene) < MIN_MAGNITUDE:
        message = "puts the eye at the centre of the sheet, so the light has no distance from it; move the eye away"
        yield Problem(key, message)
    rate = scene.time.frames_per_second
    for time in [frame / rate for frame in range(scene.time.frames + 1)] if camera.moves else [0.0]:
        when = f" at {time:g} s" if camera.moves else ""
        if camera.eye is not None:
            eye, target, up = (
                list(interpolate_keyframes(value, time)) for value in (camera.eye, camera.target, camera.up)
            )
            toward = normalised(np.subtract(eye, target))
            if math.dist(eye, target) < MIN_MAGNITUDE:
                yield Problem(key, f"{eye} is also the target{when}; move one of them")
            if not np.linalg.norm(np.cross(toward, normalised(np.array(up)))) > 1e-9:
                yield Problem(("up",), f"{up} is zero or along the line of sight{when}; take a direction across it")
        # The matrix must be finite in f32, also multiplied by the samples per pixel.
        if np.abs(_pinhole(camera, scene, time).matrix).max() > float(np.finfo(np.float32).max) / MAX_SUPERSAMPLE:
            message = f"is too far away for its focal length{when}; move it nearer"
            if camera.eye is not None and camera.intrinsics is None:
                message = f"{eye} is too far away for {camera.fov:g} degrees{when}; move it nearer or widen fov"
            yield Problem(key, message)


def _lens_problems(camera: View) -> Iterator[Problem]:
    """Yield a problem if the picture extends beyond the limit of the lens."""
    if camera.lens is None or not np.isnan(camera.undistort(border_points(camera.size))).any():
        return
    fault = "folds back" if camera.lens.limit < MAX_RADIUS else "reaches 88 degrees"
    corner_px = math.ceil(float(np.linalg.norm(border_points(camera.size) - camera.centre, axis=-1).max()))
    angle = np.linspace(0, 2 * np.pi, 64)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def is_invalid(radius: int) -> bool:
        return bool(np.isnan(camera.undistort(camera.centre + radius * circle)).any())

    valid_px = max(0, bisect_left(range(corner_px), True, key=is_invalid) - 1)
    message = f"{fault} at {valid_px} px from the principal point, and the picture reaches {corner_px} px"
    remedy = "take coefficients that are valid in the whole picture, or set outside: background"
    yield Problem(("distortion",), f"{message}; {remedy}")


def border_points(size: Array) -> Array:
    """Return one point per pixel along the edges of a picture [px], shape (n, 2); `size` is (width, height)."""
    width, height = (int(side) for side in size)
    x, y = np.arange(width + 1.0), np.arange(height + 1.0)
    sides = [(x, 0 * x), (x, 0 * x + height), (0 * y, y), (0 * y + width, y)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def pinhole(scene: Scene, time: float = 0.0) -> Camera:
    """Return the main camera of a scene at a time [s] as a static pinhole camera.

    An orthographic camera becomes a pinhole camera above the sheet, at the same scale.
    """
    camera = scene.render.main_camera
    if isinstance(camera, Camera):
        return frozen_camera(camera, scene, time)
    if camera != "top":
        return PRESET_CAMERAS[camera](scene)
    distance = scene.render.size[1] / 2 / _top_scale(scene) / math.tan(math.radians(OBLIQUE_FOV) / 2)
    lower, upper = rest_of(scene.sheet).unmasked_box.tolist()
    x, y = ((a + b) / 2 for a, b in zip(lower[:2], upper[:2], strict=True))
    return Camera(eye=(x, y, upper[2] + distance), target=(x, y, float(_middle(scene)[2])), fov=OBLIQUE_FOV)


def frozen_camera(camera: Camera, scene: Scene, time: float) -> Camera:
    """Return a camera at a time [s] as a static camera with eye, target and up."""
    if camera.pose is None and not camera.moves:
        return camera
    eye, axes, distance = _placement(camera, scene, time)
    optical_keys = camera.model_fields_set & {"fov", "intrinsics", "distortion", "outside"}
    optics = {name: getattr(camera, name) for name in optical_keys}
    target = eye - distance * axes[2]
    return Camera(eye=tuple(eye.tolist()), target=tuple(target.tolist()), up=tuple(axes[1].tolist()), **optics)


def aim_camera(camera: Camera, scene: Scene) -> Camera:
    """Return a camera with a target: without one, the point of a curved sheet at rest at the middle of the picture."""
    if scene.sheet.surface is None or camera.eye is None or "target" in camera.model_fields_set:
        return camera
    return camera.model_copy(update={"target": tuple(_middle(scene).tolist())})


def _middle(scene: Scene) -> Array:
    """Return the middle of the sheet at rest [m], shape (3,)."""
    rest = rest_of(scene.sheet)
    return rest.place(rest.coordinates(np.array([[0.5, 0.5]])))[0]


def orbit_camera(camera: Camera, right: float, up: float) -> Camera:
    """Return a static camera turned about its target: `right` about the z axis, `up` about its own x axis [rad]."""
    eye, (across, _, toward), _ = extrinsics(camera, 0.0)
    rotation = _rotation(np.array([0.0, 0.0, 1.0]), right) @ _rotation(across, -up)
    new_eye = np.array(camera.target) + rotation @ np.subtract(eye, camera.target)
    new_up = rotation @ np.cross(toward, across)
    return camera.model_copy(update={"eye": tuple(new_eye.tolist()), "up": tuple(new_up.tolist())})


def _rotation(axis: Array, angle: float) -> Array:
    """Return the rotation about a unit vector by an angle [rad]; Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _top_scale(scene: Scene) -> float:
    """Return the scale at which the sheet at rest fits the picture [px/m]; a mask does not change it."""
    box, (width_px, height_px) = rest_of(scene.sheet).unmasked_box, scene.render.size
    width, height, _ = np.ptp(box, axis=0).tolist()
    return min(width_px / max(width, 1e-300), height_px / max(height, 1e-300))


def _top(scene: Scene) -> View:
    """Return the orthographic view from above, with the sheet at rest centred and as large as the picture allows.

    The height of the eye (depth 0) above the highest point is the larger side of the sheet, along x and y.
    """
    (width_px, height_px), scale, box = scene.render.size, _top_scale(scene), rest_of(scene.sheet).unmasked_box
    (x, y, _), distance = (box[0] + box[1]) / 2, float(np.ptp(box[:, :2], axis=0).max())
    eye = np.array([x, y, box[1, 2] + distance])
    rows = [[scale, 0, 0, width_px / 2 - scale * x], [0, -scale, 0, height_px / 2 + scale * y]]
    rows += [[0, 0, 0, 1], [0, 0, -1, eye[2]]]
    size = np.array([width_px, height_px], float)
    scales = np.array([scale, scale])
    return View(np.array(rows, dtype=float), 0.0, np.eye(3), eye, scales, size / 2, size, distance, pinhole=False)


def _pinhole(camera: Camera, scene: Scene, time: float) -> View:
    placement = extrinsics(camera, time)
    # The distance is that at the start, so the light of a moving camera keeps its intensity.
    placement = placement._replace(distance=_distance(camera, scene))
    return pinhole_view(camera, scene.render.size, placement, _near(scene), scene.calibrated_size)


def _distance(camera: Camera, scene: Scene) -> float:
    """Return the distance at the start from the eye to the target, of a pose to the middle of the sheet [m]."""
    return _placement(camera, scene, 0.0).distance


def _placement(camera: Camera, scene: Scene, time: float) -> Extrinsics:
    """Return the extrinsics; with a picture by a camera, the distance of a pose is that to the middle of the sheet."""
    placement = extrinsics(camera, time)
    if camera.eye is None and scene.calibrated_size:
        return placement._replace(distance=math.dist(placement.eye, _middle(scene)))
    return placement


def _near(scene: Scene) -> float:
    """Return the distance of the near plane [m]."""
    return 1e-6 * rest_of(scene.sheet).diagonal


def _fit(scene: Scene) -> Camera:
    """Return the preset fit: the sheet at rest fills the picture, except for a margin of 2 %.

    On a rectangle, in the camera's axes up and forward, from its centre, the upper edge is at (a, b) and the lower edge
    at (-a, -b). From an eye at (-a b / d, -d) they have the tangents a / d and -a / d, so the sheet is centred. The
    lower edge is the nearer one: half its width has the tangent width / 2 / (d - b).
    """
    if scene.sheet.surface or scene.sheet.mask:
        return _fit_points(scene)
    (height, width), (width_px, height_px), axes = scene.sheet.size, scene.render.size, OBLIQUE_AXES
    a, b = height / 2 * axes[1, 1], -height / 2 * axes[2, 1]
    half_height = (1 - 2 * 0.02) * math.tan(math.radians(OBLIQUE_FOV) / 2)
    distance = max(a / half_height, width / 2 / (half_height * width_px / height_px) + b)
    eye = distance * axes[2] - a * b / distance * axes[1]
    target = eye - eye[2] / axes[2, 2] * axes[2]
    return Camera(eye=tuple(eye.tolist()), target=tuple(target.tolist()), fov=OBLIQUE_FOV)


def _fit_points(scene: Scene) -> Camera:
    """Return the preset fit of a curved or masked sheet.

    An eye at (x, y, z) in the camera's axes sees all points X within the tangents -t to t if |X - x| <= t (z - Z): on
    each side the largest t Z + X bounds t z + x, and likewise the lower bound. The nearest eye meets both bounds of the
    tighter direction, and is centred in the other one.
    """
    rest, (width_px, height_px), axes = rest_of(scene.sheet), scene.render.size, OBLIQUE_AXES
    points = rest.present_positions @ axes.T
    half_height = (1 - 2 * 0.02) * math.tan(math.radians(OBLIQUE_FOV) / 2)
    tangents = half_height * np.array([width_px / height_px, 1.0])
    right, left = (tangents * points[:, 2:] + sign * points[:, :2] for sign in (1, -1))
    most, least = right.max(axis=0), left.max(axis=0)
    depth = float(((most + least) / (2 * tangents)).max())
    eye = np.array([*((most - least) / 2), depth]) @ axes
    target = eye - (eye - _middle(scene)) @ axes[2] * axes[2]
    return Camera(eye=tuple(eye.tolist()), target=tuple(target.tolist()), fov=OBLIQUE_FOV)


def _oblique(scene: Scene) -> Camera:
    """Return the preset oblique: the sheet at rest fits into the picture, with a margin of 4 % in distance."""
    rest, (width_px, height_px) = rest_of(scene.sheet), scene.render.size
    middle = rest.box.mean(axis=0)
    corners = (rest.hull - middle) @ OBLIQUE_AXES.T
    half_height = np.tan(np.radians(OBLIQUE_FOV) / 2)
    half = np.array([half_height * width_px / height_px, half_height])
    distance = float((corners[:, 2:] + np.abs(corners[:, :2]) / half).max()) * 1.04
    return Camera(eye=tuple(middle + distance * OBLIQUE_AXES[2]), target=tuple(middle), fov=OBLIQUE_FOV)


PRESET_CAMERAS = {"oblique": _oblique, "fit": _fit}


# Axes of the presets oblique and fit: over the lower edge of the sheet, and 50 degrees above it.
OBLIQUE_AXES = look_at_axes((0.0, -0.64, 0.77), (0, 0, 0), (0, 1, 0))
