"""camera.txt of DSO: model and numbers, size of the pictures, and two lines on their rectification."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, listed
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import NO_DISTORTION, build_keys, read_camera
from taichi_msm.camera_files.trajectory import parse_numbers

# Lens models, each with the number of its coefficients. Pinhole has one, which is 0.
MODELS = {
    "Pinhole": (NO_DISTORTION, 1),
    "RadTan": ("opencv", 4),
    "EquiDistant": ("fisheye", 4),
    "KannalaBrandt": ("fisheye", 4),
}
# Without a name, the number of coefficients determines the model.
UNNAMED = {1: "Pinhole", 4: "RadTan"}
RECTIFICATION = ("crop", "full", "none")
SIZE = re.compile("[0-9]{1,9} [0-9]{1,9}")


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the camera of the original pictures under OpenCV's keys; an empty list for another format."""
    rows = [(n, line.split()) for n, line in file.lines[:4]]
    if len(rows) < 3 or not SIZE.fullmatch(" ".join(rows[1][1])):
        return []
    numbers = parse_numbers(rows[2][1]) or []
    if rows[2][1][0] not in RECTIFICATION and len(numbers) != 5:
        return []
    line, words = rows[0]
    name = words.pop(0) if re.fullmatch("[A-Za-z]+", words[0]) else ""
    values = parse_numbers(words)
    if values is None:
        raise file.fault("not numbers fx fy cx cy and coefficients; correct the line", line)
    fx, fy, cx, cy, *coefficients = [*values, *[0.0] * 4][: max(4, len(values))]
    name = name or UNNAMED.get(len(coefficients), "")
    if name == "FOV" or (name == "Pinhole" and any(coefficients)):
        if any(coefficients):
            fault = "FOV, the lens model of five numbers of which the last is not 0, is not supported"
            raise file.fault(f"{fault}; calibrate with RadTan or EquiDistant", line)
        name = "Pinhole"
    if name not in MODELS or len(coefficients) != MODELS[name][1]:
        counts = listed(f"{known} with {4 + count} numbers" for known, (_, count) in MODELS.items())
        raise file.fault(f"{name or 'a camera'} with {len(values)} numbers: not supported; expected {counts}", line)
    width, height = (int(word) for word in rows[1][1])
    if cx < 1 and cy < 1:  # Relative to the size, from the corner of the first pixel.
        fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    model = MODELS[name][0]
    values = [0.0] * 4 if model == NO_DISTORTION else coefficients
    return [build_keys(file, (fx, fy), (cx, cy), values, model, (width, height), line)]


DSO = CalibrationReader(
    "DSO",
    "camera.txt: a line `Pinhole`, `RadTan` or `EquiDistant` with numbers, the size, and `crop`, `full` or `none`",
    ("calibration: camera.txt",),
    _cameras,
    read_camera,
)
