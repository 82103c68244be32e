"""taichi_msm.scene.scene.tools."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from typing_extensions import Self

from taichi_msm.scene.section import (
    DEFAULT_OFFSET,
    MIN_MAGNITUDE,
    NotNegative,
    Number,
    Positive,
    Section,
    SheetFraction,
    Vector,
    key,
    scene_fault,
)


class Instrument(Section):
    """A metal rod with a rounded tip: what touches the sheet along a path; of a force what is drawn at its place."""

    radius: Positive = key(..., "radius of the rod [m]", "a number above 0, in metres")
    shaft: Vector = key(..., "direction from the tip along the rod", "three numbers, not all 0: [x, y, z]")
    length: Positive = key(..., "length of the rod [m]", "a number above 0, in metres")

    @field_validator("shaft", mode="after")
    @classmethod
    def _leads_somewhere(cls, shaft: Vector) -> Vector:
        if not any(abs(number) >= MIN_MAGNITUDE for number in shaft):
            raise scene_fault("has no direction; take one such as [0.3, -0.5, 1]")
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

    path: Annotated[tuple[tuple[Number, SheetFraction, SheetFraction, Number], ...], Field(min_length=1)] | None = key(
        None,
        "in place of a force: where the instrument is; keys [[t, across, down, height], ...], linear between, held "
        "outside; height: of the lowest point of its round tip above the sheet at rest [m]",
        "keys [[t, across, down, height], ...], t in seconds, across and down from -1 to 2, height in metres",
    )
    at: (
        tuple[SheetFraction, SheetFraction]
        | Annotated[tuple[tuple[Number, SheetFraction, SheetFraction], ...], Field(min_length=1)]
    ) = key(
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
            raise scene_fault(
                "missing; expected total (whole tool) or, with springs, force (one point): [x, y, z] in newtons; or "
                "path, for a tool that is moved"
            )
        if force is not None and total is not None:
            raise scene_fault("is given together with total; remove one of them")
        return force

    @field_validator("falloff", "offset", mode="after")
    @classmethod
    def _fit_total(cls, value: float, info: ValidationInfo) -> float:
        if info.data.get("total") is not None:
            if info.field_name == "falloff" and value < MIN_MAGNITUDE:
                raise scene_fault(f"{value:g} would spread total over an infinite area; take a number above 0, in 1/m")
            if info.field_name == "offset" and value != DEFAULT_OFFSET:
                raise scene_fault("goes with force, not with total; remove offset")
        return value

    @field_validator("at", "load", mode="after")
    @classmethod
    def _in_order(cls, keys: tuple[Any, ...]) -> tuple[Any, ...]:
        if not isinstance(keys[0], tuple):
            return keys
        times = [entry[0] for entry in keys]
        for n in range(1, len(times)):
            if times[n] < times[n - 1]:
                raise scene_fault(
                    f"goes back in time, from {times[n - 1]:g} s to {times[n]:g} s; sort the keys by time", n
                )
            if n > 1 and times[n] == times[n - 2]:
                raise scene_fault(
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
                raise scene_fault(
                    f"is at {now:g} s, and the key before it at {before:g} s; sort the keys, each later than the last",
                    n,
                )
        return path

    @field_validator("grip", mode="after")
    @classmethod
    def _one_grip_at_a_time(cls, grip: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for n, (begin, end) in enumerate(grip):
            if end <= begin:
                raise scene_fault(f"ends at {end:g} s, and begins at {begin:g} s; give [from, to] in this order", n)
            if n and begin < grip[n - 1][1]:
                raise scene_fault(
                    f"begins at {begin:g} s, before the grip before it ends; sort them, without overlap", n
                )
        return grip

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = self.model_fields_set
        if self.path is None:
            for name in _OF_PATH & given:
                if getattr(self, name):
                    raise scene_fault("goes with path; a tool with a force has none", name)
            return self
        for name in sorted(_OF_FORCE & given):
            if getattr(self, name) is not None:
                raise scene_fault("goes with a force, and path gives the place; remove one of them", name)
        if self.instrument is None:
            raise scene_fault("missing; with path expected a mapping with radius, shaft and length", "instrument")
        return self

    @model_serializer(mode="wrap")
    def _own_keys(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the keys of the other kind of tool, which would be refused when they are read again."""
        others = (_OF_PATH | {"path"}) if self.path is None else _OF_FORCE
        return {name: value for name, value in dump(self).items() if name not in others}
