"""Views: the map of a camera from the world to pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.camera_files.calibration import Calibration
from taichi_msm.cameras.extrinsics import OPENCV_SIGNS, Extrinsics, extrinsics, nearest_rotation
from taichi_msm.cameras.lens import IDENTITY_LENS, Lens
from taichi_msm.lenses import MODELS
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import AnyCamera


class View(NamedTuple):
    """Resolved camera: the map from the world to pixels.

    A point in the camera's frame is (right, up, -depth) [m] from the eye. Without lens distortion its pixel is

        x = centre_x + right / w scale_x,    y = centre_y - up / w scale_y    [px]

    from the upper left corner, where w is the depth for a pinhole camera, and 1 for the orthographic one. Lens
    distortion maps these pixels to those of the picture.
    """

    matrix: Array  # maps (x, y, z, 1) [m] to (X, Y, w, depth) with x = X / w, y = Y / w, shape (4, 4)
    near: float  # near plane [m]; only surfaces with a larger w are drawn
    axes: Array  # unit vectors right, up and toward the camera, as rows, shape (3, 3)
    eye: Array  # origin of the camera's frame and of depth [m], shape (3,)
    scale: Array  # pixels per metre at w = 1, horizontal and vertical, shape (2,)
    centre: Array  # principal point [px], shape (2,)
    size: Array  # width and height of the picture [px], shape (2,)
    distance: float  # from the eye to the target, at the start [m]
    pinhole: bool  # whether the projection is perspective
    lens: Lens | None = None
    baseline: float = 0.0  # distance to the companion along the x axis [m]; 0 unless the cameras are parallel
    companion: View | None = None  # right camera of a stereo pair, of which this is the left one
    light_view: View | None = None  # camera that carries the light; None if it is this camera

    @property
    def lens_model(self) -> str:
        """Name of the lens model; empty without lens distortion."""
        return "" if self.lens is None else self.lens.model

    @property
    def optics(self) -> tuple[object, ...]:
        """Parameters that determine the undistortion map, as a cache key; empty without lens distortion."""
        return () if self.lens is None else (self.lens, *self.scale, *self.centre)

    def project(self, points: Array) -> Array:
        """Map points [m], shape (..., 3), to (X, Y, w, depth) without lens distortion, shape (..., 4)."""
        return points @ self.matrix[:, :3].T + self.matrix[:, 3]

    def pixels(self, points: Array) -> Array:
        """Project points [m], shape (..., 3), to distorted pixels [px], shape (..., 2).

        The pixels are NaN behind the near plane and beyond the limit of the lens.
        """
        x, y, w, _ = np.moveaxis(self.project(points), -1, 0)
        w = np.where(w > self.near, w, np.nan)
        return self.distort(np.stack([x / w, y / w], axis=-1))

    def points(self, pixels: Array, depth: Array) -> Array:
        """Return the points [m], shape (n, 3), at undistorted pixels [px], shape (n, 2), and depths [m], shape (n,)."""
        right, down = ((pixels - self.centre) / self.scale * (depth[:, None] if self.pinhole else 1.0)).T
        return self.eye + np.stack([right, -down, -depth], axis=-1) @ self.axes

    def distort(self, pixels: Array) -> Array:
        """Return distorted pixels [px], shape (..., 2); NaN beyond the limit of the lens."""
        if self.lens is None:
            return pixels
        points = (pixels - self.centre) / self.scale
        # This comparison also excludes NaN.
        within = np.linalg.norm(points, axis=-1, keepdims=True) < self.lens.limit
        return self.centre + self.scale * self.lens.distort(np.where(within, points, np.nan))

    def undistort(self, pixels: Array) -> Array:
        """Invert `distort`, accurate to 1e-6 px; NaN where the lens has no line of sight."""
        if self.lens is None:
            return pixels
        return self.centre + self.scale * self.lens.undistort((pixels - self.centre) / self.scale)

    def disparity(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the disparity to the companion camera [px], 0 at depth 0; for cameras without lens distortion."""
        w = np.where(depth == 0, np.inf, depth if self.pinhole else 1.0)
        return (self.scale[0] * self.baseline / w).astype(np.float32)

    def normalise(self, points: Array) -> NDArray[np.float32]:
        """Map points [m], shape (..., 3), to (a w, b w, w): a, b to the right and down at w = 1, w the depth [m]."""
        x, y, w, _ = np.moveaxis(self.project(points), -1, 0)
        a, b = (x - self.centre[0] * w) / self.scale[0], (y - self.centre[1] * w) / self.scale[1]
        return np.stack([a, b, w], axis=-1).astype(np.float32)

    def cropped(self, region: tuple[int, int, int, int], size: tuple[int, int]) -> View:
        """Return the view of a part of the picture, (x, y, width, height) [px], resized to a width and height [px]."""
        corner, factor = np.array(region[:2]), np.array(size) / region[2:]
        matrix = self.matrix.copy()
        matrix[:2] = (matrix[:2] - corner[:, None] * matrix[2]) * factor[:, None]
        scale, centre = self.scale * factor, (self.centre - corner) * factor
        return self._replace(matrix=matrix, scale=scale, centre=centre, size=np.array(size, float))

    def centred_at(self, pixel: tuple[float, float]) -> View:
        """Return a copy with X = Y = 0 along the line of sight of the centre of a pixel, (column, row) from (0, 0)."""
        matrix, centre = self.matrix.copy(), self.undistort(np.array(pixel) + 0.5)
        for row in (0, 1):
            matrix[row] -= centre[row] * matrix[2]
        return self._replace(matrix=matrix)


def pinhole_view(
    camera: Camera,
    size: Sequence[float] | Array,
    placement: Extrinsics,
    near: float,
    calibrated: Sequence[float] | None = None,
) -> View:
    """Return the view of a pinhole camera, for width and height of the picture [px] and the near plane [m].

    Intrinsics and lens are those of a picture of the size `calibrated` [px], by default that of the picture.
    """
    if calibrated is not None and tuple(calibrated) != tuple(size):
        camera = _resized(camera, size[0] / calibrated[0], size[1] / calibrated[1])
    (width_px, height_px), (eye, axes, distance) = size, placement
    right, up, toward = axes
    depth = -toward
    if (intrinsics := camera.intrinsics) is not None:
        # The centre of the first pixel is (0, 0) in OpenCV, and (0.5, 0.5) in this package.
        focal_x, focal_y = camera.focal_lengths
        x, y = intrinsics.cx + 0.5, intrinsics.cy + 0.5
    else:
        focal_x = focal_y = height_px / 2 / np.tan(np.radians(camera.fov) / 2)
        x, y = width_px / 2, height_px / 2
    rows = [focal_x * right + x * depth, -focal_y * up + y * depth, depth, depth]
    matrix = np.array([[*row, -row @ eye] for row in rows])
    scale, centre = np.array([focal_x, focal_y]), np.array([x, y])
    lens = Lens(camera.distortion.model, camera.distortion.coefficients) if camera.distortion else None
    lens = None if lens == IDENTITY_LENS else lens
    return View(matrix, near, axes, eye, scale, centre, np.array(size, float), distance, pinhole=True, lens=lens)


def _resized(camera: Camera, scale_x: float, scale_y: float) -> Camera:
    """Return the camera for pictures resized edge to edge, by factors of their width and height."""
    if camera.intrinsics is None:
        return camera
    lens = camera.distortion
    model, names = (lens.model, MODELS[lens.model].coefficients) if lens else ("pinhole", ())
    given = {name: getattr(lens, name) for name in names}
    centre = (camera.intrinsics.cx, camera.intrinsics.cy)
    scaled = Calibration(camera.focal_lengths, centre, None, model, given).scaled(scale_x, scale_y)
    (fx, fy), (cx, cy) = scaled.focal or (0.0, 0.0), scaled.centre
    update: dict[str, Any] = {"intrinsics": {"fx": fx, "fy": fy, "cx": cx, "cy": cy}}
    if lens and lens.focal_length:
        update["intrinsics"] = {"cx": cx, "cy": cy}
    if lens:
        update["distortion"] = {"model": model, **scaled.coefficients}
    return camera.model_copy(update=update)


def companion_view(camera: Camera, reference: View, near: float, calibrated: Sequence[float] | None = None) -> View:
    """Return the view of a camera posed relative to a reference camera: X_this = R X_reference + T."""
    rotation, translation = (np.array(pair_transform(camera)[key]) for key in ("rotation", "translation"))
    world_to_reference = reference.axes * OPENCV_SIGNS
    axes = rotation @ world_to_reference * OPENCV_SIGNS
    eye = reference.eye - world_to_reference.T @ rotation.T @ translation
    if camera.has_own_lens:
        return pinhole_view(camera, reference.size, Extrinsics(eye, axes, reference.distance), near, calibrated)
    # Keep the optics of the reference camera: move the world instead of the camera.
    world_rotation, world_motion = reference.axes.T @ axes, np.eye(4)
    world_motion[:3, :3], world_motion[:3, 3] = world_rotation, reference.eye - world_rotation @ eye
    return reference._replace(matrix=reference.matrix @ world_motion, axes=axes, eye=eye)


def pair_transform(camera: AnyCamera) -> dict[str, Any]:
    """Return the transform from a camera's reference camera to the camera, in the convention of stereoCalibrate.

    "beside": name of the reference camera; "rotation", 3 x 3, and "translation" [m] with X_this = R X_reference + T, in
    OpenCV's axes. Empty without a reference camera.
    """
    if not isinstance(camera, Camera) or camera.beside is None:
        return {}
    rotation, translation = np.eye(3), [-(camera.baseline or 0.0), 0.0, 0.0]
    if camera.rotation is not None and camera.translation is not None:
        rotation, translation = nearest_rotation(np.array(camera.rotation)), list(camera.translation)
    return {"beside": camera.beside, "rotation": rotation.tolist(), "translation": translation}


def first_view(cameras: Sequence[Camera], size: Sequence[float]) -> View:
    """Return the view at the start of the first of some cameras, each of which is `beside` the next."""
    *beside, origin = cameras
    view = pinhole_view(origin, size, extrinsics(origin, 0.0), 0.0)
    for camera in reversed(beside):
        view = companion_view(camera, view, 0.0)
    return view
