"""Run the code of docs/fit-indentation.md, and measure the errors of five parameters for docs/fit.md.

    python docs/make_fit.py

Writes a picture, and prints the numbers of both pages. Takes about two minutes.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from taichi_msm import FitResult, Scene, Simulation, fit, load_scene, run
from taichi_msm.plot_style import BLUE, DPI, STYLE, VERMILION

Floats = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"

# The test of docs/fit-indentation.md with its hold: time [s], depth [mm] and force [N], as recorded by S. Iaquinta on
# 3 April 2023; every third row, then every tenth, of the sheet 230403-FF2A of
# indentation/experiments/zwick/raw_data/230403/230403_C_Indentation_relaxation_500N_force.xlsx
# in https://github.com/SarahIaquinta/perineal_indentation at 167a964. Without contact the force is 0.012 N, and the
# distance to the table 15.6 mm. The tool descends at 1.5 mm/s until 3.9 s, slows down, and is held from 4.7 s.
BEEF = """
    0.6 0.1844 0.0134   0.9 0.6343 0.0314   1.2 1.0843 0.0631   1.5 1.5344 0.1054   1.8 1.9844 0.1558
    2.1 2.4345 0.2164   2.4 2.8844 0.2922   2.7 3.3343 0.3861   3.0 3.7845 0.4988   3.3 4.2345 0.6322
    3.6 4.6845 0.7961   3.9 5.1342 0.9870   4.2 5.4909 1.0999   4.5 5.7310 1.1604   4.6 5.7946 1.1716
    4.8 5.8277 1.0462   5.4 5.8277 0.8766   6.2 5.8277 0.7820   7.0 5.8277 0.7250   7.8 5.8277 0.6894
    8.6 5.8277 0.6580   9.4 5.8277 0.6354  10.2 5.8277 0.6142  11.0 5.8277 0.5968  11.8 5.8277 0.5829
   12.6 5.8277 0.5690  13.4 5.8277 0.5581  14.2 5.8277 0.5469  15.0 5.8277 0.5366
"""
CONTACT, STEADY_ROWS = (0.6, 0.1844, 0.012), 12

# Young's modulus of the observed tissue [Pa], and errors of tracks [px].
TRUTH, ERROR = 2e4, 1.0
FIVE = ["tissue.young", "tissue.foundation", "tissue.damping", "probes.0.at.0", "probes.0.at.1"]


def beef() -> tuple[FitResult, Floats]:
    """Run the page's code; return its result, and the complete table: time [s], depth [m] and force [N]."""
    table = np.array(BEEF.split(), np.float64).reshape(-1, 3) - CONTACT
    table[:, 1] /= 1000
    code = (ROOT / "docs" / "fit-indentation.md").read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as directory:
        code = code.replace('"beef.csv"', repr(str(Path(directory) / "beef.csv")))
        exec(compile(code, "fit-indentation.md", "exec"), names)
    assert np.allclose(np.array([names["times"], names["depths"], names["forces"]]).T, table[:STEADY_ROWS])
    return names["found"], table


def draw_beef(result: FitResult, table: Floats) -> None:
    """Draw the forces against depth and time; the model has a single force at a depth."""
    times, depth, force = table.T
    scene = result.scene.model_dump(mode="json", exclude_none=True)
    scene["probes"][0]["path"] = [[t, 0.5, 0.5, -d] for t, d in zip(times.tolist(), depth.tolist(), strict=True)]
    scene["time"]["duration"] = float(times[-1])
    model = []
    with Simulation(scene) as simulation:
        for frame in range(simulation.scene.time.frames + 1):
            simulation.advance(min(frame, 1))
            model.append((simulation.time, -simulation.forces()[0].tip[2], -simulation.forces()[0].force[2]))
    model_times, model_depth, model_force = np.array(model).T
    end = int(np.searchsorted(model_times, times[STEADY_ROWS - 1] + 1e-6))
    with plt.style.context(STYLE, after_reset=True):
        figure, (over, held) = plt.subplots(1, 2, figsize=(7.5, 2.9), sharey=True, layout="constrained")
        over.plot(1000 * model_depth[:end], model_force[:end], color=BLUE, label="fitted")
        over.plot(1000 * model_depth[end - 1 :], model_force[end - 1 :], "--", color=BLUE, label="predicted")
        over.plot(1000 * depth, force, "o", color=VERMILION, markersize=3, label="measured")
        over.set(title="Beef, pressed by a ball", xlabel="depth [mm]", ylabel="force [N]")
        over.legend()
        held.plot(model_times[:end], model_force[:end], color=BLUE)
        held.plot(model_times[end - 1 :], model_force[end - 1 :], "--", color=BLUE)
        held.plot(times, force, "o", color=VERMILION, markersize=3)
        held.annotate("the tool stands,\nand beef relaxes", (6.5, 0.85))
        held.set(title="The same in time", xlabel="time [s]")
        figure.savefig(IMAGES / "fit-beef.png", dpi=DPI)
        plt.close(figure)


def fit_press(newtons: float, tracks: int, points: int = 41) -> FitResult:
    """Fit five parameters of press.yaml to its tracks with errors, from the shipped scene."""
    settings = {"sheet.points": [points, points], "probes.0.total": [0, 0, -newtons], "render.tracks": tracks}
    start = load_scene(ROOT / "scenes" / "press.yaml", {**settings, "output": ["tracks"]})
    assert start.tissue is not None
    truth: Scene = start.model_copy(update={"tissue": start.tissue.model_copy(update={"young": TRUTH})})
    with tempfile.TemporaryDirectory() as directory:
        run(truth, directory, estimate_error=False)
        with np.load(Path(directory) / "tracks.npz") as archive:
            pixel = np.where(archive["occluded"][..., None], np.nan, archive["points"].astype(np.float64))
            coordinates = archive["coordinates"]
    pixel += np.random.default_rng(1).normal(0, ERROR, pixel.shape)
    observed = {"time": np.arange(pixel.shape[1]) / 25, "coordinates": coordinates, "pixel": pixel, "sigma": ERROR}
    return fit(start, observed, FIVE)


def main() -> None:
    """Write the picture, and print the numbers."""
    result, table = beef()
    draw_beef(result, table)
    print(f"force at the end of the hold: {table[-1, 2] / table[:, 2].max():.0%} of the largest")
    for newtons, tracks in ((2, 16), (2, 32), (6, 16)):
        start = time.perf_counter()
        result = fit_press(newtons, tracks)
        errors = [
            f"{100 * estimate.standard_error / abs(estimate.value):.2g} % ({100 * (estimate.value / truth - 1):+.2g} %)"
            for estimate, truth in zip(result.parameters.values(), (TRUTH, 3e5, 6000, 0.5, 0.5), strict=True)
        ]
        seconds = time.perf_counter() - start
        print(f"| {newtons} N, {tracks} × {tracks} tracks | {' | '.join(errors)} | {result.runs} | {seconds:.0f} s |")


if __name__ == "__main__":
    main()
