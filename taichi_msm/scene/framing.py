"""The picture on a surface that a camera of the scene sees: its size, which cameras refer to, and its `Frame`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from taichi_msm.images import PictureError, picture_size
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import Render
from taichi_msm.scene.section import scene_fault
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.surface import Frame

# A camera at the origin that looks along -z, with x to the right and y up, in the convention of `Pose`.
POSE_AT_ORIGIN = {"rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "translation": [0, 0, 0]}

# The light on a picture by a camera by default: the gloss is in the picture.
MATTE = {"gloss": 0.0}

# Name of the camera of a picture in a scene with another main camera.
PICTURE = "picture"

# Name of the main camera in `picture` if it has none.
MAIN = "main"


def is_framed(data: Mapping[str, Any]) -> bool:
    """Return whether the surface of a scene, maybe invalid, has a picture by a camera."""
    surface = _get(data, "sheet", "surface")
    return _get(surface, "depth") is not None or _get(surface, "picture") is not None


def framed_image_size(data: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the size of the image of a scene, maybe invalid, whose surface has a picture by a camera [px]."""
    image = data.get("image")
    if not isinstance(image, str) or not is_framed(data):
        return None
    try:
        return picture_size(image)
    except PictureError:
        return None  # It is reported with the image.


def complete_framed(data: Mapping[str, Any], size: tuple[int, int] | None) -> Mapping[str, Any]:
    """Add to a scene the size of its image, if it is known, the light, and the pose of a depth map's camera."""
    render, depth = data.get("render", {}), _get(data, "sheet", "surface", "depth")
    if not isinstance(render, Mapping):
        return data
    if size is not None:
        render = {"size": size, **render}
    if isinstance(light := render.get("light", {}), Mapping):
        render = {**render, "light": {**MATTE, **light}}
    cameras = render.get("cameras")
    if depth is not None and isinstance(render.get("camera"), Mapping):
        render = {**render, "camera": _at_origin(render["camera"])}
    if depth is not None and isinstance(cameras, Mapping) and cameras:
        name = _get(depth, "camera")
        name = name if isinstance(name, str) and name in cameras else next(iter(cameras))
        if isinstance(cameras[name], Mapping):
            render = {**render, "cameras": {**cameras, name: _at_origin(cameras[name])}}
    return {**data, "render": render} if render else data


def _at_origin(camera: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a camera with a pose."""
    return camera if {"eye", "pose", "poses", "beside"} & camera.keys() else {**camera, "pose": POSE_AT_ORIGIN}


def _get(data: Any, *names: str) -> Any:
    """Return a value in mappings and sections."""
    for name in names:
        data = data.get(name) if isinstance(data, Mapping) else getattr(data, name, None)
    return data


def frame_sheet(
    sheet: Sheet,
    render: Render,
    image: str | None,
    size: tuple[int, int] | None,
    region: tuple[int, int, int, int] | None,
) -> Sheet:
    """Return a sheet whose surface has its `Frame`, for the image, its size [px] and region.

    A kept frame stays as it is; without the size of the image there is none.
    """
    surface = sheet.surface
    if surface is None or (surface.frame and surface.frame.is_kept):
        return sheet
    if surface.frame_key is None:
        frame = Frame((), (0, 0), (0, 0, 0, 0), sheet.points) if surface.is_even else None
        return sheet if frame == surface.frame else sheet.model_copy(update={"surface": surface.with_frame(frame)})
    name = surface.depth.camera if surface.depth else surface.picture
    key = ("sheet", "surface", *surface.frame_key)
    if image is None:
        kind = "depth" if surface.depth else "picture"
        raise scene_fault(f"sheet.surface.{kind} needs the picture that the camera took; name it", "image")
    if size is None:
        return sheet  # The file of the image is reported.
    if region is not None and (fault := region_fault(region, size)):
        raise scene_fault(fault, "region")
    (width, height), (image_width, image_height) = render.size, size
    if width * image_height != height * image_width:
        text = f"{width} x {height} has another aspect than the image, {image_width} x {image_height}"
        raise scene_fault(f"{text}; take {[image_width, image_height]} or a multiple", "render", "size")
    cameras = _chain(render, name, key)
    frame = Frame(cameras, size, region or (0, 0, *size), sheet.points)
    return sheet if frame == surface.frame else sheet.model_copy(update={"surface": surface.with_frame(frame)})


def keep_picture_camera(sheet: Sheet, before: Render, after: Render) -> tuple[Sheet, Render]:
    """Return a sheet and its render section, with another main camera, such that the picture keeps its camera.

    If that is the main camera, it becomes a further one.
    """
    surface = sheet.surface
    if surface is None or surface.frame_key is None or after.main_camera == before.main_camera:
        return sheet, after
    name = surface.depth.camera if surface.depth else surface.picture
    if name not in (None, before.main) and not (name == MAIN and MAIN not in before.all_cameras):
        return sheet.with_kept_frame(), after
    cameras = {before.main or MAIN: after.main_camera, **after.all_cameras, PICTURE: before.main_camera}
    cameras.pop("", None)
    if surface.depth:
        surface = surface.model_copy(update={"depth": surface.depth.model_copy(update={"camera": PICTURE})})
    else:
        surface = surface.model_copy(update={"picture": PICTURE})
    render = {name: value for name, value in after if name in after.model_fields_set - {"camera"}}
    return sheet.model_copy(update={"surface": surface}), Render(**{**render, "cameras": cameras})


def region_fault(region: tuple[int, int, int, int], size: tuple[int, int] | None) -> str:
    """Return the fault of a region of a picture of a width and height [px], None for an unknown one; empty without."""
    x, y, width, height = region
    if x < 0 or y < 0 or width < 1 or height < 1:
        return f"{list(region)} needs x and y of 0 or more, width and height above 0"
    if size is not None and (x + width > size[0] or y + height > size[1]):
        return f"{list(region)} ends at {x + width}, {y + height}; the image has {size[0]} x {size[1]} pixels"
    return ""


def _chain(render: Render, name: str | None, key: tuple[str, ...]) -> tuple[Camera, ...]:
    """Return a camera, the one that it is `beside`, and so on."""
    cameras, chain = render.all_cameras, []
    if name == MAIN and MAIN not in cameras:
        name = render.main
    current = render.main if name is None else name
    if current not in cameras:
        known = ", ".join(filter(None, cameras)) or f"{MAIN}, as render.cameras is missing"
        raise scene_fault(f"{current} is not one of render.cameras; take {known}", *key)
    while True:
        camera = cameras[current]
        if not isinstance(camera, Camera):
            # The main camera, if no other one is named.
            place = key if name or current else ("render", "camera")
            text = f"{camera} took no picture; set the camera that took image, such as {{fov: 60}}, or with intrinsics"
            raise scene_fault(f"{text} or calibration", *place)
        chain.append(camera)
        if camera.eye is not None and "target" not in camera.model_fields_set:
            raise scene_fault("the camera has no target, and the surface follows from its direction; add target", *key)
        if camera.beside is None:
            break
        current = camera.beside
    if not any(camera.has_own_lens for camera in chain):
        text = "the camera has no lens; add intrinsics, calibration or fov to it"
        raise scene_fault(text, *key)
    return tuple(chain)
