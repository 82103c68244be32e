"""Scene of the mapped tissue: a foundation that locks, with its map, and the ball pressed in at the median stiffness.

The sheet on the foundation is so soft that it adds about 0.1 % to the force of the ball.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.arithmetic import Array
from taichi_msm.errors import printable
from taichi_msm.palpation.plane import Plane, find_plane
from taichi_msm.palpation.result import Palpation
from taichi_msm.runs.directory import create_file, write_new_file
from taichi_msm.scene.section import MAX_POINTS

SCENE, STIFFNESS, TISSUE = "scene.yaml", "pictures/stiffness.png", "pictures/tissue.png"

# Largest spacing of the mass points, and margin of the sheet around the places, in radii of the ball.
MAX_SPACING_RADII, MARGIN_RADII = 1 / 6, 2.0

# Young's modulus of the sheet times its thickness, over K R^2; its thickness [m].
SHEET_SHARE, THICKNESS = 1e-4, 1e-3

# Time of the press [s], and frames per second.
DURATION, RATE = 2.0, 10.0

# Pixels of the larger side of pictures and frames.
PIXELS = 512

# Colours of the map, from soft to stiff: those of viridis.
COLOURS = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], float)


def write_scene(folder: Path, result: Palpation) -> str:
    """Write scene.yaml and its pictures into a folder; return a note if they are left out, or an empty string."""
    presses, built = result.presses, result.map
    law, prior = built.fit.law, built.fit.prior
    plane = find_plane(presses.position, result.normal, MARGIN_RADII * law.radius)
    width, height = plane.size
    cols, rows = (math.ceil(side / (MAX_SPACING_RADII * law.radius)) + 1 for side in (width, height))
    if max(rows, cols) > MAX_POINTS:
        fault = f"places over {max(plane.size):.3g} m need {rows} x {cols} mass points for a ball of {law.radius:g} m"
        return f"{SCENE} is left out: {fault}; is the unit of x, y and z right?"
    stiffness = built.stiffness(plane.pixels(rows, cols).reshape(-1, 3))[0].reshape(rows, cols)
    median = float(np.median(built.fit.mean_stiffness))
    low, high = float(stiffness.min()) / median, float(stiffness.max()) / median * (1 + 1e-6)
    (folder / STIFFNESS).parent.mkdir()
    _write_png(folder / STIFFNESS, ((stiffness / median - low) / (high - low) * 65535).round().astype(np.uint16))
    _write_png(folder / TISSUE, _colour(np.log(stiffness), _picture_size(plane)))
    pressed = int(np.argsort(built.fit.mean_stiffness)[presses.count // 2])
    depth = float(presses.greatest_depth[pressed]) + prior.mean
    across, down = plane.fractions(presses.position[pressed])
    (there,), _, _ = built.stiffness(presses.position[[pressed]])
    force = there * float(law.force(np.array([depth]))[0])
    # Deeper than three times the press, beyond which a run warns, in whole centimetres.
    thickness = math.ceil(400 * depth) / 100
    foundation = {"young": median * thickness, "depth": thickness}
    if math.isfinite(law.lock):
        foundation["lock"] = law.lock
    path = [[0, across, down, 0], [DURATION, across, down, -depth]]
    data: dict[str, Any] = {
        "image": TISSUE,
        "sheet": {"points": [rows, cols], "size": [height, width], "fixed": "border"},
        "tissue": {
            "young": SHEET_SHARE * median * law.radius**2 / THICKNESS,
            "thickness": THICKNESS,
            "foundation": foundation,
            "foundation_active": "always",
            "foundation_map": {"image": STIFFNESS, "range": [low, high]},
        },
        "probes": [
            {
                "path": path,
                "instrument": {"radius": law.radius, "shaft": [0, 0, 1], "length": 4 * law.radius},
                "friction": "rough",
            }
        ],
        "time": {"duration": DURATION, "frames_per_second": RATE, "motion": "quasistatic"},
        "render": {"size": _picture_size(plane), "camera": "oblique"},
        "output": ["png", "gif", "trajectory", "forces"],
    }
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    place = f"place {printable(presses.places[pressed])}"
    comment = f"""\
# Map of {printable(result.name)}.
# The ball goes {1000 * depth:.3g} mm deep at {place}, of median stiffness: {force:.4g} N by the law of the presses.
# Only the ratio young / depth of the foundation is measured; lock is a parameter of the curve, not a thickness.
# The sheet is too soft to matter. It sticks to the ball, so a run warns of its stretched springs.
"""
    write_new_file(folder / SCENE, (comment + text).encode())
    return ""


def _colour(values: Array, size: list[int]) -> NDArray[np.uint8]:
    """Return values as a picture of colours, of a width and a height [px]."""
    share = (values - values.min()) / max(float(np.ptp(values)), 1e-12)
    enlarged = np.asarray(
        Image.fromarray(share.astype(np.float32)).resize((size[0], size[1]), Image.Resampling.BICUBIC)
    )
    at = np.linspace(0, 1, len(COLOURS))
    colours = np.stack([np.interp(enlarged, at, COLOURS[:, k]) for k in range(3)], axis=-1)
    return np.asarray(colours.round(), np.uint8)


def _picture_size(plane: Plane) -> list[int]:
    """Return width and height of pictures [px]; even, as films need."""
    return [2 * max(1, round(PIXELS / 2 * side / max(plane.size))) for side in plane.size]


def _write_png(path: Path, pixels: NDArray[np.unsignedinteger]) -> None:
    with create_file(path) as file:
        Image.fromarray(pixels).save(file, "PNG")
