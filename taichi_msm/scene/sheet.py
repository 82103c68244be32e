"""taichi_msm.scene.scene.sheet."""

from __future__ import annotations

from typing import Literal

from taichi_msm.scene.section import (
    MAX_POINTS,
    MAX_TOLERANCE,
    MIN_TOLERANCE,
    FilePath,
    NodeCount,
    NotNegative,
    Positive,
    Section,
    Side,
    Tolerance,
    key,
)


class Sheet(Section):
    """The sheet of mass points."""

    points: tuple[NodeCount, NodeCount] = key(
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
        f"a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}",
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
