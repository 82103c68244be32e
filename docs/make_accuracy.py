"""Write docs/accuracy.md and its pictures: a study of every shipped scene, and the results of the hard cases.

    PYTHONPATH=. python docs/make_accuracy.py [--quick]

It takes a quarter of an hour; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from benchmarks import dop853, stored_form
from benchmarks.marked import table
from taichi_msm.plot_style import BLUE, DPI, SKY, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.study.measurements import REFERENCE_MARGIN, REFERENCE_RENDER
from taichi_msm.system.compiler import compiler_label

ROOT = Path(__file__).parent.parent
PAGE, TEMPLATE = ROOT / "docs" / "accuracy.md", ROOT / "docs" / "accuracy.template"
IMAGES = ROOT / "docs" / "images"
SCENES = ("press", "figure-3", "drag", "grasp", "two-tools")
HARD = sorted((ROOT / "tests" / "hard").glob("*.yaml"))
TOLERANCE = 1e-3

Record = dict[str, Any]


def program(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program in the project's folder."""
    command = [sys.executable, "-m", "taichi_msm", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def study(name: str, out: Path, *options: str) -> Record:
    """Study a shipped scene, and return the record."""
    words = ["study", f"scenes/{name}.yaml", "--tolerance", str(TOLERANCE), "--json", "--out", str(out / name)]
    done = program(*words, *options)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def points(study: Record, method: str) -> list[Record]:
    """Return the runs of one method, such as "f32 central", by falling steps."""
    precision, difference = method.split()
    return [
        point
        for point in study["stepping"]
        if (point["precision"], point["damping_difference"]) == (precision, difference) and point["error"] is not None
    ]


def seconds_to(study: Record, method: str, error: float) -> float:
    """Interpolate a method's time for an error, on logarithmic axes."""
    logs = [(math.log(point["error"]), math.log(point["seconds"]["median"])) for point in points(study, method)]
    for (coarse, before), (fine, after) in pairwise(logs):
        if fine <= math.log(error) <= coarse:
            return math.exp(before + (after - before) * (coarse - math.log(error)) / (coarse - fine))
    return math.nan


def draw(study: Record) -> None:
    """Draw the errors of three methods against the step."""
    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, 4), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        lines = ("f64 backward", VERMILION, "s"), ("f32 central", SKY, "D"), ("f64 central", BLUE, "o")
        for method, colour, marker in lines:
            steps, errors = zip(*((1000 * each["step"], each["error"]) for each in points(study, method)), strict=True)
            order = study["orders"].get(method)
            label = method if order is None else f"{method}, order {order:.2f}"
            axes.loglog(steps, errors, color=colour, marker=marker, label=label)
        axes.set(title=f"Error of {study['scene']}", xlabel="time step [ms]")
        axes.set_ylabel("error, as a fraction of\nthe largest displacement")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.legend(fontsize=10)
        figure.savefig(IMAGES / "accuracy.png", format="png")


def significant(value: float | None, digits: int = 2) -> str:
    """Format a number for a table."""
    if value is None or math.isnan(value):
        return "-"
    text = f"{value:.{digits}g}"
    return f"{float(text):g}" if 1 <= value < 1e5 else text


def scene_table(studies: dict[str, Record]) -> str:
    """Table of the errors of central differences in f32 and in f64, and of their times, by scene."""
    rows = []
    for name, study in studies.items():
        single, double = points(study, "f32 central"), points(study, "f64 central")
        rows.append(
            [
                f"`{name}`",
                significant(single[0]["error"]),
                significant(min(point["error"] for point in single)),
                significant(max(point["rounding"] for point in single)),
                significant(min(point["error"] for point in double)),
                significant(price_of_double(study)),
            ]
        )
    head = ["f32, largest stable step", "f32, best", "rounding in f32, worst", "f64, best", "time of f64 / f32"]
    return table(["scene", *head], rows)


def error_at(study: Record, method: str, step: float) -> float | None:
    """Interpolate the error of a method at a step, on logarithmic axes; None outside the measured steps."""
    for coarse, fine in pairwise(points(study, method)):
        if fine["step"] <= step <= coarse["step"]:
            share = math.log(coarse["step"] / step) / math.log(coarse["step"] / fine["step"])
            return float(coarse["error"] * (fine["error"] / coarse["error"]) ** share)
    return None


def difference_table(study: Record) -> str:
    """Table of the errors of central and backward differences at the same steps."""
    rows = []
    for point in points(study, "f64 central"):
        if (backward := error_at(study, "f64 backward", point["step"])) is not None:
            errors = point["error"], backward, backward / point["error"]
            rows.append([f"{1000 * point['step']:.4g} ms", *map(significant, errors)])
    return table(["step", "central", "backward", "ratio"], rows)


def refine_table(studies: dict[str, Record]) -> str:
    """Table of the PSNR by refinement, with one sample per pixel, by scene."""
    drawn = {
        name: {point["refine"]: point for point in study["drawing"] if point["supersample"] == 1}
        for name, study in studies.items()
    }
    refines = sorted(set.intersection(*map(set, drawn.values())))
    rows = [[f"`{name}`", *(f"{by[refine]['psnr']:.1f}" for refine in refines)] for name, by in drawn.items()]
    return table(["PSNR [dB] at refine", *map(str, refines)], rows)


def supersample_table(study: Record) -> str:
    """Table of the errors and times of supersampling, with the scene's refinement."""
    rows = [
        [
            str(point["supersample"]),
            f"{point['psnr']:.1f}",
            str(point["largest_error"]),
            f"{1000 * point['seconds']['median']:.1f}",
        ]
        for point in study["drawing"]
        if point["refine"] == study["settings"]["render"]["refine"]
    ]
    return table(["supersample", "PSNR [dB]", "largest error", "ms a frame"], rows)


def hard_rows(out: Path) -> list[list[str]]:
    """Run the hard cases by the command line; return their rows."""
    rows = []
    for path in HARD:
        text = path.read_text(encoding="utf-8").splitlines()
        purpose = " ".join(line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), text))
        print(path.stem, flush=True)
        done = program("run", str(path.relative_to(ROOT)), "--estimate-error", "--json", "--out", str(out / path.stem))
        record = json.loads(done.stdout)
        if "scene" not in record:
            reason = done.stderr.strip().split(": ", 1)[1]
            rows.append([f"`{path.stem}`", purpose, f"refused: {reason}", "-", "-", "-"])
            continue
        error = record["error_estimate"]["error"]
        # The first note is the error itself.
        result = "; ".join(["runs", *(f"warns: {note}" for note in record["notes"][1:])])
        if record["status"] != "complete":
            result = f"stopped: {record['error']}"
        rows.append(
            [
                f"`{path.stem}`",
                purpose,
                result,
                "not known" if error is None else significant(error),
                significant(record["shortest_spring"]),
                f"{record['steps']:,}",
            ]
        )
    return rows


def hard_table(out: Path) -> str:
    """Format the table of the hard cases, whose first three columns are text."""
    head = ["scene", "difficulty and expected result", "result", "error", "shortest spring", "steps"]
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|---:|---:|---:|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in hard_rows(out)])


def peer(study: Record) -> str:
    """Format the time of DOP853 for an error within the tolerance, and this program's in f64."""
    seconds, error = min(pair for pair in dop853.measure().values() if pair[1] <= TOLERANCE)
    ours = points(study, "f64 central")[-1]
    return (
        f"takes {seconds:.3g} s for an error of {significant(error)}; this program in f64 "
        f"takes {ours['seconds']['median']:.2g} s for {significant(ours['error'])}"
    )


def enough(studies: dict[str, Record]) -> int:
    """Return the refinement beyond which no scene improves by 0.1 dB."""
    needed = []
    for study in studies.values():
        drawn = [point for point in study["drawing"] if point["supersample"] == 1]
        best = max(point["psnr"] for point in drawn)
        needed.append(min(point["refine"] for point in drawn if point["psnr"] > best - 0.1))
    return max(needed)


def cost_of_backward(study: Record, error: float) -> float:
    """Return the time of backward over that of central differences for an error."""
    return seconds_to(study, "f64 backward", error) / seconds_to(study, "f64 central", error)


def price_of_double(study: Record) -> float:
    """Return the median over all steps of the time in f64 over that in f32."""
    single, double = (
        {point["steps_per_frame"]: point["seconds"]["median"] for point in points(study, f"{precision} central")}
        for precision in ("f32", "f64")
    )
    return statistics.median(double[steps] / single[steps] for steps in single if steps in double)


def sensitive(out: Path) -> float:
    """Return the rounding in f32 of a sheet of springs that wrinkles."""
    changes = ("springs.structural=100", "springs.shear=100", "output=[]", "time.precision=f32")
    settings = [word for change in changes for word in ("--set", change)]
    done = program("run", "docs/springs.yaml", *settings, "--estimate-error", "--json", "--out", str(out / "sensitive"))
    return json.loads(done.stdout)["error_estimate"]["rounding"]


def main() -> None:
    """Study, run, and write the page."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        studies = {}
        for name in SCENES:
            print(name, flush=True)
            studies[name] = study(name, out, *sys.argv[1:])
        shutil.copy(out / "press" / "study.png", IMAGES)
        hard, soft = hard_table(out), sensitive(out)
    press, paper = studies["press"], studies["figure-3"]
    draw(paper)
    first = points(press, "f32 central")[0]
    machine, versions = press["machine"], press["machine"]["versions"]
    stored = [[name, significant(error)] for name, error in stored_form.measure().items()]
    PAGE.write_text(
        TEMPLATE.read_text(encoding="utf-8").format(
            cpu=machine["cpu"],
            threads=machine["threads"],
            vectors=machine["vectors"],
            compiler=compiler_label(versions),
            python=versions["python"],
            margin=REFERENCE_MARGIN,
            coarse_step=f"{1000 * first['step']:.3g} ms",
            coarse_error=significant(first["error"]),
            peer=peer(paper),
            difference_table=difference_table(paper),
            backward_cost=significant(cost_of_backward(paper, 5e-4)),
            backward_cost_fine=significant(cost_of_backward(paper, 1e-4)),
            stored_table=table(["stored", "rounding in f32"], stored),
            scene_table=scene_table(studies),
            double_cost=significant(price_of_double(press)),
            sensitive=f"{100 * soft:.0f} %",
            enough=enough(studies),
            truth=f"refine {REFERENCE_RENDER['refine']} and supersample {REFERENCE_RENDER['supersample']}",
            refine_table=refine_table(studies),
            own_refine=press["settings"]["render"]["refine"],
            supersample_table=supersample_table(press),
            hard_table=hard,
        ),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
