"""Fit published tests of testing machines, and write docs/machine-fits.md.

    python docs/make_machine.py WORKBOOK STRIP ... [--only SHEET ...]
    python docs/make_machine.py WORKBOOK STRIP --draw SHEET
    python docs/make_machine.py WORKBOOK STRIP --draw-scenes

The page names the files; strips are skin or mucosa by their names. Fits in docs/machine-fits.json are kept, so that an
interrupted script continues: delete the file to repeat all.
With --draw it fits a strip and a sheet again, and draws them. With --draw-scenes it draws scenes/beef.yaml and
scenes/skin.yaml over their tests. Takes about half a minute of a core per test.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from taichi_msm import FitResult, SceneError, Simulation, fit, load_scene
from taichi_msm.machines.reader import EXPECTED, read_machine_test
from taichi_msm.machines.workbook import read_workbook
from taichi_msm.plot_style import BLUE, DPI, STYLE, VERMILION
from taichi_msm.study.format import markdown_table

DOCS = Path(__file__).parent
RECORD, PAGE, TEMPLATE = DOCS / "machine-fits.json", DOCS / "machine-fits.md", DOCS / "machine-fits.template"

# Length, width and thickness of the strips [m], by the name of the tissue in the file's name.
STRIPS = {"skin": (0.0346, 0.0092, 0.0024), "mucosa": (0.03167, 0.00689, 0.00128)}

GAP = "depth=Ecartement entre outils, mm"
# The slice of scenes/beef.yaml.
SLICE = "230403-FF2A"

BEEF_KEYS = {
    "young [kPa]": ("tissue.foundation.young", 1e-3),
    "lock [mm]": ("tissue.foundation.lock", 1e3),
    "contact [mm]": ("contact", 1e3),
    "share 1": ("tissue.relaxation.0.share", 1.0),
    "time 1 [s]": ("tissue.relaxation.0.time", 1.0),
    "share 2": ("tissue.relaxation.1.share", 1.0),
    "time 2 [s]": ("tissue.relaxation.1.time", 1.0),
}
STRIP_KEYS = {
    "young [kPa]": ("tissue.young", 1e-3),
    "lock": ("tissue.stiffening.lock", 1.0),
    "factor": ("tissue.stiffening.factor", 1.0),
}
RESIDUALS = {"rms [% of peak]": "rms", "largest [% of peak]": "largest"}

Keys = dict[str, tuple[str, float]]


def beef_scene(thickness: float, depth: float) -> dict[str, Any]:
    """Return a ball of 5 mm radius above a slice, with a lock of 1.8 times the largest depth; lengths in metres."""
    return {
        "sheet": {"points": [31, 31], "size": [0.03, 0.03]},
        "tissue": {
            # The sheet is soft, so that the force is that of the foundation.
            **{"young": 1e3, "thickness": 1e-3, "foundation_active": "always"},
            "foundation": {"young": 5e4, "depth": thickness, "lock": 1.8 * depth},
            "relaxation": [{"share": 0.5, "time": 0.3}, {"share": 0.2, "time": 4.0}],
        },
        "probes": [
            {
                "path": [[0, 0.5, 0.5, 0.001], [1, 0.5, 0.5, -0.005]],
                "instrument": {"radius": 0.005, "shaft": [0, 0, 1], "length": 0.05},
                "friction": "rough",
            }
        ],
        "time": {"duration": 1, "motion": "quasistatic"},
        "output": [],
    }


def strip_scene(length: float, width: float, thickness: float) -> dict[str, Any]:
    """Return a strip that a clamp pulls; lengths in metres."""
    return {
        "sheet": {"points": [9, 31], "size": [width, length], "fixed": ["left"]},
        "tissue": {"young": 1e5, "thickness": thickness, "stiffening": {"lock": 0.5, "factor": 10}},
        "probes": [{"clamp": "right", "path": [[0, 0, 0, 0], [1, 0.01, 0, 0]]}],
        "time": {"duration": 1, "motion": "quasistatic"},
        "output": [],
    }


def fit_sheet(workbook: str, sheet: str) -> FitResult:
    """Fit a sheet of the workbook."""
    gap = read_machine_test(workbook, [GAP], sheet).depth
    free = [key for key, _ in BEEF_KEYS.values()]
    return fit(beef_scene(float(gap[0]), float(np.ptp(gap))), workbook, free, sheet=sheet, workers=1)


def fit_strip(path: str) -> FitResult:
    """Fit a strip up to its largest force."""
    test = read_machine_test(path)
    size = STRIPS[next(name for name in STRIPS if name in Path(path).name)]
    window = (0.0, float(test.time[test.force.argmax()]))
    return fit(strip_scene(*size), path, [key for key, _ in STRIP_KEYS.values()], window=window, workers=1)


def summarise(result: FitResult) -> dict[str, Any]:
    """Return a fit as an entry of the record."""
    (test,) = result.tests
    parameters = {key: [estimate.value, *estimate.interval] for key, estimate in result.parameters.items()}
    # The branch with the shorter time is the first.
    branch = "tissue.relaxation.{}.{}"
    if (
        branch.format(0, "time") in parameters
        and parameters[branch.format(0, "time")] > parameters[branch.format(1, "time")]
    ):
        for name in ("share", "time"):
            first, second = (branch.format(n, name) for n in range(2))
            parameters[first], parameters[second] = parameters[second], parameters[first]
    difference = np.abs(test.force - test.loading.force) / test.loading.peak
    return {
        "parameters": parameters,
        "not_identifiable": [key for key, estimate in result.parameters.items() if not estimate.identifiable],
        "peak": test.loading.peak,
        "rms": test.residual / test.loading.peak,
        "largest": float(difference.max()),
        "rejected": result.model_rejected,
        "runs": result.runs,
        "seconds": result.seconds,
    }


def fit_column(numbers: dict[str, Any], keys: Keys) -> dict[str, str]:
    """Format residuals and parameters of a fit by their names; an end beyond a bound stays open."""
    column = {name: f"{100 * numbers[kind]:#.2g}" for name, kind in RESIDUALS.items()}
    for name, (key, scale) in keys.items():
        value, *interval = numbers["parameters"][key]
        low, high = ("…" if end is None else f"{scale * end:.3g}" for end in interval)
        column[name] = f"{scale * value:.3g} ({low} to {high})"
    return column


def range_column(fits: list[dict[str, Any]]) -> dict[str, str]:
    """Format the medians and ranges of the fits of beef, of parameters over the fits with a bounded interval."""
    samples = {name: [100 * numbers[kind] for numbers in fits] for name, kind in RESIDUALS.items()}
    for name, (key, scale) in BEEF_KEYS.items():
        estimates = [numbers["parameters"][key] for numbers in fits]
        if key.startswith("tissue."):
            samples[name] = [scale * estimate[0] for estimate in estimates if None not in estimate]
    return {name: f"{np.median(x):.3g} ({min(x):.3g} to {max(x):.3g})" for name, x in samples.items()}


def write_page(record: dict[str, Any]) -> None:
    """Write the page from its template."""
    beef = [numbers for numbers in record.values() if "contact" in numbers.get("parameters", ())]
    columns = {"FF2A": fit_column(record[SLICE], BEEF_KEYS), f"{len(beef)} slices": range_column(beef)}
    for name, tissue in ("pig-skin-05-p-1", "pig skin"), ("pig-mucosa-08-a-1", "pig mucosa"):
        columns[tissue] = fit_column(record[name], STRIP_KEYS)
    names = dict.fromkeys([*RESIDUALS, *BEEF_KEYS, *STRIP_KEYS])
    rows = [[name, *(column.get(name, "") for column in columns.values())] for name in names]
    text = TEMPLATE.read_text(encoding="utf-8")
    for name, value in {
        "numbers": markdown_table(["", *columns], rows, left_columns=range(1 + len(columns))),
        "count": len(beef),
        "rejected": sum(numbers["rejected"] for numbers in beef),
    }.items():
        text = text.replace(f"{{{name}}}", str(value))
    PAGE.write_text(text, encoding="utf-8")


def draw(pressed: FitResult, pulled: FitResult) -> None:
    """Draw measured and fitted forces over time and over depth."""
    with plt.style.context(STYLE, after_reset=True):
        figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
        titles = "Beef, pressed and held", "Beef", "Pig skin, pulled"
        for panel, title, result in zip(axes, titles, (pressed, pressed, pulled), strict=True):
            (test,) = result.tests
            loading = test.loading
            over_time = panel is axes[0]
            at = loading.time if over_time else 1000 * (loading.depth - loading.depth[0])
            panel.plot(at, loading.force, ".", color=VERMILION, markersize=4, label="measured")
            panel.plot(at, test.force, color=BLUE, label="fitted")
            panel.set(xlabel="time [s]" if over_time else "depth [mm]", ylabel="force [N]", title=title)
        axes[2].set_xlabel("pull [mm]")
        axes[0].legend()
        figure.savefig(DOCS / "images" / "machine-fits.png", dpi=DPI)
        plt.close(figure)


def simulate(name: str) -> np.ndarray:
    """Return time [s], position of the tip [m] and force [N] of a shipped scene's tool, shape (frames + 1, 7)."""
    rows = []
    with Simulation(load_scene(DOCS.parent / "scenes" / f"{name}.yaml", {"output": []})) as simulation:
        for frame in range(simulation.scene.time.frames + 1):
            simulation.advance(min(frame, 1))
            (tool,) = simulation.forces()
            rows.append((simulation.time, *tool.tip, *tool.force))
    return np.array(rows)


def draw_scenes(workbook: str, strip: str) -> None:
    """Draw the forces of the shipped scenes over the measured ones: of beef over time, of skin over the pull."""
    pressed, pulled = read_machine_test(workbook, [GAP], SLICE), read_machine_test(strip)
    contact = json.loads(RECORD.read_text(encoding="utf-8"))[SLICE]["parameters"]["contact"][0]
    start = np.interp(contact, pressed.depth[0] - pressed.depth, pressed.time)
    offset = np.median(pressed.force[pressed.time < start])
    beef, skin = simulate("beef"), simulate("skin")
    until = pulled.force.argmax() + 1
    panels = {
        "beef.yaml": (pressed.time - start, pressed.force - offset, beef[:, 0], -beef[:, 6], "time [s]"),
        "skin.yaml": (
            *(1000 * (pulled.depth - pulled.depth[0])[:until], pulled.force[:until]),
            *(1000 * (skin[:, 1] - skin[0, 1]), skin[:, 4], "pull [mm]"),
        ),
    }
    with plt.style.context(STYLE, after_reset=True):
        figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
        for panel, (name, (at, measured, frames, force, label)) in zip(axes, panels.items(), strict=True):
            shared = frames <= at[-1]
            difference = 100 * (force - np.interp(frames, at, measured))[shared] / measured.max()
            rms, largest = np.sqrt(np.mean(difference**2)), np.abs(difference).max()
            shown = slice(None, None, max(1, len(at) // 150))
            panel.plot(at[shown], measured[shown], ".", color=VERMILION, markersize=4, label="measured")
            panel.plot(frames, force, color=BLUE, label="scene")
            panel.set(xlabel=label, ylabel="force [N]", title=f"{name}: rms {rms:.2g} %, largest {largest:.2g} %")
        axes[0].legend()
        figure.savefig(DOCS / "images" / "machine-scenes.png", dpi=DPI)
        plt.close(figure)


def main() -> None:
    """Fit the tests that are not in the record, and write the page."""
    parser = argparse.ArgumentParser()
    parser.add_argument("workbook")
    parser.add_argument("strips", nargs="*")
    parser.add_argument("--only", nargs="*", help="sheets of the workbook")
    parser.add_argument("--draw", help="sheet of the workbook")
    parser.add_argument("--draw-scenes", action="store_true")
    options = parser.parse_args()
    if options.draw_scenes:
        draw_scenes(options.workbook, options.strips[0])
        return
    if options.draw:
        draw(fit_sheet(options.workbook, options.draw), fit_strip(options.strips[0]))
        return
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    sheets = options.only or [name for name in read_workbook(options.workbook, EXPECTED) if name.startswith("230403-")]
    tests = {Path(path).stem: (fit_strip, (path,)) for path in options.strips}
    tests |= {name: (fit_sheet, (options.workbook, name)) for name in sheets}
    for name, (run, arguments) in tests.items():
        if name not in record:
            try:
                record[name] = summarise(run(*arguments))
            except SceneError as error:
                record[name] = {"error": str(error)}
            RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            print(name, json.dumps({key: record[name].get(key) for key in ("rms", "seconds", "error")}), flush=True)
    write_page(record)


if __name__ == "__main__":
    main()
