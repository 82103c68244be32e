"""Lenses that bend lines: OpenCV's rational model and its fisheye, forward and back.

A place is where a line of sight meets the plane at depth 1, in OpenCV's axes: x to the right, y down. With r its
distance from the axis of view and q = r^2, the rational model gives

    x' = x R + 2 p1 x y + p2 (q + 2 x^2),    y' = y R + p1 (q + 2 y^2) + 2 p2 x y,
    R = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3),

and the fisheye, with t = atan(r),    (x', y') = (x, y) t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r.

Source: OpenCV's documentation of calib3d, "Detailed Description" and "Fisheye camera model".

The scene's camera -> one matrix from the sheet to the picture.

Where a pinhole camera is over time: its eye and its axes.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from taichi_msm.errors import Key, Problem, SceneError
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import FRAME_TOLERANCE, MAX_SUPERSAMPLE, MIN_MAGNITUDE

Array = NDArray[np.float64]

# No lens shows what is farther than this from its axis.
WIDEST = math.tan(math.radians(88))

# Coefficients up to this change nothing within it, and dividing by them may overflow.
TINY = 1e-100

# The inverse is exact to this, where the focal length is 1: well below 1e-6 px.
EXACT = 1e-11
MOST_ROUNDS = 50

# Radii at which is looked for the first fold that tangential distortion makes.
RADII = 4096

# Below this distance from the axis a fisheye's quotient t / r is 1 to rounding.
CENTRAL = 1e-8


class Lens(NamedTuple):
    """A lens: which model, and its coefficients in OpenCV's order, all of them."""

    fisheye: bool
    coefficients: tuple[float, ...]

    @property
    def limit(self) -> float:
        """The largest r up to which the lens is taken: it folds back there, or is too far from the axis."""
        return _limit(self)

    def distort(self, place: Array) -> Array:
        """Give the distorted places of places, both of shape (..., 2)."""
        return self._bend(place)[0]

    def jacobian(self, place: Array) -> Array:
        """Differentiate distorted places, rows, by places, columns; shape (..., 2, 2)."""
        return self._bend(place)[1]

    def undistort(self, distorted: Array) -> Array:
        """Give the places whose distorted places are these, both of shape (..., 2); NaN for those beyond the limit.

        Newton's method, begun at the solution without tangential distortion.
        """
        limit = self.limit
        # Not up to the limit, which may be a pole.
        near = limit * np.sin(np.linspace(0, np.pi / 2, 4097)[:-1])
        reach = np.linalg.norm(distorted, axis=-1, keepdims=True)
        radius = np.interp(reach, self._radial(near)[0], near)
        with np.errstate(invalid="ignore", divide="ignore"):
            place = np.where(reach > 0, distorted * (radius / reach), 0.0)
        error = np.full(reach.shape[:-1], np.inf)
        for _ in range(MOST_ROUNDS):
            seen, slope = self._bend(place)
            off = distorted - seen
            error = np.abs(off).max(axis=-1)
            if not (error > EXACT).any():
                break
            (a, b), (c, d) = np.moveaxis(slope, (-2, -1), (0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - c * off[..., 0]], axis=-1)
                place = place + step / (a * d - b * c)[..., None]
                # Not beyond the limit, where another solution may be.
                place *= np.minimum(1, limit / np.linalg.norm(place, axis=-1, keepdims=True))
        good = (error <= EXACT) & (np.linalg.norm(place, axis=-1) < limit)
        return np.where(good[..., None], place, np.nan)

    def _radial(self, r: Array) -> tuple[Array, Array]:
        """Give R r, how far from the axis a point is seen without tangential distortion, and its derivative by r."""
        if self.fisheye:
            t = np.arctan(r)
            polynomial = _angular(self)
            return polynomial(t), polynomial.deriv()(t) / (1 + r * r)
        above, below = _rational(self)
        q = r * r
        ratio = above(q) / below(q)
        slope = (above.deriv()(q) - ratio * below.deriv()(q)) / below(q)
        return r * ratio, ratio + 2 * q * slope

    def _bend(self, place: Array) -> tuple[Array, Array]:
        """Give distorted places and their derivatives."""
        x, y = place[..., 0], place[..., 1]
        q = x * x + y * y
        r = np.sqrt(q)
        reach, growth = self._radial(r)
        central = r < CENTRAL
        safe = np.where(central, 1.0, r)
        ratio = np.where(central, 1.0, reach / safe)
        # Derivative of the ratio by r, over r.
        slope = np.where(central, 0.0, (growth - ratio) / (safe * safe))
        p1, p2 = (0.0, 0.0) if self.fisheye else self.coefficients[2:4]
        seen = np.stack(
            [x * ratio + 2 * p1 * x * y + p2 * (q + 2 * x * x), y * ratio + p1 * (q + 2 * y * y) + 2 * p2 * x * y],
            axis=-1,
        )
        mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
        across = ratio + slope * x * x + 2 * p1 * y + 6 * p2 * x
        down = ratio + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return seen, np.stack([np.stack([across, mixed], axis=-1), np.stack([mixed, down], axis=-1)], axis=-2)


def _rational(lens: Lens) -> tuple[Polynomial, Polynomial]:
    """Give numerator and denominator of R as polynomials in q."""
    k1, k2, _, _, k3, k4, k5, k6 = lens.coefficients
    return Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])


def _angular(lens: Lens) -> Polynomial:
    """Give the polynomial in t of a fisheye."""
    k1, k2, k3, k4 = lens.coefficients
    return Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])


@lru_cache(maxsize=16)
def _limit(lens: Lens) -> float:
    """Find the first distance from the axis where distorted places no longer increase, or have a pole."""
    if lens.fisheye:
        folds = _positive(_angular(lens).deriv())
        return min(WIDEST, math.tan(min([*folds, math.radians(88)])))
    above, below = _rational(lens)
    q = Polynomial([0, 1])
    growth = (above + 2 * q * above.deriv()) * below - 2 * q * above * below.deriv()
    radial = float(min([WIDEST, *np.sqrt([*_positive(growth), *_positive(below)])]))
    tangential = math.hypot(*lens.coefficients[2:4])
    if tangential <= TINY:
        return radial
    radii = radial * np.linspace(0, 1, RADII + 1)[:-1]
    folded = np.flatnonzero(_least_determinant(lens, radii, tangential) <= 0)
    if not len(folded):
        return radial
    from scipy.optimize import brentq

    return float(brentq(lambda r: _least_determinant(lens, r, tangential), radii[folded[0] - 1], radii[folded[0]]))


def _least_determinant(lens: Lens, r: Any, tangential: float) -> Any:
    """Give the least determinant of the jacobian among all places at a distance r from the axis.

    With a = `tangential` r, and g the derivative of R r, it is g R - 4 a^2 + 2 a (g + 3 R) c + 16 a^2 c^2, where c is
    the cosine of the angle between the place and (p2, p1). As the jacobian is symmetric, and I on the axis, the lens
    does not fold within a circle where this is above 0.
    """
    r = np.maximum(r, CENTRAL)
    reach, g = lens._radial(r)
    ratio, a = reach / r, tangential * r
    c = np.maximum(-(g + 3 * ratio) / (16 * a), -1)
    return g * ratio - 4 * a * a + 2 * a * (g + 3 * ratio) * c + 16 * a * a * c * c


def _positive(polynomial: Polynomial) -> list[float]:
    """List the positive zeros of a polynomial."""
    # Leading zeros would be zeros at infinity.
    roots = polynomial.trim(TINY).roots()
    return [float(root.real) for root in roots if root.real > 0 and abs(root.imag) <= 1e-9 * abs(root)]


pass  # REMOVED
pass  # REMOVED

# The oblique preset looks from the near side, 50 degrees above the sheet, through a moderate lens.
OBLIQUE_DIRECTION = np.array([0.0, -0.64, 0.77])
OBLIQUE_FOV = 32.0
OBLIQUE_MARGIN = 1.04

# The near plane: only what is farther from the eye than this fraction of the sheet's diagonal is drawn.
NEAR = 1e-6

# The largest number of a camera's matrix that kernels can hold, in f32 and multiplied by the samples along a pixel.
LARGEST_NUMBER = float(np.finfo(np.float32).max) / MAX_SUPERSAMPLE

# A camera may be this many times the sheet's larger side away from the one that it is beside.
FARTHEST = 1e6

# The first two of several poses are at most this many times the scene's duration apart, and of two this long [s].
SPARSEST, LONGEST_GAP = 5, 1e5

# In so many directions it is looked how far a lens is good.
DIRECTIONS = 64

# A matrix that is farther from orthonormal than this is no rotation.
ORTHONORMAL = 1e-3

# The lens that bends no lines.
UNBENT = Lens(fisheye=False, coefficients=(0.0,) * 8)

# The keys of a camera that do not tell where it is.
OPTICS = {"fov", "intrinsics", "distortion", "outside"}


class View(NamedTuple):
    """A camera that was set up: the map from points to pixels.

    A point's place in the camera's frame is (right, up, -depth) [m] from the eye. Without distortion it is seen at

        x = centre_x + right / w scale_x,    y = centre_y - up / w scale_y    [px]

    from the top-left corner, with w = depth for a pinhole camera, and w = 1 for the orthographic one, whose eye may be
    anywhere on its plane. A lens moves it from there.
    """

    matrix: Array  # maps (x, y, z, 1) [m] to (X, Y, w, depth) with x = X / w, y = Y / w, shape (4, 4)
    near: float  # only what has a larger w than this is drawn [m]
    axes: Array  # unit vectors right, up and toward the camera and its headlight, as rows, shape (3, 3)
    eye: Array  # origin of depth and of the camera's frame [m], shape (3,)
    scale: Array  # pixels per metre at w = 1, across and down, shape (2,)
    centre: Array  # where the axis of view is seen [px], shape (2,)
    size: Array  # width and height of the picture [px], shape (2,)
    distance: float  # from the eye to the point that it looks at, of a moving camera when it begins [m]
    pinhole: bool
    lens: Lens | None = None  # None: it bends no lines
    baseline: float = 0.0  # to the first camera beside it, along its x axis [m]; 0: there is none
    lamp: View | None = None  # the camera that has the light; None: itself

    @property
    def model(self) -> str:
        """The model of the lens, pinhole or fisheye; empty if it bends no lines."""
        return "" if self.lens is None else "fisheye" if self.lens.fisheye else "pinhole"

    @property
    def optics(self) -> tuple[object, ...]:
        """The lens, and what the places of samples depend on besides; empty if it bends no lines."""
        return () if self.lens is None else (self.lens, *self.scale, *self.centre)

    def project(self, points: Array) -> Array:
        """Map points [m], shape (..., 3), to (X, Y, w, depth), without distortion, shape (..., 4)."""
        return points @ self.matrix[:, :3].T + self.matrix[:, 3]

    def pixels(self, points: Array) -> Array:
        """Find where points [m], shape (..., 3), are seen [px], shape (..., 2).

        NaN for those behind the eye, or beyond the limit of the lens.
        """
        x, y, w, _ = np.moveaxis(self.project(points), -1, 0)
        w = np.where(w > self.near, w, np.nan)
        return self.distorted(np.stack([x / w, y / w], axis=-1))

    def distorted(self, pixels: Array) -> Array:
        """Give the places of the picture that a camera without its lens has at these; NaN beyond the lens's limit."""
        if self.lens is None:
            return pixels
        place = (pixels - self.centre) / self.scale
        # Written so that NaN is found too.
        within = np.linalg.norm(place, axis=-1, keepdims=True) < self.lens.limit
        return self.centre + self.scale * self.lens.distort(np.where(within, place, np.nan))

    def undistorted(self, pixels: Array) -> Array:
        """Give the inverse of `distorted`, to 1e-6 px; NaN where the lens shows nothing."""
        if self.lens is None:
            return pixels
        return self.centre + self.scale * self.lens.undistort((pixels - self.centre) / self.scale)

    def disparity(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Tell how far to the left what is seen at depths [m] is for the camera beside this one [px]; 0 for depth 0.

        Neither may have a lens that bends lines.
        """
        w = np.where(depth == 0, np.inf, depth if self.pinhole else 1.0)
        return (self.scale[0] * self.baseline / w).astype(np.float32)

    def sight(self, pixel: tuple[float, float]) -> View:
        """Give a view in which what is seen at the centre of a pixel, right and down from (0, 0), has X = Y = 0."""
        matrix, place = self.matrix.copy(), self.undistorted(np.array(pixel) + 0.5)
        for row in (0, 1):
            matrix[row] -= place[row] * matrix[2]
        return self._replace(matrix=matrix)


def calibration(camera: View) -> dict[str, Any]:
    """Describe a camera by the matrices that other programs use.

    Returns:
        projection: 3 x 4, with pixel = (P [x y z 1])_12 / (P [x y z 1])_3 from the picture's upper left corner,
        without distortion. For a pinhole also, in OpenCV's axes (x right, y down, z forward): intrinsics, 3 x 3; pose,
        3 x 4, from the world to the camera; and in OpenCV's pixels, where the centre of the first one is (0, 0):
        calibration, 3 x 3, with model and distortion, the coefficients in OpenCV's order.
    """
    matrices: dict[str, Any] = {"projection": camera.matrix[:3].tolist()}
    if camera.pinhole:
        (across, down), (x, y) = camera.scale.tolist(), camera.centre.tolist()
        matrices["intrinsics"] = [[across, 0.0, x], [0.0, down, y], [0.0, 0.0, 1.0]]
        matrices["pose"] = pose(camera)
        lens = camera.lens or UNBENT
        matrices["calibration"] = [[across, 0.0, x - 0.5], [0.0, down, y - 0.5], [0.0, 0.0, 1.0]]
        matrices["model"] = "fisheye" if lens.fisheye else "pinhole"
        matrices["distortion"] = list(lens.coefficients)
    return matrices


def pose(camera: View) -> list[list[float]]:
    """Give rotation and translation from the world to the camera, in OpenCV's axes, 3 x 4."""
    turn = camera.axes * OPENCV
    return np.concatenate([turn, -turn @ camera.eye[:, None]], axis=1).tolist()


def view(scene: Scene, time: float = 0.0) -> View:
    """Set up the scene's main camera at a time [s]; raises a SceneError when any of its cameras sees nothing."""
    if blind := [str(problem) for problem in camera_problems(scene)]:
        raise SceneError(blind)
    return view_at(scene, time)


def view_at(scene: Scene, time: float, name: str = "") -> View:
    """Set up the camera of a name, which is in order, of a scene at a time [s]; without a name the main one."""
    render = scene.render
    name = name or render.main
    camera, away = render.origin(name)
    if camera == "top":
        seen = _top(scene)
    else:
        seen = _pinhole(camera if isinstance(camera, Camera) else _oblique(scene), scene, time)
    if away:
        shift, matrix = away * seen.axes[0], seen.matrix.copy()
        matrix[:, 3] -= matrix[:, :3] @ shift
        seen = seen._replace(matrix=matrix, eye=seen.eye + shift)
    lamp = None if name == render.main else view_at(scene, time)
    return seen._replace(baseline=render.baseline(name), lamp=lamp)


def moves(scene: Scene, name: str = "") -> bool:
    """Tell whether the camera of a name moves; without a name the main one."""
    camera, _ = scene.render.origin(name or scene.render.main)
    return isinstance(camera, Camera) and camera.moves


def camera_problems(scene: Scene) -> Iterator[Problem]:
    """Say why cameras see nothing, or cannot be computed, if so, and why there is no disparity that is asked for."""
    sound = True
    for name, camera in scene.render.all_cameras.items():
        problem = next(_problems_of(camera, scene, name), None) if isinstance(camera, Camera) else None
        if problem is not None:
            at: Key = ("render", "cameras", name) if name else ("render", "camera")
            yield Problem(at + problem.path, problem.message)
            sound = False
    if sound and scene.asks_for("stereo"):
        yield from _disparity_problems(scene)


def _problems_of(camera: Camera, scene: Scene, name: str) -> Iterator[Problem]:
    """Find what is wrong with a camera; keys are those of its section."""
    if camera.beside is None:
        yield from _place_problems(camera, scene)
        if camera.distortion is not None and camera.outside == "refuse":
            yield from _lens_problems(view_at(scene, 0.0, name))
    elif abs(scene.render.origin(name)[1]) > FARTHEST * max(scene.sheet.size):
        said = f"puts it more than {FARTHEST:g} times the size of the sheet away; take a smaller number, in metres"
        yield Problem(("baseline",), said)


def _disparity_problems(scene: Scene) -> Iterator[Problem]:
    """Find why there is no disparity."""
    pairs = [name for name in scene.render.all_cameras if scene.render.baseline(name)]
    if not pairs:
        said = "disparity needs a camera beside another one; take render.cameras with {beside: NAME, baseline: metres}"
        yield Problem(("output",), f"{said}, or leave it out")
    for name in pairs:
        if view_at(scene, 0.0, name).lens is not None:
            said = f"disparity is along rows only without distortion, and {name} has one; leave out one of them"
            yield Problem(("output",), said)
            return


def _place_problems(camera: Camera, scene: Scene) -> Iterator[Problem]:
    """Find what is wrong with a camera's place, at any frame; keys are those of its section."""
    if camera.pose is not None:
        turn = np.array(camera.pose.rotation)
        if not (np.abs(turn @ turn.T - np.eye(3)).max() <= ORTHONORMAL and np.linalg.det(turn) > 0):
            apart = np.abs(turn @ turn.T - np.eye(3)).max()
            what = f"no rotation: products of its rows are off by {apart:.2g}"
            if np.linalg.det(turn) < 0:
                what = "a mirror, no rotation"
            said = "its rows are the directions to the right, down and forward, of length 1 and across each other"
            yield Problem(("pose", "rotation"), f"is {what}; {said}")
            return
    if camera.poses is not None:
        begin, end, last = camera.poses[0][0], camera.poses[-1][0], scene.time.duration
        slack = FRAME_TOLERANCE / scene.time.frames_per_second
        gap = camera.poses[min(1, len(camera.poses) - 1)][0] - max(begin, 0.0)  # type: ignore[operator]
        if gap > LONGEST_GAP or (len(camera.poses) > 2 and gap > SPARSEST * last):
            said = f"its first poses are {gap:.6g} s apart, and the scene lasts {last:g} s; write times in seconds"
            yield Problem(
                ("poses",), f"{said}, nanoseconds divided by 1e9, or name the columns in a header, with t [ns]"
            )
            return
        if begin > slack or end < last - slack:  # type: ignore[operator]
            said = f"covers {begin:.12g} s to {end:.12g} s, but the scene goes from 0 s to {last:g} s"
            remedy = "its times are those of the scene: subtract the first one from all"
            if begin <= slack:  # type: ignore[operator]
                remedy = "shorten time.duration or give the poses of all of it"
            yield Problem(("poses",), f"{said}; {remedy}")
            return
    if camera.eye is None and placed(camera, 0.0).distance < MIN_MAGNITUDE:
        said = "puts the eye on the middle of the sheet, which the light's strength depends on; move it away"
        yield Problem((_place_key(camera),), said)
        return
    rate = scene.time.frames_per_second
    for time in [frame / rate for frame in range(scene.time.frames + 1)] if camera.moves else [0.0]:
        when = f" at {time:g} s" if camera.moves else ""
        if camera.eye is not None:
            eye, target, up = (list(at_time(value, time)) for value in (camera.eye, camera.target, camera.up))
            sight = unit(np.subtract(eye, target))
            if math.dist(eye, target) < MIN_MAGNITUDE:
                yield Problem(("eye",), f"{eye} is also the target{when}; move one of them")
                return
            if not np.linalg.norm(np.cross(sight, unit(np.array(up)))) > 1e-9:
                said = f"{up} is zero or along the line of sight{when}; take a direction across it"
                yield Problem(("up",), said)
                return
        if np.abs(_pinhole(camera, scene, time).matrix).max() > LARGEST_NUMBER:
            if camera.eye is not None and camera.intrinsics is None:
                said = f"{eye} is too far away for {camera.fov:g} degrees{when}; move it nearer or widen fov"
            else:
                said = f"is too far away for its focal length{when}; move it nearer"
            yield Problem((_place_key(camera),), said)
            return


def _place_key(camera: Camera) -> str:
    """Name the key that gives the place of a camera."""
    return next(name for name in ("eye", "pose", "poses") if getattr(camera, name) is not None)


def _lens_problems(camera: View) -> Iterator[Problem]:
    """Find where a lens folds back within the picture; keys are those of the camera's section."""
    if camera.lens is None or not np.isnan(camera.undistorted(border(camera.size))).any():
        return
    end = "folds back" if camera.lens.limit < WIDEST else "reaches 88 degrees"
    far = math.ceil(float(np.linalg.norm(border(camera.size) - camera.centre, axis=-1).max()))
    angle = np.linspace(0, 2 * np.pi, DIRECTIONS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def folds(radius: int) -> bool:
        return bool(np.isnan(camera.undistorted(camera.centre + radius * circle)).any())

    good = max(0, bisect_left(range(far), True, key=folds) - 1)
    said = f"{end} at {good} px from the principal point, and the picture reaches {far} px; take coefficients"
    yield Problem(("distortion",), f"{said} that are good to there, or set outside: background")


def border(size: Array) -> Array:
    """List places along the edges of a picture of this width and height, one a pixel [px], shape (n, 2)."""
    width, height = (int(side) for side in size)
    across, down = np.arange(width + 1.0), np.arange(height + 1.0)
    sides = [(across, 0 * across), (across, 0 * across + height), (0 * down, down), (0 * down + width, down)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def pinhole(scene: Scene, time: float = 0.0) -> Camera:
    """Give the scene's main camera at a time [s] as a pinhole camera that stays there.

    The orthographic one becomes one above the sheet, at equal scale.
    """
    camera = scene.render.main_camera
    if isinstance(camera, Camera):
        return held(camera, time)
    if camera == "oblique":
        return _oblique(scene)
    half_height = scene.render.size[1] / 2 / _top_scale(scene)
    return Camera(eye=(0.0, 0.0, half_height / math.tan(math.radians(OBLIQUE_FOV) / 2)), fov=OBLIQUE_FOV)


def held(camera: Camera, time: float) -> Camera:
    """Give a camera that stays where another one is at a time [s], with an eye, a target and a direction up."""
    if camera.pose is None and not camera.moves:
        return camera
    eye, axes, distance = placed(camera, time)
    optics = {name: getattr(camera, name) for name in camera.model_fields_set & OPTICS}
    target = eye - distance * axes[2]
    return Camera(eye=tuple(eye.tolist()), target=tuple(target.tolist()), up=tuple(axes[1].tolist()), **optics)


def turned(camera: Camera, right: float, up: float) -> Camera:
    """Orbit a camera that stays in its place: right about the sheet's normal, up about its horizontal axis [rad]."""
    eye, (across, _, toward), _ = placed(camera, 0.0)
    turn = _rotation(np.array([0.0, 0.0, 1.0]), right) @ _rotation(across, -up)
    moved = np.array(camera.target) + turn @ np.subtract(eye, camera.target)
    above = turn @ np.cross(toward, across)
    return camera.model_copy(update={"eye": tuple(moved.tolist()), "up": tuple(above.tolist())})


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
    size, eye = np.array([columns, lines], float), np.array([0.0, 0.0, distance])
    scales = np.array([scale, scale])
    return View(np.array(rows, dtype=float), 0.0, np.eye(3), eye, scales, size / 2, size, distance, pinhole=False)


def _pinhole(camera: Camera, scene: Scene, time: float) -> View:
    """Look from the eye to the target; fov is the angle from the picture's bottom to its top."""
    columns, lines = scene.render.size
    eye, axes, distance = placed(camera, time)
    # The light does not change while the camera moves.
    distance = placed(camera, 0.0).distance if camera.moves else distance
    right, up, depth = axes * np.array([[1.0], [1.0], [-1.0]])
    if (given := camera.intrinsics) is not None:
        # Here the centre of the first pixel is at (0.5, 0.5).
        across, down, x, y = given.fx, given.fy, given.cx + 0.5, given.cy + 0.5
    else:
        across = down = lines / 2 / np.tan(np.radians(camera.fov) / 2)
        x, y = columns / 2, lines / 2
    rows = [across * right + x * depth, -down * up + y * depth, depth, depth]
    matrix = np.array([[*row, -row @ eye] for row in rows])
    near, size = NEAR * math.hypot(*scene.sheet.size), np.array([columns, lines], float)
    bent = camera.distortion
    lens = None if bent is None else Lens(bent.model == "fisheye", bent.coefficients)
    scale, centre = np.array([across, down]), np.array([x, y])
    lens = None if lens == UNBENT else lens
    return View(matrix, near, axes, eye, scale, centre, size, distance, pinhole=True, lens=lens)


def _oblique(scene: Scene) -> Camera:
    """Tilt the camera and move it as near as the whole rest rectangle allows."""
    (height, width), (columns, lines) = scene.sheet.size, scene.render.size
    toward = OBLIQUE_DIRECTION / np.linalg.norm(OBLIQUE_DIRECTION)
    axes = placed(Camera(eye=tuple(toward), fov=OBLIQUE_FOV), 0.0).axes
    corners = np.array([[x, y, 0.0] for x in (-width / 2, width / 2) for y in (-height / 2, height / 2)]) @ axes.T
    half_height = np.tan(np.radians(OBLIQUE_FOV) / 2)
    half = np.array([half_height * columns / lines, half_height])
    distance = float((corners[:, 2:] + np.abs(corners[:, :2]) / half).max()) * OBLIQUE_MARGIN
    return Camera(eye=tuple(distance * toward), fov=OBLIQUE_FOV)


# From the axes right, up, toward the camera to OpenCV's right, down, forward, and back.
OPENCV = np.array([[1.0], [-1.0], [-1.0]])


class Placed(NamedTuple):
    """A camera at one time."""

    eye: Array  # [m], shape (3,)
    axes: Array  # unit vectors right, up and toward the camera, as rows, shape (3, 3)
    distance: float  # from the eye to the point that it looks at, for a pose to the middle of the sheet at rest [m]


def placed(camera: Camera, time: float) -> Placed:
    """Place a camera at a time [s]."""
    if camera.pose is not None:
        turn = nearest_rotation(np.array(camera.pose.rotation))
        eye = -turn.T @ np.array(camera.pose.translation)
        return Placed(eye, turn * OPENCV, float(np.linalg.norm(eye)))
    if camera.poses is not None:
        assert not isinstance(camera.poses, str)
        eye, turn = _interpolate(camera.poses, time)
        return Placed(eye, turn.T * OPENCV, float(np.linalg.norm(eye)))
    assert camera.eye is not None
    eye, target, up = (at_time(value, time) for value in (camera.eye, camera.target, camera.up))
    return Placed(np.array(eye), axes(eye, target, up), math.dist(eye, target))


def axes(eye: Sequence[float], target: Sequence[float], up: Sequence[float]) -> Array:
    """Give the unit vectors right, up and toward the eye of a camera, as rows, shape (3, 3)."""
    toward = unit(np.subtract(eye, target))
    right = unit(np.cross(scaled(np.array(up)), toward))
    return np.stack([right, np.cross(toward, right), toward])


def unit(vector: Array) -> Array:
    """Give a vector the length 1; a vector of zeros stays."""
    smaller = scaled(vector)
    return smaller / (float(np.linalg.norm(smaller)) or 1.0)


def scaled(vector: Array) -> Array:
    """Multiply a vector by a power of 2, which is exact, so that squares of it neither overflow nor vanish."""
    return np.ldexp(vector, -math.frexp(float(np.abs(vector).max()))[1])


def nearest_rotation(matrix: Array) -> Array:
    """Give the orthonormal matrix that is nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def at_time(value: Sequence[float] | Sequence[Sequence[float]], time: float) -> Sequence[float]:
    """Give a vector, or keys of one, at a time: linear between them, held outside."""
    keys = np.array(value)
    if keys.ndim == 1:
        return value  # type: ignore[return-value]
    return [float(np.interp(time, keys[:, 0], keys[:, n])) for n in (1, 2, 3)]


def _interpolate(poses: Sequence[Sequence[float]], time: float) -> tuple[Array, Array]:
    """Give the eye and the rotation from the camera to the world at a time; places linear, rotations by slerp."""
    from scipy.spatial.transform import Rotation, Slerp

    times = [row[0] for row in poses]
    n = min(max(bisect_right(times, time), 1), max(1, len(poses) - 1))
    rows = np.array(poses[n - 1 : n + 1])
    if len(rows) == 1:
        return rows[0, 1:4], Rotation.from_quat(rows[0, 4:]).as_matrix()
    here = min(max(time, rows[0, 0]), rows[1, 0])
    share = (here - rows[0, 0]) / (rows[1, 0] - rows[0, 0])
    turn = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:]))(here).as_matrix()
    return rows[0, 1:4] * (1 - share) + rows[1, 1:4] * share, turn
