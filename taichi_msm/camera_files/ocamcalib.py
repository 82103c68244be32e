"""calib_results.txt of OCamCalib: Scaramuzza's polynomial, with x down, y to the right and the axis backward.

Its centre counts from 0, as in OpenCV; OCamCalib writes the centre of its MATLAB model minus 1.
"""

from __future__ import annotations

from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, build_entries
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.lenses import MODELS

# Lines with values, in their order, each with the number of values; None for any number.
LINES = {"polynomial": None, "inverse": None, "centre": 2, "affine": 3, "size": 2}
DEGREE = 4


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the keys of the camera, if the file begins with the comment of OCamCalib."""
    if not file.text.lstrip().startswith("#polynomial coefficients"):
        return ()
    rows = zip(LINES, ((n, line) for n, line in file.lines if line[0] != "#"), strict=False)
    return [Keys(file, build_entries((name, line, n) for name, (n, line) in rows))]


def _read(keys: Keys) -> Calibration:
    """Read the lines.

    The pixel at row c u + d v, column e u + v from the centre views the direction u down, v right, f(rho) backward,
    rho^2 = u^2 + v^2. Exchanging u and v and multiplying lengths by c gives the formula of the lens `scaramuzza`.
    """
    (row, column), (c, d, e), (height, width) = (keys.require(name, n, name) for name, n in LINES.items() if n)
    count, *polynomial = keys.numbers("polynomial") or [0.0]
    a0, a1, *powers = [*polynomial, *[0.0] * DEGREE][: DEGREE + 1]
    if len(polynomial) != count or a1 or any(polynomial[DEGREE + 1 :]) or a0 >= 0 or c <= 0:
        fault = f"polynomial: {keys.data.get('polynomial')}"
        expected = f"its length, up to {DEGREE + 1}, a0 below 0, a1 = 0, a2, a3, a4, and c above 0"
        raise keys.fault(f"{fault}; expected {expected}", "polynomial")
    values = [-c * a0, *(-a / c**n for n, a in enumerate(powers, 1)), 1 / c, e / c, d / c]
    lens = dict(zip(MODELS["scaramuzza"].coefficients, values, strict=True))
    return Calibration(None, (column, row), (round(width), round(height)), "scaramuzza", lens)


OCAMCALIB = CalibrationReader(
    "OCamCalib",
    "calib_results.txt: `#polynomial coefficients for the DIRECT mapping function`",
    ("calibration: calib_results.txt",),
    _cameras,
    _read,
)
