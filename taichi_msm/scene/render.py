"""taichi_msm.scene.scene.render."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    StrictBool,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from taichi_msm.errors import did_you_mean
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.outputs import CAMERA_NAME, EXPORT_PREFIX, MAX_CAMERA_NAME, SERIES_FOLDERS
from taichi_msm.scene.section import (
    MAX_PIXELS,
    MAX_REFINE,
    MAX_RELIEF,
    MAX_SUPERSAMPLE,
    MAX_TRACKS,
    Byte,
    Integer,
    Number,
    Pixels,
    Section,
    UnitInterval,
    key,
    scene_fault,
)

# A camera as a scene has it.
AnyCamera = Literal["top", "oblique"] | Camera
PRESETS = ("top", "oblique")


class Light(Section):
    """How shading: tissue lights the sheet, from beside the camera."""

    ambient: UnitInterval = key(0.2, "share of the light that comes from everywhere", "a number, 0 to 1")
    gloss: UnitInterval = key(0.4, "brightness of the wet highlight, as a fraction of white", "a number, 0 to 1")
    relief: Annotated[Number, Field(ge=-MAX_RELIEF, le=MAX_RELIEF)] = key(
        0.0,
        "height of white in the picture above black, in percent of the sheet's larger side",
        f"a number, -{MAX_RELIEF} to {MAX_RELIEF}",
    )
    vignette: UnitInterval = key(0.0, "how much darker the picture's corners are", "a number, 0 to 1")


class Render(Section):
    """How a frame is drawn."""

    size: tuple[Pixels, Pixels] = key(
        (512, 512), "width, height of a frame [px]", f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels"
    )
    refine: Annotated[Integer, Field(ge=0, le=MAX_REFINE)] = key(
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
    supersample: Annotated[Integer, Field(ge=1, le=MAX_SUPERSAMPLE)] = key(
        1, "samples per pixel along each axis", f"a whole number, 1 to {MAX_SUPERSAMPLE}"
    )
    background: tuple[Byte, Byte, Byte] = key(
        (0, 0, 0), "colour where no surface is", "three whole numbers, 0 to 255: [red, green, blue]"
    )
    # Of grasp.yaml, 512 x 512 pixels, 65 % takes 2.5 kB a frame at 40 dB, where a GIF takes 35 kB.
    quality: Annotated[Integer, Field(ge=1, le=100)] = key(
        65, "quality of the film, with output: mp4 [%]", "a whole number, 1 to 100"
    )
    tracks: Annotated[Integer, Field(ge=1, le=MAX_TRACKS)] = key(
        16, "material points along each side of the grid of tracks", f"a whole number, 1 to {MAX_TRACKS}"
    )

    @field_validator("camera", mode="after")
    @classmethod
    def _calibrated(cls, camera: AnyCamera, info: ValidationInfo) -> AnyCamera:
        if isinstance(camera, Camera) and camera.beside is not None:
            raise scene_fault("goes with render.cameras, where the other camera has its name", "beside")
        # A size at fault is reported by itself.
        return camera.calibrated(info.data["size"]) if isinstance(camera, Camera) and "size" in info.data else camera

    @field_validator("cameras", mode="after")
    @classmethod
    def _known_by_name(cls, cameras: dict[str, AnyCamera] | None, info: ValidationInfo) -> dict[str, AnyCamera] | None:
        if cameras is None:
            return None
        if not cameras:
            raise scene_fault("has no camera; add one by its name")
        for name, camera in cameras.items():
            if not re.fullmatch(CAMERA_NAME, name):
                raise scene_fault(f"is no name of a camera; take up to {MAX_CAMERA_NAME} of a-z, 0-9, _ and -", name)
            if name in SERIES_FOLDERS or name.startswith(EXPORT_PREFIX):
                raise scene_fault("is the name of a folder that is not a camera's; take another name", name)
            if name in PRESETS and camera != name:
                raise scene_fault("is the name of a camera that any scene has; take another name", name)
            if isinstance(camera, Camera) and camera.beside is not None:
                _require_beside(name, cameras)
        if "size" not in info.data:
            return cameras
        calibrated = {}
        for name, camera in cameras.items():
            try:
                calibrated[name] = camera.calibrated(info.data["size"]) if isinstance(camera, Camera) else camera
            except PydanticCustomError as error:
                raise scene_fault(error.message(), name, *(error.context or {}).get("below", ())) from None
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
            raise scene_fault("is given together with cameras; remove one of them, or set it to null", "camera")
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
        raise scene_fault("the first camera is the main one, beside no other; put another one first", name, "beside")
    way, camera = [name], cameras[name]
    while isinstance(camera, Camera) and camera.beside is not None:
        other = camera.beside
        if other in way:
            if len(way) == 1:
                raise scene_fault(f"{other} is this camera itself; name another one", name, "beside")
            raise scene_fault(f"goes round, {', '.join([*way, other])}; give one of them an eye", name, "beside")
        if other not in cameras:
            if len(way) > 1:
                return  # It is reported where it is named.
            others = [one for one in cameras if one != name]
            near = did_you_mean(other, others) or f"; the others are {', '.join(others)}"
            raise scene_fault(f"{other}: no camera has this name{near}", name, "beside")
        way.append(other)
        camera = cameras[other]
