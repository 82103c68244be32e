"""Sections of a pinhole camera: intrinsics, lens distortion and pose."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PrivateAttr,
    StrictBool,
    StrictInt,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)
from typing_extensions import Self

from taichi_msm.camera_files.calibration import Calibration, focal_fault
from taichi_msm.camera_files.camera_file import CameraFileError
from taichi_msm.camera_files.key_lookup import ROUNDING_TOLERANCE
from taichi_msm.camera_files.readers import PoseKeys, read_calibration, read_pair_pose, read_poses
from taichi_msm.camera_files.trajectory import pose_fault
from taichi_msm.lenses import MODELS
from taichi_msm.lenses.model import MAX_COEFFICIENT
from taichi_msm.scene.section import (
    MIN_MAGNITUDE,
    FilePath,
    Number,
    Positive,
    Section,
    Vector,
    key,
    require_increasing,
    scene_fault,
)

_RANGE_EXPECTS = "a number, {:g} to {:g}"
Coordinate = Annotated[Number, Field(ge=-MAX_COEFFICIENT, le=MAX_COEFFICIENT)]
_COORDINATE_EXPECTS = _RANGE_EXPECTS.format(-MAX_COEFFICIENT, MAX_COEFFICIENT)

_FOCAL_EXPECTS = "a number above 0, in pixels"
_FOCAL_MEANING = "focal length [px]; required unless the lens model has one (scaramuzza)"


class Intrinsics(Section):
    """Focal lengths and principal point, in OpenCV's pixel coordinates."""

    fx: Positive | None = key(None, f"horizontal {_FOCAL_MEANING}", _FOCAL_EXPECTS)
    fy: Positive | None = key(None, f"vertical {_FOCAL_MEANING}", _FOCAL_EXPECTS)
    cx: Coordinate = key(..., "x of the principal point [px]; 0 is the centre of the first pixel", _COORDINATE_EXPECTS)
    cy: Coordinate = key(..., "y of the principal point [px]; 0 is the centre of the first pixel", _COORDINATE_EXPECTS)


def _alternatives(names: Iterable[str]) -> str:
    """Join names by commas and `or`."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


class _Model(Section):
    model: Literal[tuple(MODELS)] = key(  # type: ignore[valid-type]
        "pinhole",
        "; ".join(f"{name}: {model.meaning}" for name, model in MODELS.items()),
        _alternatives(MODELS),
    )


def _coefficient_keys() -> dict[str, Any]:
    """Return a pydantic field per coefficient; a coefficient of several lens models has that of the first model."""
    coefficients = {name: row for model in reversed(MODELS.values()) for name, row in model.coefficients.items()}
    return {
        name: (
            Annotated[Number, Field(ge=row.least, le=row.most)] | None,
            key(row.default, row.meaning, _RANGE_EXPECTS.format(row.least, row.most)),
        )
        for name, row in sorted(coefficients.items())
    }


_Coefficients: Any = create_model("_Coefficients", __base__=_Model, **_coefficient_keys())


class Distortion(_Coefficients):  # type: ignore[misc]
    """Lens distortion: a lens model, and a key for each coefficient."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of the lens model, in the order of `LensModel.coefficients`."""
        return tuple(getattr(self, name) for name in MODELS[self.model].coefficients)

    @property
    def focal_length(self) -> float | None:
        """Focal length in the lens model [px]; None for a model without one."""
        name = MODELS[self.model].focal_length
        return getattr(self, name) if name else None

    def _unused_keys(self) -> Collection[str]:
        return type(self).model_fields.keys() - {"model", *MODELS[self.model].coefficients}

    @model_validator(mode="after")
    def _check_coefficients_of_model(self) -> Self:
        coefficients = MODELS[self.model].coefficients
        for name, row in coefficients.items():
            if getattr(self, name) is None:
                raise scene_fault(f"missing; expected {_RANGE_EXPECTS.format(row.least, row.most)}", name)
        for name in sorted(self.model_fields_set - {"model", *coefficients}):
            if getattr(self, name):
                models = _alternatives(model for model, row in MODELS.items() if name in row.coefficients)
                *names, last = coefficients
                raise scene_fault(f"requires model: {models}; {self.model} has {', '.join(names)} and {last}", name)
        return self


Rotation = tuple[Vector, Vector, Vector]
_ROTATION_EXPECTS = "three rows of three numbers: an orthonormal matrix"


class Pose(Section):
    """Extrinsics of a camera, in OpenCV's axes: x right, y down, z forward."""

    rotation: Rotation = key(..., "rotation from the world's axes to the camera's", _ROTATION_EXPECTS)
    translation: Vector = key(..., "world origin in the camera's axes [m]", "three numbers: [x, y, z] in metres")


# Keyframes: [t, x, y, z] of a vector; [t, x, y, z, qx, qy, qz, qw] of a pose, with a quaternion; t [s], position [m].
VectorKeyframes = Annotated[tuple[tuple[Number, Number, Number, Number], ...], Field(min_length=1)]
PoseRows = Annotated[
    tuple[tuple[Number, Number, Number, Number, Number, Number, Number, Number], ...], Field(min_length=1)
]

_OR_KEYFRAMES = " or keyframes [[t, x, y, z], ...], t in seconds"


class Camera(Section):
    """Pinhole camera, with optional calibration, lens distortion and motion."""

    calibration: FilePath | None = key(
        None,
        "in place of fov and distortion: calibration of OpenCV, ROS, COLMAP, ZED or another program, relative to "
        "the scene file",
        "the path of a file",
    )
    calibration_eye: Literal["left", "right"] = key(
        "left", "camera of a stereo calibration that is read", "left or right"
    )
    camera: StrictInt | Annotated[str, Field(strict=True, min_length=1)] | None = key(
        None,
        "in a calibration of several cameras (ZED, COLMAP, Metashape), name of the one that is read",
        "the name of a camera in the file, such as LEFT_CAM_HD",
    )
    calibration_unit: Literal["m", "mm"] | None = key(
        None, "unit of the translation T in a stereo calibration", "m or mm"
    )
    scale: StrictBool = key(False, "scale a calibration of another picture size to this one", "true or false")
    intrinsics: Intrinsics | None = key(
        None,
        "in place of fov: focal lengths and principal point, in OpenCV's pixel coordinates",
        "a mapping with fx, fy, cx and cy",
    )
    distortion: Distortion | None = key(
        None,
        "lens distortion: model and coefficients, as in OpenCV",
        "a mapping with k1, k2, p1, p2, k3 to k6, or with another model and its coefficients",
    )
    outside: Literal["refuse", "background"] = key(
        "refuse",
        "pixels where the distortion is not invertible: refuse the scene, or draw the background",
        "refuse or background",
    )
    pose: Pose | None = key(
        None,
        "in place of eye, target and up: transform from the world to the camera",
        "a mapping with rotation and translation",
    )
    poses: FilePath | PoseRows | None = key(
        None,
        "in place of eye, target and up: trajectory, the transform from the camera to the world: a file of TUM, EuRoC, "
        "KITTI, COLMAP or another program, relative to the scene file, or rows [t, tx, ty, tz, qx, qy, qz, qw]",
        "the path of a file, or rows [[t, tx, ty, tz, qx, qy, qz, qw], ...]",
    )
    poses_unit: Literal["m", "mm"] | None = key(
        None, "unit of positions in the file of poses; default: that of its header or format, else m", "m or mm"
    )
    poses_time: Literal["s", "ms", "us", "ns"] | None = key(
        None, "unit of times in the file of poses; default: that of its header, else s", "s, ms, us or ns"
    )
    poses_start: Number | None = key(
        None,
        "time in the file of poses at which the scene begins [s]; below the first time of the file, counted from its "
        "first pose; default: the scene has the times of the file",
        "a number, in seconds",
    )
    poses_rate: Positive | None = key(
        None, "poses per second of a file without times, such as KITTI's and COLMAP's", "a number above 0"
    )
    beside: Annotated[str, Field(strict=True, min_length=1)] | None = key(
        None,
        "in `cameras`, in place of eye, pose and poses: name of the reference camera of a stereo pair, to which this "
        "camera is fixed",
        "the name of another camera",
    )
    baseline: Number | None = key(
        None,
        "with beside: distance from the reference camera along its x axis [m]; lens and direction are the same",
        "a number other than 0, in metres",
    )
    rotation: Rotation | None = key(
        None,
        "with beside, in place of baseline: R of OpenCV's stereoCalibrate, from the axes of the reference camera to "
        "those of this one; default of intrinsics, calibration and fov: the lens of the reference camera",
        _ROTATION_EXPECTS,
    )
    translation: Vector | None = key(
        None,
        "with rotation: T of OpenCV's stereoCalibrate in metres, X_this = R X_reference + T",
        "three numbers: [x, y, z] in metres",
    )
    eye: Vector | VectorKeyframes | None = key(
        None,
        "position of the camera [m], or its keyframes, linear between, constant outside; required without pose, "
        "poses and beside",
        "three numbers: [x, y, z] in metres," + _OR_KEYFRAMES,
    )
    target: Vector | VectorKeyframes = key(
        (0.0, 0.0, 0.0),
        "point on the optical axis [m], or its keyframes",
        "three numbers: [x, y, z] in metres," + _OR_KEYFRAMES,
    )
    up: Vector | VectorKeyframes = key(
        (0.0, 1.0, 0.0),
        "direction that is up in the picture, or its keyframes",
        "three numbers: [x, y, z]," + _OR_KEYFRAMES,
    )
    # f32 resolves directions to 2^-24 rad, 3.4e-6 degrees: about 300 rows of pixels at the minimum.
    fov: Annotated[Number, Field(ge=0.001, lt=180)] = key(
        40.0,
        "vertical field of view, without distortion [degrees]",
        "a number from 0.001 to below 180, in degrees",
    )

    # Warning about the file of poses, set where it is read.
    _note: str = PrivateAttr("")

    @property
    def note(self) -> str:
        """Warning about the file of poses; empty without one."""
        return self._note

    @property
    def has_own_lens(self) -> bool:
        """Whether the camera has its own intrinsics, in place of those of its reference camera."""
        return self.intrinsics is not None or "fov" in self.model_fields_set

    @property
    def moves(self) -> bool:
        """Whether the pose of the camera depends on time."""
        return any(isinstance(value[0], tuple) for value in (self.poses, self.eye, self.target, self.up) if value)

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths fx, fy [px]: those of the lens model, else of `intrinsics`."""
        assert self.intrinsics is not None
        lens_focal = self.distortion.focal_length if self.distortion else None
        focal_x, focal_y = lens_focal or self.intrinsics.fx, lens_focal or self.intrinsics.fy
        assert focal_x is not None
        assert focal_y is not None
        return focal_x, focal_y

    @field_validator("poses", mode="after")
    @classmethod
    def _check_poses(cls, poses: str | PoseRows | None) -> str | PoseRows | None:
        for n, row in enumerate(poses if isinstance(poses, tuple) else ()):
            if fault := pose_fault(row, poses[n - 1] if n else None):  # type: ignore[index, arg-type]
                raise scene_fault(fault, n)
        return poses

    @field_validator("eye", "target", "up", mode="after")
    @classmethod
    def _check_keyframes(cls, keyframes: Any, info: ValidationInfo) -> Any:
        if info.field_name == "eye" and keyframes is None and not {"beside", "pose", "poses"} & _given_before(info):
            raise scene_fault("missing; expected " + cls.model_fields["eye"].json_schema_extra["expects"])  # type: ignore
        if keyframes is not None and isinstance(keyframes[0], tuple):
            require_increasing(keyframes)
        return keyframes

    @model_validator(mode="after")
    def _check_combination(self) -> Self:
        given = {name for name in self.model_fields_set if getattr(self, name) is not None}
        if self.beside is not None:
            self._check_pair(given)
        for name in ("baseline", "rotation", "translation") if self.beside is None else ():
            if name in given:
                raise scene_fault(f"requires beside, the name of another camera; add beside or remove {name}", name)
        for name in ("scale", "calibration_eye", "camera", "calibration_unit") if self.calibration is None else ():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise scene_fault(f"requires calibration; remove {name}", name)
        for name in PoseKeys._fields if not isinstance(self.poses, str) else ():
            if name in given:
                raise scene_fault(f"requires poses, the path of a file; remove {name}", name)
        if self.outside == "background" and self.distortion is None and self.calibration is None:
            raise scene_fault("requires distortion; remove outside", "outside")
        if self.camera is not None and "calibration_eye" in given:
            raise scene_fault(
                "conflicts with camera, which selects the camera; remove calibration_eye", "calibration_eye"
            )
        self._check_focal_length()
        exclusive = (("calibration", "intrinsics", "fov"), ("pose", "poses", "eye"), ("calibration", "distortion"))
        for names in exclusive:
            if len(both := [name for name in names if name in given]) > 1:
                raise scene_fault(f"conflicts with {both[0]}; remove one of them", both[1])
        for name in {"target", "up"} & given if {"pose", "poses"} & given else ():
            raise scene_fault(f"requires eye, as pose and poses have a direction; remove {name}", name)
        return self

    def _check_pair(self, given: set[str]) -> None:
        """Check the keys of a camera with a reference camera."""
        for name in sorted({"eye", "pose", "poses", "target", "up"} & given):
            raise scene_fault(f"conflicts with beside, which sets the pose; remove {name}", name)
        if self.baseline is not None:
            for name in sorted(given - {"beside", "baseline"}):
                message = f"conflicts with baseline, which copies {self.beside}"
                remedy = f"remove {name}, or replace baseline by rotation and translation"
                raise scene_fault(f"{message}; {remedy}", name)
            if abs(self.baseline) < MIN_MAGNITUDE:
                fault = f"{self.baseline:g} is the position of {self.beside}"
                raise scene_fault(f"{fault}; expected a number other than 0, in metres", "baseline")
        elif missing := {"rotation", "translation"} - given:
            for name in {"rotation", "translation"} & given:
                raise scene_fault(f"requires {missing.pop()}; add it", name)
            if self.calibration is None:
                message = "missing; expected a number other than 0, in metres; or add rotation and translation"
                raise scene_fault(message, "baseline")
        if self.distortion is not None and not self.has_own_lens:
            fault = f"requires intrinsics or fov, as the default is the lens of {self.beside}"
            raise scene_fault(f"{fault}; add one of them or remove distortion", "distortion")

    def _check_focal_length(self) -> None:
        """Check that the lens model or `intrinsics` has the focal length, and that two agree."""
        lens_focal = self.distortion.focal_length if self.distortion else None
        if self.intrinsics is None:
            if lens_focal is not None:
                fault = "missing; the lens model has the focal length, but no principal point"
                raise scene_fault(f"{fault}; add intrinsics: {{cx: ..., cy: ...}}", "intrinsics")
            return
        for name in ("fx", "fy"):
            focal = getattr(self.intrinsics, name)
            if focal is None and lens_focal is None:
                raise scene_fault(f"missing; expected {_FOCAL_EXPECTS}", "intrinsics", name)
            if focal and lens_focal and not math.isclose(focal, lens_focal, rel_tol=ROUNDING_TOLERANCE):
                fault = f"{focal:g} is not the focal length of the lens, a0 = {lens_focal:g}"
                raise scene_fault(f"{fault}; remove fx and fy", "intrinsics", name)

    def _unused_keys(self) -> Collection[str]:
        needed = {"eye", "target", "up"} if self.eye is not None else {"pose", "poses"} & self.model_fields_set
        if self.beside is not None:
            needed = {"beside", "baseline"} if self.baseline is not None else {"beside", "rotation", "translation"}
        if self.beside is None or self.has_own_lens:
            needed |= {"intrinsics"} if self.intrinsics is not None else {"fov"}
        needed |= {name for name in ("distortion", "outside") if name in self.model_fields_set}
        return type(self).model_fields.keys() - needed

    def with_poses(self) -> Self:
        """Return a copy with the rows of the trajectory in place of its file; without a file, the camera itself."""
        if not isinstance(self.poses, str):
            return self
        try:
            rows, is_still, note = read_poses(
                self.poses, PoseKeys(**{name: getattr(self, name) for name in PoseKeys._fields})
            )
        except CameraFileError as error:
            raise scene_fault(str(error), "poses") from None
        kept = {name: getattr(self, name) for name in self.model_fields_set - {"poses", *PoseKeys._fields}}
        if is_still:
            return self.model_validate({**kept, "pose": still_pose(rows[0])})
        camera = self.model_validate(kept | {"poses": rows})
        object.__setattr__(camera, "__pydantic_private__", {"_note": note})
        return camera

    def calibrated(self, size: tuple[int, int], *, is_image: bool = False, reference: Camera | None = None) -> Self:
        """Return a copy with the intrinsics and the distortion of the calibration in place of its file.

        Without a file, return the camera itself.

        Args:
            size: width and height of the pictures [px].
            is_image: whether they are those of the scene's image, not render.size.
            reference: camera of the key `beside`, with its files.
        """
        if self.calibration is None:
            given = self.intrinsics
            if given and given.fx and given.fy and (fault := focal_fault((given.fx, given.fy), size)):
                raise scene_fault(fault, "intrinsics")
            return self
        # The unit of lengths matters only to stereo pairs.
        unit = self.calibration_unit if self.beside else "m"
        try:
            calibration = read_calibration(self.calibration, self.calibration_eye, unit, self.camera, size)
            has_pose = self.beside is None or self.rotation is not None or calibration.right is not None
            if not has_pose and reference is not None and reference.calibration:
                pair_pose = read_pair_pose(reference.calibration, self.calibration, self.calibration_unit)
                calibration = calibration._replace(right=pair_pose)
        except CameraFileError as error:
            raise scene_fault(str(error), "calibration") from None
        if calibration.focal and not calibration.size and (fault := focal_fault(calibration.focal, size)):
            raise scene_fault(f"{self.calibration}: {fault}", "calibration")
        if self.scale and calibration.size is None:
            fault = "lacks the picture size, which scale needs; add image_width and image_height"
            raise scene_fault(f"{self.calibration}: {fault}, or remove scale", "calibration")
        scale_x, scale_y = (new / old for new, old in zip(size, calibration.size or size, strict=True))
        if (scale_x, scale_y) != (1, 1) and not self.scale:
            assert calibration.size is not None
            name, remedy = "render.size", f"set render.size: {list(calibration.size)}, or scale: true"
            if is_image:
                name, remedy = "the image", "take an image of that size, or set scale: true"
            raise scene_fault(
                f"{self.calibration}: calibrates pictures of {calibration.size[0]} x {calibration.size[1]} pixels, and "
                f"{name} is {size[0]} x {size[1]}; {remedy}",
                "calibration",
            )
        calibration = calibration.scaled(scale_x, scale_y)
        intrinsics = dict(zip(("cx", "cy", "fx", "fy"), calibration.centre + (calibration.focal or ()), strict=False))
        update: dict[str, Any] = {"intrinsics": intrinsics, **self._stereo_pose(calibration)}
        unused = {"calibration", "calibration_eye", "camera", "calibration_unit", "scale"}
        if calibration.model != "pinhole" or any(calibration.coefficients.values()):
            update["distortion"] = {"model": calibration.model, **calibration.coefficients}
        else:
            unused |= {"outside"}
        kept = {name: getattr(self, name) for name in self.model_fields_set - unused}
        try:
            camera = self.model_validate(kept | update)
        except ValidationError as error:
            details = error.errors()[0]
            value = f"{'.'.join(map(str, details['loc']))} = {details['input']:g} is out of range"
            if self.scale:
                value += " for pictures of this size; calibrate at a size near it"
            raise scene_fault(f"{self.calibration}: {value}", "scale" if self.scale else "calibration") from None
        object.__setattr__(camera, "__pydantic_private__", {"_note": self.note})
        return camera

    def _stereo_pose(self, calibration: Calibration) -> dict[str, Any]:
        """Return the keys rotation and translation of a stereo calibration; empty for a camera without `beside`."""
        if self.beside is None:
            return {}
        if calibration.right is not None:
            if self.rotation is not None:
                raise scene_fault(f"conflicts with R and T of {self.calibration}; remove one of them", "rotation")
            return calibration.right._asdict()
        if self.rotation is None:
            remedy = "add rotation and translation, R and T of stereoCalibrate"
            if calibration.other_key:
                remedy = f"set {calibration.other_key}, or add rotation and translation"
            if self.calibration_eye == "right":
                remedy = "write R, 3 x 3, and T, 3 numbers, of stereoCalibrate, or add rotation and translation"
            raise scene_fault(f"{self.calibration}: has no R and T of this camera; {remedy}", "calibration")
        return {}


def still_pose(row: Sequence[float]) -> dict[str, Any]:
    """Return the keys of `Pose`, from the world to the camera, of a row of `poses`."""
    from scipy.spatial.transform import Rotation

    inverse = Rotation.from_quat(row[4:]).inv()
    return {"rotation": inverse.as_matrix().tolist(), "translation": (-inverse.apply(row[1:4])).tolist()}


def _given_before(info: ValidationInfo) -> set[str]:
    """Return the keys before the validated one that have a value, valid or not."""
    fields = list(Camera.model_fields)
    previous = fields[: fields.index(str(info.field_name))]
    # `info.data` lacks keys with an invalid value.
    return {name for name in previous if info.data.get(name, name) is not None}
