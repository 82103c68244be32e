"""Section `sheet.surface`: the sheet at rest, where it is not flat, and the files of its heights and points."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cached_property
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, model_validator
from typing_extensions import Self

from taichi_msm.array_files import ArrayFile, quantum, read_array_file
from taichi_msm.images import PICTURE_SUFFIXES, file_sha256, read_grey
from taichi_msm.scene.section import FilePath, NotNegative, Number, Positive, Section, key, scene_fault

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


class RestSurface(Section):
    """The sheet at rest, where it is not flat; exactly one of its kinds."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": [name]} for name in ("height", "tube", "dome", "points")]}
    )

    height: HeightField | None = key(
        None, "heights over the flat sheet", "a mapping with file, and range of a picture or unit of an array"
    )
    tube: Tube | None = key(None, "the sheet is rolled to a tube about an axis along y", "a mapping: {radius: [m]}")
    dome: Dome | None = key(None, "the sheet is a part of a sphere", "a mapping: {radius: [m]}")
    points: PointGrid | None = key(None, "positions of a grid of points", "a mapping with file and unit")

    @property
    def _given_kinds(self) -> list[str]:
        """Names of the given kinds."""
        # Iteration over a model would include its cached properties.
        return [name for name in type(self).model_fields if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Name of the kind."""
        return self._given_kinds[0]

    @cached_property
    def file(self) -> ArrayFile | None:
        """Content of the file, read once; None for a kind without one, and a PictureError if it cannot be used."""
        return self.height.heights if self.height else self.points.points if self.points else None

    @property
    def file_key(self) -> tuple[str, ...]:
        """Key of the file below `surface`; () for a kind without one."""
        return (self.kind, "file") if self.height or self.points else ()

    def _unused_keys(self) -> Collection[str]:
        return type(self).model_fields.keys() - {self.kind}

    @property
    def path(self) -> str:
        """Path of the file; empty for a kind without one."""
        section = self.height or self.points
        return section.file if section else ""

    def with_path(self, path: Callable[[str], str]) -> RestSurface:
        """Return a copy with the path p of the file, if the kind has one, replaced by `path(p)`."""
        section = self.height or self.points
        if section is None:
            return self
        return self.model_copy(update={self.kind: section.model_copy(update={"file": path(section.file)})})

    @model_validator(mode="after")
    def _check_one_kind(self) -> Self:
        if not self._given_kinds:
            raise scene_fault("is empty; expected one of height, tube, dome, points")
        if len(self._given_kinds) > 1:
            raise scene_fault(f"conflicts with {self.kind}; remove one of them", self._given_kinds[1])
        return self


def metres(unit: str | float) -> float:
    """Return a unit in metres."""
    return METRES[unit] if isinstance(unit, str) else unit
