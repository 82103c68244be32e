"""The scene: one frozen model per section of the YAML file, with every default and limit, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    StrictBool,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from taichi_msm import faults
from taichi_msm.camera_files import CameraFileError, pose_fault, read_calibration, read_poses
from taichi_msm.errors import ArgumentError, SceneError, did_you_mean
from taichi_msm.faults import LARGEST, SMALLEST, refused
from taichi_msm.outputs.table import CAMERA_NAME, EXPORTS, FOLDERS, MAX_NAME, OUTPUTS

MAX_POINTS = 4096
MAX_PROBES = 16
MAX_PIXELS = 8192
MAX_REFINE = 64
MAX_TRACKS = 256
MAX_RELIEF = 10
MAX_SUPERSAMPLE = 4

# The smallest field of view [degrees]. Directions that differ by less than 2^-24, 3.4e-6 degrees, are one in f32; so a
# narrower picture would have fewer than about 300 distinct rows.
MIN_FOV = 1e-3

# Operating systems limit the length of a path to about this.
MAX_PATH = 4096

# The offset of a probe in the paper (eq. 5).
DEFAULT_OFFSET = 10.0

# Times that differ by less than this fraction of a frame are one instant: 0.1 s x 30 /s is 3 frames.
WHOLE = 1e-6

# Below the first, rounding in f64 is no longer small beside the error; above the second, the result means nothing.
SMALLEST_TOLERANCE = 1e-10
LARGEST_TOLERANCE = 0.5

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=SMALLEST, le=LARGEST)]
NotNegative = Annotated[Number, Field(ge=0)]
Whole = Annotated[int, Field(strict=True)]
Tolerance = Annotated[Number, Field(ge=SMALLEST_TOLERANCE, le=LARGEST_TOLERANCE)]
Count = Annotated[Whole, Field(ge=2, le=MAX_POINTS)]
Pixels = Annotated[Whole, Field(ge=1, le=MAX_PIXELS)]
Byte = Annotated[Whole, Field(ge=0, le=255)]
FilePath = Annotated[str, Field(strict=True, min_length=1, max_length=MAX_PATH)]
Share = Annotated[Number, Field(ge=0, le=1)]
Side = Literal["top", "bottom", "left", "right"]
Vector = tuple[Number, Number, Number]
# A tool may come from beyond the edge; larger numbers are taken for pixels given by mistake, and refused.
Fraction = Annotated[Number, Field(ge=-1, le=2)]


def key(default: Any, means: str, expects: str) -> Any:
    """Describe one key: its default (... where it is required), what it means, and what errors say that it may hold."""
    return Field(default, description=means, json_schema_extra={"expects": expects})


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass

    OutputName = str
else:
    ModelMetaclass = type(BaseModel)
    OutputName = Literal[tuple(OUTPUTS)]


class _Checked(ModelMetaclass):
    """Makes the sections that a caller asks for; pydantic makes those inside them, and collects their faults."""

    def __call__(cls: type[BaseModel], /, *values: Any, **keys: Any) -> Any:  # type: ignore[misc]  # noqa: N805
        if values:
            raise ArgumentError(f"{cls.__name__} takes its keys by name: {', '.join(cls.model_fields)}")
        try:
            return super().__call__(**keys)  # type: ignore[misc]
        except ValidationError as error:
            raise SceneError([str(problem) for problem in faults.key_problems(error, cls, keys)]) from None


class Section(BaseModel, metaclass=_Checked):
    """A section of the scene: immutable, and strict about its keys.

    Raises:
        SceneError: when a key is unknown, missing or wrong, here and in `model_copy`; when a key is assigned to.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy the section, with other values for some keys."""
        del deep  # The values are immutable, so a shallow copy is as good.
        if not (update is None or (isinstance(update, Mapping) and all(isinstance(name, str) for name in update))):
            raise ArgumentError(f"update: {update!r}; take a mapping from keys to values")
        return type(self)(**{**{name: getattr(self, name) for name in self.model_fields_set}, **(update or {})})

    def __setattr__(self, name: str, value: object) -> None:
        raise SceneError([f"{name}: a scene cannot be changed; use model_copy(update={{{name!r}: ...}})"])


class Sheet(Section):
    """The sheet of mass points."""

    points: tuple[Count, Count] = key(
        ..., "rows, columns of mass points", f"two whole numbers, 2 to {MAX_POINTS}: [rows, cols]"
    )
    size: tuple[Positive, Positive] = key(
        ..., "height, width of the sheet at rest [m]", "two numbers above 0: [height, width] in metres"
    )
    mass: Positive | None = key(
        None,
        "mass of one point [kg]; required with springs unless motion is quasistatic",
        "a number above 0, in kg",
    )
    fixed: Literal["border", "corners", "none"] | tuple[Side, ...] = key(
        "border", "the points that never move", "border, corners, none, or a list of top, bottom, left, right"
    )
    tolerance: Tolerance | None = key(
        None,
        "with tissue: largest allowed error due to the number of points, as a fraction of the largest "
        "displacement; pilot runs find how many more points are needed",
        f"a number, {SMALLEST_TOLERANCE:g} to {LARGEST_TOLERANCE:g}",
    )


class StiffnessMap(Section):
    """Stiffness that differs from place to place, by the grey of an image over the whole sheet."""

    image: FilePath = key(
        ...,
        "a picture whose grey tells the stiffness; relative to the scene file, in its folder or below",
        "the path of a picture",
    )
    range: tuple[Positive, Positive] = key(
        ...,
        "factor of the stiffness where the picture is black, and where it is white; linear between",
        "two numbers above 0: [black, white]",
    )


class Springs(Section):
    """The stiffness of each family of springs, per spring, as in the paper; 0 leaves a family out."""

    structural: NotNegative = key(0.0, "springs to the 4 nearest neighbours [N/m]", "a number, 0 or more, in N/m")
    shear: NotNegative = key(0.0, "springs to the 4 diagonal neighbours [N/m]", "a number, 0 or more, in N/m")
    virtual: NotNegative = key(0.0, "springs from each point to its rest position [N/m]", "a number, 0 or more, in N/m")
    virtual_active: Literal["loaded", "always"] = key(
        "loaded", "when the virtual springs exist: while any probe's percent is not 0, or always", "loaded or always"
    )
    map: StiffnessMap | None = key(
        None, "factor of structural and shear from place to place", "a mapping with image and range"
    )


class Foundation(Section):
    """The tissue underneath, as an elastic layer; young / depth is its stiffness, force per area and displacement."""

    young: Positive = key(..., "Young's modulus of the tissue underneath [Pa]", "a number above 0, in Pa")
    depth: Positive = key(..., "depth of the tissue underneath [m]", "a number above 0, in metres")


class Tissue(Section):
    """Tissue in physical units: a sheet of plane stress with Poisson's ratio 1/3, the same at any number of points."""

    young: Positive = key(..., "Young's modulus E [Pa]", "a number above 0, in Pa")
    thickness: Positive = key(..., "thickness t of the sheet [m]", "a number above 0, in metres")
    density: Positive | None = key(
        None, "density [kg/m3]; required unless motion is quasistatic", "a number above 0, in kg/m3"
    )
    foundation: NotNegative | Foundation = key(
        0.0,
        "stiffness of the tissue underneath, as virtual springs: force per area and displacement [N/m3]; "
        "or young / depth of that tissue",
        "a number, 0 or more, in N/m3, or {young: [Pa], depth: [m]}",
    )
    foundation_active: Literal["loaded", "always"] = key(
        "loaded", "when the foundation acts: while any probe's percent is not 0, or always", "loaded or always"
    )
    damping: NotNegative = key(0.0, "C / m [1/s]", "a number, 0 or more, in 1/s")
    pretension: NotNegative = key(
        0.0, "tension S of the sheet at rest [N/m]; every side must be fixed", "a number, 0 or more, in N/m"
    )
    bending: Literal["plate"] | NotNegative = key(
        0.0,
        "bending stiffness D [N m]; plate: E t^3 / (12 (1 - nu^2)); every side must be fixed, and is hinged",
        "plate, or a number, 0 or more, in N m",
    )
    map: StiffnessMap | None = key(None, "factor of young from place to place", "a mapping with image and range")
    foundation_map: StiffnessMap | None = key(
        None, "factor of the foundation from place to place", "a mapping with image and range"
    )

    @property
    def foundation_stiffness(self) -> float:
        """Stiffness of the foundation, where its map has the factor 1 [N/m3]."""
        below = self.foundation
        return below.young / below.depth if isinstance(below, Foundation) else below


class Instrument(Section):
    """A metal rod with a rounded tip: what touches the sheet along a path; of a force what is drawn at its place."""

    radius: Positive = key(..., "radius of the rod [m]", "a number above 0, in metres")
    shaft: Vector = key(..., "direction from the tip along the rod", "three numbers, not all 0: [x, y, z]")
    length: Positive = key(..., "length of the rod [m]", "a number above 0, in metres")

    @field_validator("shaft", mode="after")
    @classmethod
    def _leads_somewhere(cls, shaft: Vector) -> Vector:
        if not any(abs(number) >= SMALLEST for number in shaft):
            raise refused("has no direction; take one such as [0.3, -0.5, 1]")
        return shaft


# The keys of a probe that only a tool with a force has, and only one with a path.
_OF_FORCE = {"at", "total", "force", "load", "falloff", "radius", "offset"}
_OF_PATH = {"friction", "grip"}


class Probe(Section):
    """A tool: a force and where and when it acts (eq. 5), or the path of a rod that touches the sheet."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": list(names)} for names in (("total",), ("force",), ("path", "instrument"))]
        }
    )

    path: Annotated[tuple[tuple[Number, Fraction, Fraction, Number], ...], Field(min_length=1)] | None = key(
        None,
        "in place of a force: where the instrument is; keys [[t, across, down, height], ...], linear between, held "
        "outside; height: of the lowest point of its round tip above the sheet at rest [m]",
        "keys [[t, across, down, height], ...], t in seconds, across and down from -1 to 2, height in metres",
    )
    at: tuple[Fraction, Fraction] | Annotated[tuple[tuple[Number, Fraction, Fraction], ...], Field(min_length=1)] = key(
        (0.5, 0.5),
        "control point: fraction of the width from the left, of the height from the top; "
        "or keys [[t, across, down], ...], linear between, held outside",
        "[across, down], fractions from -1 to 2, or keys [[t, across, down], ...]",
    )
    total: Vector | None = key(
        None, "force of the whole tool on a wide sheet at 100 % [N]", "three numbers: [x, y, z] in newtons"
    )
    force: Vector | None = key(
        None,
        "with springs, instead of total: force on one point at 100 %, before decay and offset [N]",
        "three numbers: [x, y, z] in newtons",
    )
    load: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=1)] = key(
        ((0.0, 100.0),),
        "keys [t, percent], linear between; 0 before the first, the last value after the last; "
        "two keys at one time are a jump",
        "keys [[t, percent], ...], t in seconds",
    )
    falloff: NotNegative = key(
        150.0,
        "decay of the force with the distance from the control point, or from the tool's flat end [1/m]",
        "a number, 0 or more, in 1/m",
    )
    radius: NotNegative = key(
        0.0, "radius of the tool's flat end, where the force does not decay [m]", "a number, 0 or more, in m"
    )
    offset: Annotated[Number, Field(ge=-50, le=1000)] = key(
        DEFAULT_OFFSET,
        "with force only: subtracted in the exponent of the decay, so also at the control point",
        "a number, -50 to 1000",
    )
    instrument: Instrument | None = key(
        None,
        "the rod that is drawn for the tool; with path it is what touches the sheet, and required",
        "a mapping with radius, shaft and length",
    )
    friction: NotNegative = key(
        0.0, "with path: Coulomb's coefficient between the instrument and the sheet", "a number, 0 or more"
    )
    grip: tuple[tuple[Number, Number], ...] = key(
        (),
        "with path: times [[from, to], ...] [s] between which the tip holds the tissue that it is at",
        "pairs of times [[from, to], ...], in seconds",
    )

    @property
    def moved(self) -> bool:
        """Whether the tool is moved along a path; else it exerts a force."""
        return self.path is not None

    @field_validator("force", mode="after")
    @classmethod
    def _one_force(cls, force: Vector | None, info: ValidationInfo) -> Vector | None:
        if not {"path", "total"} <= info.data.keys():
            return force  # A fault of its own.
        total = info.data["total"]
        if force is None and total is None and info.data["path"] is None:
            raise refused(
                "missing; expected total (whole tool) or, with springs, force (one point): [x, y, z] in newtons; or "
                "path, for a tool that is moved"
            )
        if force is not None and total is not None:
            raise refused("is given together with total; remove one of them")
        return force

    @field_validator("falloff", "offset", mode="after")
    @classmethod
    def _fit_total(cls, value: float, info: ValidationInfo) -> float:
        if info.data.get("total") is not None:
            if info.field_name == "falloff" and value < SMALLEST:
                raise refused(f"{value:g} would spread total over an infinite area; take a number above 0, in 1/m")
            if info.field_name == "offset" and value != DEFAULT_OFFSET:
                raise refused("goes with force, not with total; remove offset")
        return value

    @field_validator("at", "load", mode="after")
    @classmethod
    def _in_order(cls, keys: tuple[Any, ...]) -> tuple[Any, ...]:
        if not isinstance(keys[0], tuple):
            return keys
        times = [entry[0] for entry in keys]
        for n in range(1, len(times)):
            if times[n] < times[n - 1]:
                raise refused(f"goes back in time, from {times[n - 1]:g} s to {times[n]:g} s; sort the keys by time", n)
            if n > 1 and times[n] == times[n - 2]:
                raise refused(
                    f"third key at {times[n]:g} s; a jump is two keys at one time, so remove the middle one", n
                )
        return keys

    @field_validator("path", mode="after")
    @classmethod
    def _goes_forward(cls, path: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        for n in range(1, len(path or ())):
            assert path is not None
            before, now = path[n - 1][0], path[n][0]
            if now <= before:
                raise refused(
                    f"is at {now:g} s, and the key before it at {before:g} s; sort the keys, each later than the last",
                    n,
                )
        return path

    @field_validator("grip", mode="after")
    @classmethod
    def _one_grip_at_a_time(cls, grip: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for n, (begin, end) in enumerate(grip):
            if end <= begin:
                raise refused(f"ends at {end:g} s, and begins at {begin:g} s; give [from, to] in this order", n)
            if n and begin < grip[n - 1][1]:
                raise refused(f"begins at {begin:g} s, before the grip before it ends; sort them, without overlap", n)
        return grip

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = self.model_fields_set
        if self.path is None:
            for name in _OF_PATH & given:
                if getattr(self, name):
                    raise refused("goes with path; a tool with a force has none", name)
            return self
        for name in sorted(_OF_FORCE & given):
            if getattr(self, name) is not None:
                raise refused("goes with a force, and path gives the place; remove one of them", name)
        if self.instrument is None:
            raise refused("missing; with path expected a mapping with radius, shaft and length", "instrument")
        return self

    @model_serializer(mode="wrap")
    def _own_keys(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the keys of the other kind of tool, which would be refused when they are read again."""
        others = (_OF_PATH | {"path"}) if self.path is None else _OF_FORCE
        return {name: value for name, value in dump(self).items() if name not in others}


class Time(Section):
    """The time span, the frames and the steps."""

    duration: Positive = key(
        ..., "simulated time [s]; duration x frames_per_second is a whole number", "a number above 0, in seconds"
    )
    frames_per_second: Positive = key(25.0, "frames per simulated second", "a number above 0")
    motion: Literal["dynamic", "quasistatic"] = key(
        "dynamic",
        "dynamic: the sheet moves; quasistatic: every frame is the sheet at rest under its loads, and mass, density, "
        "damping and step do not matter",
        "dynamic or quasistatic",
    )
    step: Literal["auto"] | Positive = key(
        "auto",
        "time step [s], a whole fraction of a frame; auto: half the stability limit or less",
        "auto, or a number above 0, in seconds",
    )
    tolerance: Tolerance | None = key(
        None,
        "with step: auto, largest allowed error of any frame due to the step, as a fraction of the largest "
        "displacement; pilot runs find the step",
        f"a number, {SMALLEST_TOLERANCE:g} to {LARGEST_TOLERANCE:g}",
    )
    damping_difference: Literal["central", "backward"] = key(
        "central",
        "finite difference for the velocity in the damping: central is of order 2, backward "
        "(the paper's eq. 3) of order 1",
        "central or backward",
    )
    precision: Literal["auto", "f32", "f64"] = key(
        "auto",
        "floating-point precision; auto: f64 if stepping is a small part of the run, else f32",
        "auto, f32 or f64",
    )

    @property
    def at_rest(self) -> bool:
        """Whether every frame is the sheet at rest."""
        return self.motion == "quasistatic"

    @property
    def frames(self) -> int:
        """F, the number of frame intervals; F + 1 frames are drawn."""
        return round(self.duration * self.frames_per_second)

    @model_validator(mode="after")
    def _whole_frames(self) -> Time:
        frames = self.duration * self.frames_per_second
        if not 0.5 < frames <= 1e9 or abs(frames - round(frames)) > WHOLE:
            nearest = max(1, round(min(frames, 1e9))) / self.frames_per_second
            raise refused(
                f"{self.duration:.12g} s x {self.frames_per_second:.12g} frames per second = {frames:.12g} frames, "
                f"not a whole number up to 1e9; try {nearest:.12g}",
                "duration",
            )
        return self

    @model_validator(mode="after")
    def _one_way_to_the_step(self) -> Time:
        if self.tolerance is not None and self.step != "auto":
            said = f"a tolerance chooses the step, but step is {self.step:.12g}"
            raise refused(f"{said}; set step: auto or remove the tolerance", "tolerance")
        return self

    @model_validator(mode="after")
    def _fits_rest(self) -> Time:
        if self.at_rest and self.tolerance is not None:
            raise refused("is for the time step, and motion: quasistatic takes none; remove the tolerance", "tolerance")
        if self.at_rest and self.precision == "f32":
            raise refused("f32 is too coarse for motion: quasistatic; take auto or f64", "precision")
        return self


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
                raise refused("goes with model: pinhole; a fisheye has k1, k2, k3 and k4", name)
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
                    raise refused(fault, n)
            return poses
        try:
            return read_poses(poses)  # type: ignore[return-value]
        except CameraFileError as error:
            raise refused(str(error)) from None

    @field_validator("eye", "target", "up", mode="after")
    @classmethod
    def _in_order(cls, keys: Any, info: ValidationInfo) -> Any:
        if info.field_name == "eye" and keys is None and not {"beside", "pose", "poses"} & _given(info):
            raise refused("missing; expected " + cls.model_fields["eye"].json_schema_extra["expects"])  # type: ignore
        if keys is None or not isinstance(keys[0], tuple):
            return keys
        for n in range(1, len(keys)):
            if keys[n][0] <= keys[n - 1][0]:
                said = f"is at {keys[n][0]:g} s, and the key before it at {keys[n - 1][0]:g} s"
                raise refused(f"{said}; sort the keys, each later than the last", n)
        return keys

    @model_validator(mode="after")
    def _said_once(self) -> Self:
        given = {name for name in self.model_fields_set if getattr(self, name) is not None}
        if self.beside is not None:
            for name in sorted(given - {"beside", "baseline"}):
                raise refused(
                    "is given together with beside, and a camera beside another is like that; remove it", name
                )
            if self.baseline is None or abs(self.baseline) < SMALLEST:
                what = "missing" if self.baseline is None else f"{self.baseline:g} puts it where {self.beside} is"
                raise refused(f"{what}; expected a number but 0, in metres", "baseline")
        elif self.baseline is not None:
            raise refused("goes with beside, the name of another camera; add it or remove this", "baseline")
        if self.scale and self.calibration is None:
            raise refused("goes with calibration; remove it", "scale")
        if self.outside == "background" and self.distortion is None and self.calibration is None:
            raise refused("goes with distortion; remove it", "outside")
        for ways in (("calibration", "intrinsics", "fov"), ("pose", "poses", "eye"), ("calibration", "distortion")):
            if len(both := [name for name in ways if name in given]) > 1:
                raise refused(f"is given together with {both[0]}; remove one of them", both[1])
        for name in {"target", "up"} & given if {"pose", "poses"} & given else ():
            raise refused("goes with eye; a pose has a direction of its own", name)
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
            raise refused(str(error), "calibration") from None
        if self.scale and found.size is None:
            said = "tells no size of its pictures, so it cannot be scaled; add image_width and image_height"
            raise refused(f"{self.calibration}: {said}, or remove scale", "calibration")
        across, down = (new / old for new, old in zip(size, found.size or size, strict=True))
        if (across, down) != (1, 1) and not self.scale:
            assert found.size is not None
            raise refused(
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
            raise refused(
                f"{self.calibration}: {said} are out of range; calibrate at a size near it", "scale"
            ) from None


def _given(info: ValidationInfo) -> set[str]:
    """Give the names of the keys before this one that have a value, or one at fault."""
    before = list(Camera.model_fields)
    names = before[: before.index(str(info.field_name))]
    return {name for name in names if info.data.get(name, name) is not None}


# A camera as a scene has it.
AnyCamera = Literal["top", "oblique"] | Camera
PRESETS = ("top", "oblique")


class Light(Section):
    """How shading: tissue lights the sheet, from beside the camera."""

    ambient: Share = key(0.2, "share of the light that comes from everywhere", "a number, 0 to 1")
    gloss: Share = key(0.4, "brightness of the wet highlight, as a fraction of white", "a number, 0 to 1")
    relief: Annotated[Number, Field(ge=-MAX_RELIEF, le=MAX_RELIEF)] = key(
        0.0,
        "height of white in the picture above black, in percent of the sheet's larger side",
        f"a number, -{MAX_RELIEF} to {MAX_RELIEF}",
    )
    vignette: Share = key(0.0, "how much darker the picture's corners are", "a number, 0 to 1")


class Render(Section):
    """How a frame is drawn."""

    size: tuple[Pixels, Pixels] = key(
        (512, 512), "width, height of a frame [px]", f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels"
    )
    refine: Annotated[Whole, Field(ge=0, le=MAX_REFINE)] = key(
        10, "points inserted between two neighbours when drawing", f"a whole number, 0 to {MAX_REFINE}"
    )
    camera: AnyCamera = key(
        "top",
        "top: straight down, to scale; oblique: tilted, shows depth; or a pinhole camera",
        "top, oblique, or a mapping: {eye: [x, y, z], target: [x, y, z], up: [x, y, z], fov: degrees}, with pose or "
        "poses in place of eye, and intrinsics or calibration in place of fov",
    )
    cameras: dict[str, AnyCamera] | None = key(
        None,
        "in place of camera: several by name, each with files in a folder of its own; the first is the main one, whose "
        "light is in all pictures",
        "names of a-z, 0-9, _ and -, each with top, oblique, {eye: [x, y, z], ...} or {beside: NAME, baseline: metres}",
    )
    shading: Literal["none", "headlight", "tissue"] = key(
        "headlight",
        "none: the picture's own colours; headlight: lit from the camera; tissue: wet tissue in the light of an "
        "endoscope",
        "none, headlight or tissue",
    )
    light: Light = key(Light(), "the light, with shading: tissue", "a mapping")
    wireframe: StrictBool = key(False, "draw the mass-point mesh over the surface", "true or false")
    supersample: Annotated[Whole, Field(ge=1, le=MAX_SUPERSAMPLE)] = key(
        1, "samples per pixel along each axis", f"a whole number, 1 to {MAX_SUPERSAMPLE}"
    )
    background: tuple[Byte, Byte, Byte] = key(
        (0, 0, 0), "colour where no surface is", "three whole numbers, 0 to 255: [red, green, blue]"
    )
    # Of grasp.yaml, 512 x 512 pixels, 65 % takes 2.5 kB a frame at 40 dB, where a GIF takes 35 kB.
    quality: Annotated[Whole, Field(ge=1, le=100)] = key(
        65, "quality of the film, with output: mp4 [%]", "a whole number, 1 to 100"
    )
    tracks: Annotated[Whole, Field(ge=1, le=MAX_TRACKS)] = key(
        16, "material points along each side of the grid of tracks", f"a whole number, 1 to {MAX_TRACKS}"
    )

    @field_validator("camera", mode="after")
    @classmethod
    def _calibrated(cls, camera: AnyCamera, info: ValidationInfo) -> AnyCamera:
        if isinstance(camera, Camera) and camera.beside is not None:
            raise refused("goes with render.cameras, where the other camera has its name", "beside")
        # A size at fault is reported by itself.
        return camera.calibrated(info.data["size"]) if isinstance(camera, Camera) and "size" in info.data else camera

    @field_validator("cameras", mode="after")
    @classmethod
    def _known_by_name(cls, cameras: dict[str, AnyCamera] | None, info: ValidationInfo) -> dict[str, AnyCamera] | None:
        if cameras is None:
            return None
        if not cameras:
            raise refused("has no camera; add one by its name")
        for name, camera in cameras.items():
            if not re.fullmatch(CAMERA_NAME, name):
                raise refused(f"is no name of a camera; take up to {MAX_NAME} of a-z, 0-9, _ and -", name)
            if name in FOLDERS or name.startswith(EXPORTS):
                raise refused("is the name of a folder that is not a camera's; take another name", name)
            if name in PRESETS and camera != name:
                raise refused("is the name of a camera that any scene has; take another name", name)
            if isinstance(camera, Camera) and camera.beside is not None:
                _require_beside(name, cameras)
        if "size" not in info.data:
            return cameras
        calibrated = {}
        for name, camera in cameras.items():
            try:
                calibrated[name] = camera.calibrated(info.data["size"]) if isinstance(camera, Camera) else camera
            except PydanticCustomError as error:
                raise refused(error.message(), name, *(error.context or {}).get("below", ())) from None
        return calibrated

    @model_validator(mode="before")
    @classmethod
    def _without_null(cls, data: Any) -> Any:
        """Take `camera: null` for none, as an override cannot remove a key."""
        if isinstance(data, Mapping) and data.get("camera", "") is None:
            return {name: value for name, value in data.items() if name != "camera"}
        return data

    @model_validator(mode="after")
    def _one_way_to_the_cameras(self) -> Self:
        if self.cameras is not None and "camera" in self.model_fields_set:
            raise refused("is given together with cameras; remove one of them, or set it to null", "camera")
        return self

    @model_serializer(mode="wrap")
    def _one_kind(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out `camera` beside `cameras`, or the latter if there is none."""
        unused = "cameras" if self.cameras is None else "camera"
        return {name: value for name, value in dump(self).items() if name != unused}

    @property
    def all_cameras(self) -> dict[str, AnyCamera]:
        """The cameras by the folders for what they see: the run's own, which is "", for one without a name."""
        return {"": self.camera} if self.cameras is None else self.cameras

    @property
    def main(self) -> str:
        """The name of the main camera, which has the light; "": the only one, without a name."""
        return next(iter(self.all_cameras))

    @property
    def main_camera(self) -> AnyCamera:
        """The main camera."""
        return self.all_cameras[self.main]

    def with_main(self, camera: AnyCamera) -> Self:
        """Replace the main camera; those beside it follow."""
        if self.cameras is None:
            return self.model_copy(update={"camera": camera})
        return self.model_copy(update={"cameras": {**self.cameras, self.main: camera}})

    def origin(self, name: str) -> tuple[AnyCamera, float]:
        """Give the camera that a named one is like, itself or one that it is beside, and how far that is away [m]."""
        camera, away = self.all_cameras[name], 0.0
        while isinstance(camera, Camera) and camera.beside is not None:
            away += camera.baseline or 0.0
            camera = self.all_cameras[camera.beside]
        return camera, away

    def baseline(self, name: str) -> float:
        """Tell how far the first camera beside a named one is from it [m]; 0: there is none."""
        for camera in self.all_cameras.values():
            if isinstance(camera, Camera) and camera.beside == name and camera.baseline is not None:
                return camera.baseline
        return 0.0


def _require_beside(name: str, cameras: Mapping[str, AnyCamera]) -> None:
    """Make sure that a camera is beside another one that has a place."""
    if name == next(iter(cameras)):
        raise refused("the first camera is the main one, beside no other; put another one first", name, "beside")
    way, camera = [name], cameras[name]
    while isinstance(camera, Camera) and camera.beside is not None:
        other = camera.beside
        if other in way:
            if len(way) == 1:
                raise refused(f"{other} is this camera itself; name another one", name, "beside")
            raise refused(f"goes round, {', '.join([*way, other])}; give one of them an eye", name, "beside")
        if other not in cameras:
            if len(way) > 1:
                return  # It is reported where it is named.
            others = [one for one in cameras if one != name]
            near = did_you_mean(other, others) or f"; the others are {', '.join(others)}"
            raise refused(f"{other}: no camera has this name{near}", name, "beside")
        way.append(other)
        camera = cameras[other]


class Scene(Section):
    """Everything a run needs; what the YAML file says, checked and with its defaults filled in.

    Example:
        >>> from taichi_msm import Scene
        >>> tissue = {"young": 3e4, "thickness": 3e-3, "density": 1050}
        >>> sheet = {"points": [31, 31], "size": [0.1, 0.1]}
        >>> scene = Scene(sheet=sheet, tissue=tissue, time={"duration": 1}, output=["trajectory"])
        >>> scene.time.frames, scene.render.size
        (25, (512, 512))
    """

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["tissue"]}, {"required": ["springs"]}]})

    image: FilePath | None = key(
        None,
        "the picture on the sheet: PNG, JPEG, WebP, BMP or TIFF; relative to the scene file, "
        "in its folder or below; required to draw",
        "the path of a picture",
    )
    region: tuple[Whole, Whole, Whole, Whole] | None = key(
        None,
        "x, y, width, height [px] of the part of the image that the sheet carries; default: all of it",
        "four whole numbers: [x, y, width, height] in pixels",
    )
    sheet: Sheet = key(..., "the sheet of mass points", "a mapping with points and size")
    tissue: Tissue | None = key(None, "what the sheet is made of", "a mapping with young, thickness and density")
    springs: Springs | None = key(None, "instead of tissue: the springs", "a mapping with structural, shear, virtual")
    damping: NotNegative = key(0.0, "with springs: C, force per velocity [N s/m]", "a number, 0 or more, in N s/m")
    probes: Annotated[tuple[Probe, ...], Field(max_length=MAX_PROBES)] = key(
        (),
        "the tools",
        f"a list of at most {MAX_PROBES} mappings with at, total or force, load, or with path and instrument",
    )
    time: Time = key(..., "time span, frames and steps", "a mapping with at least duration")
    render: Render = key(Render(), "how a frame is drawn", "a mapping")
    output: tuple[OutputName, ...] = key(
        ("png", "gif", "trajectory"),
        "what is written besides run.json; [] simulates only",
        f"a list of {', '.join(OUTPUTS)}",
    )

    @property
    def folders(self) -> dict[str, tuple[str, ...]]:
        """The entries of output by their folders: what a camera sees goes to its own, the rest to that of the run."""
        wanted = [output for name, output in OUTPUTS.items() if name in self.output]
        folders = {"": tuple(output.name for output in wanted if not output.is_seen)}
        for camera in self.render.all_cameras:
            has_pair = bool(self.render.baseline(camera))
            seen = (output.name for output in wanted if output.is_seen and (has_pair or not output.of_pair))
            folders[camera] = (*folders.get(camera, ()), *seen)
        return folders

    def asks_for(self, *sources: str) -> bool:
        """Tell whether the values of any output are in one of these fields of `Observed`."""
        return any(OUTPUTS[name].source in sources for name in self.output)

    @property
    def draws(self) -> bool:
        """Whether any output is a picture."""
        return self.asks_for("picture")

    @property
    def labels_pixels(self) -> bool:
        """Whether any output is a label of every pixel."""
        return self.asks_for("labels", "flow", "stereo")

    @property
    def renders(self) -> bool:
        """Whether any output depends on what the camera sees."""
        return any(OUTPUTS[name].is_seen for name in self.output)

    @property
    def has_instruments(self) -> bool:
        """Whether any probe has an instrument, which is drawn."""
        return any(probe.instrument is not None for probe in self.probes)

    @property
    def kind(self) -> Literal["tissue", "springs"]:
        """The section that says what the sheet is made of."""
        return "springs" if self.tissue is None else "tissue"

    @property
    def stiffness_map(self) -> StiffnessMap | None:
        """The map of the springs or the tissue."""
        return self.maps.get("map")

    @property
    def maps(self) -> dict[str, StiffnessMap]:
        """The maps of the springs or the tissue, by the keys that name them: map, foundation_map."""
        return {name: value for name, value in (self.tissue or self.springs or ()) if isinstance(value, StiffnessMap)}

    @property
    def pictures(self) -> dict[str, str]:
        """The paths of the picture and the maps, by the keys that name them, such as image and tissue.map.image."""
        image = {} if self.image is None else {"image": self.image}
        return image | {f"{self.kind}.{name}.image": each.image for name, each in self.maps.items()}

    def with_pictures(self, path: Callable[[str], str]) -> Scene:
        """Give the picture and the maps other paths, each by its present one."""
        maps = {name: each.model_copy(update={"image": path(each.image)}) for name, each in self.maps.items()}
        image = None if self.image is None else path(self.image)
        sheet = self.tissue or self.springs
        material = None if sheet is None else sheet.model_copy(update=maps)
        return self.model_copy(update={"image": image, self.kind: material})

    @model_validator(mode="after")
    def _picture_given(self) -> Scene:
        if self.draws and self.image is None:
            raise refused(
                "a picture is needed to draw png, gif or mp4; name one, or set output to [trajectory] or []", "image"
            )
        return self
