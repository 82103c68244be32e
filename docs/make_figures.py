"""Draw the pictures of the README and of the pages on scenes, labels, sweeps and live sessions.

    PYTHONPATH=. python docs/make_figures.py

Needs the extras `test` and `bench`, for the plots and the photograph, and Chromium. Takes about two minutes.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import skimage
from matplotlib import style
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import Simulation, load_scene, run
from taichi_msm.cli.main import main as main_of_program
from taichi_msm.load.scene_file import plan_file
from taichi_msm.plot_style import BLUE, DPI, GREY, INK, ONE_COLUMN_WIDTH, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.scene.camera import Camera
from taichi_msm.sweeps.spec import load_sweep
from taichi_msm.view.recording import Captures
from taichi_msm.view.script import load_script, record_film, schedule_events
from taichi_msm.view.server import Server
from taichi_msm.view.session import Session
from taichi_msm.view.web import Address
from tests.view.chromium import chromium

Floats = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
SCENES = ROOT / "scenes"
IMAGES = ROOT / "docs" / "images"

# The most characteristic moment of each scene [s].
MOMENTS = {"drag": 1.12, "two-tools": 0.84, "tumour": 2.2}

# The stages of the paper's figure 3: at rest, pressed, pressed fully, let go.
STAGES = (0.0, 0.2, 0.4, 0.64)

# Half the frames of the shipped scenes.
SLOW = "time.frames_per_second=12.5"

# The scene press on a dome.
DOME = (
    SLOW,
    "sheet.surface={dome: {radius: 0.064}}",
    "render.camera={eye: [0, -0.09, 0.075], target: [0, -0.012, -0.008], fov: 42}",
    "render.light={ambient: 0, relief: -0.1, gloss: 0.3}",
)

# A fundus photograph, CC0, NHS Foundation Trust; it comes with scikit-image.
RETINA = Path(skimage.__file__).parent / "data" / "retina.jpg"


def frames(scene_file: Path, moments: tuple[float, ...], size: tuple[int, int]) -> list[Image.Image]:
    """Draw a scene at some moments [s]."""
    scene = load_scene(scene_file, [f"render.size={list(size)}", "render.supersample=2", "output=[png]"])
    pictures = []
    with Simulation(scene) as simulation:
        for moment in moments:
            simulation.advance(round(moment * scene.time.frames_per_second) - simulation.frame)
            pictures.append(Image.fromarray(simulation.draw()))
    return pictures


def animation(
    name: str, scene: str, size: int, *overrides: str, image: Path | None = None, height: int | None = None
) -> None:
    """Write the film of a scene as an animated WebP, in another size (by default square) or on another picture."""
    settings = [f"render.size=[{size},{height or size}]", "render.supersample=2", "output=[png]", *overrides]
    described = load_scene(SCENES / f"{scene}.yaml", settings, image)
    with tempfile.TemporaryDirectory() as directory:
        run(described, directory, estimate_error=False)
        first, *others = (Image.open(path) for path in sorted(Path(directory, "frames").iterdir()))
        duration = round(1000 / described.time.frames_per_second)
        film = {"save_all": True, "append_images": others, "duration": duration, "loop": 0}
        first.save(IMAGES / f"{name}.webp", None, **film, quality=82, method=6)


def endoscope(size: int) -> None:
    """Write the film of the scene endoscope, in another size, with every second frame."""
    shipped = load_scene(SCENES / "endoscope.yaml")
    assert isinstance(shipped.render.camera, Camera)
    assert shipped.render.camera.intrinsics is not None
    share = size / shipped.render.size[0]
    # The principal point, from the picture's corner, is half a pixel more.
    values = {
        name: round((value + 0.5) * share - 0.5 if name in ("cx", "cy") else value * share, 2)
        for name, value in shipped.render.camera.intrinsics.model_dump().items()
    }
    rate = shipped.time.frames_per_second / 2
    smaller = (f"render.camera.intrinsics={json.dumps(values)}", f"time.frames_per_second={rate:g}")
    animation("endoscope", "endoscope", size, *smaller)


def four_pixels() -> None:
    """Draw the upper left pixels of a picture with both conventions of coordinates."""
    figure, axes = plt.subplots(figsize=(5.6, 3.9), layout="constrained")
    axes.set(xlim=(-0.75, 2.75), ylim=(2.5, -0.75), aspect="equal")
    axes.axis("off")
    axes.imshow([[0.93, 0.87], [0.87, 0.93]], cmap="gray", vmin=0, vmax=1, extent=(0, 2, 2, 0))
    for edge in range(3):
        axes.plot([0, 2.2], [edge, edge], color=GREY, linewidth=1)
        axes.plot([edge, edge], [0, 2.2], color=GREY, linewidth=1)
        axes.annotate(f"{edge}", (edge, -0.08), ha="center", va="bottom", color=VERMILION)
        axes.annotate(f"{edge}", (-0.08, edge), ha="right", va="center", color=VERMILION)
    for across in range(2):
        for down in range(2):
            centre = across + 0.5, down + 0.5
            axes.plot(*centre, "o", color=INK, markersize=4)
            axes.annotate(f"({centre[0]}, {centre[1]})", (centre[0], down + 0.34), ha="center", color=VERMILION)
            axes.annotate(f"({across}, {down})", (centre[0], down + 0.78), ha="center", color=BLUE)
    for text, colour, at in (("from the corner of the picture", VERMILION, -0.42), ("OpenCV", BLUE, 2.42)):
        axes.annotate(text, (1, at), ha="center", color=colour)
    figure.savefig(IMAGES / "pixels.png", dpi=110)


def stereo(moment: float, size: int) -> None:
    """Draw the scene grasp from two cameras at a moment [s], and the disparity of the left one."""
    right = {"beside": "left", "baseline": 0.005}
    camera = load_scene(SCENES / "grasp.yaml").render.camera
    assert isinstance(camera, Camera)
    cameras = {"left": camera.model_dump(mode="json", exclude_unset=True), "right": right}
    changes = {"render.camera": None, "render.cameras": cameras, "render.size": [size, size]}
    scene = load_scene(SCENES / "grasp.yaml", {**changes, "output": ["png", "disparity"]})
    frame = round(moment * scene.time.frames_per_second)
    with tempfile.TemporaryDirectory() as directory:
        run(scene, directory)
        pair = [Image.open(Path(directory, name, "frames", f"{frame:04}.png")).convert("RGB") for name in cameras]
        disparity = np.array(Image.open(Path(directory, "left", "disparity", f"{frame:04}.tiff")))
    figure, axes = plt.subplots(1, 3, figsize=(TWO_COLUMN_WIDTH, 2.9), layout="constrained")
    shown = np.where(disparity > 0, disparity, np.nan)
    axes[0].imshow(pair[0])
    axes[1].imshow(pair[1])
    image = axes[2].imshow(shown, cmap="viridis")
    for axis, title in zip(axes, ("left", "right", "disparity of left [px]"), strict=True):
        axis.set_title(title)
        axis.axis("off")
    figure.colorbar(image, ax=axes[2])
    figure.savefig(IMAGES / "stereo.jpg", dpi=130, pil_kwargs={"quality": 90})


def depth_frame(moment: float) -> None:
    """Draw the frame of the scene frame, its depth, the wall under the probe at a moment [s], and the flow."""
    scene = load_scene(SCENES / "frame.yaml", {"output": ["png", "depth", "flow"], "time.duration": moment + 0.04})
    frame = round(moment * scene.time.frames_per_second)
    assert scene.image is not None
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        run(scene, folder, estimate_error=False)
        files = scene.image, SCENES / "textures" / "frame-depth.png", folder / "frames" / f"{frame:04}.png"
        picture, counts, pressed = (np.array(Image.open(file)) for file in files)
        flow: Floats = np.fromfile(folder / "flow" / f"{frame:04}.flo", "<f4", offset=12).reshape(*counts.shape, 2)
    figure, axes = plt.subplots(2, 2, figsize=(8, 6), layout="constrained")
    length = np.where(np.abs(flow[..., 0]) < 1e9, np.hypot(flow[..., 0], flow[..., 1]), np.nan)
    axes[0, 0].imshow(picture)
    figure.colorbar(axes[0, 1].imshow(0.02 * counts, cmap="viridis"), ax=axes[0, 1])
    axes[1, 0].imshow(pressed)
    figure.colorbar(axes[1, 1].imshow(length, cmap="magma"), ax=axes[1, 1])
    y, x = np.nonzero(length > 0.3)
    y, x = np.stack([y, x])[:, (y % 24 == 12) & (x % 24 == 12)]
    axes[1, 1].quiver(x, y, *flow[y, x].T, color="white", angles="xy", scale_units="xy", scale=0.15)
    titles = "a frame", "its depth [mm]", "its wall under a probe", "a label: the flow to the next frame [px]"
    for axis, title in zip(axes.flat, titles, strict=True):
        axis.set_title(title)
        axis.axis("off")
    figure.savefig(IMAGES / "frame.jpg", dpi=100, pil_kwargs={"quality": 88})


def forces_of(name: str) -> tuple[Floats, Floats, Floats]:
    """Return the times [s], positions of the tip [m] and forces [N] of a scene's only tool in all frames."""
    time, tip, force = [], [], []
    with Simulation(load_scene(SCENES / f"{name}.yaml", {"output": []})) as simulation:
        for frame in range(simulation.scene.time.frames + 1):
            simulation.advance(min(frame, 1))
            (tool,) = simulation.forces()
            time.append(simulation.time)
            tip.append(tool.tip)
            force.append(tool.force)
    return np.array(time), np.array(tip), np.array(force)


def indentation() -> None:
    """Plot the force of the scene indent against time and depth."""
    time, tip, force = forces_of("indent")
    depth, upward = -1000 * tip[:, 2], -force[:, 2]
    deepest = int(depth.argmax())
    figure, (over_time, over_depth) = plt.subplots(
        1, 2, figsize=(TWO_COLUMN_WIDTH, 3.4), sharey=True, layout="constrained"
    )
    over_time.plot(time, upward, "o-", color=BLUE, markersize=3)
    over_time.set(xlabel="time [s]", ylabel="force on the tip [N]")
    over_depth.plot(depth[: deepest + 1], upward[: deepest + 1], "o-", color=BLUE, markersize=4, label="going down")
    over_depth.plot(
        depth[deepest:], upward[deepest:], "o", color=VERMILION, markersize=8, fillstyle="none", label="coming up"
    )
    slopes = [np.polyfit(depth[part], upward[part], 1) for part in (slice(1, 4), slice(deepest - 2, deepest + 1))]
    for slope, ends, label in zip(slopes, ([0, 3.2], [2.8, 6]), ([3.3, 0.17], [3.4, 0.55]), strict=True):
        over_depth.plot(ends, np.polyval(slope, ends), "--", color=GREY, linewidth=1)
        over_depth.annotate(f"{slope[0]:.2f} N/mm", label)
    over_depth.set(xlabel="depth of the tip [mm]")
    over_depth.legend(loc="upper left")
    figure.savefig(IMAGES / "indent.png", dpi=DPI)


def palpation() -> None:
    """Plot the force on the finger at each position of the scene tumour, above the map of stiffness."""
    _, tip, force = forces_of("tumour")
    scene = load_scene(SCENES / "tumour.yaml")
    deepest = tip[:, 2] <= tip[:, 2].min() + 1e-9
    width = 1000 * scene.sheet.size[1]
    figure, (force_axes, map_axes) = plt.subplots(
        2, 1, figsize=(ONE_COLUMN_WIDTH, 4.4), sharex=True, layout="constrained"
    )
    force_axes.bar(1000 * tip[deepest, 0], np.linalg.norm(force[deepest], axis=1), width=5, color=BLUE)
    force_axes.set(ylabel="force 3 mm deep [N]", box_aspect=1 / 3)
    with Image.open(SCENES / "textures" / "tumour.png") as stiffness:
        third = stiffness.height // 3
        middle = np.asarray(stiffness)[third:-third]
        map_axes.grid(visible=False)
        map_axes.imshow(middle, cmap="gray", extent=(-width / 2, width / 2, -width / 6, width / 6))
    map_axes.plot(1000 * tip[deepest, 0], 1000 * tip[deepest, 1], "o", color=VERMILION)
    map_axes.set(xlabel="position of the tip, from the middle of the sheet [mm]", ylabel="[mm]")
    figure.savefig(IMAGES / "palpation.png", dpi=DPI)


def live(name: str, size: int, rate: float, seconds: float) -> None:
    """Record a film of a live session with the scene press and its script."""
    settings = {"render.size": [size, size], "render.supersample": 2, "time.frames_per_second": rate}
    scene = load_scene(SCENES / "press.yaml", settings)
    script = load_script(SCENES / "scripts" / "press.yaml", scene.render.size)
    with tempfile.TemporaryDirectory() as directory, Session(scene, Captures(Path(directory), "press.yaml")) as session:
        record_film(
            session, IMAGES / f"{name}.gif", seconds, schedule_events(script, session.frame_rate, scene.render.size)
        )


def page(width: int, height: int) -> None:
    """Save a screenshot of a session with the scene press, with a stiffer foundation at the end."""

    async def press(session: Session, folder: Path) -> None:
        with Address(0) as address:
            server = Server(session, address, "scenes/press.yaml")
            serving = asyncio.create_task(server.run(lambda: None))
            async with chromium(folder / "profile") as tab:
                await tab.open(server.url, width, height)
                await tab.until("state !== null && state.time > 0.3")
                for strength in (40, 70, 100):
                    await tab.value(f"send('strength', {strength}); send('press', 200, 300, false)")
                    await tab.until(f"state.time > {session.frame / session.frame_rate + 1.0}")
                    await tab.value("send('release')")
                    await tab.until(f"state.time > {session.frame / session.frame_rate + 0.5}")
                await tab.value("send('press', 230, 310, false)")
                await tab.until(f"state.time > {session.frame / session.frame_rate + 0.7}")
                await tab.value("send('material', 'tissue.foundation', 4.5e5)")
                await tab.until(f"state.time > {session.frame / session.frame_rate + 0.7}")
                await tab.screenshot(folder / "page.png")
            serving.cancel()
            await asyncio.wait([serving])

    scene = load_scene(SCENES / "press.yaml", {"render.size": [720, 720], "render.supersample": 2})
    with tempfile.TemporaryDirectory() as directory, Session(scene, Captures(Path(directory), "press.yaml")) as session:
        asyncio.run(press(session, Path(directory)))
        with Image.open(Path(directory) / "page.png") as picture:
            picture.convert("RGB").save(IMAGES / "browser.jpg", quality=84)


def sweep() -> None:
    """Write smaller pictures of the contact sheet and the plot of the sweep stiffness."""
    with tempfile.TemporaryDirectory() as directory:
        if main_of_program(["sweep", str(SCENES / "sweeps" / "stiffness.yaml"), "--out", directory]) != 0:
            raise SystemExit("the sweep failed")
        # Two rows of the contact sheet.
        for name, share, target in (("contact.jpg", 0.34, "sweep-contact.jpg"), ("sweep.png", 1, "sweep-plot.png")):
            with Image.open(Path(directory) / name) as picture:
                part = picture.convert("RGB").crop((0, 0, picture.width, round(share * picture.height)))
            part.resize((1400, round(1400 * part.height / part.width))).save(IMAGES / target, quality=88)


def data_set(runs: int, moment: float, size: int) -> list[Image.Image]:
    """Draw the first runs of the sweep tracking at a moment [s]."""
    described = load_sweep(SCENES / "sweeps" / "tracking.yaml")
    pictures = []
    for values in described.values(runs):
        plan = plan_file(described.scene, (*described.overrides(values), f"render.size=[{size},{size}]"))
        with Simulation(plan) as simulation:
            simulation.advance(round(moment * plan.scene.time.frames_per_second))
            pictures.append(Image.fromarray(simulation.draw()))
    return pictures


def grid(pictures: list[Image.Image], columns: int, gap: int = 6) -> Image.Image:
    """Arrange pictures in rows on white."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    page = Image.new("RGB", (columns * (width + gap) - gap, rows * (height + gap) - gap), "white")
    for n, picture in enumerate(pictures):
        page.paste(picture, (n % columns * (width + gap), n // columns * (height + gap)))
    return page


def main() -> None:
    """Write every picture."""
    IMAGES.mkdir(exist_ok=True)
    animation("press", "press", 384)
    animation("kidney", "kidney", 384, SLOW, "time.duration=2.24")
    animation("incision", "incision", 384, SLOW)
    animation("frame", "frame", 400, SLOW, height=320)
    animation("retina", "grasp", 384, image=RETINA)
    animation("dome", "press", 384, *DOME, image=RETINA)
    endoscope(384)
    with style.context(STYLE, after_reset=True):
        depth_frame(0.36)
        four_pixels()
        stereo(0.8, 400)
        indentation()
        palpation()
    live("live", 250, 10, 4.8)
    page(1280, 800)
    stages = frames(SCENES / "figure-3.yaml", STAGES, (560, 420))
    grid(stages, 2).save(IMAGES / "figure-3.jpg", quality=90)
    stills = [frames(SCENES / f"{name}.yaml", (moment,), (400, 400))[0] for name, moment in MOMENTS.items()]
    grid(stills, 3).save(IMAGES / "scenes.jpg", quality=90)
    grid(data_set(8, moment=0.72, size=300), 4).save(IMAGES / "data-set.jpg", quality=88)
    sweep()
    for path in sorted(IMAGES.iterdir()):
        print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1024:.0f} KiB  {np.array(Image.open(path)).shape}")


if __name__ == "__main__":
    main()
