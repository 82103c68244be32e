"""Sections of the tools."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator
from typing_extensions import Self

from taichi_msm.scene.section import (
    DEFAULT_OFFSET,
    MAX_FRACTION,
    MIN_FRACTION,
    MIN_MAGNITUDE,
    NotNegative,
    Number,
    Positive,
    Section,
    SheetFraction,
    Side,
    Vector,
    key,
    require_increasing,
    scene_fault,
)


class Instrument(Section):
    """Solid of a tool: it touches the sheet if the tool is position-controlled, and is only drawn otherwise."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["radius"]}, {"required": ["plate"]}]})

    radius: Positive | None = key(None, "radius of a capsule, with round ends [m]", "a number above 0, in metres")
    plate: Positive | None = key(
        None, "in place of radius: radius of a plate, with flat ends [m]", "a number above 0, in metres"
    )
    shaft: Vector = key(..., "direction from the tip along the axis", "three numbers, not all 0: [x, y, z]")
    length: Positive = key(..., "length of the axis [m]", "a number above 0, in metres")

    @property
    def shape(self) -> str:
        """Name of the shape."""
        return "capsule" if self.plate is None else "plate"

    @property
    def outer_radius(self) -> float:
        """Radius of the shape [m]."""
        radius = self.radius if self.plate is None else self.plate
        assert radius is not None
        return radius

    @field_validator("shaft", mode="after")
    @classmethod
    def _check_not_zero(cls, shaft: Vector) -> Vector:
        if not any(abs(number) >= MIN_MAGNITUDE for number in shaft):
            raise scene_fault("is 0 and has no direction; take one such as [0.3, -0.5, 1]")
        return shaft

    @model_validator(mode="after")
    def _check_one_shape(self) -> Self:
        if self.radius is None and self.plate is None:
            raise scene_fault("missing; expected a number above 0, in metres; or plate, for a flat end", "radius")
        if self.radius is not None and self.plate is not None:
            raise scene_fault("conflicts with radius, for a round end; remove one of them", "plate")
        return self

    def _unused_keys(self) -> Collection[str]:
        return ("radius",) if self.radius is None else ("plate",)


# Keys of force-controlled tools only, and of position-controlled tools only.
_FORCE_KEYS = {"at", "total", "force", "load", "falloff", "radius", "offset"}
_PATH_KEYS = {"friction", "grip"}

# Keyframes: of a path [t, across, down, height], of the path of a clamp [t, x, y, z], and of a control point
# [t, across, down]; t [s], height, x, y and z [m], across and down as fractions of the sheet.
PathKeyframe = tuple[Number, Number, Number, Number]
PointKeyframe = tuple[Number, SheetFraction, SheetFraction]

_PATH_EXPECTS = (
    "keyframes [[t, across, down, height], ...], t in seconds, across and down from -1 to 2, height in metres; or, "
    "with clamp, [[t, x, y, z], ...] in seconds and metres"
)


class Probe(Section):
    """Tool, either force-controlled (eq. 5) or position-controlled along a path: an instrument or a clamp."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": list(names)}
                for names in (("total",), ("force",), ("path", "instrument"), ("path", "clamp"))
            ]
        }
    )

    clamp: Side | None = key(
        None,
        "in place of an instrument: side of the sheet that is held and moved along path",
        "top, bottom, left or right",
    )
    path: Annotated[tuple[PathKeyframe, ...], Field(min_length=1)] | None = key(
        None,
        "in place of a force: keyframes [[t, across, down, height], ...] of the instrument's tip, height of its lowest "
        "point above the sheet at rest [m]; or keyframes [[t, x, y, z], ...] of the displacement of a clamp [m], the "
        "first one [0, 0, 0, 0]; linear between, constant outside",
        _PATH_EXPECTS,
    )
    at: tuple[SheetFraction, SheetFraction] | Annotated[tuple[PointKeyframe, ...], Field(min_length=1)] = key(
        (0.5, 0.5),
        "control point [across, down], as fractions of the width from the left and of the height from the top; or its "
        "keyframes [[t, across, down], ...], linear between, constant outside",
        "[across, down], fractions from -1 to 2, or keyframes [[t, across, down], ...]",
    )
    total: Vector | Number | None = key(
        None,
        "total force of the tool on a wide sheet at 100 % [N]; a number is along the normal of the sheet at rest at "
        "the control point",
        "three numbers, [x, y, z] in newtons, or a number",
    )
    force: Vector | Number | None = key(
        None,
        "with springs, instead of total: force on a mass point at 100 %, before decay and offset [N]",
        "three numbers, [x, y, z] in newtons, or a number",
    )
    load: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=1)] = key(
        ((0.0, 100.0),),
        "keyframes [t, percent], linear between; 0 before the first, the last value after the last; "
        "two keyframes at the same time are a jump",
        "keyframes [[t, percent], ...], t in seconds",
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
        "with force only: number subtracted from the exponent of the decay, at every distance",
        "a number, -50 to 1000",
    )
    instrument: Instrument | None = key(
        None,
        "solid of the tool, which is drawn; required with path, where it touches the sheet",
        "a mapping with radius or plate, shaft and length",
    )
    friction: Literal["rough"] | NotNegative = key(
        0.0,
        "with path: Coulomb's coefficient between the instrument and the sheet; or, in quasi-static scenes, rough: "
        "points stick to the instrument at first touch",
        "a number, 0 or more, or rough",
    )
    grip: tuple[tuple[Number, Number], ...] = key(
        (),
        "with path: times [[from, to], ...] [s] between which the tip holds the tissue below it",
        "pairs of times [[from, to], ...], in seconds",
    )

    @property
    def moved(self) -> bool:
        """Whether the tool is position-controlled, by a path, rather than force-controlled."""
        return self.path is not None

    @property
    def vector(self) -> Vector | None:
        """Force or total as x, y and z [N], a number along z; None with a path."""
        force = self.force if self.total is None else self.total
        return force if force is None or isinstance(force, tuple) else (0.0, 0.0, force)

    @property
    def is_normal(self) -> bool:
        """Whether the force is a number, along the normal of the sheet at rest."""
        return isinstance(self.total if self.force is None else self.force, float)

    def with_force(self, factor: float) -> Probe:
        """Return a copy with a multiple of its total."""
        total = self.total
        if total is None:
            return self
        scaled = tuple(factor * part for part in total) if isinstance(total, tuple) else factor * total
        return self.model_copy(update={"total": scaled})

    @field_validator("force", mode="after")
    @classmethod
    def _check_one_force(cls, force: Vector | float | None, info: ValidationInfo) -> Vector | float | None:
        if not {"clamp", "path", "total"} <= info.data.keys():
            return force  # A fault of these keys is reported separately.
        total = info.data["total"]
        if force is None and total is None and info.data["path"] is None and info.data["clamp"] is None:
            raise scene_fault(
                "missing; expected total (whole tool) or, with springs, force (one point): [x, y, z] in newtons; or "
                "path, for a position-controlled tool"
            )
        if force is not None and total is not None:
            raise scene_fault("conflicts with total; remove one of them")
        return force

    @field_validator("falloff", "offset", mode="after")
    @classmethod
    def _check_fits_total(cls, value: float, info: ValidationInfo) -> float:
        if info.data.get("total") is not None:
            if info.field_name == "falloff" and value < MIN_MAGNITUDE:
                raise scene_fault(f"{value:g} would spread total over an infinite area; take a number above 0, in 1/m")
            if info.field_name == "offset" and value != DEFAULT_OFFSET:
                raise scene_fault("requires force, and total is given; remove offset")
        return value

    @field_validator("at", "load", mode="after")
    @classmethod
    def _check_order(cls, keyframes: tuple[Any, ...]) -> tuple[Any, ...]:
        if not isinstance(keyframes[0], tuple):
            return keyframes  # A constant control point.
        times = [keyframe[0] for keyframe in keyframes]
        for n in range(1, len(times)):
            if times[n] < times[n - 1]:
                raise scene_fault(
                    f"is at {times[n]:g} s, the previous keyframe at {times[n - 1]:g} s; sort the keyframes by time",
                    n,
                )
            if n > 1 and times[n] == times[n - 2]:
                raise scene_fault(
                    f"third keyframe at {times[n]:g} s; a jump has two keyframes at one time, remove the middle one", n
                )
        return keyframes

    @field_validator("path", mode="after")
    @classmethod
    def _check_path(
        cls, path: tuple[PathKeyframe, ...] | None, info: ValidationInfo
    ) -> tuple[PathKeyframe, ...] | None:
        require_increasing(path or ())
        for n, keyframe in enumerate(path or ()):
            for axis in (1, 2):
                if info.data.get("clamp", "") is None and not MIN_FRACTION <= keyframe[axis] <= MAX_FRACTION:
                    raise scene_fault(f"{keyframe[axis]:g} is not allowed; expected {_PATH_EXPECTS}", n, axis)
        return path

    @field_validator("grip", mode="after")
    @classmethod
    def _check_grips_are_separate(cls, grip: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for n, (begin, end) in enumerate(grip):
            if end <= begin:
                raise scene_fault(f"ends at {end:g} s, and begins at {begin:g} s; write [from, to] in this order", n)
            if n and begin < grip[n - 1][1]:
                raise scene_fault(
                    f"begins at {begin:g} s, before the previous grip ends; sort the grips, without overlap", n
                )
        return grip

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        given = self.model_fields_set
        if self.clamp is not None:
            if self.path is None:
                raise scene_fault("missing; with clamp expected keyframes [[t, x, y, z], ...], t in seconds", "path")
            for name in sorted((_FORCE_KEYS | _PATH_KEYS | {"instrument"}) & given):
                if getattr(self, name) not in (None, 0.0, ()):
                    raise scene_fault("conflicts with clamp, which has only a path; remove one of them", name)
            return self
        if self.path is None:
            for name in _PATH_KEYS & given:
                if getattr(self, name):
                    raise scene_fault(f"requires path; remove {name} from a tool with a force", name)
            return self
        names = [name for name in sorted(_FORCE_KEYS & given) if getattr(self, name) is not None]
        if names:
            them = f"them: {', '.join(names)}" if len(names) > 1 else "one of them"
            raise scene_fault(f"requires a force, and path replaces it; remove {them}", names[0])
        if self.instrument is None:
            raise scene_fault("missing; with path expected a mapping with radius, shaft and length", "instrument")
        return self

    def _unused_keys(self) -> Collection[str]:
        if self.clamp is not None:
            return _FORCE_KEYS | _PATH_KEYS | {"instrument"}
        return _FORCE_KEYS | {"clamp"} if self.path is not None else _PATH_KEYS | {"clamp", "path"}
