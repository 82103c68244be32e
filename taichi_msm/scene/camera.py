"""taichi_msm.scene.scene.camera."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    StrictBool,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from typing_extensions import Self

from taichi_msm.scene.calibration import CameraFileError, pose_fault, read_calibration, read_poses
from taichi_msm.scene.section import (
    MIN_FOV,
    MIN_MAGNITUDE,
    FilePath,
    Number,
    Positive,
    Section,
    Vector,
    key,
    scene_fault,
)

# The coefficients of OpenCV's models of distortion, in its order.
COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

_MOST = 1e6
_COEFFICIENT = f"a number, {-_MOST:g} to {_MOST:g}"
Coefficient = Annotated[Number, Field(ge=-_MOST, le=_MOST)]


class Intrinsics(Section):
    """The focal lengths and the principal point of a calibrated camera, in OpenCV's pixels."""

    fx: Positive = key(..., "focal length across [px]", "a number above 0, in pixels")
    fy: Positive = key(..., "focal length down [px]", "a number above 0, in pixels")
    cx: Coefficient = key(..., "principal point across [px]; the centre of the first pixel is 0", _COEFFICIENT)
    cy: Coefficient = key(..., "principal point down [px]; the centre of the first pixel is 0", _COEFFICIENT)


class Distortion(Section):
    """How a lens bends lines: OpenCV's rational model, or its fisheye."""

    model: Literal["pinhole", "fisheye"] = key(
        "pinhole", "pinhole: OpenCV's rational model; fisheye: its fisheye, with k1 to k4", "pinhole or fisheye"
    )
    k1: Coefficient = key(0.0, "radial coefficient", _COEFFICIENT)
    k2: Coefficient = key(0.0, "radial coefficient", _COEFFICIENT)
    k3: Coefficient = key(0.0, "radial coefficient", _COEFFICIENT)
    k4: Coefficient = key(0.0, "radial coefficient; of a pinhole in the denominator", _COEFFICIENT)
    k5: Coefficient = key(0.0, "radial coefficient in the denominator", _COEFFICIENT)
    k6: Coefficient = key(0.0, "radial coefficient in the denominator", _COEFFICIENT)
    p1: Coefficient = key(0.0, "tangential coefficient", _COEFFICIENT)
    p2: Coefficient = key(0.0, "tangential coefficient", _COEFFICIENT)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The coefficients of the model, in OpenCV's order."""
        return tuple(getattr(self, name) for name in COEFFICIENTS[self.model])

    @model_validator(mode="after")
    def _of_its_model(self) -> Self:
        for name in sorted(self.model_fields_set - {"model", *COEFFICIENTS[self.model]}):
            if getattr(self, name):
                raise scene_fault("goes with model: pinhole; a fisheye has k1, k2, k3 and k4", name)
        return self


class Pose(Section):
    """Where a camera is, in OpenCV's axes: x right, y down, z forward."""

    rotation: tuple[Vector, Vector, Vector] = key(
        ..., "from the world's axes to the camera's", "three rows of three numbers: an orthonormal matrix"
    )
    translation: Vector = key(..., "the world's origin in the camera's axes [m]", "three numbers: [x, y, z] in metres")


Times = Annotated[tuple[tuple[Number, Number, Number, Number], ...], Field(min_length=1)]
Quaternions = Annotated[
    tuple[tuple[Number, Number, Number, Number, Number, Number, Number, Number], ...], Field(min_length=1)
]

_KEYS = " or keys [[t, x, y, z], ...], t in seconds"


class Camera(Section):
    """A pinhole camera, which may be calibrated, have a lens that bends lines, and move."""

    calibration: FilePath | None = key(
        None,
        "in place of fov and distortion: a calibration of OpenCV, ROS or STIR, relative to the scene file",
        "the path of a file",
    )
    scale: StrictBool = key(
        False, "whether a calibration of pictures of another size is scaled to this one", "true or false"
    )
    intrinsics: Intrinsics | None = key(
        None, "in place of fov: as calibrated, in OpenCV's pixels", "a mapping with fx, fy, cx and cy"
    )
    distortion: Distortion | None = key(
        None,
        "how the lens bends lines, in OpenCV's terms",
        "a mapping with k1, k2, p1, p2, k3 to k6, or with model: fisheye and k1 to k4",
    )
    outside: Literal["refuse", "background"] = key(
        "refuse",
        "what to do where the distortion folds back within the picture: refuse the scene, or draw the background there",
        "refuse or background",
    )
    pose: Pose | None = key(
        None, "in place of eye, target and up: from the world to the camera", "a mapping with rotation and translation"
    )
    poses: FilePath | Quaternions | None = key(
        None,
        "in place of eye, target and up: the camera's place over time, a file in TUM's format, relative to the scene "
        "file, or its rows [t, tx, ty, tz, qx, qy, qz, qw], from the camera to the world",
        "the path of a file, or rows [[t, tx, ty, tz, qx, qy, qz, qw], ...]",
    )
    beside: Annotated[str, Field(strict=True, min_length=1)] | None = key(
        None,
        "in `cameras`, in place of all else but baseline: the name of another camera, which this one is like",
        "the name of another camera",
    )
    baseline: Number | None = key(
        None,
        "how far it is from the camera that it is beside, along the x axis of that [m]",
        "a number but 0, in metres",
    )
    eye: Vector | Times | None = key(
        None,
        "where the camera is [m], or keys of it, linear between, held outside; required unless there is pose, poses or "
        "beside",
        "three numbers: [x, y, z] in metres," + _KEYS,
    )
    target: Vector | Times = key(
        (0.0, 0.0, 0.0), "the point it looks at [m], or keys of it", "three numbers: [x, y, z] in metres," + _KEYS
    )
    up: Vector | Times = key(
        (0.0, 1.0, 0.0),
        "the direction that is up in the picture, or keys of it",
        "three numbers: [x, y, z]," + _KEYS,
    )
    fov: Annotated[Number, Field(ge=MIN_FOV, lt=180)] = key(
        40.0,
        "angle from the picture's bottom to its top, without distortion [degrees]",
        f"a number from {MIN_FOV:g} to below 180, in degrees",
    )

    @property
    def moves(self) -> bool:
        """Whether the camera is not in the same place at all times."""
        return any(isinstance(value[0], tuple) for value in (self.poses, self.eye, self.target, self.up) if value)

    @field_validator("poses", mode="after")
    @classmethod
    def _read_poses(cls, poses: str | Quaternions | None) -> Quaternions | None:
        if not isinstance(poses, str):
            for n, row in enumerate(poses or ()):
                if fault := pose_fault(row, poses[n - 1] if n else None):  # type: ignore[index]
                    raise scene_fault(fault, n)
            return poses
        try:
            return read_poses(poses)  # type: ignore[return-value]
        except CameraFileError as error:
            raise scene_fault(str(error)) from None

    @field_validator("eye", "target", "up", mode="after")
    @classmethod
    def _in_order(cls, keys: Any, info: ValidationInfo) -> Any:
        if info.field_name == "eye" and keys is None and not {"beside", "pose", "poses"} & _given(info):
            raise scene_fault("missing; expected " + cls.model_fields["eye"].json_schema_extra["expects"])  # type: ignore
        if keys is None or not isinstance(keys[0], tuple):
            return keys
        for n in range(1, len(keys)):
            if keys[n][0] <= keys[n - 1][0]:
                said = f"is at {keys[n][0]:g} s, and the key before it at {keys[n - 1][0]:g} s"
                raise scene_fault(f"{said}; sort the keys, each later than the last", n)
        return keys

    @model_validator(mode="after")
    def _said_once(self) -> Self:
        given = {name for name in self.model_fields_set if getattr(self, name) is not None}
        if self.beside is not None:
            for name in sorted(given - {"beside", "baseline"}):
                raise scene_fault(
                    "is given together with beside, and a camera beside another is like that; remove it", name
                )
            if self.baseline is None or abs(self.baseline) < MIN_MAGNITUDE:
                what = "missing" if self.baseline is None else f"{self.baseline:g} puts it where {self.beside} is"
                raise scene_fault(f"{what}; expected a number but 0, in metres", "baseline")
        elif self.baseline is not None:
            raise scene_fault("goes with beside, the name of another camera; add it or remove this", "baseline")
        if self.scale and self.calibration is None:
            raise scene_fault("goes with calibration; remove it", "scale")
        if self.outside == "background" and self.distortion is None and self.calibration is None:
            raise scene_fault("goes with distortion; remove it", "outside")
        for ways in (("calibration", "intrinsics", "fov"), ("pose", "poses", "eye"), ("calibration", "distortion")):
            if len(both := [name for name in ways if name in given]) > 1:
                raise scene_fault(f"is given together with {both[0]}; remove one of them", both[1])
        for name in {"target", "up"} & given if {"pose", "poses"} & given else ():
            raise scene_fault("goes with eye; a pose has a direction of its own", name)
        return self

    @model_serializer(mode="wrap")
    def _own_keys(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what was not given and has no meaning beside what was."""
        if self.beside is not None:
            return {name: value for name, value in dump(self).items() if name in ("beside", "baseline")}
        needed = {"eye", "target", "up"} if self.eye is not None else {"pose", "poses"} & self.model_fields_set
        needed |= {"intrinsics"} if self.intrinsics is not None else {"fov"}
        needed |= {name for name in ("distortion", "outside") if name in self.model_fields_set}
        return {name: value for name, value in dump(self).items() if name in needed}

    def calibrated(self, size: tuple[int, int]) -> Self:
        """Read the calibration for pictures of a width and height [px]; raises pydantic's error of a key."""
        if self.calibration is None:
            return self
        try:
            found = read_calibration(self.calibration)
        except CameraFileError as error:
            raise scene_fault(str(error), "calibration") from None
        if self.scale and found.size is None:
            said = "tells no size of its pictures, so it cannot be scaled; add image_width and image_height"
            raise scene_fault(f"{self.calibration}: {said}, or remove scale", "calibration")
        across, down = (new / old for new, old in zip(size, found.size or size, strict=True))
        if (across, down) != (1, 1) and not self.scale:
            assert found.size is not None
            raise scene_fault(
                f"{self.calibration}: of pictures of {found.size[0]} x {found.size[1]} pixels, not of {size[0]} x "
                f"{size[1]}; set render.size to these, or scale: true",
                "calibration",
            )
        # Edges of pictures are scaled to edges; they are half a pixel from the centres of pixels.
        (fx, fy), (cx, cy) = found.focal, found.centre
        intrinsics = {"fx": fx * across, "fy": fy * down}
        intrinsics |= {"cx": (cx + 0.5) * across - 0.5, "cy": (cy + 0.5) * down - 0.5}
        update: dict[str, Any] = {"calibration": None, "scale": False, "intrinsics": intrinsics}
        if any(found.coefficients):
            model = "fisheye" if found.fisheye else "pinhole"
            # OpenCV lets the last ones of a pinhole out.
            names = zip(COEFFICIENTS[model], found.coefficients, strict=False)
            update["distortion"] = {"model": model, **dict(names)}
        elif found.fisheye:
            update["distortion"] = {"model": "fisheye"}
        unused = {"calibration", "scale"} if "distortion" in update else {"calibration", "scale", "outside"}
        kept = {name: getattr(self, name) for name in self.model_fields_set - unused}
        try:
            return self.model_validate(kept | update)
        except ValidationError:
            said = f"{', '.join(f'{name} = {value:g}' for name, value in intrinsics.items())} for pictures of this size"
            raise scene_fault(
                f"{self.calibration}: {said} are out of range; calibrate at a size near it", "scale"
            ) from None


def _given(info: ValidationInfo) -> set[str]:
    """Give the names of the keys before this one that have a value, or one at fault."""
    before = list(Camera.model_fields)
    names = before[: before.index(str(info.field_name))]
    return {name for name in names if info.data.get(name, name) is not None}
