"""Reports of studies: summary, page, record and figure, which are written atomically."""

from __future__ import annotations

import errno
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

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

VERSIONS = {"taichi-msm": "0.1.0", "python": "3.11.7", "taichi": "1.7.4", "numpy": "2.4.6", "platform": "linux x86_64"}
MACHINE = {"cpu": "AMD EPYC 7R13", "cores": 4, "arch": "cpu", "threads": 2, "vectors": 512, "versions": VERSIONS}

# Rounding in f32, as a fraction of the largest displacement.
F32_ROUNDING = 3e-6


def spread(median: float) -> list[float]:
    return [0.9 * median, median, median, median, 1.3 * median]


def series(precision: str, difference: str) -> list[SteppingMeasurement]:
    """Return measurements of order 2 or 1, the coarsest of which diverged."""
    points = [SteppingMeasurement(precision, difference, 10, 0.004, None, None, False, samples=spread(0.02))]
    for halving in range(6):
        exact = 9e-4 / 4**halving if difference == "central" else 2.7e-3 / 2**halving
        rounding = F32_ROUNDING if precision == "f32" else None
        error = exact + (rounding or 0.0)
        seconds = (0.03 if precision == "f32" else 0.05) * 2**halving
        method = precision, difference, 20 * 2**halving, 0.002 / 2**halving
        points.append(SteppingMeasurement(*method, error, rounding, error > 2e-6, samples=spread(seconds)))
    return points


def realistic() -> Study:
    """A study of a sheet of springs."""
    study = Study("press", scene(render={"refine": 2}).model_dump(mode="json"), "complete", 1e-3, MACHINE)
    study.reference = Reference(2560, 1e-7, 0.0644)
    for precision in ("f32", "f64"):
        for difference in ("central", "backward"):
            study.stepping += series(precision, difference)
            study.orders[f"{precision} {difference}"] = 1.98 if difference == "central" else 1.01
    for supersample, refine in product((1, 2, 4), (0, 1, 2, 5)):
        psnr, samples = 50 + 5 * supersample - 4 / (1 + refine) ** 4, spread(0.01 * supersample**2)
        study.drawing.append(DrawingMeasurement(refine, supersample, psnr, 12 - refine, samples=samples))
    study.notes = ["drawing was not measured from refine 10, supersample 4 on, for lack of memory"]
    return study


def of_tissue() -> Study:
    """A study of tissue, with meshes; the error of the finest one is a bound."""
    study = realistic()
    study.settings["sheet"]["points"] = [31, 31]
    study.points = [
        MeshMeasurement(5, 5, 40, None, False, samples=spread(0.002)),
        MeshMeasurement(9, 9, 58, 0.191, True, samples=spread(0.00227)),
        MeshMeasurement(16, 16, 88, 0.0836, True, samples=spread(0.00293)),
        MeshMeasurement(31, 31, 162, 0.0209, True, samples=spread(0.0112)),
        MeshMeasurement(61, 61, 317, 0.0105, False, samples=spread(0.0484)),
    ]
    return study


def interrupted() -> Study:
    """Interrupted before the reference was computed."""
    return Study("press", realistic().settings, "interrupted", 1e-3, MACHINE, notes=["interrupted: what was measured"])


def motionless() -> Study:
    """A sheet without motion: every error is 0, and all pictures are equal."""
    study = realistic()
    study.reference = Reference(2560, 0.0, 0.0)
    study.stepping = [replace(point, error=0.0, rounding=None, known=True) for point in study.stepping]
    study.drawing = [replace(drawing, psnr=None, largest_error=0) for drawing in study.drawing]
    return study


def without_reference() -> Study:
    """All runs diverged, and the reference, too."""
    study = realistic()
    study.stepping = [point for point in study.stepping if point.error is None]
    study.reference = Reference(40, float("nan"), float("inf"))
    return study


def odd() -> Study:
    """One measurement on a GPU, of a scene with special characters in its name."""
    study = replace(realistic(), scene="[bold]$x$ 呼 \udcff | :smile:")
    machine = {**MACHINE, "arch": "cuda", "threads": None}
    return replace(study, machine=machine, stepping=study.stepping[1:2], drawing=study.drawing[:1])


def strict() -> Study:
    """The tolerance is smaller than all errors, of a scene with contact."""
    study = realistic()
    settings = {**study.settings, "probes": [{"path": [[0, 0.5, 0.5, 0]]}]}
    return replace(study, tolerance=5e-7, settings=settings)


CASES = [of_tissue, interrupted, motionless, without_reference, odd, strict]
# Cases whose tables are compared.
TABLES = (of_tissue, motionless, odd)


def page(directory: Path) -> str:
    return (directory / "study.md").read_text(encoding="utf-8")


def lines(text: str, build: Callable[[], Study]) -> list[str]:
    """Return the lines that are compared, without blank ones and alignment."""
    omitted = "| -" if build in TABLES else "|"
    return [" ".join(line.split()) for line in text.splitlines() if line and not line.startswith(omitted)]


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove Matplotlib, so that no time is spent on the figure."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "taichi_msm.study.plot", raising=False)


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize("build", CASES, ids=lambda build: build.__name__)
def test_reports_of_studies(build: Callable[[], Study], tmp_path: Path, message: Messages) -> None:
    study = build()
    message(lines(format_summary(study), build))
    outputs = write_report(study, tmp_path / "new" / "out")
    assert outputs == FILES[1:]
    assert sorted(outputs) == sorted(path.name for path in (tmp_path / "new" / "out").iterdir())
    # Non-finite numbers are null.
    record = json.loads((tmp_path / "new" / "out" / "study.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert record.pop("outputs") == outputs
    assert record == json.loads(json.dumps(study_record(study)))
    text = page(tmp_path / "new" / "out")
    assert text.count("## Recommendation") == 1
    assert ("<" in text) == ("An error with < is" in text)
    message(lines(text, build))


def test_legends_of_the_figure() -> None:
    """Legends are below their panels and within the figure; they have all meshes and refinements."""
    style = pytest.importorskip("matplotlib.style")
    from taichi_msm.plot_style import STYLE
    from taichi_msm.study.plot import _figure

    with style.context(STYLE, after_reset=True):
        figure = _figure(of_tissue())
    figure.draw_without_rendering()
    axes = {panel.get_title(loc="left"): panel for panel in figure.axes}
    assert list(axes) == ["Stepping", "Drawing", "Points"]
    legends = {name: legend for name in axes if (legend := axes[name].get_legend())}
    words = {name: [text.get_text() for text in legend.texts] for name, legend in legends.items()}
    assert words["Points"][:4] == ["9 x 9", "16 x 16", "31 x 31 (the scene)", "61 x 61, at most"]
    assert words["Drawing"] == [*(f"supersample {n}" for n in (1, 2, 4)), *(f"refine {n}" for n in (0, 1, 2, 5))]
    texts = [text for legend in legends.values() for text in legend.texts]
    handles = [handle for legend in legends.values() for handle in legend.legend_handles if handle]
    labels = [text.get_window_extent() for text in [*texts, *figure.texts]]
    panels = [panel.bbox for panel in figure.axes]
    assert not any(box.count_overlaps([*labels[:number], *panels]) for number, box in enumerate(labels))
    assert not any(handle.get_window_extent().count_overlaps(labels) for handle in handles)
    assert all(figure.bbox.containsx(box.x1) and figure.bbox.containsy(box.y0) for box in labels)


@pytest.mark.parametrize("build", [odd, of_tissue], ids=lambda build: build.__name__)
def test_layout_of_the_figure(build: Callable[[], Study], tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    with matplotlib.rc_context({"lines.linewidth": 7}):
        before = matplotlib.rcParams.copy()
        assert write_report(build(), tmp_path) == FILES
        assert matplotlib.rcParams.copy() == before
    with Image.open(tmp_path / "study.png") as image:
        picture = np.asarray(image.convert("RGB"))
    # Missing panels take no space.
    assert picture.shape[:2] == (1780 if build is of_tissue else 940, 1800)
    assert (picture == 255).all(axis=-1).mean() > 0.7
    assert len(np.unique(picture @ (1 << 16, 1 << 8, 1))) > 100
    # The margins are empty.
    assert (picture[:, [0, -1]] == 255).all()
    assert (picture[[0, -1]] == 255).all()


@pytest.mark.usefixtures("no_picture")
def test_missing_matplotlib(tmp_path: Path) -> None:
    (tmp_path / "study.png").write_bytes(b"of an earlier study")
    (tmp_path / "foreign.txt").write_text("foreign")
    study = realistic()
    for _ in range(2):
        assert write_report(study, tmp_path) == FILES[1:]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.txt", *sorted(FILES[1:])]
    assert study.notes.count(WITHOUT_MATPLOTLIB) == 1
    assert json.loads((tmp_path / "study.json").read_text())["notes"] == study.notes
    assert WITHOUT_MATPLOTLIB in page(tmp_path)
    assert f"note: {WITHOUT_MATPLOTLIB}" in format_summary(study)


def test_plot_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr("taichi_msm.study.plot.plot", Mock(side_effect=ValueError("reason")))
    study = realistic()
    assert write_report(study, tmp_path) == FILES[1:]
    message(study.notes, "study.png", "ValueError")


@pytest.mark.usefixtures("no_picture")
def test_full_disk_leaves_the_earlier_report(
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


def test_formats_of_numbers_and_times(message: Messages) -> None:
    times = (0.0, 1.234e-7, 22.54e-6, 0.99949e-3, 0.9996e-3, 0.1, 0.9999, 59.96, 1234.5)
    message(map(format_duration, times))
    message(map(format_number, (0.0, 1.0, 0.00027, 2.7e-9, 99.96, 999.6, 1e7)))
    # A range has the unit of its median.
    message(map(format_timing, (Timing(0.0011, 0.0009, 0.012, 5), Timing(0.0011, 0.0011, 0.0011, 1))))


def test_most_accurate_of_equally_fast_settings_is_recommended() -> None:
    fast = replace(realistic().stepping[0], error=9e-4, samples=spread(0.030), damping_difference="backward")
    exact = replace(fast, error=1e-6, samples=spread(0.0325), damping_difference="central")
    study = replace(realistic(), stepping=[fast, exact])
    assert study.best_stepping == exact
    slower = replace(exact, samples=spread(0.0335))
    assert replace(study, stepping=[fast, slower]).best_stepping == fast, "slower by more than a tenth"


def with_points(tolerance: float, *errors: float, points: int = 31) -> Study:
    """Return a study of meshes of 16, 31, 61, ... points per side with these errors; the scene has `points`."""
    study = replace(realistic(), tolerance=tolerance)
    study.settings["sheet"]["points"] = [points, points]
    study.points = [
        MeshMeasurement(count, count, 100, error, True, samples=spread(0.01))
        for count, error in zip((16, 31, 61, 121), errors, strict=False)
    ]
    return study


@pytest.mark.parametrize(
    ("tolerance", "points", "errors", "recommended"),
    [
        # Of order 2, so that an eighth of the error needs sqrt(8) times the cells: 169.7 for 60.
        (1e-3, 61, (0.128, 0.032, 0.008), 171),
        # The order is limited to 1 to 2.
        (1e-3, 31, (0.5, 0.01), 1 + 95),
        (1e-3, 31, (0.009, 0.01), 1 + 300),
        # Measured.
        (1e-3, 31, (0.04, 0.01, 5e-4), 61),
        # The mesh of the scene suffices.
        (1e-3, 31, (0.04, 0.001), None),
        # Above the limit of scenes.
        (1e-6, 31, (0.04, 0.02), 600001),
    ],
)
def test_recommended_points(
    tolerance: float, points: int, errors: tuple[float, ...], recommended: int | None, message: Messages
) -> None:
    study = with_points(tolerance, *errors, points=points)
    assert study.recommended_points == (None if recommended is None else (recommended, recommended))
    assert (study.best_stepping is None) == (recommended is not None)
    lines = study.recommendation()
    assert lines[0] == ("time:" if recommended is None else "sheet:" if recommended <= 4096 else "render:")
    if lines[0] == "sheet:":
        sheet = {"points": [recommended, recommended], "size": [0.3, 0.4]}
        scene(**{**yaml.safe_load("\n".join(lines)), "sheet": sheet})
    message(remarks(study))


def test_tolerance_of_the_sheet_takes_precedence(message: Messages) -> None:
    study = with_points(1e-3, 0.04, 0.01)
    study.settings["sheet"]["tolerance"] = 0.015
    assert study.recommendation()[0] == "time:"
    message(remarks(study), "0.015")
