"""Rerun export: a recording per run, for the viewer of rerun.io.

    world/sheet             mesh of the mass points with the picture of the scene
    world/tools/0           mesh of the instrument of a probe, by the number of the probe
    world/tracks            positions of the tracked points
    world/camera            pose and pinhole of the camera; world/cameras/NAME for each of several
    world/camera/picture    frames
    world/camera/depth      depth [m]
    world/camera/flow       flow [px], a tensor of shape (height, width, 2)

Lengths are in metres, in the world of the scene, with y up. The timelines are `frame` and `time` [s]. Pixels count from
the picture's upper left corner, as Rerun's do. Rerun has no lens distortion: pictures are exported as drawn.

Source: Rerun's documentation of archetypes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.extrinsics import OPENCV_SIGNS
from taichi_msm.cameras.view import View
from taichi_msm.errors import NotInstalledError, ProgressCallback
from taichi_msm.exports.formats import FORMATS, one_path_per_run
from taichi_msm.exports.inputs import (
    EXPORT_REFINE,
    instrument_mesh,
    mass_points,
    read_depth,
    read_flow,
    read_picture_file,
    read_track_positions,
    unit_normals,
)
from taichi_msm.model.geometry import Rest
from taichi_msm.model.surface import place_instruments, refine_surface
from taichi_msm.render.camera import calibration, is_moving, view_at
from taichi_msm.render.labels import NO_FLOW
from taichi_msm.render.texture import load_texture
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene.outputs import OUTPUTS

try:
    import rerun
except ImportError:
    raise NotInstalledError("--format rerun: needs rerun-sdk, which is not installed; pip install rerun-sdk") from None


def _write_run(run: FinishedRun, path: Path, progress: ProgressCallback) -> list[str]:
    # The viewer merges recordings with the same identity: here, those of the same folder.
    identity = uuid5(NAMESPACE_URL, run.directory.resolve().as_uri())
    with rerun.RecordingStream("taichi_msm", recording_id=identity) as recording:
        recording.save(path)
        recording.send_recording_name(run.directory.name)
        # The time of the export is not a timeline of the recording.
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        _log_run(run, recording, progress)
        recording.flush()
        recording.disconnect()
    camera_runs = _camera_runs(run).values()
    optional = FORMATS["rerun"].optional_outputs
    missing = [key for key in optional if not any(camera_run.has_output(key) for camera_run in camera_runs)]
    notes = [f"the results have no {key}; {run.remedy(key)}" for key in missing]
    if any(view_at(run.scene, 0.0, camera_run.camera).lens is not None for camera_run in camera_runs):
        notes.append(
            "Rerun has no lens distortion, so projected points deviate from the pictures of a distorted camera"
        )
    return notes


write = one_path_per_run(_write_run, ".rrd")


def _camera_runs(run: FinishedRun) -> dict[str, FinishedRun]:
    """Return a copy of the run for each of its cameras, by the entity of the camera."""
    names = run.camera_names()
    entities = {f"world/cameras/{name}": name for name in names} if names else {"world/camera": ""}
    return {entity: replace(run, camera=name) for entity, name in entities.items()}


def _log_run(run: FinishedRun, recording: Any, progress: ProgressCallback) -> None:
    positions, rest, camera_runs = run.positions(), run.rest(), _camera_runs(run)
    tracked = [camera_run for camera_run in camera_runs.values() if camera_run.has_output("tracks")]
    tracks = read_track_positions(tracked[0])[1] if tracked else None
    # Distinct colours: the hues of successive tracks are 0.618 turns apart.
    phase = np.arange(0 if tracks is None else len(tracks))[:, None] * 0.618 + np.array([0, 1 / 3, 2 / 3])
    colours = (127.5 + 127.5 * np.cos(2 * np.pi * phase)).astype(np.uint8)
    instruments = [number for number, probe in enumerate(run.scene.probes) if probe.instrument is not None]
    recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    for frame, position in enumerate(positions):
        progress(frame, run.frames)
        time = float(run.time[frame])
        recording.set_time("frame", sequence=frame)
        recording.set_time("time", duration=time)
        recording.log("world/sheet", _mesh(run, position, rest, is_first=frame == 0))
        for number, solid in zip(instruments, place_instruments(run.scene, position, time), strict=True):
            if frame == 0:
                vertices, normals, triangles = instrument_mesh(solid)
                mesh = rerun.Mesh3D(vertex_positions=vertices, vertex_normals=normals, triangle_indices=triangles)
                recording.log(f"world/tools/{number}", mesh, static=True)
            recording.log(f"world/tools/{number}", rerun.Transform3D(translation=solid.tip))
        if tracks is not None:
            recording.log("world/tracks", rerun.Points3D(tracks[:, frame], colors=colours))
        for entity, camera_run in camera_runs.items():
            view = view_at(run.scene, time, camera_run.camera)
            if view.pinhole and (frame == 0 or is_moving(run.scene, camera_run.camera)):
                recording.log(entity, *_pinhole(view))
            _log_pictures(camera_run, frame, entity, recording)


def _mesh(run: FinishedRun, position: NDArray[np.floating], rest: Rest | None, *, is_first: bool) -> Any:
    """Build the mesh of the first frame, or only vertices of a later one; the viewer keeps triangles and texture."""
    mask = rest.mask if rest else None
    points, normals = mass_points(position, mask), unit_normals(position, mask)
    vertices: dict[str, Any] = {"vertex_positions": points, "vertex_normals": normals}
    if not is_first:
        return rerun.Mesh3D.from_fields(**vertices)
    surface = refine_surface(position, EXPORT_REFINE, rest)
    vertices["triangle_indices"] = surface.triangles
    if run.scene.image is None:
        return rerun.Mesh3D(**vertices)
    picture = load_texture(run.scene, run.sha256.get("image", ""))
    return rerun.Mesh3D(**vertices, vertex_texcoords=surface.texture_coordinates, albedo_texture=picture)


def _pinhole(view: View) -> tuple[Any, Any]:
    """Build pose and projection of a camera, in OpenCV's axes."""
    pose = rerun.Transform3D(translation=view.eye, mat3x3=(view.axes * OPENCV_SIGNS).T)
    matrix, size = calibration(view)["intrinsics"], view.size.tolist()
    return pose, rerun.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF)


def _log_pictures(run: FinishedRun, frame: int, entity: str, recording: Any) -> None:
    if run.has_output("png"):
        picture = rerun.EncodedImage(contents=read_picture_file(run, "png", frame), media_type="image/png")
        recording.log(f"{entity}/picture", picture)
    if run.has_output("depth"):
        recording.log(f"{entity}/depth", rerun.DepthImage(read_depth(run, frame), meter=1.0))
    if run.has_output("flow") and frame < OUTPUTS["flow"].count(run.frames):
        flow = read_flow(run, frame)
        largest = float(np.abs(flow[flow < NO_FLOW / 2]).max(initial=1.0))
        tensor = rerun.Tensor(flow, dim_names=("height", "width", "right and down"), value_range=(-largest, largest))
        recording.log(f"{entity}/flow", tensor)
