"""Time of a picture by shading, instrument, labels and lens, in turn in one process; frame rate of runs with labels."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from typing import Any

from benchmarks.clock import in_turn, seconds
from benchmarks.drawing.problem import Problem
from benchmarks.process import call
from benchmarks.race import Progress
from benchmarks.whole_run import SCENE, command
from taichi_msm.model.surface import place_instruments
from taichi_msm.render.camera import Shot, view
from taichi_msm.render.labels import requested_labels
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.tracking import compute_flow
from taichi_msm.scene import outputs
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.scene import Scene
from taichi_msm.system import runtime
from taichi_msm.system.process import available_threads

ALL_LABELS = tuple(name for name, output in outputs.OUTPUTS.items() if output.source in ("labels", "flow", "tracks"))

PIXELS = (512, 1024)
REFINE = 10

# The baseline.
HEADLIGHT = "headlight"

LABELS = "labels alone"

# Pinholes without and with a lens, at a height [m] from which the sheet fills either picture.
PINHOLES: dict[str, dict[str, Any]] = {"pinhole": {}, "lens": {"distortion": {"k1": -0.3}}}
HEIGHT = 0.22

# Pictures of every variant in a round.
PICTURES = 8

INSTRUMENT = {"radius": 0.012, "shaft": [0.5, -0.6, 0.9], "length": 0.3}

# Outputs of the timed runs, and their settings.
OUTPUTS = {
    "frames": ("png",),
    "labels": ALL_LABELS,
    "frames and labels": ("png", *ALL_LABELS),
}
SETTINGS = ("sheet.points=[31,31]", "time.duration=6")

Samples = dict[str, list[float]]


def variants(problem: Problem) -> dict[str, Callable[[], Any]]:
    """Return the timed calls."""
    position, camera = problem.position, view(problem.scene)

    def scene(shading: str, **changes: Any) -> Scene:
        render = problem.scene.render.model_copy(update={"shading": shading, **changes})
        return problem.scene.model_copy(update={"render": render})

    def picture(made: Scene, *, picture: bool = True, labels: bool = False) -> Callable[[], Any]:
        names = requested_labels(()) if labels else frozenset[str]()
        drawing = Rasterizer(made, problem.texture, drawing_config(made, picture=picture, labels=names))
        return lambda: drawing.render(position, None, place_instruments(made, position, 0.2))

    def pinhole(lens: dict[str, Any]) -> Scene:
        focal, middle = 1.2 * problem.pixels, (problem.pixels - 1) / 2
        intrinsics = {"fx": focal, "fy": focal, "cx": middle, "cy": middle}
        return with_instrument(scene("tissue", camera=Camera(eye=(0, 0, HEIGHT), intrinsics=intrinsics, **lens)))

    def with_instrument(made: Scene) -> Scene:
        probe = made.probes[0].model_copy(update={"instrument": INSTRUMENT})
        return made.model_copy(update={"probes": [probe]})

    plain, tissue = scene(HEADLIGHT), scene("tissue")
    pinholes = {name: pinhole(lens) for name, lens in PINHOLES.items()}
    coordinates = picture(plain, picture=False, labels=True)().labels.coordinates
    return {
        HEADLIGHT: picture(plain),
        "none": picture(scene("none")),
        "tissue": picture(tissue),
        "tissue, relief": picture(scene("tissue", light={"relief": -0.2})),
        "tissue, instrument": picture(with_instrument(tissue)),
        "headlight and labels": picture(plain, labels=True),
        LABELS: picture(plain, picture=False, labels=True),
        "flow and occlusion": lambda: compute_flow(plain, coordinates, Shot(problem.rest, camera)),
        **{f"tissue, instrument, {name}": picture(made) for name, made in pinholes.items()},
        **{f"{LABELS}, {name}": picture(made, picture=False, labels=True) for name, made in pinholes.items()},
    }


def cost(pixels: int, rounds: int) -> Samples:
    """Return times of every variant [s], measured in turn."""
    runtime.start("cpu", available_threads())
    return in_turn(variants(Problem(pixels, REFINE, lit=True)), rounds, PICTURES)


def labels(pixels: int) -> float:
    """Return the time of the labels of a picture without its colours [s]."""
    runtime.start("cpu", available_threads())
    draw = variants(Problem(pixels, REFINE, lit=True))[LABELS]
    draw()
    return seconds(lambda count: [draw() for _ in range(count)])


def rates(rounds: int) -> Samples:
    """Return frames per second of runs, after compilation, from the first step to the last file."""
    samples: Samples = {name: [] for name in OUTPUTS}
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for name, output in OUTPUTS.items():
                words = [*settings, "--set", f"output=[{','.join(output)}]", "--no-estimate"]
                _, text = command("run", SCENE, "--json", "--out", f"{folder}/out", *words, cache=f"{folder}/cache")
                record = json.loads(text)
                times = record["timings"]
                samples[name].append(record["frames"] / (times["total"] - times["startup"] - times["compile"]))
    return samples


def measure(rounds: int, progress: Progress) -> dict[str, Any]:
    """Time pictures of every size, and runs."""
    pictures = {}
    for pixels in PIXELS:
        progress(f"{pixels} px")
        pictures[str(pixels)] = call("benchmarks.looks:cost", pixels=pixels, rounds=8 * rounds)
    progress("runs")
    return {"pictures": pictures, "rates": rates(rounds)}
