"""The command `palpation`: files, scene, predictions, messages."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from taichi_msm import run
from taichi_msm.cli.main import main
from taichi_msm.load.scene_file import load_scene
from taichi_msm.palpation.plane import find_plane
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.palpation.synthetic import LOCK, Truth, log_stiffness, make_presses, write_table

PICTURES = ["pictures/stiffness.png", "pictures/tissue.png"]
FILES = ["curves.png", "map.png", "places.csv", *PICTURES, "predicted.csv", "scene.yaml"]

# Where the tissue lies in the frame of the robot: x of the map along z, y along x, and the normal along y.
ROTATION = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_presses(80)


@pytest.fixture(scope="module")
def others() -> Truth:
    return make_presses(40, seed=2)


@pytest.fixture(scope="module")
def mapped(truth: Truth, others: Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a map, of tissue that is tilted in space, with a place that is left out."""
    folder = tmp_path_factory.mktemp("palpation")
    tilted = replace(truth.presses, position=truth.presses.position @ ROTATION)
    table = write_table(folder / "liver.csv", tilted)
    header, *lines = table.read_text().splitlines()
    lines.append("air,1,0,1,0.1,0.0001")
    table.write_text("\n".join([f"{header},nx,ny,nz", *(f"{line},0,1,0" for line in lines)]) + "\n")
    write_table(folder / "others.csv", replace(others.presses, position=others.presses.position @ ROTATION))
    arguments = ["palpation", str(table), "--radius", "4mm", "--predict", str(folder / "others.csv")]
    assert main([*arguments, "--out", str(folder / "map"), "--json"]) == 0
    return folder / "map"


def test_record(mapped: Path, truth: Truth, message: Messages) -> None:
    record = json.loads((mapped / "fit.json").read_text())
    assert record["files"] == sorted(FILES)
    low, high = record["lock_interval"]
    # The interval has the lock with 95 %, and twice as far with more than 99.98 %.
    assert 2 * low - record["lock"] < LOCK < 2 * high - record["lock"]
    assert record["factor"] == 10
    assert record["presses"] == truth.presses.count
    message(record["left_out"][0]["reason"])
    assert record["left_out"][0]["place"] == "air"
    assert 0.005 < record["length"] < 0.05
    for scores in (record["residual"], *(record["scores"][name] for name in ("constant", "nearest", "map"))):
        assert 0 < scores["median"] < scores["p90"] < 1
    assert 0.75 < record["scores"]["coverage"] < 1


def test_places(mapped: Path, truth: Truth) -> None:
    rows = rows_of(mapped / "places.csv")
    assert list(rows[0]) == ["place", "x", "y", "z", "stiffness", "low", "high", "offset", "residual"]
    assert [row["place"] for row in rows] == list(truth.presses.places)
    numbers = {key: np.array([float(row[key]) for row in rows]) for key in list(rows[0])[1:]}
    position = np.column_stack([numbers[key] for key in "xyz"])
    np.testing.assert_allclose(position, truth.presses.position @ ROTATION, atol=1e-7)  # four digits of mm
    covered = (numbers["low"] < truth.stiffness) & (truth.stiffness < numbers["high"])
    # 95 % of 80 +- 3.5 standard deviations of the binomial distribution.
    assert covered.mean() > 0.95 - 3.5 * math.sqrt(0.95 * 0.05 / 80)
    assert np.median(numbers["offset"]) == pytest.approx(0.7e-3, abs=1e-4)
    # The noise is 2 % of the peak.
    assert np.median(numbers["residual"]) == pytest.approx(0.018, abs=0.004)


def test_predictions_of_other_presses(mapped: Path, others: Truth) -> None:
    rows = rows_of(mapped / "predicted.csv")
    assert list(rows[0]) == ["place", "depth", "force", "low", "high"]
    assert [row["place"] for row in rows] == [others.presses.places[n] for n in others.presses.index]
    force, low, high = (np.array([float(row[key]) for row in rows]) for key in ("force", "low", "high"))
    measured, peak = others.presses.force, others.presses.peak[others.presses.index]
    # 90 % of 40 presses, whose rows are correlated, +- 3.5 standard deviations of 40 independent values.
    assert abs(np.mean((low < measured) & (measured < high)) - 0.9) < 3.5 * math.sqrt(0.09 / 40)
    assert np.median(np.abs(force - measured) / peak) < 0.06


def test_scene_runs_alone(mapped: Path, truth: Truth, device: Device, tmp_path: Path, message: Messages) -> None:
    text = (mapped / "scene.yaml").read_text()
    message(text.partition("image:")[0], hide=r"\b[\d.]+(?= (mm|N)\b)")
    scene = yaml.safe_load(text)
    # Extent of the places and two radii on each side, as height and width; points within a quarter of the radius.
    extent = np.ptp(truth.presses.position, axis=0)[:2]
    turned = find_plane(truth.presses.position, np.array([0, 0, 1.0]), 0.008)
    np.testing.assert_allclose(scene["sheet"]["size"], turned.size[::-1], rtol=1e-3)
    assert (np.sort(turned.size)[::-1] >= np.sort(extent)[::-1]).all()
    assert (np.array(scene["sheet"]["size"]) / (np.array(scene["sheet"]["points"]) - 1) <= 0.004 / 4).all()
    for name in ("scene.yaml", *PICTURES):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((mapped / name).read_bytes())
    record = run(load_scene(tmp_path / "scene.yaml"), tmp_path / "run", threads=device.threads, estimate_error=False)
    assert record["status"] == "complete"
    force = -float((tmp_path / "run" / "forces.csv").read_text().splitlines()[-1].split(",")[-1])
    expected = re.search(r"([\d.]+) N by the law", text)
    assert expected is not None
    # The mass points, squares of R / 6, have (1 / 6)^2 / 12 of the dent's curvature, R / depth: 0.5 %; the edge of the
    # contact, between points, about as much again; and the sheet 0.2 %.
    assert force == pytest.approx(float(expected[1]), rel=0.02)


def test_picture_of_the_stiffness(mapped: Path, truth: Truth) -> None:
    scene = yaml.safe_load((mapped / "scene.yaml").read_text())
    foundation, factors = scene["tissue"]["foundation"], scene["tissue"]["foundation_map"]
    assert foundation["lock"] == pytest.approx(LOCK, rel=0.05)
    with Image.open(mapped / factors["image"]) as picture:
        grey = np.asarray(picture).astype(float) / 65535
    assert [*grey.shape] == scene["sheet"]["points"]
    black, white = factors["range"]
    stiffness = foundation["young"] / foundation["depth"] * (black + (white - black) * grey)
    plane = find_plane(truth.presses.position @ ROTATION, np.array([0, 1.0, 0]), 0.008)
    at = plane.pixels(*grey.shape)
    true = np.exp(log_stiffness(at.reshape(-1, 3) @ ROTATION.T)).reshape(grey.shape)
    inner = (slice(18, -18), slice(18, -18))
    # Within the places the map is known to about 5 %, with a scatter of 5 % and places 5 mm apart.
    assert np.std(np.log(stiffness / true)[inner]) < 0.1


def test_plane_keeps_the_side_and_the_handedness() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-3, 3, 50), rng.uniform(-1, 1, 50), 0.1 * rng.standard_normal(50)])
    rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    rotation *= np.linalg.det(rotation)
    plane = find_plane(flat @ rotation.T, rotation @ [0, 0, 1.0], 0.5)
    assert np.linalg.det(plane.axes) == pytest.approx(1)
    assert plane.axes[2] @ (rotation @ [0, 0, 1.0]) > 0.99
    assert plane.size[0] > 2 * plane.size[1]
    # The first pixel is at the upper left, and a place is where its fractions are.
    corner = plane.from_space(plane.pixels(10, 20)[0, 0])
    np.testing.assert_allclose(corner[:2], plane.low + np.array([0.025, 0.95]) * plane.size)
    np.testing.assert_allclose(plane.fractions(plane.pixels(10, 20)[3, 7]), [7.5 / 20, 3.5 / 10])


def test_places_on_a_line(truth: Truth, tmp_path: Path, program: Program) -> None:
    position = truth.presses.position[:15] * [1, 0, 0] + [0, 0.1, 0.2]
    table = write_table(tmp_path / "liver.csv", replace(truth.presses.subset(np.arange(15)), position=position))
    done = program("palpation", str(table), "--radius", "4mm", "--out", str(tmp_path / "map"))
    assert done.returncode == 0, done.stderr
    height, width = load_scene(tmp_path / "map" / "scene.yaml").sheet.size
    # Two radii on each side.
    assert height == pytest.approx(0.016)
    assert width == pytest.approx(0.016 + np.ptp(position[:, 0]), abs=1e-6)
    plane = find_plane(position, np.array([0, 0, 1.0]), 0.008)
    np.testing.assert_allclose(plane.axes, np.eye(3), atol=1e-9)


def test_linear_tissue(tmp_path: Path, program: Program, message: Messages) -> None:
    table = write_table(tmp_path / "silicone.csv", make_presses(30, lock=math.inf).presses)
    done = program("palpation", str(table), "--radius", "0.004", "--out", str(tmp_path / "map"))
    assert done.returncode == 0
    message(done.stdout.splitlines()[2], "lock")
    record = json.loads((tmp_path / "map" / "fit.json").read_text())
    assert record["lock"] is None
    assert record["lock_interval"] is None
    assert "lock" not in yaml.safe_load((tmp_path / "map" / "scene.yaml").read_text())["tissue"]["foundation"]
    assert not (tmp_path / "map" / "predicted.csv").exists()


def test_summary(truth: Truth, tmp_path: Path, program: Program, message: Messages) -> None:
    flipped = replace(truth.presses, force=-truth.presses.force)
    table = write_table(tmp_path / "liver.csv", flipped)
    done = program("palpation", str(table), "--radius", "4 mm", "--out", str(tmp_path / "map"))
    message(done.stdout, "forces have another sign", hide=r"(?<!the )\b\d+(\.\d+)?")


def test_without_matplotlib(
    truth: Truth, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "taichi_msm.palpation.plots", raising=False)
    table = write_table(tmp_path / "liver.csv", truth.presses.subset(np.arange(12)))
    done = program("palpation", str(table), "--radius", "4mm", "--out", str(tmp_path / "map"), "--json")
    record: dict[str, Any] = json.loads(done.stdout)
    message(record["notes"], "matplotlib")
    assert not (tmp_path / "map" / "map.png").exists()


def test_unlikely_depths(truth: Truth, tmp_path: Path, program: Program, message: Messages) -> None:
    table = write_table(tmp_path / "liver.csv", truth.presses.subset(np.arange(12)))
    done = program("palpation", str(table), "--radius", "0.4mm", "--out", str(tmp_path / "map"), "--json")
    message(json.loads(done.stdout)["notes"], "--radius")


def test_places_too_far_apart_for_a_scene(truth: Truth, tmp_path: Path, program: Program, message: Messages) -> None:
    far = replace(truth.presses.subset(np.arange(12)), position=1000 * truth.presses.position[:12])
    table = write_table(tmp_path / "liver.csv", far)
    done = program("palpation", str(table), "--radius", "4mm", "--out", str(tmp_path / "map"), "--json")
    message(json.loads(done.stdout)["notes"], "scene.yaml", hide=r"\d+ x \d+")
    assert not (tmp_path / "map" / "scene.yaml").exists()
    assert (tmp_path / "map" / "places.csv").exists()


@pytest.mark.parametrize("radius", ["4", "4 inch", "mm", "0", "-4mm", "nan"])
def test_invalid_radius(radius: str, program: Callable[..., Any], message: Messages) -> None:
    done = program("palpation", "liver.csv", "--radius", radius)
    assert done.returncode == 2
    message(done.stderr, "--radius")


@pytest.mark.parametrize("name", ["nowhere.csv", "nowhere.xlsx"])
def test_missing_tables(
    name: str, tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.chdir(tmp_path)
    done = program("palpation", name, "--radius", "4mm")
    assert done.returncode == 2
    message(done.stderr, name)
    assert not list(tmp_path.iterdir())


def test_results_replace_earlier_ones_alone(mapped: Path, truth: Truth, tmp_path: Path, program: Program) -> None:
    table = write_table(tmp_path / "liver.csv", truth.presses.subset(np.arange(12)))
    out = tmp_path / "map"
    arguments = "palpation", str(table), "--radius", "4mm", "--out", str(out)
    assert program(*arguments, "--predict", str(table)).returncode == 0
    (out / "mine.txt").write_text("kept")
    assert program(*arguments).returncode == 0
    assert not (out / "predicted.csv").exists()
    assert (out / "mine.txt").exists()
    (out / "fit.json").unlink()
    done = program(*arguments)
    assert done.returncode == 4
    assert "not written by this program" in done.stderr
