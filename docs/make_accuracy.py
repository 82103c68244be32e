"""Write docs/accuracy.md and its pictures: a study of every shipped scene, and what becomes of the hard cases.

    PYTHONPATH=. python docs/make_accuracy.py

It takes a quarter of an hour; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import stored_form

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "accuracy.md"
IMAGES = ROOT / "docs" / "images"
SCENES = ("press", "figure-3", "drag", "grasp", "two-tools")
HARD = sorted((ROOT / "tests" / "hard").glob("*.yaml"))
TOLERANCE = 1e-3

Record = dict[str, Any]


def program(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program in the project's folder."""
    command = [sys.executable, "-m", "taichi_msm", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def study(name: str, out: Path) -> Record:
    """Study a shipped scene and keep its picture."""
    done = program("study", f"scenes/{name}.yaml", "--tolerance", str(TOLERANCE), "--json", "--out", str(out / name))
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
    for (coarse, before), (fine, after) in zip(known, known[1:], strict=False):
        if fine <= math.log(error) <= coarse:
            return math.exp(before + (after - before) * (coarse - math.log(error)) / (coarse - fine))
    return math.nan


def significant(value: float | None, digits: int = 2) -> str:
    """Write a number for a table."""
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def table(head: list[str], rows: list[list[str]]) -> str:
    """Write a table, its first column of text and the others of numbers."""
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def scene_table(studies: dict[str, Record]) -> str:
    """Show for every scene how exact central differences can be in f32 and in f64, and at what price."""
    rows = []
    for name, found in studies.items():
        single, double = points(found, "f32 central"), points(found, "f64 central")
        same = [
            b["seconds"]["median"] / a["seconds"]["median"]
            for a in single
            for b in double
            if a["steps_per_frame"] == b["steps_per_frame"]
        ]
        rows.append(
            [
                f"`{name}`",
                significant(single[0]["error"]),
                significant(min(one["error"] for one in single)),
                significant(max(one["rounding"] for one in single)),
                significant(min(one["error"] for one in double)),
                significant(sorted(same)[len(same) // 2]),
            ]
        )
    head = ["scene", "f32, largest stable step", "f32, best", "rounding in f32, worst", "f64, best", "time of f64 / f32"]
    return table(head, rows)


def difference_table(found: Record) -> str:
    """Show central beside backward differences at the same steps."""
    backward = {one["steps_per_frame"]: one for one in points(found, "f64 backward")}
    rows = [
        [
            f"{1000 * one['step']:.4g} ms",
            significant(one["error"]),
            significant(backward[one["steps_per_frame"]]["error"]),
            significant(backward[one["steps_per_frame"]]["error"] / one["error"]),
        ]
        for one in points(found, "f64 central")
        if one["steps_per_frame"] in backward
    ]
    return table(["step", "central", "backward", "ratio"], rows)


def refine_table(studies: dict[str, Record]) -> str:
    """Show for every scene what refining buys, at one sample a pixel."""
    drawn = {
        name: {one["refine"]: one for one in found["drawing"] if one["supersample"] == 1} for name, found in studies.items()
    }
    refines = sorted(set.intersection(*(set(each) for each in drawn.values())))
    rows = [
        [f"`{name}`", *(f"{each[refine]['psnr']:.1f}" for refine in refines)]
        for name, each in drawn.items()
    ]
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
        says = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        print(path.stem, flush=True)
        done = program("run", str(path.relative_to(ROOT)), "--estimate-error", "--json", "--out", str(out / path.stem))
        record = json.loads(done.stdout)
        if "scene" not in record:
            reason = done.stderr.strip().split(": ", 1)[1]
            rows.append([f"`{path.stem}`", says, f"refused: {reason}", "–", "–", "–"])
            continue
        error = record["error_estimate"]["error"]
        happens = {"complete": "runs"}.get(record["status"], "stopped: " + record.get("error", ""))
        if record["status"] == "complete" and record["shortest_spring"] < 0.5:
            happens = "runs, and says that springs are pressed below half their length"
        rows.append(
            [
                f"`{path.stem}`",
                says,
                happens,
                "not known: a pilot diverged" if error is None else significant(error),
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


TEXT = """\
# Speed against error

Made by `docs/make_accuracy.py` from `taichi-msm study` of every shipped scene, with
{cpu}, {threads} threads, Taichi {taichi}, Python {python}. An error is the largest of any point at any frame, as a fraction of
the largest displacement of any point at any frame, against central differences in float64 with steps so small that their
own error, estimated by halving, is {margin} times smaller than any error that counts as known (hollow points are not). A time is the
median of five runs through the whole scene, compiled and warm, the bar from the fastest to the slowest; all settings take
turns.

## press

{studies[press][text]}

![Speed against error of press](images/accuracy-press.png)

At the largest stable step, {coarse_step}, central differences in f32 are wrong by {coarse_error}, and every halving of the step
divides that by four until rounding shows. SciPy's DOP853 on the same equations, {peer}.

## What central differences buy

The paper takes the damping by a backward difference, of order 1. The same steps of `press` in f64:

{difference_table}

Both cost the same for a step. For an error of {tolerance:g} the backward ones take {backward_cost} times the time; for one of
1e-4 {backward_cost_fine}. There is no reason to take them but to repeat the paper.

## What the stored form of the position buys in f32

`benchmarks/stored_form.py` steps the paper's sheet (`figure-3`) at 18,000 steps a second in NumPy and stores the state in three
forms. This is the rounding, against the same steps in float64:

{stored_table}

Differences of nearly equal positions lose the digits of a small motion; the difference, stored, keeps them. It costs nothing:
the same two numbers for each coordinate are read and written.

## When f64 is worth its price

{scene_table}

f64 takes about {double_cost} times the time of f32 at the same step. With smooth motion the rounding of f32 is far below the error of
any step that one would take for a picture, and f64 buys nothing. It is worth its price where errors below some 1e-5 are asked for, and
where the motion is sensitive: a sheet that is pushed together along its surface buckles, which of two neighbouring folds it
falls into is decided by the last digits, and rounding then grows. `--estimate-error` shows it; the column "rounding" is large there.

## Which refinement a picture of 512 pixels needs

Against a picture of refine {truth_refine} and supersample {truth_supersample}, one sample a pixel, at the most deformed frame:

{refine_table}

From refine {enough} on nothing is gained: what is left is aliasing, which only supersampling takes away. On a sheet of 61 × 61
points a cell is some 10 pixels wide. For `press`, refine {own_refine}:

{supersample_table}

## All scenes

{pictures}

## Hard cases

The scenes in `tests/hard`, run as a user would, with `--estimate-error`. `tests/test_hard_cases.py` holds every one to what is said of it
here, and its error to a more exact solution.

{hard_table}
"""


def peers(found: Record) -> str:
    """Say what DOP853 takes for its best point that is no worse than the tolerance."""
    good = [one for one in found["peers"] if one["error"] <= TOLERANCE]
    if not good:
        return "was not done within its time"
    best = min(good, key=lambda one: one["seconds"]["median"])
    ours = seconds_to(found, "f64 central", max(best["error"], points(found, "f64 central")[-1]["error"]))
    return (
        f"takes {best['seconds']['median']:.3g} s for an error of {significant(best['error'])}, "
        f"for which this program in f64 takes {1000 * ours:.3g} ms"
    )


def enough(studies: dict[str, Record]) -> int:
    """Find the refinement from which no scene gains."""
    return max(found["recommended_refine"] for found in studies.values())


def main() -> None:
    """Study, run, and write the page."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        studies = {}
        for name in SCENES:
            print(name, flush=True)
            studies[name] = study(name, out)
        hard = hard_table(out)
    press = studies["press"]
    first = points(press, "f32 central")[0]
    machine, versions = press["machine"], press["machine"]["versions"]
    stored = [[name, significant(error)] for name, error in stored_form.measure().items()]
    PAGE.write_text(
        TEXT.format(
            cpu=machine["cpu"],
            threads=machine["threads"],
            taichi=versions["taichi"],
            python=versions["python"],
            margin=MARGIN,
            coarse_step=f"{1000 * first['step']:.3g} ms",
            coarse_error=significant(first["error"]),
            peer=peers(press),
            difference_table=difference_table(press),
            tolerance=TOLERANCE,
            backward_cost=significant(cost_of_backward(press, TOLERANCE)),
            backward_cost_fine=significant(cost_of_backward(press, 3e-4)),
            stored_table=table(["stored", "rounding in f32"], stored),
            scene_table=scene_table(studies),
            double_cost=significant(price_of_double(press)),
            truth=f"refine {FINEST['refine']} and supersample {FINEST['supersample']}",
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
