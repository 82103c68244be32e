"""The report of a study says what was measured, for people and for machines, and is whole or not there."""

from __future__ import annotations

import errno
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.study.format import format_duration, format_number, format_timing
from taichi_msm.study.report import WITHOUT_MATPLOTLIB, format_summary, remarks, study_record, write_report
from taichi_msm.study.result import (
    DrawingMeasurement,
    MeshMeasurement,
    Reference,
    SteppingMeasurement,
    Study,
    Timing,
)
from tests.golden import Messages
from tests.scenes import scene

FILES = ["study.png", "study.md", "study.json"]

VERSIONS = {
    "taichi-msm": "0.1.0",
    "python": "3.11.7",
    "taichi": "1.7.4",
    "numpy": "2.4.6",
    "pillow": "12.2.0",
    "platform": "linux x86_64",
}
MACHINE = {"cpu": "AMD EPYC 7R13", "cores": 4, "arch": "cpu", "threads": 2, "vectors": 512, "versions": VERSIONS}

# The floor that rounding makes in f32, as a fraction of the largest displacement.
FLOOR = 3e-6


def spread(median: float) -> list[float]:
    return [0.9 * median, median, median, median, 1.3 * median]


def series(precision: str, difference: str) -> list[SteppingMeasurement]:
    """Points of order 2 or 1, the coarsest of which diverged."""
    points = [SteppingMeasurement(precision, difference, 10, 0.004, None, None, False, samples=spread(0.02))]
    for halving in range(6):
        exact = 9e-4 / 4**halving if difference == "central" else 2.7e-3 / 2**halving
        rounding = FLOOR if precision == "f32" else None
        error = exact + (rounding or 0.0)
        seconds = (0.03 if precision == "f32" else 0.05) * 2**halving
        known = error > 2e-6
        points.append(
            SteppingMeasurement(
                precision,
                difference,
                20 * 2**halving,
                0.002 / 2**halving,
                error,
                rounding,
                known,
                samples=spread(seconds),
            )
        )
    return points


def realistic() -> Study:
    """Like the study of a sheet in springs."""
    found = Study("press", scene(render={"refine": 2}).model_dump(mode="json"), "complete", 1e-3, MACHINE)
    found.reference = Reference(2560, 1e-7, 0.0644)
    for precision in ("f32", "f64"):
        for difference in ("central", "backward"):
            found.stepping += series(precision, difference)
            found.orders[f"{precision} {difference}"] = 1.98 if difference == "central" else 1.01
    found.drawing = [
        DrawingMeasurement(
            refine,
            supersample,
            50 + 5 * supersample - 4 / (1 + refine) ** 4,
            12 - refine,
            samples=spread(0.01 * supersample**2),
        )
        for supersample in (1, 2, 4)
        for refine in (0, 1, 2, 5)
    ]
    found.notes = ["drawing was not measured from refine 10, supersample 4 on: memory"]
    return found


def of_tissue() -> Study:
    """With points, as tissue has them: orders 1 and 2, and a bound where there was no finer one to compare with."""
    found = realistic()
    found.settings["sheet"]["points"] = [31, 31]
    found.points = [
        MeshMeasurement(5, 5, 40, None, False, samples=spread(0.002)),
        MeshMeasurement(9, 9, 58, 0.191, True, samples=spread(0.00227)),
        MeshMeasurement(16, 16, 88, 0.0836, True, samples=spread(0.00293)),
        MeshMeasurement(31, 31, 162, 0.0209, True, samples=spread(0.0112)),
        MeshMeasurement(61, 61, 317, 0.0105, False, samples=spread(0.0484)),
    ]
    return found


def interrupted() -> Study:
    """Stopped before the reference was there."""
    return Study("press", realistic().settings, "interrupted", 1e-3, MACHINE, notes=["interrupted: what was measured"])


def halfway() -> Study:
    found = replace(realistic(), status="interrupted", drawing=[])
    return replace(found, stepping=found.stepping[:3], orders={"f32 central": None})


def motionless() -> Study:
    """Nothing moved: every error is 0, and every picture is the same."""
    found = realistic()
    found.reference = Reference(2560, 0.0, 0.0)
    found.stepping = [replace(point, error=0.0, rounding=None, known=True) for point in found.stepping]
    found.drawing = [replace(drawn, psnr=None, largest_error=0) for drawn in found.drawing]
    return found


def without_reference() -> Study:
    """Every run diverged, the reference with them."""
    found = realistic()
    found.stepping = [point for point in found.stepping if point.error is None]
    found.reference = Reference(40, float("nan"), float("inf"))
    return found


def odd() -> Study:
    """One point, of a scene with an odd name, on a GPU."""
    found = replace(realistic(), scene="[bold]$x$ 呼 \udcff | :smile:")
    return replace(
        found,
        machine={**MACHINE, "arch": "cuda", "threads": None},
        stepping=found.stepping[1:2],
        drawing=found.drawing[:1],
    )


def strict() -> Study:
    """With a tolerance that no step meets."""
    return replace(realistic(), tolerance=5e-7)


CASES = [of_tissue, interrupted, halfway, motionless, without_reference, odd, strict]
# Those whose tables are compared.
TABLES = (of_tissue, motionless, odd)


def page(directory: Path) -> str:
    return (directory / "study.md").read_text(encoding="utf-8")


def lines(text: str, made: Callable[[], Study]) -> list[str]:
    """Lines without rules, blank ones and columns; without tables unless the case has those that are compared."""
    left_out = "| -" if made in TABLES else "|"
    return [" ".join(line.split()) for line in text.splitlines() if line and not line.startswith(left_out)]


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the time of drawing it."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "taichi_msm.study.plot", raising=False)


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize("made", CASES, ids=lambda made: made.__name__)
def test_every_study_is_reported(made: Callable[[], Study], tmp_path: Path, message: Messages) -> None:
    found = made()
    message(lines(format_summary(found), made))
    outputs = write_report(found, tmp_path / "new" / "out")
    assert outputs == FILES[1:]
    assert sorted(outputs) == sorted(path.name for path in (tmp_path / "new" / "out").iterdir())
    # Numbers that JSON has not are null.
    record = json.loads((tmp_path / "new" / "out" / "study.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert record.pop("outputs") == outputs
    assert record == json.loads(json.dumps(study_record(found)))
    text = page(tmp_path / "new" / "out")
    assert text.count("## Recommendation") == 1
    assert ("<" in text) == ("An error with < is" in text)
    message(lines(text, made))


def test_nothing_in_the_picture_covers_anything_else() -> None:
    """Legends are below their panels and within the picture; every sheet and every refinement is in one."""
    style = pytest.importorskip("matplotlib.style")
    from taichi_msm.plot_style import STYLE
    from taichi_msm.study.plot import _figure

    with style.context(STYLE, after_reset=True):
        figure = _figure(of_tissue())
    figure.canvas.draw()
    axes = {one.get_title(loc="left"): one for one in figure.axes}
    assert list(axes) == ["Stepping", "Drawing", "Points"]
    legends = {name: legend for name in axes if (legend := axes[name].get_legend())}
    words = {name: [text.get_text() for text in legend.texts] for name, legend in legends.items()}
    assert words["Points"][:4] == ["9 x 9", "16 x 16", "31 x 31 (the scene)", "61 x 61, at most"]
    assert words["Drawing"] == [*(f"supersample {n}" for n in (1, 2, 4)), *(f"refine {n}" for n in (0, 1, 2, 5))]
    texts = [text for legend in legends.values() for text in legend.texts]
    handles = [handle for legend in legends.values() for handle in legend.legend_handles if handle]
    labels = [one.get_window_extent() for one in [*texts, *figure.texts]]
    panels = [one.bbox for one in figure.axes]
    assert not any(box.count_overlaps([*labels[:number], *panels]) for number, box in enumerate(labels))
    assert not any(handle.get_window_extent().count_overlaps(labels) for handle in handles)
    assert all(figure.bbox.containsx(box.x1) and figure.bbox.containsy(box.y0) for box in labels)


@pytest.mark.parametrize("made", [interrupted, halfway, odd, of_tissue], ids=lambda made: made.__name__)
def test_the_picture_is_readable_and_keeps_inside(made: Callable[[], Study], tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    (tmp_path / "study.png").write_bytes(b"of an earlier study")
    with matplotlib.rc_context({"lines.linewidth": 7}):
        before = matplotlib.rcParams.copy()
        assert write_report(made(), tmp_path) == (FILES[1:] if made is interrupted else FILES)
        assert matplotlib.rcParams.copy() == before, "settings of others stay"
    if made is interrupted:
        assert not (tmp_path / "study.png").exists()
        return
    with Image.open(tmp_path / "study.png") as image:
        picture = np.asarray(image.convert("RGB"))
    # Panels that are missing leave no hole.
    assert picture.shape[:2] == (1780 if made is of_tissue else 940, 1200 if made is halfway else 1800)
    assert (picture == 255).all(axis=-1).mean() > 0.7
    assert len(np.unique(picture @ (1 << 16, 1 << 8, 1))) > 100
    # Nothing is cut off.
    assert (picture[:, [0, -1]] == 255).all()
    assert (picture[[0, -1]] == 255).all()


@pytest.mark.usefixtures("no_picture")
def test_without_matplotlib_there_is_a_note_and_no_old_picture(tmp_path: Path) -> None:
    (tmp_path / "study.png").write_bytes(b"of an earlier study")
    (tmp_path / "mine.txt").write_text("mine")
    found = realistic()
    for _ in range(2):
        assert write_report(found, tmp_path) == FILES[1:]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.txt", *sorted(FILES[1:])]
    assert found.notes.count(WITHOUT_MATPLOTLIB) == 1
    assert json.loads((tmp_path / "study.json").read_text())["notes"] == found.notes
    assert WITHOUT_MATPLOTLIB in page(tmp_path)
    assert f"note: {WITHOUT_MATPLOTLIB}" in format_summary(found)


@pytest.mark.usefixtures("no_picture")
def test_a_full_disk_leaves_the_earlier_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    write_report(odd(), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write = Path.write_text

    def full(path: Path, *arguments: Any, **options: Any) -> int:
        if path.name == "study.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", full)
    with message.raises(FilesError, "space"):
        write_report(realistic(), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_numbers_with_their_units(message: Messages) -> None:
    times = (0.0, 1.234e-7, 22.54e-6, 0.99949e-3, 0.9996e-3, 0.1, 0.9999, 59.96, 1234.5)
    message(map(format_duration, times))
    message(map(format_number, (0.0, 1.0, 0.00027, 2.7e-9, 99.96, 999.6, 1e7)))
    # A spread is in the unit of its median.
    message(map(format_timing, (Timing(0.0011, 0.0009, 0.012, 5), Timing(0.0011, 0.0011, 0.0011, 1))))


def test_of_steppings_that_are_as_fast_the_least_wrong_is_recommended() -> None:
    quick = replace(realistic().stepping[0], error=9e-4, samples=spread(0.030), damping_difference="backward")
    exact = replace(quick, error=1e-6, samples=spread(0.0325), damping_difference="central")
    found = replace(realistic(), stepping=[quick, exact])
    assert found.best_stepping == exact
    slower = replace(exact, samples=spread(0.0335))
    assert replace(found, stepping=[quick, slower]).best_stepping == quick, "more than a tenth is not the clock's"


def with_points(tolerance: float, *errors: float, own: int = 31) -> Study:
    """Sheets of 16, 31, 61, ... points a side with these errors; the scene has `own`. Cells halve each time."""
    found = replace(realistic(), tolerance=tolerance)
    found.settings["sheet"]["points"] = [own, own]
    found.points = [
        MeshMeasurement(count, count, 100, error, True, samples=spread(0.01))
        for count, error in zip((16, 31, 61, 121), errors, strict=False)
    ]
    return found


@pytest.mark.parametrize(
    ("tolerance", "own", "errors", "points"),
    [
        # Four times less at each halving, so that 8 times less takes sqrt(8) times the cells: 169.7 on 60.
        (1e-3, 61, (0.128, 0.032, 0.008), 171),
        # No faster than with the second power, and no slower than with the first, whatever is seen.
        (1e-3, 31, (0.5, 0.01), 1 + 95),
        (1e-3, 31, (0.011, 0.01), 1 + 300),
        (1e-3, 31, (0.009, 0.01), 1 + 300),
        # Measured.
        (1e-3, 31, (0.04, 0.01, 5e-4), 61),
        (1e-3, 31, (0.04, 0.01, 0.002, 5e-4), 121),
        # The scene's own points do.
        (1e-3, 31, (0.04, 0.001), None),
        # More than a scene may have.
        (1e-6, 31, (0.04, 0.02), 600001),
    ],
)
def test_points_are_recommended_before_any_step(
    tolerance: float, own: int, errors: tuple[float, ...], points: int | None, message: Messages
) -> None:
    found = with_points(tolerance, *errors, own=own)
    assert found.recommended_points == (None if points is None else (points, points))
    assert (found.best_stepping is None) == (points is not None)
    lines = found.recommendation()
    assert lines[0] == ("time:" if points is None else "sheet:" if points <= 4096 else "render:")
    if lines[0] == "sheet:":
        scene(**{**yaml.safe_load("\n".join(lines)), "sheet": {"points": [points, points], "size": [0.3, 0.4]}})
    message(remarks(found))


def test_the_tolerance_of_the_sheet_comes_first(message: Messages) -> None:
    found = with_points(1e-3, 0.04, 0.01)
    found.settings["sheet"]["tolerance"] = 0.015
    assert found.recommendation()[0] == "time:"
    message(remarks(found), "0.015")
