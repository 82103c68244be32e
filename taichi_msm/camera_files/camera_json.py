"""camera.json, the calibration in the results of a run."""

from __future__ import annotations

from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.errors import truncate
from taichi_msm.lenses import MODELS

KEYS = {"size", "projection", "calibration", "model", "distortion"}


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the keys of the camera; an empty list for another format."""
    return [Keys(file, file.data)] if file.data.keys() >= KEYS else []


def _read(keys: Keys) -> Calibration:
    """Read `calibration`, in OpenCV's pixel coordinates; `intrinsics` has the first pixel centre at (0.5, 0.5)."""
    model = keys.data["model"]
    if model not in MODELS:
        fault = f"model: {truncate(str(model))} is not supported; expected one of: {', '.join(MODELS)}"
        raise keys.file.fault(fault)
    names = tuple(MODELS[model].coefficients)
    fx, _, cx, _, fy, cy, *_ = keys.require("calibration", 9, "calibration")
    width, height = keys.require("size", 2, "size")
    values = keys.require("distortion", len(names), "distortion")
    focal = None if model == "scaramuzza" else (fx, fy)
    return Calibration(focal, (cx, cy), (round(width), round(height)), model, dict(zip(names, values, strict=True)))


CAMERA_JSON = CalibrationReader(
    "camera.json",
    "a run's camera.json of a pinhole: `projection`, `calibration`, `model`, `distortion`",
    ("calibration: camera.json",),
    _cameras,
    _read,
)
