"""Reports of a sweep: their content, and failures."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from scipy.stats import qmc

from taichi_msm import sweep
from taichi_msm.accuracy.companions import MESH_DOUBT, MESH_REMEDY
from taichi_msm.errors import ForeignError
from taichi_msm.load.scene_file import parse_override
from taichi_msm.plot_style import STYLE
from taichi_msm.sweeps import plots
from taichi_msm.sweeps.plots import (
    abbreviate_keys,
    estimate_sensitivity,
    first_order_index,
    format_short,
    read_gif_frame,
    varied_parameters,
    varied_results,
)
from taichi_msm.sweeps.pool import Pool
from taichi_msm.sweeps.runs import REPORT_FILES, Outcome, SweepState, begin_sweep
from taichi_msm.sweeps.spec import make_sweep
from taichi_msm.sweeps.tables import assign_splits, summary_lines, write_reports
from tests.golden import Messages

VARY = {
    "damping": {"log_uniform": [1e-3, 1e-1]},
    "probes.0.at": {"uniform": [[0.3, 0.5], [0.7, 0.5]]},
    "image": {"choice": ["speckle.png", "other.png"]},
}
Make = Callable[..., SweepState]


@pytest.fixture
def make(small: Path, ran: Path) -> Make:
    """Return a function that builds a sweep of small.yaml with records of runs and synthetic outcomes.

    The displacement is the logarithm of the damping; run 3 and every seventh after it diverged.
    """
    shutil.copy("speckle.png", "other.png")

    def make(samples: int = 8, vary: dict[str, Any] = VARY, **settings: Any) -> SweepState:
        described = make_sweep("small.yaml", {"vary": vary, "samples": samples, "seed": 1, **settings})
        values = described.values()
        outcomes = [
            Outcome(run, "diverged", "why", 9.0)
            if run % 7 == 3
            else Outcome(run, "complete", "", np.log(row[0]), 0.9, None)
            for run, row in enumerate(values)
        ]
        state = SweepState(small / "out", described, values, outcomes)
        for run in range(samples):
            state.run_directory(run).mkdir(parents=True, exist_ok=True)
            shutil.copy(ran / "run.json", state.run_directory(run))
        return state

    return make


def write(result: SweepState, executor: Executor | None = None) -> tuple[list[str], list[str]]:
    """Write the reports without progress."""
    return write_reports(result, executor or ThreadPoolExecutor(1), lambda stage, done, total: None)


def copy_runs(ran: Path, result: SweepState) -> None:
    """Copy the results of a run to every complete run."""
    for outcome in result.outcomes:
        if outcome.status == "complete":
            shutil.copytree(ran, result.run_directory(outcome.run), dirs_exist_ok=True)


def test_captions_are_short(message: Messages) -> None:
    keys = ["tissue.young", "probes.0.at", "probes.1.at", "probes.0.total.2", "render.light", "light"]
    message(abbreviate_keys(keys))
    values = [23412.5, 1.2345e-5, 7, "textures/a.png", [0.51234, [1, 2.0]], {"eye": [0.1]}, True, None]
    message(map(format_short, values))


def test_splits_depend_on_seed_and_number() -> None:
    # Pinned, as data sets must keep their splits.
    assert [run for run, part in enumerate(assign_splits(20, 1)) if part == "test"] == [1, 16]
    assert [run for run, part in enumerate(assign_splits(20, 1)) if part == "val"] == [11, 19]
    for runs, tenth in ((64, 6), (65, 7), (100, 10), (4, 0), (5, 1)):
        parts = assign_splits(runs, 1)
        assert [parts.count(part) for part in ("train", "val", "test")] == [runs - 2 * tenth, tenth, tenth]
    assert assign_splits(64, 1) != assign_splits(64, 2)


def test_varied_parameters_and_results(make: Make) -> None:
    result = make()
    damping, place, image = varied_parameters(result, range(8))
    assert (damping.name, damping.is_logarithmic) == ("damping", True)
    # The second component does not vary.
    assert (place.name, place.numbers.tolist()) == ("at[0]", [row[1][0] for row in result.values])
    assert (image.name, image.labels) == ("image", ["speckle.png", "other.png"])
    assert image.numbers.tolist() == [float(row[2] == "other.png") for row in result.values]
    columns = varied_results(result, range(8))
    assert list(columns) == ["max_displacement"]
    assert np.isnan(columns["max_displacement"]).tolist() == [run == 3 for run in range(8)]


def test_sensitivity_of_a_linear_function() -> None:
    """The variances of 3 x and y are as 9 to 1; the largest error with the first 40 seeds of the points is 0.09."""
    grid = np.array(list(itertools.product(range(8), range(8))), dtype=float)
    for points in (qmc.Sobol(2, seed=np.random.default_rng(0)).random(64), grid):
        for column, expected in zip(points.T, (0.9, 0.1), strict=True):
            index, confidence = first_order_index(column, 3 * points[:, 0] + points[:, 1])
            assert index == pytest.approx(expected, abs=0.12)
            assert abs(index - expected) < confidence


def test_sensitivity_needs_64_complete_runs(make: Make) -> None:
    assert write(make(64))[0] == ["table.csv", "table.parquet", "dataset.json", "sweep.png"]
    result = make(128)
    assert "sensitivity.csv" in write(result)[0]
    lines = (result.directory / "sensitivity.csv").read_text().splitlines()
    assert lines[0] == "result,parameter,first_order,confidence"
    assert [line.split(",")[:2] for line in lines[1:]] == [
        ["max_displacement", name] for name in ("damping", "at[0]", "image")
    ]
    shares = [float(line.split(",")[2]) for line in lines[1:]]
    assert shares == pytest.approx([1, 0, 0], abs=0.1)


def test_contact_sheet(make: Make, ran: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    result = make()
    copy_runs(ran, result)
    names, notes = write(result)
    assert names == ["table.csv", "table.parquet", "dataset.json", "contact.jpg", "sweep.png"]
    assert notes == []
    with Image.open(result.directory / "contact.jpg") as picture:
        pixels = np.asarray(picture).astype(int)
    # Two rows of four enlarged frames of 40 x 30 pixels, with gaps of 20 pixels and captions of some lines.
    width, height, above = 330, 248, 43
    rows = np.split(pixels[above : above + (len(pixels) - 63) // 2 * 2], 2)
    assert pixels.shape[1] == 20 + 4 * (width + 20)
    tiles = [row[:height, 20 + (width + 20) * column :][:, :width] for row in rows for column in range(4)]
    position = np.load(ran / "trajectory.npz")["position"]
    largest = int(np.linalg.norm(position - position[0], axis=-1).max(axis=(1, 2)).argmax())
    assert 0 < largest < 4
    with Image.open(ran / "frames" / f"000{largest}.png") as frame:
        shown = np.asarray(frame.resize((width, height), Image.Resampling.LANCZOS)).astype(int)
    assert all(np.abs(tile - shown).mean() < 5 for run, tile in enumerate(tiles) if run != 3)
    # The tile of a run that diverged is grey, with a word.
    assert 0.97 < (np.abs(tiles[3] - 0xE6) <= 2).all(axis=2).mean() < 1
    damaged = result.run_directory(1) / "frames" / "0002.png"
    damaged.write_bytes(damaged.read_bytes()[:100])
    drawing = Mock(wraps=plots._draw_tiles)
    monkeypatch.setattr(plots, "_draw_tiles", drawing)
    names, notes = write(result)
    assert "contact.jpg" in names
    message(drawing.call_args.args[-1], "8 runs")
    message(notes, "contact.jpg", "0002.png", hide=r"(?<=decoded).*")


@pytest.mark.default_cases("frames-0")
@pytest.mark.parametrize(("kept", "difference"), [("frames", 0), ("animation.gif", 10), ("trajectory.npz", 0)])
def test_frames_come_from_any_output(make: Make, ran: Path, kept: str, difference: float, pool: Pool) -> None:
    """An animation has fewer colours; a redrawn frame is equal."""
    result = make(2)
    copy_runs(ran, result)
    write(result, pool)
    first = np.asarray(Image.open(result.directory / "contact.jpg")).astype(int)
    for run, name in itertools.product(range(2), {"frames", "animation.gif", "trajectory.npz"} - {kept}):
        path = result.run_directory(run) / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert write(result, pool)[1] == []
    assert np.abs(np.asarray(Image.open(result.directory / "contact.jpg")) - first).mean() <= difference


def test_picture_of_an_animation_at_a_time(tmp_path: Path) -> None:
    red, blue = (Image.new("RGB", (40, 30), colour) for colour in ("red", "blue"))
    red.save(tmp_path / "a.gif", save_all=True, append_images=[blue, red], duration=[40, 80, 40])
    for time, colour in ((0.039, (255, 0, 0)), (0.041, (0, 0, 255)), (0.119, (0, 0, 255)), (0.13, (255, 0, 0))):
        assert read_gif_frame(tmp_path / "a.gif", time).getcolors() == [(40 * 30, colour)]


def test_earlier_reports_are_replaced_atomically(
    make: Make, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """Also when the drawing is interrupted, or another report fails."""
    result = make(128)
    for name in REPORT_FILES:
        (result.directory / name).write_text("earlier")

    def kill(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("taichi_msm.sweeps.plots.plot", kill)
        with pytest.raises(KeyboardInterrupt):
            write(result)
    assert {path.name for path in result.directory.iterdir()} == {"runs", *REPORT_FILES}
    assert (result.directory / "contact.jpg").read_text() == (result.directory / "sweep.png").read_text() == "earlier"
    (result.directory / "sweep.png").unlink()
    (result.directory / "sweep.png").mkdir()
    names, notes = write(result)
    assert names == ["table.csv", "table.parquet", "dataset.json", "sensitivity.csv"]
    assert {path.name for path in result.directory.iterdir()} == {"runs", "sweep.png", *names}
    message(notes, "sweep.png", hide=r"(?<=written: ).*")


def test_missing_libraries(make: Make, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    for name in ("matplotlib", "SALib", "SALib.analyze", "pyarrow"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "taichi_msm.sweeps.plots", raising=False)
    names, notes = write(make(128))
    assert names == ["table.csv", "dataset.json"]
    message(notes, "output: [png]", "SALib", "matplotlib")


def test_reports_without_a_complete_run(make: Make, message: Messages) -> None:
    state = make(2)
    state.outcomes = [Outcome(run, "diverged", "why", 9.0) for run in range(2)]
    message(write(state)[1])


def test_plots_of_the_most_sensitive_parameters(make: Make, message: Messages) -> None:
    style = pytest.importorskip("matplotlib.style")
    from taichi_msm.sweeps.plots import PlotData, _figure

    keys = ["springs.shear", "springs.structural", "springs.virtual", "sheet.mass", "probes.0.falloff"]
    vary = {key: {"uniform": [1, 2]} for key in keys} | {"probes.0.force": {"uniform": [[0, 0, 1], [1, 1, 2]]}}
    result = make(128, {"damping": {"uniform": [0.1, 1]}, **vary})
    varied, columns = varied_parameters(result, range(128)), varied_results(result, range(128))
    indices = estimate_sensitivity(varied, columns)
    failed = np.isnan(columns["max_displacement"])
    with style.context(STYLE, after_reset=True):
        figure = _figure(PlotData("title", varied, columns, failed, indices))
    names = [axes.get_xlabel() for axes in figure.axes]
    assert len(varied) == 9
    assert len(names) == 8
    assert names[0] == "damping"
    (omitted,) = {parameter.name for parameter in varied} - set(names)
    assert min(indices, key=lambda index: index.first_order).parameter == omitted
    message(" ".join(figure.get_supxlabel().split()), omitted)
    # Crosses at the bottom edge mark the failed runs.
    crosses = np.asarray(figure.axes[0].collections[1].get_offsets())
    assert crosses.tolist() == [[number, 0] for number in varied[0].numbers[failed]]


def test_types_of_the_parquet_table(make: Make) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    result = make(8, {**VARY, "render.camera": {"choice": ["top", {"eye": [0, 0, 1], "target": [0, 0, 0]}]}})
    write(result)
    table = parquet.read_table(result.directory / "table.parquet")
    kinds = {field.name: str(field.type) for field in table.schema}
    assert kinds == {
        "run": "int64",
        "damping": "double",
        "probes.0.at": "list<element: double>",
        "image": "string",
        # Values of two types become arguments of --set.
        "render.camera": "string",
        "status": "string",
        "error": "string",
        **dict.fromkeys(["max_displacement", "shortest_spring", "error_estimate", "mesh_error", "seconds"], "double"),
    }
    columns = table.to_pydict()
    assert columns["damping"] == [row[0] for row in result.values]
    assert columns["probes.0.at"] == [row[1] for row in result.values]
    assert set(columns["render.camera"]) == {"top", '{"eye": [0, 0, 1], "target": [0, 0, 0]}'}
    assert columns["max_displacement"] == [outcome.max_displacement for outcome in result.outcomes]


def test_columns_of_forces(make: Make) -> None:
    """It has another name if the key of this name varies."""
    result = make(8)
    outcomes = [replace(outcome, forces=(1.5, None) if outcome.run == 2 else ()) for outcome in result.outcomes]
    columns = replace(result, outcomes=outcomes).columns()
    assert list(columns)[-3:] == ["probes.0.force", "probes.1.force", "seconds"]
    assert (columns["probes.0.force"][:4], columns["probes.1.force"][2]) == ([None, None, 1.5, None], None)
    named = make(8, {**VARY, "probes.0.force": {"choice": [[0, 0, -1000], [0, 0, -500]]}})
    named = replace(named, outcomes=[replace(outcome, forces=(1.5,)) for outcome in named.outcomes])
    assert "probes.0.force.greatest" in named.columns()
    assert "probes.0.force" not in named.columns()


def test_content_of_a_data_set(make: Make, ran: Path, root: Path) -> None:
    result = make(20)
    write(result)
    described = json.loads((result.directory / "dataset.json").read_text())
    rows = described.pop("runs")
    assert [row["run"] for row in rows] == [run for run in range(20) if run not in (3, 10, 17)]
    values = dict(zip(VARY, result.values[4], strict=True))
    assert rows[3] == {"run": 4, "folder": "runs/000004", "part": "train", "values": values}
    assert [row["part"] for row in rows] == [assign_splits(20, 1)[row["run"]] for row in rows]
    assert described["vary"] == VARY
    assert described["seed"] == 1
    assert described["outputs"] == ["frames", "animation.gif", "trajectory.npz", "run.json"]
    assert (described["frames"], described["size"], described["frames_per_second"]) == (5, [40, 30], 10)
    assert "numpy" in described["versions"]
    git = ["git", "-C", str(root), "rev-parse", "HEAD"]
    expected = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or None
    assert described["commit"] == json.loads((ran / "run.json").read_text())["commit"] == expected


def test_data_set_of_several_sizes(small: Path, pool: Pool) -> None:
    sizes = [[16, 12], [12, 16]]
    vary = {"render.size": {"grid": sizes}}
    overrides = {"time.duration": 0.1, "output": ["png"]}
    outcomes = list(sweep("small.yaml", vary, "out", executor=pool, overrides=overrides))
    assert {outcome.status for outcome in outcomes} == {"complete"}
    rows = json.loads(Path("out/dataset.json").read_text())["runs"]
    assert [row["size"] for row in rows] == sizes
    with Image.open(rows[1]["folder"].join(["out/", "/frames/0001.png"])) as frame:
        assert list(frame.size) == sizes[1]
    assert {path.name for path in Path("out").iterdir()} == {
        *("runs", "sweep.json", "table.csv", "table.parquet", "dataset.json", "contact.jpg"),
    }


def test_cells_that_look_like_formulas(make: Make) -> None:
    """A spreadsheet takes cells that begin with = + - @ for formulas; those of values are still arguments of --set."""
    pictures = ["=1+2.png", "-a.png", "+a.png", "@a.png"]
    for name in pictures:
        shutil.copy("speckle.png", name)
    state = make(vary={**VARY, "image": {"choice": pictures}, "probes.0.offset": {"choice": [-1.5]}})
    state.outcomes[0] = Outcome(0, "refused", "--set probes.0.offset=-1.5: why")
    write(state)
    rows = list(csv.DictReader((state.directory / "table.csv").read_text().splitlines()))
    for row, values in zip(rows, state.values, strict=True):
        assert not row["image"].startswith(("=", "+", "-", "@"))
        assert [parse_override(f"key={row[key]}").value for key in state.sweep.keys] == values
        assert row["probes.0.offset"] == "-1.5", "a number stays one"
    assert rows[0]["error"] == "'--set probes.0.offset=-1.5: why"


def test_summary_lines(message: Messages) -> None:
    outcomes = [Outcome(run, "complete", "", 0.1, notes=(f"a warning of {run} m",)) for run in range(3)]
    outcomes[0] = Outcome(0, "refused", "damping: too large")
    message(summary_lines(Path("out"), outcomes, (1, 2), [], []), "--shard")


def test_warnings_of_the_mesh_are_reported_once(message: Messages) -> None:
    """Of runs with errors of 5 %, 6 % and 5 %, the warnings are those of the second."""
    outcomes = []
    for run, error in enumerate((0.05, 0.06, 0.05)):
        notes = f"{MESH_DOUBT}: doubt {run}", f"{MESH_REMEDY}, try {run}", f"slip of {run} m"
        outcomes.append(Outcome(run, "complete", mesh_error=error, notes=notes))
    message(summary_lines(Path("out"), outcomes, None, ["table.csv"], []), "doubt 1", "try 1", "labels")


def test_foreign_files_stay(make: Make, message: Messages) -> None:
    result = make()
    shutil.rmtree(result.directory / "runs")
    for name in REPORT_FILES:
        (result.directory / name).write_text("foreign")
        with message.raises(ForeignError, name):
            begin_sweep(result.sweep, result.directory)
        assert (result.directory / name).read_text() == "foreign"
        (result.directory / name).unlink()
