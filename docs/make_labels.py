"""Make the picture of labels.md and its line on flow, which is checked by what it is for: to warp a frame.

    PYTHONPATH=. python docs/make_labels.py

What frame i + 1 shows where flow leads from a pixel of frame i is what frame i shows there, but for light, which is
switched off for that. What is left comes from filtering, and beside outlines from pixels that show both sides of them.
Light is then switched on again, at first without highlights and the lamp's direction, which leaves the tool's shadow.
"""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from taichi_msm import Flow, Labels, Simulation, load_scene

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "images" / "labels.jpg"
PAGE = ROOT / "docs" / "labels.md"
START, END = "<!-- warping: made by docs/make_labels.py -->\n", "<!-- end of warping -->\n"

# The frame before the fold of grasp.yaml drops, when everything moves.
SCENE, FRAME = "grasp", 21
SIZE, GAP, SAMPLES = 300, 6, 3

# How many times differences are shown as large as they are.
STRONGER = 6

Image8 = NDArray[np.uint8]


def warped(later: Image8, flow: Flow) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fetch what a later picture shows where flow leads, filtered bilinearly.

    Args:
        later: colours, shape (height, width, 3).
        flow: from the earlier frame to it.

    Returns:
        Colours, shape (height, width, 3); and where they are known: on the sheet, if it is not hidden then.
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


def left_over(*settings: str) -> float:
    """Return the mean difference between a frame and the next one, warped, of the scene with some settings [grey]."""
    with Simulation(load_scene(ROOT / "scenes" / f"{SCENE}.yaml", settings)) as simulation:
        simulation.advance(FRAME)
        first, labels = simulation.draw(), simulation.labels()
        simulation.advance()
        back, known = warped(simulation.draw(), simulation.flow(labels))
    return float(np.abs(back - first)[known].mean())


def coloured(flow: Flow) -> Image8:
    """Show directions as hues and lengths as saturation."""
    known = flow.flow[..., 0] < 1e9
    right, down = np.moveaxis(np.where(known[..., None], flow.flow, 0), -1, 0)
    length = np.hypot(right, down) / np.hypot(right, down).max()
    hues = np.array([colorsys.hsv_to_rgb(n / 360, 1, 1) for n in range(360)])
    hue = hues[np.degrees(np.arctan2(down, right)).astype(int) % 360]
    return np.where(known[..., None], 255 * (1 - length[..., None] * (1 - hue)), 0).astype(np.uint8)


def longest(flow: Flow) -> float:
    """Give the longest flow [px]."""
    return float(np.hypot(*np.moveaxis(flow.flow, -1, 0))[flow.flow[..., 0] < 1e9].max())


def shades(depth: NDArray[np.float32]) -> Image8:
    """Show what is nearer as brighter."""
    near, far = np.percentile(depth[depth > 0], [0.5, 99.5])
    grey = np.where(depth > 0, np.clip(255 * (far - depth) / (far - near), 20, 255), 0)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def masks(labels: Labels, flow: Flow) -> Image8:
    """Show the instrument in blue, and what will be hidden in orange."""
    found = np.full((*flow.occlusion.shape, 3), 40, np.uint8)
    found[labels.instrument > 0] = (90, 150, 255)
    found[flow.occlusion > 0] = (255, 150, 40)
    return found


def difference(a: NDArray[np.floating], b: Image8, known: NDArray[np.bool_]) -> Image8:
    """Show a difference where it is known."""
    apart = np.clip(STRONGER * np.abs(a - b), 0, 255) * known[..., None]
    return apart.astype(np.uint8)


def page(panels: dict[str, Image8]) -> Image.Image:
    """Put panels in two rows, each with its name."""
    columns = len(panels) // 2
    sheet = Image.new("RGB", (columns * (SIZE + GAP) - GAP, 2 * (SIZE + 22)), "white")
    draw = ImageDraw.Draw(sheet)
    for n, (name, panel) in enumerate(panels.items()):
        corner = n % columns * (SIZE + GAP), n // columns * (SIZE + 22)
        sheet.paste(Image.fromarray(panel), corner)
        draw.text((corner[0] + SIZE // 2, corner[1] + SIZE + 11), name, "black", anchor="mm", font_size=13)
    return sheet


def main() -> None:
    """Write the picture, and to the page what is left after warping."""
    settings = [f"render.size=[{SIZE},{SIZE}]", f"render.supersample={SAMPLES}"]
    lit = load_scene(ROOT / "scenes" / f"{SCENE}.yaml", settings)
    plain = load_scene(ROOT / "scenes" / f"{SCENE}.yaml", [*settings, "render.shading=none"])
    with Simulation(lit) as simulation, Simulation(plain) as unlit:
        for one in (simulation, unlit):
            one.advance(FRAME)
        picture, labels, first = simulation.draw(), simulation.labels(), unlit.draw()
        for one in (simulation, unlit):
            one.advance()
        flow, second = simulation.flow(labels), unlit.draw()
    back, known = warped(second, flow)
    before, after = (np.abs(one.astype(float) - first)[known].mean() for one in (second, back))
    dull, even = "render.light.gloss=0", "render.light.ambient=1"
    whole, matt, shadow = (left_over(*settings, *off) for off in ([], [dull], [dull, even]))
    panels = {
        f"frame {FRAME}": picture,
        "depth, light is near": shades(labels.depth),
        f"flow, up to {longest(flow):.0f} px": coloured(flow),
        f"difference from frame {FRAME + 1} x {STRONGER}": difference(second.astype(float), first, known),
        f"the same x {STRONGER}, warped by flow": difference(back, first, known),
        "blue: instrument; orange: then hidden": masks(labels, flow),
    }
    page(panels).save(PICTURE, quality=92)
    said = (
        f"The top picture shows it: frame {FRAME} of `{SCENE}.yaml` and the next, drawn without light at\n"
        f"{SIZE} × {SIZE} pixels of {SAMPLES} × {SAMPLES} samples, differ by {before:.2f} grey levels on average\n"
        f"where the next one shows the same; fetched from where flow leads, by {after:.2f}, due to filtering.\n"
        f"Lit frames differ by {whole:.2f} then. Light is not carried along by the tissue: how bright a point is\n"
        "depends on how it is turned to the lamp and how near it is, the tool's shadow moves over it, and highlights\n"
        f"change with the line of sight. {matt:.2f} are left without highlights (`light.gloss: 0`), and {shadow:.2f}\n"
        "if light comes from everywhere, too (`light.ambient: 1`): the shadow, and filtering. To compare frames by\n"
        "their colours, draw them with `shading: none`. (`docs/make_labels.py` makes the picture and these lines.)\n"
    )
    begin, rest = PAGE.read_text(encoding="utf-8").split(START)
    PAGE.write_text(begin + START + said + END + rest.split(END)[1], encoding="utf-8")
    print(said, end="")


if __name__ == "__main__":
    main()
