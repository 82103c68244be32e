"""Calibrations of stereo pairs with a key per camera: OpenCV's stereoCalibrate, SCARED, STIR."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.keys import Keys, flat, fold
from taichi_msm.camera_files.opencv import MATRIX, OpenCV
from taichi_msm.camera_files.text import CameraFile

# Marks of the left and the right camera, around the name of a key.
MARKS = (
    (r"(.+?)_?1", r"(.+?)_?2"),
    (r"(?i:left)_?(.+)|(.+?)_?(?i:left)", r"(?i:right)_?(.+)|(.+?)_?(?i:right)"),
    (r"[lL]_(.+)|(.+?)(?:_l|_?L)", r"[rR]_(.+)|(.+?)(?:_r|_?R)"),
    (r"(.+?)_?0", r"(.+?)_?1"),
)


class Stereo(OpenCV):
    """Reader of marked keys, as K1, D1, K2, D2, and of the pose R, T of the right camera."""

    name = "OpenCV stereo, SCARED, STIR"
    recognised_by = "`K1`, `D1`, `K2`, `D2` (or `M1`, `cameraMatrix1`, `leftcameramat`, `K_l`, ...), with `R`, `T`"
    unit = None

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the keys of each camera, if both have a matrix, with those that have no mark."""
        for marks in MARKS:
            eyes = [_marked(file, mark) for mark in marks]
            if all(any(_is_matrix(file, *item) for item in eye.items()) for eye in eyes):
                shared = {key: fold(key) for key in file.data if not any(key in eye for eye in eyes)}
                folded = [{**shared, **eye} for eye in eyes]
                return [Keys(file, {key: file.data[key] for key in names}, names) for names in folded]
        return ()


def _marked(file: CameraFile, mark: str) -> dict[str, str]:
    """Return the keys that have a mark, each with its folded name without it."""
    matches = {key: re.fullmatch(mark, str(key)) for key in file.data}
    return {key: fold("".join(filter(None, match.groups()))) for key, match in matches.items() if match}


def _is_matrix(file: CameraFile, key: str, name: str) -> bool:
    return bool(re.fullmatch(MATRIX, name)) and len(flat(file.data[key])) == 9
