"""Sections of the sheet and its material: springs or tissue."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from taichi_msm.images import DECODING_BYTES, PictureError, file_sha256, picture_size, read_grey, require_memory
from taichi_msm.laws.locking import Locking
from taichi_msm.scene.section import (
    MAX_PATH,
    MAX_POINTS,
    MAX_TOLERANCE,
    MIN_TOLERANCE,
    FilePath,
    NodeCount,
    NotNegative,
    Number,
    OpenUnitInterval,
    Positive,
    Section,
    Tolerance,
    key,
    scene_fault,
)
from taichi_msm.scene.surface import KINDS, KeptGrid, PointGrid, RestSurface

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


# Edges that can be fixed.
Edge = Literal["top", "bottom", "left", "right", "outline"]


@dataclass(frozen=True, eq=False)
class MaskPixels:
    """Pixels of a mask, compared by identity, as arrays have no one ==."""

    is_sheet: NDArray[np.bool_]  # shape (height, width)
    sha256: str  # of the file


class SheetMask(Section):
    """Picture of the parts of the rectangle that are sheet; in a scene its path stands for a mapping with image."""

    image: FilePath = key(
        ...,
        "path of a picture, white where there is sheet; relative to the scene file, in its folder or below",
        "the path of a picture",
    )
    invert: bool = key(False, "whether black is sheet instead of white", "true or false")

    @model_validator(mode="before")
    @classmethod
    def _accept_path(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        if not 0 < len(data) <= MAX_PATH:
            raise scene_fault("expected the path of a picture, or a mapping with image and invert")
        return {"image": data}

    @cached_property
    def pixels(self) -> MaskPixels:
        """Pixels, read once; a PictureError if the file cannot be used."""
        sha256, (width, height) = file_sha256(self.image), picture_size(self.image)
        require_memory(self.image, DECODING_BYTES * width * height, "scale it down")
        grey = read_grey(self.image, sha256)
        # White is 128 and more, of 16 bits 32768.
        return MaskPixels((grey >> (8 * grey.dtype.itemsize - 1) == 1) != self.invert, sha256)


def _complete_schema(schema: dict[str, Any]) -> None:
    """Add to the schema of a sheet what its validators allow.

    With surface.points and depth, the size is not allowed, and the number of points is that of the file by default.
    """
    schema |= {"required": [], "anyOf": [{"required": ["points", "size"]}, {"required": ["surface"]}]}
    schema["properties"]["mask"]["anyOf"].insert(0, {"type": "string", "minLength": 1, "maxLength": MAX_PATH})


class Sheet(Section):
    """Sheet of mass points."""

    model_config = ConfigDict(json_schema_extra=_complete_schema)

    points: tuple[NodeCount, NodeCount] = key(
        ...,
        "rows, columns of mass points; with surface.points by default those of its file",
        f"two whole numbers, 2 to {MAX_POINTS}: [rows, cols]",
    )
    size: tuple[Positive, Positive] = key(
        ...,
        "height, width of the sheet at rest, with a surface of the flat sheet that is bent [m]; not with "
        "surface.depth and points, which have their own",
        "two numbers above 0: [height, width] in metres",
    )
    surface: RestSurface | None = key(
        None, "the sheet at rest, where it is not flat", "a mapping with one of height, tube, dome, depth, points"
    )
    mass: Positive | None = key(
        None,
        "mass of a mass point [kg]; required with springs unless motion is quasistatic",
        "a number above 0, in kg",
    )
    fixed: (
        Literal["border", "outline", "corners", "none"]
        | tuple[Literal["top", "bottom", "left", "right", "outline"], ...]
    ) = key(
        "border",
        "the mass points that never move; border and sides are those of the rectangle, outline all points of fewer "
        "than four cells",
        "border, outline, corners, none, or a list of top, bottom, left, right, outline",
    )
    mask: SheetMask | None = key(
        None,
        "with tissue: picture of the parts of the rectangle that are sheet, white where there is sheet; the path of "
        "the picture, or a mapping to invert it",
        "the path of a picture, or a mapping with image and invert",
    )
    tolerance: Tolerance | None = key(
        None,
        "with tissue: largest allowed discretisation error (mesh), as a fraction of the largest displacement; "
        "companion runs find the number of mass points",
        f"a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}",
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_sizes(cls, data: Any) -> Any:
        """Add to `surface.points` the number of points of its file, unless it is given, and an unused size."""
        surface = data.get("surface") if isinstance(data, Mapping) else None
        names_kind = surface.keys() & KINDS if isinstance(surface, Mapping) else isinstance(surface, RestSurface)
        if surface is not None and not names_kind:
            return {"points": (2, 2), "size": (1.0, 1.0), **data}  # The fault of the surface comes alone.
        grid, depth = (
            surface.get(name) if isinstance(surface, Mapping) else getattr(surface, name, None)
            for name in ("points", "depth")
        )
        if grid is None and depth is None:
            return data
        if "size" in data:
            kind, owner = ("depth", "the surface") if grid is None else ("points", "its points")
            raise scene_fault(f"conflicts with surface.{kind}, whose size is that of {owner}; remove size", "size")
        points = data.get("points")
        if points is None and grid is not None:
            try:
                grid = grid if isinstance(grid, PointGrid) else PointGrid.model_validate(grid)
                points = grid.points.values.shape[:2]
            except PictureError as error:
                raise scene_fault(str(error), "surface", "points", "file") from None
            except ValidationError:
                points = (2, 2)  # The faults of the section come alone.
            if max(points) > MAX_POINTS:
                text = (
                    f"{grid.file} has {points[0]} x {points[1]} points; set sheet.points, at most {MAX_POINTS} a side"
                )
                raise scene_fault(text, "surface", "points", "file")
        return {**data, **({} if points is None else {"points": points}), "size": (1.0, 1.0)}

    @model_validator(mode="after")
    def _check_surface(self) -> Self:
        surface, (height, width) = self.surface, self.size
        if surface is None:
            return self
        if surface.has_own_size:
            # It is not given.
            self.__pydantic_fields_set__.discard("size")
        if surface.tube and width > 2 * math.pi * abs(surface.tube.radius) * (1 + 1e-9):
            radius = surface.tube.radius
            text = f"{radius:g} m is too small to roll a width of {width:g} m"
            raise scene_fault(f"{text}; {_remedy(radius, width / 2 / math.pi)}", "surface", "tube", "radius")
        if surface.dome and max(height, width) / 2 > math.pi / 4 * abs(surface.dome.radius) * (1 + 1e-9):
            radius, side = surface.dome.radius, max(height, width)
            text = f"{radius:g} m is too small for a side of {side:g} m"
            raise scene_fault(f"{text}; {_remedy(radius, 2 * side / math.pi)}", "surface", "dome", "radius")
        return self

    def _unused_keys(self) -> Collection[str]:
        unused = ("size",) if self.surface and self.surface.has_own_size else () if self.surface else ("surface",)
        return unused if self.mask else (*unused, "mask")

    @property
    def files(self) -> dict[str, str]:
        """Paths of the files of surface and mask, by dotted key of the scene."""
        surface, mask = self.surface, self.mask
        files = {".".join(("sheet", "surface", *surface.file_key)): surface.path} if surface and surface.path else {}
        return files | ({"sheet.mask.image": mask.image} if mask else {})

    def with_files(self, path: Callable[[str], str]) -> Sheet:
        """Return a copy with the path p of each file of surface and mask replaced by `path(p)`."""
        changes: dict[str, Any] = {}
        if self.surface:
            changes["surface"] = self.surface.with_path(path)
        if self.mask:
            changes["mask"] = self.mask.model_copy(update={"image": path(self.mask.image)})
        return self.model_copy(update=changes) if changes else self

    def with_kept_frame(self) -> Sheet:
        """Return a copy for another mesh or other cameras, which keeps the surface of a file."""
        if self.surface is None or self.surface.frame is None:
            return self
        frame = self.surface.frame._replace(is_kept=True)
        return self.model_copy(update={"surface": self.surface.with_frame(frame)})

    def with_frozen_surface(self, smooth: float | None, grid: KeptGrid | None) -> Sheet:
        """Return a copy whose surface of a file follows from its own mass points, as a run has used it.

        Args:
            smooth: standard deviation in place of that of a depth map [px]; None for no change.
            grid: even grid, of as many mass points as the sheet's; None to minimise it, or for a grid as in the file.
        """
        surface = self.surface
        if surface is None or surface.frame is None:
            return self
        frame = surface.frame._replace(points=self.points, is_kept=True, grid=grid)
        if surface.depth and smooth is not None:
            surface = surface.model_copy(update={"depth": surface.depth.model_copy(update={"smooth": smooth})})
        return self.model_copy(update={"surface": surface.with_frame(frame)})

    @property
    def unit_hint(self) -> str:
        """Warning about a size that is probably in millimetres; empty for a sheet of up to 5 m."""
        height, width = self.size
        if max(height, width) <= 5.0:
            return ""
        remedy = f"if these are millimetres, take [{height / 1000:g}, {width / 1000:g}]"
        return f"sheet.size: {height:g} x {width:g} m is large for tissue; {remedy}"


def _remedy(radius: float, least: float) -> str:
    """Return the remedy for a radius of the right sign that is too small, with a number that 4 digits do not lower."""
    limit = f"at least {1.0005 * least:.4g}" if radius > 0 else f"at most {-1.0005 * least:.4g}"
    return f"take {limit} m, or a smaller sheet.size"


class StiffnessMap(Section):
    """Image over the whole sheet, whose grey values are factors of the stiffness."""

    image: FilePath = key(
        ...,
        "path of a picture, whose grey values are factors; relative to the scene file, in its folder or below",
        "the path of a picture",
    )
    range: tuple[Positive, Positive] = key(
        ...,
        "factor of the stiffness at black and at white; linear between",
        "two numbers above 0: [black, white]",
    )


class Springs(Section):
    """Stiffness of each family of springs, per spring, as in the paper; a family with stiffness 0 is absent."""

    structural: NotNegative = key(0.0, "springs to the 4 nearest neighbours [N/m]", "a number, 0 or more, in N/m")
    shear: NotNegative = key(0.0, "springs to the 4 diagonal neighbours [N/m]", "a number, 0 or more, in N/m")
    virtual: NotNegative = key(
        0.0, "springs from each mass point to its rest position [N/m]", "a number, 0 or more, in N/m"
    )
    virtual_active: Literal["loaded", "always"] = key(
        "loaded",
        "loaded: the virtual springs act while the load of any probe is not 0; always: at all times",
        "loaded or always",
    )
    map: StiffnessMap | None = key(None, "map of factors of structural and shear", "a mapping with image and range")


_FACTOR = Locking.keys["factor"]
Factor = Annotated[Number, Field(ge=_FACTOR.least, le=_FACTOR.most)]


class Stiffening(Section):
    """Tissue that locks when it is stretched: its stiffness grows with the strain, up to a factor."""

    lock: Positive = key(..., "strain at which the springs lock", "a number above 0, a strain without a unit")
    factor: Factor = key(_FACTOR.default, _FACTOR.meaning, _FACTOR.expected)


class RelaxationBranch(Section):
    """Branch of the stress relaxation."""

    share: OpenUnitInterval = key(..., "share of the elastic forces that relaxes", "a number above 0 and below 1")
    time: Positive = key(..., "relaxation time [s]", "a number above 0, in s")


class Foundation(Section):
    """Elastic (Winkler) foundation of a layer of tissue: stiffness young / depth, force per area and displacement."""

    young: Positive = key(..., "Young's modulus of the tissue below the sheet [Pa]", "a number above 0, in Pa")
    depth: Positive = key(..., "depth of the tissue below the sheet [m]", "a number above 0, in metres")
    lock: Positive | None = key(
        None, "depth of indentation at which the foundation locks [m]", "a number above 0, in metres"
    )
    factor: Factor = key(_FACTOR.default, f"with lock: {_FACTOR.meaning}", _FACTOR.expected)

    def _unused_keys(self) -> Collection[str]:
        return () if self.lock else ("lock", "factor")

    @model_validator(mode="after")
    def _check_factor(self) -> Self:
        if self.lock is None and "factor" in self.model_fields_set:
            raise scene_fault("requires lock; add lock, a depth in metres, or remove factor", "factor")
        return self


class Tissue(Section):
    """Tissue in physical units: a sheet in plane stress with Poisson's ratio 1/3, for any number of mass points."""

    young: Positive = key(..., "Young's modulus E [Pa]", "a number above 0, in Pa")
    thickness: Positive = key(..., "thickness t of the sheet [m]", "a number above 0, in metres")
    density: Positive | None = key(
        None, "density [kg/m3]; required unless motion is quasistatic", "a number above 0, in kg/m3"
    )
    foundation: NotNegative | Foundation = key(
        0.0,
        "stiffness of the elastic (Winkler) foundation, force per area and displacement [N/m3]; or young and depth of "
        "the tissue below the sheet, with the stiffness young / depth",
        "a number, 0 or more, in N/m3, or {young: [Pa], depth: [m]}",
    )
    foundation_active: Literal["loaded", "always"] = key(
        "loaded",
        "loaded: the foundation acts while the load of any probe is not 0; always: at all times",
        "loaded or always",
    )
    damping: NotNegative = key(0.0, "damping per mass, C / m [1/s]", "a number, 0 or more, in 1/s")
    pretension: NotNegative = key(
        0.0, "tension S of the sheet at rest [N/m]; all sides must be fixed or clamped", "a number, 0 or more, in N/m"
    )
    bending: Literal["plate"] | NotNegative = key(
        0.0,
        "bending stiffness D [N m]; plate: E t^3 / (12 (1 - nu^2)); all sides must be fixed or clamped, and are hinged",
        "plate, or a number, 0 or more, in N m",
    )
    stiffening: Stiffening | None = key(
        None, "stiffness that grows with the strain", "a mapping: {lock: [a strain], factor: [default 10]}"
    )
    relaxation: tuple[RelaxationBranch, ...] = key(
        (),
        "stress relaxation of all elastic forces, in up to 4 branches, whose shares sum to less than 1; a foundation "
        "must always be active",
        "a list of up to 4 mappings: [{share: [0 to 1], time: [s]}, ...]",
    )
    map: StiffnessMap | None = key(None, "map of factors of young", "a mapping with image and range")
    foundation_map: StiffnessMap | None = key(
        None, "map of factors of the foundation", "a mapping with image and range"
    )

    @property
    def unit_hint(self) -> str:
        """Warning about a thickness that is probably in millimetres; empty for a sheet of up to 0.1 m."""
        if self.thickness <= 0.1:
            return ""
        remedy = f"if this is in millimetres, take {self.thickness / 1000:g}"
        return f"tissue.thickness: {self.thickness:g} m is thick for a sheet of tissue; {remedy}"

    @property
    def foundation_stiffness(self) -> float:
        """Stiffness of the foundation before its map of factors [N/m3]."""
        foundation = self.foundation
        return foundation.young / foundation.depth if isinstance(foundation, Foundation) else foundation
