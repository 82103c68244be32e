"""Sections of the drawing: size, cameras, shading and light."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from taichi_msm.errors import did_you_mean
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.outputs import CAMERA_NAME, EXPORT_PREFIX, MAX_CAMERA_NAME, SERIES_FOLDERS
from taichi_msm.scene.section import (
    MAX_PIXELS,
    MAX_SUPERSAMPLE,
    Byte,
    Integer,
    Number,
    Pixels,
    Section,
    UnitInterval,
    key,
    scene_fault,
)

# A preset, by its name, or a pinhole camera.
AnyCamera = Literal["top", "oblique", "fit"] | Camera
PRESETS = ("top", "oblique", "fit")


# Width and height of the picture to which calibrations refer [px], where it is not `size`.
_calibrated_size: ContextVar[tuple[int, int] | None] = ContextVar("calibrated_size", default=None)


@contextmanager
def calibrated_size(size: tuple[int, int] | None) -> Iterator[None]:
    """Let calibrations refer to pictures of a width and height within the block [px]; None: to `size`."""
    token = _calibrated_size.set(size)
    try:
        yield
    finally:
        _calibrated_size.reset(token)


class Light(Section):
    """Light of `shading: tissue`, from a source next to the camera."""

    ambient: UnitInterval = key(0.2, "ambient fraction of the light", "a number, 0 to 1")
    gloss: UnitInterval = key(0.4, "brightness of the wet highlight, as a fraction of white", "a number, 0 to 1")
    relief: Annotated[Number, Field(ge=-10, le=10)] = key(
        0.0, "height of white above black in the image, in percent of the sheet's larger side", "a number, -10 to 10"
    )
    vignette: UnitInterval = key(0.0, "darkening of the picture's corners, as a fraction", "a number, 0 to 1")


class Render(Section):
    """Drawing of the frames."""

    size: tuple[Pixels, Pixels] = key(
        (512, 512), "width, height of a frame [px]", f"two whole numbers, 1 to {MAX_PIXELS}: [width, height] in pixels"
    )
    refine: Annotated[Integer, Field(ge=0, le=64)] = key(
        10, "vertices inserted between two neighbouring mass points when drawing", "a whole number, 0 to 64"
    )
    camera: AnyCamera = key(
        "top",
        "top: orthographic, from above; oblique: tilted, shows depth; fit: as oblique, and the sheet at rest fills the "
        "picture up to a margin of 2 %; or a pinhole camera",
        "top, oblique, fit, or a mapping: {eye: [x, y, z], target: [x, y, z], up: [x, y, z], fov: degrees}, with pose "
        "or poses in place of eye, and intrinsics or calibration in place of fov",
    )
    cameras: dict[str, AnyCamera] | None = key(
        None,
        "in place of camera: several cameras by name, each with its own folder of files; the first is the main camera, "
        "whose light is in all pictures",
        "names of a-z, 0-9, _ and -, each with top, oblique, fit, {eye: [x, y, z], ...}, {beside: NAME, baseline: "
        "metres} or {beside: NAME, rotation: 3 x 3, translation: [x, y, z], ...}",
    )
    shading: Literal["none", "headlight", "tissue"] = key(
        "headlight",
        "none: the colours of the image; headlight: light from the camera; tissue: wet tissue in the light of an "
        "endoscope",
        "none, headlight or tissue",
    )
    light: Light = key(Light(), "light of shading: tissue", "a mapping")
    wireframe: StrictBool = key(False, "draw the mass-point mesh over the surface", "true or false")
    supersample: Annotated[Integer, Field(ge=1, le=MAX_SUPERSAMPLE)] = key(
        1, "samples per pixel along each axis", f"a whole number, 1 to {MAX_SUPERSAMPLE}"
    )
    background: tuple[Byte, Byte, Byte] = key(
        (0, 0, 0), "colour of the background", "three whole numbers, 0 to 255: [red, green, blue]"
    )
    # At 65 %, a frame of grasp.yaml with 512 x 512 pixels takes 2.5 kB with a PSNR of 40 dB, and 35 kB in a GIF.
    quality: Annotated[Integer, Field(ge=1, le=100)] = key(
        65, "quality of the video of output: mp4 [%]", "a whole number, 1 to 100"
    )
    tracks: Annotated[Integer, Field(ge=1, le=256)] = key(
        16, "material points along each side of the grid of tracked points", "a whole number, 1 to 256"
    )

    @field_validator("camera", mode="after")
    @classmethod
    def _read_files(cls, camera: AnyCamera, info: ValidationInfo) -> AnyCamera:
        if isinstance(camera, Camera) and camera.beside is not None:
            raise scene_fault("requires render.cameras, where the reference camera has a name; remove beside", "beside")
        return _read_files(camera, info, {})

    @field_validator("cameras", mode="after")
    @classmethod
    def _check_cameras(cls, cameras: dict[str, AnyCamera] | None, info: ValidationInfo) -> dict[str, AnyCamera] | None:
        if cameras is None:
            return None
        if not cameras:
            raise scene_fault("is empty; add a camera under a name")
        for name, camera in cameras.items():
            if not re.fullmatch(CAMERA_NAME, name):
                raise scene_fault(f"is not a name of a camera; take up to {MAX_CAMERA_NAME} of a-z, 0-9, _ and -", name)
            if name in SERIES_FOLDERS or name.startswith(EXPORT_PREFIX):
                raise scene_fault("is the name of an output folder; take another name", name)
            if name in PRESETS and camera != name:
                raise scene_fault("is the name of a built-in camera; take another name", name)
            if isinstance(camera, Camera) and camera.beside is not None:
                _check_reference_camera(name, cameras)
        loaded = {}
        for name, camera in cameras.items():
            try:
                loaded[name] = _read_files(camera, info, cameras)
            except PydanticCustomError as error:
                raise scene_fault(error.message(), name, *(error.context or {}).get("below", ())) from None
        return loaded

    @model_validator(mode="before")
    @classmethod
    def _ignore_null(cls, data: Any) -> Any:
        """Drop `camera: null`, by which an override removes the key."""
        if isinstance(data, Mapping) and data.get("camera", "") is None:
            return {name: value for name, value in data.items() if name != "camera"}
        return data

    @model_validator(mode="after")
    def _check_one_key_of_cameras(self) -> Self:
        if self.cameras is not None and "camera" in self.model_fields_set:
            raise scene_fault("conflicts with cameras; remove one of them, or set it to null", "camera")
        return self

    def _unused_keys(self) -> Collection[str]:
        return ("cameras",) if self.cameras is None else ("camera",)

    @property
    def all_cameras(self) -> dict[str, AnyCamera]:
        """Cameras by their names, which are also their folders; "" for a camera without a name."""
        return {"": self.camera} if self.cameras is None else self.cameras

    @property
    def main(self) -> str:
        """Name of the main camera, which has the light; "" for a camera without a name."""
        return next(iter(self.all_cameras))

    @property
    def main_camera(self) -> AnyCamera:
        """Main camera."""
        return self.all_cameras[self.main]

    def with_main(self, camera: AnyCamera) -> Self:
        """Return a copy with another main camera. Cameras with `beside` move with it."""
        if self.cameras is None:
            return self.model_copy(update={"camera": camera})
        return self.model_copy(update={"cameras": {**self.cameras, self.main: camera}})

    def origin(self, name: str) -> tuple[AnyCamera, float]:
        """Follow the `baseline` of a camera to the camera that it copies.

        Returns:
            The copied camera, or the camera itself without `baseline`; and the distance from it along its x axis [m].
        """
        camera, distance = self.all_cameras[name], 0.0
        while isinstance(camera, Camera) and camera.beside is not None and camera.baseline is not None:
            distance += camera.baseline
            camera = self.all_cameras[camera.beside]
        return camera, distance

    def companion(self, name: str) -> str:
        """Return the name of the first camera whose `beside` is `name`, or "" without one."""
        cameras = self.all_cameras.items()
        return next((right for right, camera in cameras if isinstance(camera, Camera) and camera.beside == name), "")


def _read_files(camera: AnyCamera, info: ValidationInfo, cameras: Mapping[str, AnyCamera]) -> AnyCamera:
    """Return a camera, one of `cameras` by name, with its calibration and trajectory files read."""
    if not isinstance(camera, Camera):
        return camera
    camera = camera.with_poses()
    # An invalid size is reported separately.
    image_size = _calibrated_size.get()
    size = image_size or info.data.get("size")
    reference = cameras.get(camera.beside or "")
    pair = reference if isinstance(reference, Camera) else None
    return camera.calibrated(size, is_image=image_size is not None, reference=pair) if size else camera


def _check_reference_camera(name: str, cameras: Mapping[str, AnyCamera]) -> None:
    """Check that the chain of reference cameras of a camera ends at a camera with a pose."""
    if name == next(iter(cameras)):
        raise scene_fault(
            "the first camera is the main one, which has no reference camera; put another camera first", name, "beside"
        )
    chain, camera = [name], cameras[name]
    while isinstance(camera, Camera) and camera.beside is not None:
        reference = camera.beside
        if reference in chain:
            if len(chain) == 1:
                raise scene_fault(f"{reference} is this camera itself; name another one", name, "beside")
            raise scene_fault(
                f"the reference cameras form a cycle, {', '.join([*chain, reference])}; give one of them an eye",
                name,
                "beside",
            )
        if reference not in cameras:
            if len(chain) > 1:
                return  # The fault is reported at the camera that has this key.
            names = [candidate for candidate in cameras if candidate != name]
            hint = did_you_mean(reference, names) or f"; the others are {', '.join(names)}"
            raise scene_fault(f"{reference}: no camera has this name{hint}", name, "beside")
        chain.append(reference)
        camera = cameras[reference]
