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
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.study.format import format_duration, format_number, format_timing
from taichi_msm.study.report import WITHOUT_MATPLOTLIB, format_summary, study_record, write_report
from taichi_msm.study.result import (
    DrawingMeasurement,
    MeshMeasurement,
    PeerMeasurement,
    Reference,
    SteppingMeasurement,
    Study,
    TermMeasurement,
    Timing,
)
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


def spread(median: float, runs: int = 5) -> list[float]:
    return [0.9 * median, *[median] * (runs - 2), 1.3 * median] if runs > 1 else [median]


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
    """Like the study of scenes/press.yaml."""
    found = Study("press", scene(render={"refine": 2}).model_dump(mode="json"), "complete", 1e-3, MACHINE)
    found.reference = Reference(2560, 1e-7, 0.0644)
    for precision in ("f32", "f64"):
        for difference in ("central", "backward"):
            found.stepping += series(precision, difference)
            found.orders[f"{precision} {difference}"] = 1.98 if difference == "central" else 1.01
    found.peers = [
        PeerMeasurement(
            10.0**-digits, 10.0 ** (-digits - 2), digits < 4, 2000 + 500 * digits, samples=spread(3 + digits, 1)
        )
        for digits in (2, 4, 6)
    ]
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
    names = ("", "springs.structural", "springs.shear", "springs.virtual", "damping", "probes.0")
    found.terms = [TermMeasurement(name, samples=spread(23e-6 - 2e-6 * len(name) / 9, 9)) for name in names]
    found.notes = ["DOP853 takes more than 20 s at rtol 1e-08 and was stopped"]
    return found


def of_tissue() -> Study:
    """With points, as tissue has them: orders 1 and 2, and a bound where there was no finer one to compare with."""
    found = realistic()
    found.settings["sheet"]["points"] = [31, 31]
    found.points = [
        MeshMeasurement(9, 9, 58, 0.191, True, 0.0511, samples=spread(0.00227)),
        MeshMeasurement(16, 16, 88, 0.0836, True, None, samples=spread(0.00293)),
        MeshMeasurement(31, 31, 162, 0.0209, True, 0.0217, samples=spread(0.0112)),
        MeshMeasurement(61, 61, 317, 0.0105, False, 0.0114, samples=spread(0.0484)),
    ]
    return found


def tissue_alone() -> Study:
    """Without a picture to draw; the coarsest sheet diverged."""
    found = of_tissue()
    return replace(found, drawing=[], points=[replace(found.points[0], error=None), *found.points[1:]])


def interrupted() -> Study:
    """Stopped before the reference was there."""
    return Study("press", realistic().settings, "interrupted", 1e-3, MACHINE, notes=["interrupted: what was measured"])


def halfway() -> Study:
    found = replace(realistic(), status="interrupted", peers=[], drawing=[], terms=[])
    return replace(found, stepping=found.stepping[:3], orders={"f32 central": None})


def diverged() -> Study:
    return replace(realistic(), stepping=[point for point in realistic().stepping if point.error is None], peers=[])


def motionless() -> Study:
    """Nothing moved: every error is 0, and every picture is the same."""
    found = realistic()
    found.reference = Reference(2560, 0.0, 0.0)
    found.stepping = [replace(point, error=0.0, rounding=None, known=True) for point in found.stepping]
    found.peers = [replace(peer, error=0.0, known=True) for peer in found.peers]
    found.drawing = [replace(drawn, psnr=None, largest_error=0) for drawn in found.drawing]
    return found


def without_reference() -> Study:
    """Every run diverged, the reference with them."""
    found = diverged()
    found.reference = Reference(40, float("nan"), float("inf"))
    found.peers = [PeerMeasurement(1e-4, float("nan"), False, 100, samples=spread(1, 1))]
    return found


def one_point() -> Study:
    found = realistic()
    return replace(found, stepping=found.stepping[1:2], peers=[], drawing=found.drawing[:1], terms=found.terms[:1])


def oddly_named() -> Study:
    return replace(one_point(), scene="[bold]$x$ 呼 \udcff | :smile:")


def on_a_gpu() -> Study:
    return replace(realistic(), machine={**MACHINE, "arch": "cuda", "threads": None})


CASES = [
    realistic,
    of_tissue,
    tissue_alone,
    interrupted,
    halfway,
    diverged,
    motionless,
    without_reference,
    one_point,
    oddly_named,
    on_a_gpu,
]
every_case = pytest.mark.parametrize("made", CASES, ids=lambda made: made.__name__)


def pixels(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def page(directory: Path) -> str:
    return (directory / "study.md").read_text(encoding="utf-8")


def printed(found: Study) -> list[str]:
    """Lines of the summary, without the lines of its tables."""
    return [" ".join(line.replace("|", " ").split()) for line in format_summary(found).splitlines()]


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the time of drawing it."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "taichi_msm.study.plot", raising=False)


@pytest.mark.usefixtures("no_picture")
@every_case
def test_every_study_is_reported(made: Callable[[], Study], tmp_path: Path) -> None:
    found = made()
    outputs = write_report(found, tmp_path / "new" / "out")
    assert outputs == FILES[1:]
    assert sorted(outputs) == sorted(path.name for path in (tmp_path / "new" / "out").iterdir())
    record = json.loads((tmp_path / "new" / "out" / "study.json").read_text(encoding="utf-8"))
    assert record["status"] == found.status
    assert len(format_summary(found).splitlines()) > 2
    assert page(tmp_path / "new" / "out").count("## Recommendation") == 1


@pytest.mark.usefixtures("no_picture")
def test_the_record_has_everything(tmp_path: Path) -> None:
    found = realistic()
    outputs = write_report(found, tmp_path)
    record = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    assert record.pop("outputs") == outputs
    assert record == json.loads(json.dumps(study_record(found)))
    assert record["recommendation"] == found.recommendation()
    known = [dict(one) for one in record["stepping"]]
    for one in known:
        del one["method"], one["seconds"]
    assert [SteppingMeasurement(**one) for one in known] == [replace(one, samples=[]) for one in found.stepping]
    assert [Timing(**one["seconds"]) for one in record["stepping"]] == [one.seconds for one in found.stepping]
    assert [one["method"] for one in record["stepping"]] == [point.method for point in found.stepping]
    assert record["machine"] == MACHINE
    assert record["settings"] == found.settings


def test_numbers_that_json_has_not_are_null() -> None:
    record = study_record(without_reference())
    assert record["reference"] == {"steps_per_frame": 40, "error": None, "largest": None}
    assert record["peers"][0]["error"] is None


@pytest.mark.usefixtures("no_picture")
def test_the_page_has_all_tables(tmp_path: Path) -> None:
    found = realistic()
    write_report(found, tmp_path)
    text = page(tmp_path)
    heads = [line for line in text.splitlines() if line.startswith("#")]
    assert heads == [
        "# press: speed against error",
        "## Stepping",
        "## Drawing",
        "## Terms",
        "## Notes",
        "## Recommendation",
    ]
    assert "AMD EPYC 7R13, 2 threads, vectors of 512 bits" in text
    assert "Taichi 1.7.4" in text
    assert "its own error is about 1.00e-07" in text
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    # Four tables, each with a head and a rule.
    assert len(rows) == 28 + 3 + 12 + 6 + 4 * 2
    assert ["f32 central", "4.00 ms", "10", "diverged", "", "20.0 ms (18.0 to 26.0)", ""] in rows
    assert ["f32 central", "2.00 ms", "20", "0.000903", "3.00e-06", "30.0 ms (27.0 to 39.0)", "recommended"] in rows
    assert ["f64 central", "62.5 us", "640", "< 8.79e-07", "", "1.60 s (1.44 to 2.08)", ""] in rows
    assert ["1e-06", "< 1.00e-08", "5000", "9.00 s (once)"] in rows
    assert "An error with < is an approximate upper bound" in text
    assert "Observed orders: f32 central 1.98, f32 backward 1.01" in text
    assert ["2", "1", "55.0 dB", "10", "10.0 ms (9.00 to 13.0)", "recommended"] in rows
    assert ["nothing", "23.0 us (20.7 to 29.9)", "100 %"] in rows
    assert ["springs.structural", "19.0 us (17.1 to 24.7)", "83 %"] in rows
    assert "- DOP853 takes more" in text
    block = text.split("```yaml\n")[1].split("```")[0]
    assert yaml.safe_load(block) == {
        "time": {"step": 0.002, "damping_difference": "central", "precision": "f32"},
        "render": {"refine": 2, "supersample": 1},
    }


@pytest.mark.usefixtures("no_picture")
def test_points_are_reported_beside_their_estimates(tmp_path: Path) -> None:
    found = of_tissue()
    write_report(found, tmp_path)
    text = page(tmp_path)
    assert text.index("## Drawing") < text.index("## Points") < text.index("## Terms")
    part = text.split("## Points")[1].split("## Terms")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line.startswith("|")]
    assert rows[2:] == [
        ["9 x 9", "58", "0.191", "0.0511", "2.27 ms (2.04 to 2.95)", ""],
        ["16 x 16", "88", "0.0836", "not known", "2.93 ms (2.64 to 3.81)", ""],
        ["31 x 31", "162", "0.0209", "0.0217", "11.2 ms (10.1 to 14.6)", "of the scene"],
        ["61 x 61", "317", "< 0.0105", "0.0114", "48.4 ms (43.6 to 62.9)", ""],
    ]
    assert "An error with < is an approximate upper bound" in part
    record = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    seconds = [Timing(**one.pop("seconds")) for one in record["points"]]
    assert seconds == [one.seconds for one in found.points]
    assert [MeshMeasurement(**one) for one in record["points"]] == [replace(one, samples=[]) for one in found.points]
    assert "61 x 61 317 < 0.0105 0.0114 48.4 ms (43.6 to 62.9)" in printed(found)
    assert "9 x 9 58 diverged 0.0511 2.27 ms (2.04 to 2.95)" in printed(tissue_alone())


def test_nothing_in_the_picture_covers_anything_else() -> None:
    """Legends are below their panels and within the picture; every sheet and every refinement is in one."""
    style = pytest.importorskip("matplotlib.style")
    from taichi_msm.plot_style import STYLE
    from taichi_msm.study.plot import _figure

    with style.context(STYLE, after_reset=True):
        figure = _figure(of_tissue())
    figure.canvas.draw()
    axes = {one.get_title(loc="left"): one for one in figure.axes}
    assert list(axes) == ["Stepping", "Drawing", "Points", "Terms"]
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


@pytest.mark.usefixtures("no_picture")
def test_a_page_without_upper_bounds_does_not_explain_them(tmp_path: Path) -> None:
    write_report(one_point(), tmp_path)
    assert "<" not in page(tmp_path)


@pytest.mark.usefixtures("no_picture")
def test_the_page_says_that_no_step_is_good_enough(tmp_path: Path) -> None:
    write_report(replace(realistic(), tolerance=1e-9), tmp_path)
    text = page(tmp_path)
    assert "No step that was measured is within the tolerance of 1e-09; the closest is f64 central at 62.5 us" in text
    assert "time.tolerance" in text
    write_report(diverged(), tmp_path)
    assert "within the tolerance of 0.001: all diverged." in page(tmp_path)
    write_report(interrupted(), tmp_path)
    assert "none was measured" in page(tmp_path)
    assert "(interrupted)" in page(tmp_path)


@pytest.mark.parametrize(
    "made",
    [
        pytest.param(
            made, marks=pytest.mark.fuzz if made in (tissue_alone, halfway, diverged, without_reference) else ()
        )
        for made in CASES[:-1]
    ],
    ids=lambda made: made.__name__,
)
def test_the_picture_is_readable_and_keeps_inside(made: Callable[[], Study], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    outputs = write_report(made(), tmp_path)
    assert outputs == (FILES[1:] if made is interrupted else FILES)
    if made is interrupted:
        return
    picture = pixels(tmp_path / "study.png")
    height, width, _ = picture.shape
    # One panel alone is narrower, so that parts that are missing leave no hole.
    assert width == (1200 if made in (halfway, motionless) else 1800)
    assert height == (940 if made in (halfway, diverged, motionless, without_reference) else 1780)
    assert (picture == 255).all(axis=-1).mean() > 0.7
    assert len(np.unique(picture @ (1 << 16, 1 << 8, 1))) > 100
    # Nothing is cut off.
    assert (picture[:, [0, -1]] == 255).all()
    assert (picture[[0, -1]] == 255).all()


def test_drawing_the_picture_changes_no_settings_of_others(tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.rcParams["lines.linewidth"] = 7
    before = matplotlib.rcParams.copy()
    write_report(one_point(), tmp_path)
    assert matplotlib.rcParams.copy() == before
    matplotlib.rcdefaults()


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


def test_a_study_with_nothing_to_draw_removes_the_old_picture(tmp_path: Path) -> None:
    (tmp_path / "study.png").write_bytes(b"of an earlier study")
    assert write_report(interrupted(), tmp_path) == FILES[1:]
    assert not (tmp_path / "study.png").exists()


def test_a_file_in_the_place_of_the_directory_is_told(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.write_text("a file")
    with pytest.raises(FilesError) as caught:
        write_report(realistic(), out)
    assert str(caught.value) == f"{out}: cannot write: Not a directory; choose another --out"
    assert out.read_text() == "a file"


@pytest.mark.usefixtures("no_picture")
def test_a_full_disk_leaves_the_earlier_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_report(one_point(), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write = Path.write_text

    def full(path: Path, *arguments: Any, **options: Any) -> int:
        if path.name == "study.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(FilesError, match=r": cannot write: No space left on device; free some space or choose another"):
        write_report(realistic(), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.usefixtures("no_picture")
def test_the_record_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = []
    move = Path.replace

    def watch(path: Path, target: Path) -> Path:
        moved.append(target.name)
        return move(path, target)

    monkeypatch.setattr(Path, "replace", watch)
    assert write_report(realistic(), tmp_path) == moved
    assert moved[-1] == "study.json"


def test_the_summary_is_short_and_ends_in_the_recommendation() -> None:
    found = realistic()
    text = format_summary(found)
    assert text.rstrip().endswith("\n".join(["To put in the scene:", "", *found.recommendation()]))
    lines = text.splitlines()
    assert len(lines) < 40
    assert max(map(len, lines[2:])) <= 90
    rows = printed(found)
    assert "f32 central 2.00 ms 0.000903 30.0 ms (27.0 to 39.0) recommended" in rows
    # The coarsest of order 1 within the tolerance.
    assert "f64 backward 500 us 0.000675 200 ms (180 to 260)" in rows
    assert "SciPy's DOP853 at rtol 0.01: error 0.000100, 5.00 s (once)" in rows
    assert "2 1 55.0 dB 10 10.0 ms (9.00 to 13.0) recommended" in rows
    assert sum(" dB " in row for row in rows) == 3
    assert "note: DOP853 takes more than 20 s at rtol 1e-08 and was stopped" in rows


def test_the_summary_says_what_is_closest_to_the_tolerance() -> None:
    found = replace(realistic(), tolerance=5e-7)
    text = format_summary(found)
    assert "f64 central 62.5 us < 8.79e-07 1.60 s (1.44 to 2.08)" in printed(found)
    assert "An error with < is an approximate upper bound" in text
    assert "No step that was measured is within the tolerance of 5e-07; the closest is f64 central" in text
    # The drawing is recommended all the same.
    assert text.rstrip().endswith("render:\n  refine: 2\n  supersample: 1")


def test_the_summary_of_a_method_that_diverged() -> None:
    assert "f32 central 4.00 ms diverged 20.0 ms (18.0 to 26.0)" in printed(diverged())


def test_names_are_printed_as_they_are() -> None:
    assert format_summary(oddly_named()).startswith(
        "[bold]$x$ 呼 \\udcff | :smile: on AMD EPYC 7R13, 2 threads, vectors of 512 bits\n"
    )


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0.00 us"),
        (1.234e-7, "0.123 us"),
        (22.54e-6, "22.5 us"),
        (0.99949e-3, "999 us"),
        (0.9996e-3, "1.00 ms"),
        (0.1, "100 ms"),
        (0.9999, "1.00 s"),
        (59.96, "60.0 s"),
        (1234.5, "1234 s"),
    ],
)
def test_times_read_well(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


def test_numbers_have_three_digits() -> None:
    written = [format_number(value) for value in (0.0, 1.0, 0.00027, 2.7e-9, 99.96, 999.6, 1e7)]
    assert written == ["0.00", "1.00", "0.000270", "2.70e-09", "100", "1000", "1.00e+07"]


def test_a_spread_is_in_the_unit_of_its_median() -> None:
    assert format_timing(Timing(0.0011, 0.0009, 0.012, 5)) == "1.10 ms (0.900 to 12.0)"
    assert format_timing(Timing(0.0011, 0.0011, 0.0011, 1)) == "1.10 ms (once)"


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
        MeshMeasurement(count, count, 100, error, True, None, samples=spread(0.01))
        for count, error in zip((16, 31, 61, 121), errors, strict=False)
    ]
    return found


def test_points_that_are_too_few_are_told_before_any_step() -> None:
    found = with_points(1e-3, 0.128, 0.032, 0.008, own=61)
    # Four times less at each halving, so that 8 times less takes sqrt(8) times the cells: 169.7 on 60.
    assert found.recommended_points == (171, 171)
    assert found.best_stepping is None
    lines = ["sheet:", "  points: [171, 171]", "time:", "  step: auto", "  tolerance: 0.001"]
    assert found.recommendation()[:5] == lines
    text = format_summary(found)
    said = (
        "61 x 61 points make an error of 0.00800, which no step can mend; the tolerance is 0.001. Take about 171 x 171"
    )
    assert f"{said} (extrapolated, not measured); with time.tolerance a run finds the step for them.\n" in text
    assert "recommended" not in text.split("refine")[0]
    scene(**{**yaml.safe_load("\n".join(found.recommendation())), "sheet": {"points": [171, 171], "size": [0.3, 0.4]}})


@pytest.mark.parametrize(
    ("errors", "more"),
    [
        # No faster than with the second power, and no slower than with the first, whatever is seen.
        ((0.5, 0.01), 1 + 95),
        ((0.011, 0.01), 1 + 300),
        ((0.009, 0.01), 1 + 300),
        ((0.04, 0.01, 5e-4), 61),
        ((0.04, 0.01, 0.002, 5e-4), 121),
        ((0.04, 0.001), None),
    ],
    ids=str,
)
def test_the_points_for_a_tolerance(errors: tuple[float, ...], more: int | None) -> None:
    found = with_points(1e-3, *errors)
    assert found.recommended_points == (None if more is None else (more, more))
    assert (found.best_stepping is None) == (more is not None)


def test_points_that_were_measured_and_do_are_recommended(tmp_path: Path) -> None:
    found = with_points(1e-3, 0.04, 0.01, 5e-4)
    rows = printed(found)
    assert any(row.startswith("61 x 61 100 0.000500 ") and row.endswith(" recommended") for row in rows)
    assert any(" 61 x 61 are within it; with time.tolerance a run finds the step for them." in row for row in rows)
    write_report(found, tmp_path)
    assert " 61 x 61 are within it; " in page(tmp_path)


def test_more_points_than_a_scene_may_have_are_not_recommended() -> None:
    found = with_points(1e-6, 0.04, 0.02)
    assert found.recommended_points == (600001, 600001)
    assert found.recommendation()[0] == "render:"
    assert "take a wider tool (probes.N.radius, a smaller falloff), or allow a larger error" in format_summary(found)


def test_points_that_do_are_told_beside_the_step() -> None:
    said = "31 x 31 points make an error of 0.0100, the recommended step one of 0.000903; the tolerance is 0.02."
    assert said in format_summary(with_points(0.02, 0.04, 0.01)).replace("\n", " ")
    # The scene's own tolerance for points comes first.
    found = with_points(1e-3, 0.04, 0.01)
    found.settings["sheet"]["tolerance"] = 0.015
    assert found.recommendation()[0] == "time:"
    assert "an error of 0.0100, the recommended step one of 0.000903; the tolerance is 0.015." in format_summary(found)
