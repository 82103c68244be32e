"""Draw the pictures of labels.md and its lines on flow and stereo pairs, with the residuals of both.

    PYTHONPATH=. python docs/make_labels.py

Without light, frame i + 1 warped by flow equals frame i, except for filtering, and for pixels with both sides of an
outline. With light but without highlights and the lamp's direction, the tool's shadow remains. Corresponding points of
`stereo` are in the same row after OpenCV's rectification.
"""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from benchmarks.marked import replace_marked
from taichi_msm import Flow, Labels, Simulation, load_scene
from taichi_msm.render.camera import calibration

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "images" / "labels.jpg"
PAGE = ROOT / "docs" / "labels.md"
PAIR_PICTURE = ROOT / "docs" / "images" / "pair.jpg"

# The frame before the fold of grasp.yaml drops, when everything moves.
SCENE, FRAME = "grasp", 21
SIZE, GAP, SAMPLES = 300, 6, 3

# Magnification of displayed differences.
MAGNIFIED = 6

# A stereo pair of converging cameras with different lenses; size and spacing of the correspondences [px].
LEFT = {
    "intrinsics": {"fx": 540.0, "fy": 539.0, "cx": 243.2, "cy": 237.1},
    "distortion": {"k1": -0.34, "k2": 0.12, "p1": 0.0006, "p2": -0.0004},
    "eye": [-0.004, -0.06, 0.07],
    "target": [0.0, -0.004, 0.0],
}
TURN = cv2.Rodrigues(np.radians([0.8, -3.2, 2.5]))[0]
RIGHT = {
    "beside": "left",
    "rotation": TURN.tolist(),
    "translation": [-0.0054, 0.0003, -0.0002],
    "intrinsics": {"fx": 562.0, "fy": 560.0, "cx": 236.0, "cy": 242.5},
    "distortion": {"k1": -0.38, "k2": 0.15, "p1": -0.0008, "p2": 0.0003},
}
PAIR_SIZE, SPACING = 480, 80

Image8 = NDArray[np.uint8]


def warped(later: Image8, flow: Flow) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Warp a later picture back by flow, with bilinear filtering.

    Args:
        later: colours, shape (height, width, 3).
        flow: from the earlier frame to it.

    Returns:
        Colours, shape (height, width, 3); and their validity: on the sheet, if it is not hidden later.
    """
    height, width, _ = later.shape
    known = (flow.flow[..., 0] < 1e9) & (flow.occlusion == 0)
    y, x = np.mgrid[:height, :width]
    x = np.clip(np.where(known, x + flow.flow[..., 0], 0), 0, width - 1)
    y = np.clip(np.where(known, y + flow.flow[..., 1], 0), 0, height - 1)
    i, j = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    t, s = (y - i)[..., None], (x - j)[..., None]
    upper = later[i, j] * (1 - s) + later[i, j + 1] * s
    return upper * (1 - t) + (later[i + 1, j] * (1 - s) + later[i + 1, j + 1] * s) * t, known


def warping_residual(*settings: str) -> float:
    """Return the mean difference between a frame and the next one warped, with some settings [grey]."""
    with Simulation(load_scene(ROOT / "scenes" / f"{SCENE}.yaml", settings)) as simulation:
        simulation.advance(FRAME)
        first, labels = simulation.draw(), simulation.labels()
        simulation.advance()
        back, known = warped(simulation.draw(), simulation.flow(labels))
    return float(np.abs(back - first)[known].mean())


def coloured(flow: Flow) -> Image8:
    """Return flow as colours: directions as hues and lengths as saturation."""
    known = flow.flow[..., 0] < 1e9
    right, down = np.moveaxis(np.where(known[..., None], flow.flow, 0), -1, 0)
    length = np.hypot(right, down) / np.hypot(right, down).max()
    hues = np.array([colorsys.hsv_to_rgb(n / 360, 1, 1) for n in range(360)])
    hue = hues[np.degrees(np.arctan2(down, right)).astype(int) % 360]
    return np.where(known[..., None], 255 * (1 - length[..., None] * (1 - hue)), 0).astype(np.uint8)


def longest(flow: Flow) -> float:
    """Return the length of the longest flow [px]."""
    return float(np.hypot(*np.moveaxis(flow.flow, -1, 0))[flow.flow[..., 0] < 1e9].max())


def shades(depth: NDArray[np.float32]) -> Image8:
    """Return depth as grey, brighter for nearer surfaces."""
    near, far = np.percentile(depth[depth > 0], [0.5, 99.5])
    grey = np.where(depth > 0, np.clip(255 * (far - depth) / (far - near), 20, 255), 0)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def masks(labels: Labels, flow: Flow) -> Image8:
    """Return the instrument in blue, and points hidden in the next frame in orange."""
    picture = np.full((*flow.occlusion.shape, 3), 40, np.uint8)
    picture[labels.instrument > 0] = (90, 150, 255)
    picture[flow.occlusion > 0] = (255, 150, 40)
    return picture


def difference(a: NDArray[np.floating], b: Image8, known: NDArray[np.bool_]) -> Image8:
    """Return the magnified difference where it is known."""
    return (np.clip(MAGNIFIED * np.abs(a - b), 0, 255) * known[..., None]).astype(np.uint8)


def page(panels: dict[str, Image8]) -> Image.Image:
    """Arrange panels in two rows, each with its name."""
    columns = len(panels) // 2
    sheet = Image.new("RGB", (columns * (SIZE + GAP) - GAP, 2 * (SIZE + 22)), "white")
    draw = ImageDraw.Draw(sheet)
    for n, (name, panel) in enumerate(panels.items()):
        corner = n % columns * (SIZE + GAP), n // columns * (SIZE + 22)
        sheet.paste(Image.fromarray(panel), corner)
        draw.text((corner[0] + SIZE // 2, corner[1] + SIZE + 11), name, "black", anchor="mm", font_size=13)
    return sheet


def marked(picture: Image8, points: NDArray[np.float64], *, rows: bool) -> Image8:
    """Draw coloured circles around points, and in rectified pictures their rows."""
    marked = picture.copy()
    for n, (x, y) in enumerate(points.tolist()):
        colour = tuple(int(255 * part) for part in colorsys.hsv_to_rgb(n / len(points), 0.6, 1))
        if rows:
            cv2.line(marked, (0, round(y)), (picture.shape[1], round(y)), colour, 1, cv2.LINE_AA)
        cv2.circle(marked, (round(16 * x), round(16 * y)), 16 * 6, colour, 2, cv2.LINE_AA, 4)
    return marked


def pair() -> str:
    """Draw a stereo pair with its correspondences, original and rectified; return the text on their agreement."""
    settings: dict[str, Any] = {
        "render.camera": None,
        "render.cameras": {"left": LEFT, "right": RIGHT},
        "render.size": [PAIR_SIZE, PAIR_SIZE],
        "output": ["stereo"],
    }
    with Simulation(load_scene(ROOT / "scenes" / f"{SCENE}.yaml", settings)) as simulation:
        simulation.advance(FRAME)
        observation = simulation.observe(None, "left")
        pictures = [simulation.draw(name) for name in ("left", "right")]
        cameras = [calibration(simulation.renderer.resolve_camera(name)) for name in ("left", "right")]
    assert observation.stereo is not None
    stereo, hidden = observation.stereo.stereo, observation.stereo.stereo_occlusion
    assert stereo is not None
    assert hidden is not None
    lenses = [(np.array(camera["calibration"]), np.array(camera["distortion"])) for camera in cameras]
    size, translation = (PAIR_SIZE, PAIR_SIZE), np.array(RIGHT["translation"])[:, None]
    rectified = cv2.stereoRectify(*lenses[0], *lenses[1], size, TURN, translation, alpha=0)
    turns, matrices = rectified[:2], rectified[2:4]
    rows, columns = np.nonzero((stereo[..., 0] < 1e9) & (hidden == 0))
    left = np.stack([columns, rows], axis=-1).astype(float)
    both = [left, left + stereo[rows, columns]]

    def rectify(criteria: tuple[int, int, float]) -> list[NDArray[np.float64]]:
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        return [
            undistort(points[:, None], *lens, R=turn, P=matrix, criteria=criteria)[:, 0]
            for points, lens, turn, matrix in zip(both, lenses, turns, matrices, strict=True)
        ]

    exact, five = (rectify((3, iterations, 1e-9)) for iterations in (100, 5))
    offsets = [float(np.abs(first[:, 1] - second[:, 1]).max()) for first, second in (exact, five)]
    shown = ((left + SPACING // 2) % SPACING == 0).all(axis=1)
    shown &= ((exact[0] > 0) & (exact[0] < PAIR_SIZE)).all(axis=1)
    flat = [
        cv2.remap(picture, *cv2.initUndistortRectifyMap(*lens, turn, matrix, size, cv2.CV_32FC1), cv2.INTER_LINEAR)
        for picture, lens, turn, matrix in zip(pictures, lenses, turns, matrices, strict=True)
    ]
    upper, lower = (
        np.hstack([marked(picture, points[shown], rows=rows) for picture, points in zip(drawn, pair, strict=True)])
        for drawn, pair, rows in ((pictures, both, False), (flat, exact, True))
    )
    Image.fromarray(np.vstack([upper, np.full((GAP, 2 * PAIR_SIZE, 3), 255, np.uint8), lower])).save(
        PAIR_PICTURE, quality=88
    )
    return (
        "Corresponding points of the rectified pictures are in the same row to\n"
        f"{offsets[0]:.4f} px; without `criteria`, after OpenCV's five iterations, up to {offsets[1]:.2f} px\n"
        "apart, and more with lenses that distort more.\n"
    )


def main() -> None:
    """Write the pictures, and the residuals of warping and rectification to the page."""
    settings = [f"render.size=[{SIZE},{SIZE}]", f"render.supersample={SAMPLES}"]
    lit = load_scene(ROOT / "scenes" / f"{SCENE}.yaml", settings)
    plain = load_scene(ROOT / "scenes" / f"{SCENE}.yaml", [*settings, "render.shading=none"])
    with Simulation(lit) as simulation, Simulation(plain) as unlit:
        for each in (simulation, unlit):
            each.advance(FRAME)
        picture, labels, first = simulation.draw(), simulation.labels(), unlit.draw()
        for each in (simulation, unlit):
            each.advance()
        flow, second = simulation.flow(labels), unlit.draw()
    back, known = warped(second, flow)
    before, after = (np.abs(picture.astype(float) - first)[known].mean() for picture in (second, back))
    dull, even = "render.light.gloss=0", "render.light.ambient=1"
    lit_left, matt, shadow = (warping_residual(*settings, *off) for off in ([], [dull], [dull, even]))
    panels = {
        f"frame {FRAME}": picture,
        "depth, light is near": shades(labels.depth),
        f"flow, up to {longest(flow):.0f} px": coloured(flow),
        f"difference from frame {FRAME + 1} x {MAGNIFIED}": difference(second.astype(float), first, known),
        f"the same x {MAGNIFIED}, warped by flow": difference(back, first, known),
        "blue: instrument; orange: then hidden": masks(labels, flow),
    }
    page(panels).save(PICTURE, quality=92)
    warping = (
        f"In the top picture, frame {FRAME} of `{SCENE}.yaml` and the next, without light, with\n"
        f"{SIZE} × {SIZE} pixels of {SAMPLES} × {SAMPLES} samples, differ by {before:.2f} grey levels on average\n"
        f"where both show a point, and after warping by {after:.2f}, due to filtering. Lit frames then differ by\n"
        f"{lit_left:.2f}, as light does not move with the tissue: by {matt:.2f} without highlights\n"
        f"(`light.gloss: 0`), and by {shadow:.2f} if light also comes from everywhere (`light.ambient: 1`), due to\n"
        "the tool's shadow and filtering. To compare frames by their colours, draw them with `shading: none`. (By\n"
        "`docs/make_labels.py`, as the lines on the stereo pair.)\n"
    )
    for name, lines in (("warping", warping), ("pair", pair())):
        text = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(replace_marked(text, name, "docs/make_labels.py", lines), encoding="utf-8")
        print(lines, end="")


if __name__ == "__main__":
    main()
