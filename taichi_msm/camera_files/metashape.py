"""XML of Agisoft Metashape: sensors of exported cameras, or an exported lens calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import build_keys, read_camera

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# Coefficients of terms that OpenCV's model lacks: r^8, skew, and powers of r in the tangential distortion.
UNSUPPORTED = ("k4", "b2", "p3", "p4")


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the sensors with a calibration, by their ids; an empty list for another format."""
    root = file.xml
    if root is None:
        return []
    if root.tag == "calibration":
        return [_camera(file, root, root.findtext("projection", "").strip(), "")]
    return [
        _camera(file, _adjusted(sensor), sensor.get("type", ""), sensor.get("id", ""))
        for sensor in root.iter("sensor")
        if sensor.find("calibration") is not None
    ]


def _adjusted(sensor: Element) -> Element:
    """Return the calibration that Metashape has adjusted, else the only one."""
    calibrations = {element.get("class", ""): element for element in sensor.findall("calibration")}
    return calibrations.get("adjusted", list(calibrations.values())[-1])


def _camera(file: CameraFile, calibration: Element, kind: str, camera: str) -> Keys:
    values = [(element.tag, (element.text or "").strip(), None) for element in calibration if len(element) == 0]
    resolution = calibration.find("resolution")
    if resolution is not None:
        values = [(name, value, None) for name, value, _ in values if name != "resolution"]
        values += [(name, resolution.get(name, ""), None) for name in ("width", "height")]
    return Keys(file, file.entries([*values, ("type", kind, None)]), camera=camera)


def _read(keys: Keys) -> Calibration:
    """Read the numbers: cx, cy from the middle, and p1, p2 exchanged; the first pixel centre is (0.5, 0.5)."""
    kind = keys.data["type"]
    if kind != "frame":
        raise keys.file.fault(f"a sensor of type {kind or 'unknown'}: not supported; expected frame")
    if others := [name for name in UNSUPPORTED if keys.number(name, 0.0)]:
        raise keys.file.fault(f"{others[0]} is not 0, and not supported; optimise the cameras without {others[0]}")
    size = keys.number("width"), keys.number("height")
    focal = keys.number("f")
    centre = [keys.number(name, 0.0) + side / 2 - 0.5 for name, side in zip(("cx", "cy"), size, strict=True)]
    coefficients = [keys.number(name, 0.0) for name in ("k1", "k2", "p2", "p1", "k3")]
    # b1 stretches the picture along x.
    focal_lengths = focal + keys.number("b1", 0.0), focal
    return read_camera(build_keys(keys.file, focal_lengths, centre, coefficients, "opencv", size))


METASHAPE = CalibrationReader(
    "Agisoft Metashape",
    "XML of exported cameras or of a lens: `f`, `cx`, `cy`, `k1`, ...; of several sensors, one is selected by `camera`",
    ("calibration: cameras.xml", "calibration: cameras.xml, camera: 0"),
    _cameras,
    _read,
)
