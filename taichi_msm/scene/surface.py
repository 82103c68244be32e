"""Section `sheet.surface`: the sheet at rest, where it is not flat, and the files of heights, points and depths."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, ConfigDict, Field, PrivateAttr, model_validator
from typing_extensions import Self

from taichi_msm.array_files import ArrayFile, quantum, read_array_file, read_raw_array
from taichi_msm.images import PICTURE_SUFFIXES, file_sha256, read_depth, read_grey
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.section import FilePath, NotNegative, Number, Positive, Section, key, scene_fault

if TYPE_CHECKING:
    from numpy.typing import NDArray

METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6}


def _require_radius(value: float) -> float:
    if value == 0:
        raise scene_fault("0 is not allowed; expected a number other than 0, in metres")
    return value


Radius = Annotated[Number, AfterValidator(_require_radius)]
Unit = Literal["m", "mm", "um"] | Positive
_UNIT_EXPECTS = "m, mm, um, or a number above 0, in metres per count, such as 0.01 for cm"


class HeightField(Section):
    """Heights of the sheet from a picture or an array."""

    file: FilePath = key(
        ...,
        "path of a picture, or of an .npy or .npz array, of the heights z over the sheet, first row at the top; "
        "relative to the scene file, in its folder or below",
        "the path of a picture or of an array",
    )
    range: tuple[Number, Number] | None = key(
        None, "of a picture: z at black and at white [m]; linear between", "two numbers: [black, white] in metres"
    )
    unit: Unit | None = key(None, "of an array: its unit", _UNIT_EXPECTS)

    @property
    def is_picture(self) -> bool:
        """Whether the file is a picture."""
        return self.file.lower().endswith(PICTURE_SUFFIXES)

    @cached_property
    def heights(self) -> ArrayFile:
        """Heights z [m], shape (h, w), read once; a PictureError if the file cannot be used."""
        if self.range is not None:
            sha256, (black, white) = file_sha256(self.file), self.range
            grey = read_grey(self.file, sha256)
            largest = 65535 if grey.dtype.itemsize == 2 else 255
            scale = (white - black) / largest
            return ArrayFile(black + scale * grey, sha256, abs(scale) * quantum(grey))
        assert self.unit is not None
        return read_array_file(self.file, metres(self.unit), ("height", "z"), lambda shape: len(shape) == 2, "(h, w)")

    def _unused_keys(self) -> Collection[str]:
        return ("unit",) if self.unit is None else ("range",)

    @model_validator(mode="after")
    def _check_one_scale(self) -> Self:
        if self.is_picture and self.range is None:
            raise scene_fault("missing; with a picture expected [black, white], z in metres", "range")
        if self.is_picture and self.unit is not None:
            raise scene_fault("conflicts with a picture, whose heights are those of range; remove unit", "unit")
        if not self.is_picture and self.unit is None:
            raise scene_fault(f"missing; with an array expected {_UNIT_EXPECTS}", "unit")
        if not self.is_picture and self.range is not None:
            raise scene_fault("conflicts with an array, whose heights are in unit; remove range", "range")
        return self


class Folds(Section):
    """Folds around a tube, like the haustra of a colon."""

    depth: NotNegative = key(..., "height of the folds, inward [m]", "a number, 0 or more, in metres")
    spacing: Positive = key(..., "distance of two folds along the tube [m]", "a number above 0, in metres")


class Tube(Section):
    """A tube about an axis along y."""

    radius: Radius = key(
        ..., "radius [m]; above 0 seen from inside, below 0 from outside", "a number other than 0, in metres"
    )
    folds: Folds | None = key(None, "folds around the tube", "a mapping: {depth: [m], spacing: [m]}")

    @model_validator(mode="after")
    def _check_folds(self) -> Self:
        if self.folds is not None and 0 < self.radius <= self.folds.depth:
            text = f"{self.folds.depth:g} m reach the axis of a tube of {self.radius:g} m; take less than the radius"
            raise scene_fault(text, "folds", "depth")
        return self


class Dome(Section):
    """A part of a sphere."""

    radius: Radius = key(..., "radius [m]; below 0 for a bowl", "a number other than 0, in metres")


class DepthMap(Section):
    """Depth of every pixel of the image, seen by a camera."""

    file: FilePath = key(
        ...,
        "path of a picture of one channel, or of an .npy or .npz array (h, w), or (h, w, 3) of points, of the depth of "
        "every pixel of `image`; 0, the largest integer, NaN and infinity are no depth; relative to the scene file, in "
        "its folder or below",
        "the path of a picture or of an array",
    )
    unit: Unit = key(..., "unit of the file", _UNIT_EXPECTS)
    camera: Annotated[str, Field(strict=True, min_length=1)] | None = key(
        None, "name of the camera, one of render.cameras; default: the main camera", "the name of a camera"
    )
    along: Literal["axis", "ray"] = key(
        "axis", "axis: along the viewing direction; ray: distance from the eye", "axis or ray"
    )
    smooth: Literal["auto"] | NotNegative = key(
        "auto",
        "standard deviation of the smoothing [px]; auto: half the mean side of a cell; 0: none",
        "auto, or a number, 0 or more, in pixels",
    )

    @cached_property
    def numbers(self) -> ArrayFile:
        """Numbers of the file as they are, shape (h, w), read once; a PictureError if it cannot be used."""
        if self.file.lower().endswith(PICTURE_SUFFIXES):
            sha256 = file_sha256(self.file)
            values = read_depth(self.file, sha256)
        else:
            values, sha256 = read_raw_array(
                self.file,
                ("depth", "z"),
                lambda shape: len(shape) == 2 or (len(shape) == 3 and shape[2] == 3),
                "(h, w) or (h, w, 3)",
            )
            values = values[..., 2] if values.ndim == 3 else values
        return ArrayFile(values, sha256, 0.0)

    @property
    def metres(self) -> float:
        """Unit of the file [m]."""
        return metres(self.unit)


class PointGrid(Section):
    """Positions of a grid of points from a file."""

    file: FilePath = key(
        ...,
        "path of an .npy or .npz array (r, c, 3) of x, y and z, rows from the top; of an .npz the key points, or its "
        "only array; relative to the scene file, in its folder or below",
        "the path of an .npy or .npz file",
    )
    unit: Unit = key(..., "unit of the file", _UNIT_EXPECTS)

    @cached_property
    def points(self) -> ArrayFile:
        """Positions [m], shape (r, c, 3), read once; a PictureError if the file cannot be used."""
        return read_array_file(
            self.file,
            metres(self.unit),
            ("points",),
            lambda shape: len(shape) == 3 and shape[2] == 3 and min(shape) > 1,
            "(r, c, 3), at least (2, 2, 3)",
        )


@dataclass(frozen=True)
class KeptGrid:
    """Even grid of a run, compared by its digest."""

    fractions: NDArray[Any] = field(compare=False)  # across and down, shape (rows, cols, 2)
    sha256: str

    @classmethod
    def of(cls, fractions: NDArray[Any]) -> KeptGrid:
        """Return the grid of fractions across and down, shape (rows, cols, 2)."""
        return cls(fractions, hashlib.sha256(fractions.tobytes()).hexdigest())


class Frame(NamedTuple):
    """The picture on a surface that a camera sees at the start, and that camera."""

    cameras: tuple[Camera, ...]  # the camera, then the one that it is `beside`, and so on
    image_size: tuple[int, int]  # width and height of `image`, to which calibrations refer [px]
    region: tuple[int, int, int, int]  # x, y, width and height of the part on the sheet [px]
    points: tuple[int, int]  # rows and columns from which smoothing and grid follow
    is_kept: bool = False  # whether the surface keeps this frame, also with other cameras or mass points
    grid: KeptGrid | None = None  # of `points`, of a run that is repeated or continued; None: by minimisation


KINDS = ("height", "tube", "dome", "depth", "points")


class RestSurface(Section):
    """The sheet at rest, where it is not flat; exactly one of its kinds."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": [name]} for name in KINDS]})

    height: HeightField | None = key(
        None, "heights over the flat sheet", "a mapping with file, and range of a picture or unit of an array"
    )
    tube: Tube | None = key(None, "the sheet is rolled to a tube about an axis along y", "a mapping: {radius: [m]}")
    dome: Dome | None = key(None, "the sheet is a part of a sphere", "a mapping: {radius: [m]}")
    depth: DepthMap | None = key(
        None, "depth of `image`, seen by a camera of the scene", "a mapping with file and unit"
    )
    points: PointGrid | None = key(None, "positions of a grid of points", "a mapping with file and unit")
    grid: Literal["even", "given"] | None = key(
        None,
        "with depth or points. even: mass points are spread over the surface, in cells of one aspect (default of "
        "depth); given: as in the file (default of points)",
        "even or given",
    )
    picture: Annotated[str, Field(strict=True, min_length=1)] | None = key(
        None,
        "with points: name of the camera by whose picture, `image`, the surface is coloured; the main camera without "
        "a name is main; default: the image is spread by rows and columns",
        "the name of a camera",
    )
    # Of a surface with a picture by a camera, set by the scene.
    _frame: Frame | None = PrivateAttr(None)

    @property
    def frame(self) -> Frame | None:
        """The picture by a camera; None where the image is spread by rows and columns."""
        return self._frame

    def with_frame(self, frame: Frame | None) -> RestSurface:
        """Return a copy with another frame."""
        surface = self.model_copy()
        object.__setattr__(surface, "__pydantic_private__", {"_frame": frame})
        return surface

    @property
    def frame_key(self) -> tuple[str, ...] | None:
        """Key of the name of the frame's camera below `surface`; None without a frame."""
        return ("depth", "camera") if self.depth else ("picture",) if self.picture else None

    @property
    def is_even(self) -> bool:
        """Whether the mass points are spread evenly over the surface of the file."""
        return self.grid == "even" or (self.depth is not None and self.grid is None)

    @property
    def _given_kinds(self) -> list[str]:
        """Names of the given kinds."""
        return [name for name in KINDS if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Name of the kind."""
        return self._given_kinds[0]

    @property
    def has_own_size(self) -> bool:
        """Whether the size of the sheet follows from the file."""
        return self.depth is not None or self.points is not None

    @property
    def _file_section(self) -> HeightField | DepthMap | PointGrid | None:
        return self.height or self.depth or self.points

    @cached_property
    def file(self) -> ArrayFile | None:
        """Content of the file, read once; None for a kind without one, and a PictureError if it cannot be used."""
        if self.height:
            return self.height.heights
        return self.depth.numbers if self.depth else self.points.points if self.points else None

    @property
    def file_key(self) -> tuple[str, ...]:
        """Key of the file below `surface`; () for a kind without one."""
        return (self.kind, "file") if self._file_section else ()

    def _unused_keys(self) -> Collection[str]:
        used = {self.kind, *(name for name in ("grid", "picture") if getattr(self, name) is not None)}
        return type(self).model_fields.keys() - used

    @property
    def path(self) -> str:
        """Path of the file; empty for a kind without one."""
        return self._file_section.file if self._file_section else ""

    def with_path(self, path: Callable[[str], str]) -> RestSurface:
        """Return a copy with the path p of the file, if the kind has one, replaced by `path(p)`."""
        section = self._file_section
        if section is None:
            return self
        changed = self.model_copy(update={self.kind: section.model_copy(update={"file": path(section.file)})})
        return changed.with_frame(self.frame)

    @model_validator(mode="after")
    def _check_one_kind(self) -> Self:
        if not self._given_kinds:
            raise scene_fault(f"is empty; expected one of {', '.join(KINDS)}")
        if len(self._given_kinds) > 1:
            raise scene_fault(f"conflicts with {self.kind}; remove one of them", self._given_kinds[1])
        if self.grid is not None and not (self.depth or self.points):
            raise scene_fault(f"needs depth or points; remove it, as {self.kind} has an even grid", "grid")
        if self.picture is not None and not self.points:
            remedy = "set depth.camera" if self.depth else "remove it"
            raise scene_fault(f"needs points; {remedy}", "picture")
        return self


def metres(unit: str | float) -> float:
    """Return a unit in metres."""
    return METRES[unit] if isinstance(unit, str) else unit
