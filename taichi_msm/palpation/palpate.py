"""From a table of presses to the map of a tissue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from taichi_msm.errors import StageProgressCallback, writing
from taichi_msm.palpation.fit import fit_presses, lock_interval, with_lock_error
from taichi_msm.palpation.predict import build_map
from taichi_msm.palpation.presses import choose_presses, presses_to_predict
from taichi_msm.palpation.report import publication, write_report
from taichi_msm.palpation.result import Palpation
from taichi_msm.palpation.scores import score
from taichi_msm.palpation.table import read_table

# Depth in radii of the ball, above which its unit is questioned.
MAX_RADII = 5.0


def palpate(
    table: str,
    radius: float,
    directory: Path,
    progress: StageProgressCallback,
    *,
    predict: str | None = None,
    columns: Sequence[str] = (),
    sheet: str | None = None,
) -> Palpation:
    """Map the presses of a table by a ball of a radius [m], and write the files of the map into a directory."""
    read = read_table(table, columns, sheet)
    to_predict = None if predict is None else read_table(predict, columns, with_force=False)
    presses, left_out = choose_presses(read)
    with writing(directory), publication(directory) as published:
        fit = fit_presses(presses, radius, lambda done, total: progress("fit", done, total))
        interval = None
        if not math.isinf(fit.law.lock):
            interval = lock_interval(presses, fit)
            fit = with_lock_error(presses, fit, interval)
        progress("map", 0, 0)
        built = build_map(presses, fit)
        scores = score(presses, fit, lambda done, total: progress("scores", done, total))
        predicted, notes = None, [*read.notes]
        if (deepest := float(presses.greatest_depth.max())) > MAX_RADII * radius:
            fault = f"depths up to {1000 * deepest:.3g} mm, more than {MAX_RADII:g} radii of the ball"
            notes.append(f"{read.name}: {fault}; check the units of depth and --radius")
        if to_predict is not None:
            others = presses_to_predict(to_predict)
            predicted = others, built.predict(others)
            notes += to_predict.notes
        result = Palpation(read.name, presses, left_out, read.normal, built, interval, scores, predicted, notes)
        progress("write", 0, 0)
        write_report(result, published)
    return result
