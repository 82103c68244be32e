"""Press a wall, and sheets from its frame and depth, compare them, and measure OpenCV's depth, for docs/frame.md.

    PYTHONPATH=. python docs/make_frame.py

Needs OpenCV (extra `bench`). Takes about two minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.ndimage import map_coordinates

from benchmarks.marked import replace_marked, table
from taichi_msm import Scene, load_scene, run

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "scenes" / "textures"))  # for the modules that make_frame.py imports

from scenes.textures.make_frame import CAMERA, SIDE, SIZE, UNIT, write_wall  # noqa: E402

Floats = NDArray[np.float64]
Sections = dict[str, Any]

PAGE = ROOT / "docs" / "frame.md"

TISSUE = load_scene(ROOT / "scenes" / "frame.yaml").tissue
RADIUS, PRESSED = 0.005, 0.005  # of the ball, and its depth [m]
PLACES = (0.012, -0.012), (0.039, 0.004)  # x and y [m]: in the middle of the frame, near its right border
NEAR = 3 * RADIUS  # radius of the part that is compared [m]

# Mass points of the wall, and of most sheets from its frame, whose cells are about as large.
WALL, SHEET = (241, 241), (121, 151)
COARSE_STEP = 8e-4  # of depths [m]
SMOOTH = 6  # standard deviation of more smoothing [px]
CUT, OF_OPENCV = 48, 3  # columns of pixels at the left without OpenCV's depth, and its smoothing [px]
BASELINE = 0.004  # of the stereo pair on the page [m]


class View:
    """The camera of a run, and the surface that it sees."""

    def __init__(self, folder: Path) -> None:
        camera = json.loads((folder / "camera.json").read_text())
        self.focal, self.pose = camera["intrinsics"][0][0], np.array(camera["pose"])
        with Image.open(folder / "depth" / "0000.tiff") as depths:
            self.depth = np.asarray(depths, dtype=np.float64)

    def pixels(self, points: Floats) -> Floats:
        """Project points [m], shape (n, 3), to pixels from the picture's corner, shape (n, 2)."""
        x, y, z = self.pose[:, :3] @ points.T + self.pose[:, 3:]
        return np.stack([self.focal * x / z + SIZE[0] / 2, self.focal * y / z + SIZE[1] / 2], axis=1)

    def seen(self, pixels: Floats) -> Floats:
        """Return the points of the surface at pixels [m], shape (n, 3)."""
        z = 1 / map_coordinates(1 / self.depth, pixels.T[::-1] - 0.5, order=3, mode="nearest")
        rays = np.column_stack([(pixels - np.array(SIZE) / 2) / self.focal, np.ones(len(pixels))])
        return (rays * z[:, None] - self.pose[:, 3]) @ self.pose[:, :3]


class Pressed(NamedTuple):
    """A sheet at rest and pressed: positions [m] and normals, shape (n, 3), of its mass points, and the force [N]."""

    rest: Floats
    normal: Floats
    moved: Floats
    force: Floats


def ball(across: float, down: float) -> Sections:
    """Return the probe, which comes from behind the camera."""
    path = [[0, across, down, 0.15], [0.5, across, down, 0.002], [1, across, down, -PRESSED]]
    return {"path": path, "instrument": {"radius": RADIUS, "shaft": [0.3, -0.3, 0.9], "length": 0.1}}


def press(folder: Path, across: float, down: float, **sections: Any) -> Pressed:
    """Press a sheet with the ball at a place."""
    time = {"duration": 1, "frames_per_second": 4, "motion": "quasistatic"}
    scene = Scene(tissue=TISSUE, probes=[ball(across, down)], time=time, **sections)
    (tool,) = run(scene, folder, estimate_error=False)["probes"]
    with np.load(folder / "rest.npz") as rest, np.load(folder / "trajectory.npz") as trajectory:
        arrays = rest["position"], rest["normal"], trajectory["position"][-1]
    position, normal, moved = (array.reshape(-1, 3) for array in arrays)
    return Pressed(position, normal, moved, np.array(tool["greatest_force_vector"]))


class Trip:
    """The wall, and sheets from its frame."""

    def __init__(self, folder: Path, at: tuple[float, float]) -> None:
        self.folder = folder
        folder.mkdir()
        wall = write_wall(folder)
        heights = np.load(folder / "wall.npy")
        count = len(heights) // 4
        axis = ((np.arange(count) + 0.5) / count - 0.5) * SIDE
        z = heights.reshape(count, 4, count, 4).mean(axis=(1, 3))
        np.save(folder / "wall.npy", np.stack([*np.meshgrid(axis, -axis), z], axis=-1))
        surface = {"points": {"file": str(folder / "wall.npy"), "unit": "m"}, "grid": "even"}
        self.sections: Sections = {
            "image": wall["image"],
            "render": wall["render"],
            "output": ["png", "depth", "trajectory"],
        }
        self.sheet: Sections = {"points": WALL, "surface": surface, "fixed": "border"}
        run(self.at_rest(), folder / "rest", estimate_error=False)
        self.view = View(folder / "rest")
        with np.load(folder / "rest" / "rest.npz") as rest:
            position = rest["position"]
        row, col = np.unravel_index(np.hypot(*(position[..., :2] - at).T).T.argmin(), WALL)
        self.place = position[row, col]
        self.fractions = col / (WALL[1] - 1), row / (WALL[0] - 1)
        self.whole = press(folder / "whole", *self.fractions, sheet=self.sheet, **self.sections)
        near = np.linalg.norm(self.whole.rest - self.place, axis=1) < 2 * NEAR
        values = np.hstack([self.whole.moved - self.whole.rest, self.whole.normal])[near]
        self.of_wall = CloughTocher2DInterpolator(self.whole.rest[near, :2], values)

    def at_rest(self) -> Scene:
        """Return the scene of the wall without the ball."""
        time = {"duration": 1, "frames_per_second": 1, "motion": "quasistatic"}
        return Scene(tissue=TISSUE, time=time, sheet=self.sheet, **self.sections)

    @property
    def border_distance(self) -> float:
        """Distance of the place to the visible surface at the frame's border [m]."""
        width, height = SIZE
        row, column = np.indices((height, width))
        is_border = (row % (height - 1) == 0) | (column % (width - 1) == 0)
        border = self.view.seen(np.column_stack([column[is_border], row[is_border]]) + 0.5)
        return float(np.linalg.norm(border - self.place, axis=1).min())

    def visible_part(self) -> Pressed:
        """Press the wall without its part outside the frame, where it is fixed."""
        position = self.whole.rest.reshape(*WALL, 3)
        middle = (position[1:, 1:] + position[1:, :-1] + position[:-1, 1:] + position[:-1, :-1]) / 4
        pixels = self.view.pixels(middle.reshape(-1, 3))
        is_seen = ((pixels > 0) & (pixels < SIZE)).all(axis=1).reshape(middle.shape[:2])
        Image.fromarray(np.where(is_seen, 255, 0).astype(np.uint8)).save(self.folder / "mask.png")
        sheet = {**self.sheet, "mask": str(self.folder / "mask.png"), "fixed": "outline"}
        return press(self.folder / "part", *self.fractions, sheet=sheet, **self.sections)

    def from_frame(
        self, depth: NDArray[Any], unit: float = 1, points: tuple[int, int] = SHEET, left: int = 0, **keys: Any
    ) -> Pressed:
        """Press the sheet of the frame, without some columns of pixels at its left, and a depth in a unit [m]."""
        np.save(self.folder / "depth.npy", depth)
        grid = keys.pop("grid", "even")
        across, down = (self.view.pixels(self.place[None])[0] - (left, 0)) / (SIZE[0] - left, SIZE[1])
        surface = {"depth": {"file": str(self.folder / "depth.npy"), "unit": unit, **keys}, "grid": grid}
        return press(
            self.folder / f"sheet{len(list(self.folder.iterdir()))}",
            across,
            down,
            image=str(self.folder / "rest" / "frames" / "0000.png"),
            region=(left, 0, SIZE[0] - left, SIZE[1]),
            sheet={"points": points, "surface": surface, "fixed": "border"},
            render={"camera": CAMERA},
            output=["trajectory"],
        )

    def row(self, name: str, pressed: Pressed) -> list[str]:
        """Return the errors of a sheet near the ball, against the whole wall."""
        near = np.linalg.norm(pressed.rest - self.place, axis=1) < NEAR
        near &= np.linalg.norm(pressed.normal, axis=1) > 0.5  # mass points without a cell have no normal
        rest, moved = pressed.rest[near], pressed.moved[near]
        pixels = self.view.pixels(rest)
        true_rest = self.view.seen(pixels)
        motion, normal = np.hsplit(self.of_wall(true_rest[:, :2]), 2)
        surface = np.abs(((moved - true_rest - motion) * normal).sum(axis=1))
        error = np.linalg.norm(moved - rest - motion, axis=1)
        flow = np.linalg.norm(self.view.pixels(moved) - self.view.pixels(true_rest + motion), axis=1)
        force, true_force = np.linalg.norm(pressed.force), np.linalg.norm(self.whole.force)
        columns = (1000 * np.linalg.norm(rest - true_rest, axis=1), 1000 * surface, 1000 * error)
        return [
            name,
            *(f"{values.mean():.3f}, {values.max():.3f} mm" for values in columns),
            f"{flow.mean():.2f}, {flow.max():.2f} px",
            f"{100 * (force / true_force - 1):+.1f} %",
        ]


def draw_pair(scene: Scene, folder: Path) -> None:
    """Draw a scene at rest, without its tools, as the stereo pair of the page."""
    render = scene.render.model_dump(mode="json", exclude_unset=True)
    cameras = {"left": render.pop("camera"), "right": {"beside": "left", "baseline": BASELINE}}
    sections = scene.model_dump(mode="json", exclude_unset=True, include={"image", "sheet", "tissue"})
    time = {"duration": 1, "frames_per_second": 1, "motion": "quasistatic"}
    pair = Scene(**sections, time=time, render={**render, "cameras": cameras}, output=["png", "depth"])
    run(pair, folder / "output" / "pair", estimate_error=False)


def match(folder: Path) -> Floats:
    """Return OpenCV's depth of a pair [m], 0 where there is none, by the code of the page."""
    code = PAGE.read_text(encoding="utf-8").split("```py\n")[1].split("```")[0]
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)
    depth: Floats = np.load(folder / "depth.npy")
    return depth


def match_row(name: str, scene: Scene, folder: Path) -> tuple[Floats, list[str]]:
    """Return OpenCV's depth of a scene as a pair [m], and the row of its errors."""
    draw_pair(scene, folder)
    depth = match(folder)
    with Image.open(folder / "output" / "pair" / "left" / "depth" / "0000.tiff") as depths:
        errors = 1000 * np.abs(depth - np.asarray(depths))[depth > 0]
    missing = 100 * np.mean(depth == 0)
    return depth, [name, f"{missing:.0f} %", f"{np.median(errors):.2f} mm", f"{np.quantile(errors, 0.95):.2f} mm"]


def tables() -> tuple[str, str]:
    """Return the tables of the errors of sheets from a frame, and of OpenCV's depth."""
    with TemporaryDirectory() as name:
        trip, at_border = (Trip(Path(name) / f"{n}", at) for n, at in enumerate(PLACES))
        depth = trip.view.depth
        counts = np.rint(depth / UNIT).astype(np.uint16)
        coarse = np.rint(depth / COARSE_STEP).astype(np.uint16)
        _, shipped = match_row("`frame.yaml`", load_scene(ROOT / "scenes" / "frame.yaml"), Path(name))
        matched, wall = match_row("the wall above, with highlights", trip.at_rest(), Path(name))
        row, sheet = trip.row, trip.from_frame
        rows = [
            row(f"the wall, cut off at the border, {1000 * trip.border_distance:.0f} mm away", trip.visible_part()),
            row("from the frame, depth exact, `smooth: 0`, `grid: given`", sheet(depth, grid="given", smooth=0)),
            row("`grid: even`", sheet(depth, smooth=0)),
            row("`smooth: auto`, 1.6 px", sheet(depth)),
            row("depth in steps of 0.02 mm (16 bits)", sheet(counts, UNIT)),
            row("depth in steps of 0.8 mm", sheet(coarse, COARSE_STEP)),
            row(f"the same, `smooth: {SMOOTH}`", sheet(coarse, COARSE_STEP, smooth=SMOOTH)),
            row(f"depth of OpenCV (below), `smooth: {OF_OPENCV}`", sheet(matched, left=CUT, smooth=OF_OPENCV)),
            row("depth in steps of 0.02 mm, 65 x 81 points", sheet(counts, UNIT, (65, 81))),
            at_border.row(
                f"the same, {1000 * at_border.border_distance:.0f} mm from the border",
                at_border.from_frame(np.rint(at_border.view.depth / UNIT).astype(np.uint16), UNIT, (65, 81)),
            ),
        ]
        print(f"{np.linalg.norm(trip.whole.force):.3f} N at {trip.place} m")
    trip_head = ["sheet", "depth", "surface", "displacement", "flow", "force"]
    return table(trip_head, rows), table(["frames", "without depth", "median error", "95 % below"], [shipped, wall])


def check_lines() -> str:
    """Return the lines of `taichi-msm check` on the surface of the shipped scene."""
    command = [sys.executable, "-m", "taichi_msm", "check", "scenes/frame.yaml"]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    lines = [line for line in printed.splitlines() if line.startswith("surface:")]
    return "\n".join(["```text", *lines, "```", ""])


def main() -> None:
    """Write the tables of the page."""
    trip, pair = tables()
    page = PAGE.read_text(encoding="utf-8")
    for part, text in (("check", check_lines()), ("trip", trip + "\n"), ("pair", pair + "\n")):
        page = replace_marked(page, part, "docs/make_frame.py", text)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
