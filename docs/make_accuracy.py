"""Write docs/accuracy.md and its pictures: a study of every shipped scene, and what becomes of the hard cases.

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

from benchmarks import dop853, stored_form
from taichi_msm.study.format import markdown_table
from taichi_msm.study.measurements import REFERENCE_MARGIN, REFERENCE_RENDER
from taichi_msm.study.result import PSNR_TOLERANCE_DB
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
    """Study a shipped scene and keep its picture."""
    words = ["study", f"scenes/{name}.yaml", "--tolerance", str(TOLERANCE), "--json", "--out", str(out / name)]
    done = program(*words, *options)
    if done.returncode:
        raise SystemExit(done.stderr)
    shutil.copy(out / name / "study.png", IMAGES / f"accuracy-{name}.png")
    return json.loads(done.stdout)


def points(found: Record, method: str) -> list[Record]:
    """Pick the points of one method of stepping, by falling steps."""
    precision, difference = method.split()
    return [
        one
        for one in found["stepping"]
        if (one["precision"], one["damping_difference"]) == (precision, difference) and one["error"] is not None
    ]


def seconds_to(found: Record, method: str, error: float) -> float:
    """Interpolate the time that a method takes to an error, on logarithmic axes."""
    known = [(math.log(one["error"]), math.log(one["seconds"]["median"])) for one in points(found, method)]
    for (coarse, before), (fine, after) in pairwise(known):
        if fine <= math.log(error) <= coarse:
            return math.exp(before + (after - before) * (coarse - math.log(error)) / (coarse - fine))
    return math.nan


def significant(value: float | None, digits: int = 2) -> str:
    """Write a number for a table."""
    if value is None or math.isnan(value):
        return "-"
    text = f"{value:.{digits}g}"
    return f"{float(text):g}" if 1 <= value < 1e5 else text


def table(head: list[str], rows: list[list[str]]) -> str:
    """Write a table, its first column of text and the others of numbers."""
    return markdown_table(head, rows, left_columns=(0,))


def scene_table(studies: dict[str, Record]) -> str:
    """Show for every scene how exact central differences can be in f32 and in f64, and at what price."""
    rows = []
    for name, found in studies.items():
        single, double = points(found, "f32 central"), points(found, "f64 central")
        rows.append(
            [
                f"`{name}`",
                significant(single[0]["error"]),
                significant(min(one["error"] for one in single)),
                significant(max(one["rounding"] for one in single)),
                significant(min(one["error"] for one in double)),
                significant(price_of_double(found)),
            ]
        )
    head = [
        "scene",
        "f32, largest stable step",
        "f32, best",
        "rounding in f32, worst",
        "f64, best",
        "time of f64 / f32",
    ]
    return table(head, rows)


def error_at(found: Record, method: str, step: float) -> float | None:
    """Interpolate the error of a method at a step, on logarithmic axes; None: outside what was measured."""
    for coarse, fine in pairwise(points(found, method)):
        if fine["step"] <= step <= coarse["step"]:
            share = math.log(coarse["step"] / step) / math.log(coarse["step"] / fine["step"])
            return float(coarse["error"] * (fine["error"] / coarse["error"]) ** share)
    return None


def difference_table(found: Record) -> str:
    """Show central beside backward differences at the same steps."""
    rows = []
    for one in points(found, "f64 central"):
        if (backward := error_at(found, "f64 backward", one["step"])) is not None:
            ratio = backward / one["error"]
            rows.append([f"{1000 * one['step']:.4g} ms", *map(significant, (one["error"], backward, ratio))])
    return table(["step", "central", "backward", "ratio"], rows)


def refine_table(studies: dict[str, Record]) -> str:
    """Show for every scene what refining buys, at one sample a pixel."""
    drawn = {
        name: {one["refine"]: one for one in found["drawing"] if one["supersample"] == 1}
        for name, found in studies.items()
    }
    refines = sorted(set.intersection(*(set(each) for each in drawn.values())))
    rows = [[f"`{name}`", *(f"{each[refine]['psnr']:.1f}" for refine in refines)] for name, each in drawn.items()]
    return table(["PSNR [dB] at refine", *map(str, refines)], rows)


def supersample_table(found: Record) -> str:
    """Show what supersampling buys and costs, at the scene's own refinement."""
    own = found["settings"]["render"]["refine"]
    rows = [
        [
            str(one["supersample"]),
            f"{one['psnr']:.1f}",
            str(one["largest_error"]),
            f"{1000 * one['seconds']['median']:.1f}",
        ]
        for one in found["drawing"]
        if one["refine"] == own
    ]
    return table(["supersample", "PSNR [dB]", "largest error", "ms a frame"], rows)


def hard_rows(out: Path) -> list[list[str]]:
    """Run the hard cases as a user would."""
    rows = []
    for path in HARD:
        text = path.read_text(encoding="utf-8").splitlines()
        says = " ".join(line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), text))
        print(path.stem, flush=True)
        done = program("run", str(path.relative_to(ROOT)), "--estimate-error", "--json", "--out", str(out / path.stem))
        record = json.loads(done.stdout)
        if "scene" not in record:
            reason = done.stderr.strip().split(": ", 1)[1]
            rows.append([f"`{path.stem}`", says, f"refused: {reason}", "-", "-", "-"])
            continue
        error = record["error_estimate"]["error"]
        # The first note is the error itself.
        happens = "; ".join(["runs", *(f"says: {note}" for note in record["notes"][1:])])
        if record["status"] != "complete":
            happens = f"stopped: {record['error']}"
        rows.append(
            [
                f"`{path.stem}`",
                says,
                happens,
                "not known" if error is None else significant(error),
                significant(record["shortest_spring"]),
                f"{record['steps']:,}",
            ]
        )
    return rows


def hard_table(out: Path) -> str:
    """Write the table of the hard cases, whose second and third columns are text."""
    head = ["scene", "what is hard, and what must happen", "what happens", "error", "shortest spring", "steps"]
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|---:|---:|---:|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in hard_rows(out)])


def peer(found: Record) -> str:
    """Say what DOP853 takes for its fastest error within the tolerance."""
    seconds, error = min(pair for pair in dop853.measure().values() if pair[1] <= TOLERANCE)
    ours = points(found, "f64 central")[-1]
    return (
        f"takes {seconds:.3g} s for an error of {significant(error)}; this program in f64 "
        f"takes {ours['seconds']['median']:.2g} s for {significant(ours['error'])}"
    )


def enough(studies: dict[str, Record]) -> int:
    """Find the refinement from which no scene gains."""
    needed = []
    for found in studies.values():
        drawn = [one for one in found["drawing"] if one["supersample"] == 1]
        best = max(one["psnr"] for one in drawn)
        needed.append(min(one["refine"] for one in drawn if one["psnr"] > best - PSNR_TOLERANCE_DB))
    return max(needed)


def cost_of_backward(found: Record, error: float) -> float:
    """Compare the times of both differences for an error."""
    return seconds_to(found, "f64 backward", error) / seconds_to(found, "f64 central", error)


def price_of_double(found: Record) -> float:
    """Give the median over all steps of the time in f64 over that in f32."""
    double = {one["steps_per_frame"]: one["seconds"]["median"] for one in points(found, "f64 central")}
    single = {one["steps_per_frame"]: one["seconds"]["median"] for one in points(found, "f32 central")}
    return statistics.median(double[steps] / single[steps] for steps in single if steps in double)


def sensitive(out: Path) -> float:
    """Give the rounding in f32 of a sheet in springs that wrinkles."""
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
        hard, soft = hard_table(out), sensitive(out)
    press, paper = studies["press"], studies["figure-3"]
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
            pictures="\n\n".join(f"![{name}](images/accuracy-{name}.png)" for name in SCENES if name != "press"),
            hard_table=hard,
        ),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
