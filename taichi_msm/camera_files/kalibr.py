"""Kalibr's camchain: a section per camera, each but the first with the pose after the one before it.

The sensor.yaml of EuRoC has the keys of a section.
"""

from __future__ import annotations

from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, build, lens_model
from taichi_msm.camera_files.keys import Keys, flat
from taichi_msm.camera_files.text import CameraFile


class Kalibr(CalibrationReader):
    """Reader of a camchain."""

    name = "Kalibr's camchain, EuRoC's sensor.yaml"
    recognised_by = "`camera_model`, `intrinsics: [fx, fy, cx, cy]`, in `cam0` and `cam1`, whose pose is `T_cn_cnm1`"

    def recognises(self, file: CameraFile) -> bool:
        """Return whether there are sections of cameras."""
        return bool(self.cameras(file))

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the sections of the cameras."""
        sections = [file.data, *(file.data[name] for name in sorted(file.data, key=str))]
        cameras = [section for section in sections if isinstance(section, dict) and "camera_model" in section]
        return [Keys(file, camera) for camera in cameras if len(flat(camera.get("intrinsics"))) in (4, 5)]

    def read(self, keys: Keys) -> Calibration:
        """Read a section."""
        file, camera = keys.file, keys.data
        if (projection := camera["camera_model"]) not in ("pinhole", "omni"):
            raise file.fault(f"camera_model: {projection} is not known; found {keys}; calibrate as pinhole or omni")
        values = keys.numbers("distortioncoeff(icient)?s") or []
        model = lens_model(file, "distortion_model", camera.get("distortion_model"), values)
        if model is None or not (values or model == "none"):
            remedy = "write distortion_model: radtan, equidistant or none, and distortion_coeffs"
            raise file.fault(f"no distortion that is known; found {keys}; {remedy}")
        model, values = ("pinhole", [0.0] * 4) if model == "none" else (model, values)
        size = keys.require("resolution", 2, "resolution")
        if projection == "pinhole":
            return build(file, keys.require("intrinsics", 4, "intrinsics"), size, model, values)
        if model != "pinhole":
            raise file.fault(f"omni with {model} is not known; calibrate with distortion_model: radtan or none")
        xi, *intrinsics = keys.require("intrinsics", 5, "intrinsics")
        return build(file, intrinsics, size, "omnidir", [xi, *values])

    def pose(self, keys: Keys) -> tuple[Sequence[float], Sequence[float]] | None:
        """Read T_cn_cnm1, four rows [R, t]."""
        if "T_cn_cnm1" not in keys.data:
            return None
        rows = keys.require("tcncnm1", 16, "T_cn_cnm1")
        return [*rows[0:3], *rows[4:7], *rows[8:11]], rows[3:12:4]
