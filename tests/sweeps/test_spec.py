"""Sweep files: what they mean, and every fault of one."""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtri
from scipy.stats import qmc

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import ANY_CAMERA, CAMERA_FILE_KEYS, PICTURE_KEYS, load_plan
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PATH
from taichi_msm.sweeps.spec import Distribution, format_override, load_sweep, run_values, sample_run_values
from tests.scenes import speckle


def shares(dimensions: int, samples: int, seed: int) -> Any:
    """Points of SciPy's scrambled Sobol sequence, without its warning about other numbers than powers of two."""
    return qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed)).random(
        2 ** math.ceil(math.log2(samples))
    )


def values(samples: int | None, **vary: dict[str, Any]) -> list[list[Any]]:
    return run_values({name: Distribution(**one) for name, one in vary.items()}, samples, 3)


def test_every_number_and_every_choice_takes_a_dimension_in_the_order_of_the_keys() -> None:
    made = values(
        5,
        a={"uniform": [2, 3]},
        b={"log_uniform": [[1, 10], [100, 10]]},
        c={"choice": ["x", "y", "z"]},
        d={"normal": [1, 0.5]},
    )
    assert len(made) == 5
    for row, u in zip(made, shares(5, 5, 3)[:5], strict=True):
        # Rounding: a few operations on numbers near these.
        assert row[0] == pytest.approx(2 + u[0], rel=1e-15)
        assert row[1] == pytest.approx([100 ** u[1], 10.0], rel=1e-14)
        assert row[2] == "xyz"[int(3 * u[3])]
        assert row[3] == pytest.approx(1 + 0.5 * ndtri(u[4]), rel=1e-14)


def test_more_samples_begin_with_the_same_ones() -> None:
    vary = {"a": {"uniform": [0, 1]}, "b": {"normal": [0, 1]}}
    assert values(1000, **vary)[:3] == values(3, **vary)
    assert values(1, **vary) == values(3, **vary)[:1]


def test_a_normal_distribution_has_a_value_for_the_share_0() -> None:
    assert math.isfinite(Distribution(normal=[0, 1]).value([0.0]))


def test_a_lists_numbers_keep_their_shape() -> None:
    low, high = [[0, 0], [0.2, 100]], [[0, 0], [0.4, 100]]
    (row,) = values(1, load={"uniform": [low, high]})
    assert row[0][0] == [0, 0]
    assert 0.2 <= row[0][1][0] <= 0.4
    assert row[0][1][1] == 100


def test_some_runs_are_spread_over_all() -> None:
    vary = {"a": Distribution(grid=list(range(10))), "b": Distribution(grid=list(range(1000)))}
    every = run_values(vary, None, 3)
    assert every[1234] == [1, 234]
    assert [every.index(row) for row in sample_run_values(vary, None, 3, 4)] == [1250, 3750, 6250, 8750]
    assert sample_run_values({"a": vary["a"]}, None, 3, 100) == [[n] for n in range(10)]


def test_grids_give_every_combination_the_last_key_fastest() -> None:
    assert values(None, a={"grid": [1, 2]}, b={"grid": ["x", [3, 4]]}) == [[1, "x"], [1, [3, 4]], [2, "x"], [2, [3, 4]]]


@pytest.mark.parametrize(
    "value",
    [
        0.1,
        1e-7,
        1 / 3,
        5,
        -2.5e300,
        True,
        None,
        "none",
        "a b, c",
        "1e3",
        "true",
        "#a",
        "ü",
        "",
        [0.1, [2, "x"]],
        {"a": [1]},
    ],
)
def test_a_cell_is_what_set_takes(value: Any) -> None:
    from taichi_msm.load.scene_file import parse_override

    assert parse_override(f"key={format_override(value)}").value == value


@pytest.fixture
def folder(small: Path) -> Path:
    """`small` with a folder of pictures, and a scene below another folder."""
    (small / "textures").mkdir()
    for name in ("b", "a"):
        Image.fromarray(speckle(30, 40, ord(name))).save(small / "textures" / f"{name}.png")
    (small / "textures" / "notes.txt").write_text("no picture")
    return small


def test_pictures_are_found_from_the_sweep_file_and_given_from_the_scene(folder: Path) -> None:
    (folder / "scenes").mkdir()
    for name in ("small.yaml", "speckle.png"):
        (folder / name).rename(folder / "scenes" / name)
    (folder / "many.yaml").write_text(
        "scene: scenes/small.yaml\nsamples: 4\nvary:\n"
        '  image: {choice: "textures/*.png"}\n  springs.structural: {uniform: [10, 20]}\n'
        "set: {springs.map: {image: textures/a.png, range: [1, 2]}}\n"
    )
    sweep = load_sweep("many.yaml")
    assert sweep.settings.vary["image"].values == ["../textures/a.png", "../textures/b.png"]
    overrides = sweep.overrides(["../textures/b.png", 12.5])
    assert overrides == (
        'springs.map={"image": "../textures/a.png", "range": [1, 2]}',
        "image=../textures/b.png",
        "springs.structural=12.5",
    )
    scene = load_plan("scenes/small.yaml", overrides).scene
    assert scene.pictures == {"image": "scenes/../textures/b.png", "springs.map.image": "scenes/../textures/a.png"}
    assert {Path(path).name for path in sweep.files} == {"a.png", "b.png", "speckle.png"}


CALIBRATION = "K: [50, 0, 20, 0, 50, 15, 0, 0, 1]\nD: [0, 0, 0, 0]\nwidth: 40\nheight: 30\n"
POSES = "0 0 0 0.4 1 0 0 0\n9 0 0 0.5 1 0 0 0\n"


def test_files_of_cameras_are_found_from_the_sweep_file_and_given_from_the_scene(folder: Path) -> None:
    (folder / "scenes").mkdir()
    for name in ("small.yaml", "speckle.png"):
        (folder / name).rename(folder / "scenes" / name)
    (folder / "lab").mkdir()
    for name, text in (("a.yml", CALIBRATION), ("b.yml", CALIBRATION), ("way.txt", POSES)):
        (folder / "lab" / name).write_text(text)
    cameras = {"left": {"calibration": "lab/a.yml", "poses": "lab/way.txt"}}
    vary = {
        "render.cameras.left.calibration": {"grid": "lab/*.yml"},
        "render.cameras.7": {"grid": [{"poses": "lab/way.txt"}]},
    }
    data = {"scene": "scenes/small.yaml", "set": {"render.cameras": cameras}, "vary": vary}
    (folder / "many.yaml").write_text(json.dumps(data))
    sweep = load_sweep("many.yaml")
    assert sweep.settings.set["render.cameras"]["left"]["poses"] == "../lab/way.txt"
    assert [row[0] for row in sweep.values()] == ["../lab/a.yml", "../lab/b.yml"]
    assert [row[1] for row in sweep.values()] == [{"poses": "../lab/way.txt"}] * 2
    assert {os.path.relpath(path) for path in sweep.files} == {
        *("lab/a.yml", "lab/b.yml", "lab/way.txt", "scenes/speckle.png"),
    }
    plan = load_plan("scenes/small.yaml", sweep.overrides(sweep.values()[0]))
    assert plan.sha256 == {
        "render.cameras.left.calibration": hashlib.sha256(CALIBRATION.encode()).hexdigest(),
        "render.cameras.left.poses": hashlib.sha256(POSES.encode()).hexdigest(),
        "render.cameras.7.poses": hashlib.sha256(POSES.encode()).hexdigest(),
    }


def test_every_key_of_a_scene_that_names_a_file_is_known() -> None:
    schema = Scene.model_json_schema()
    found = set()

    def walk(part: dict[str, Any], key: tuple[str, ...]) -> None:
        if part.get("maxLength") == MAX_PATH:
            found.add(key)
        for name, inner in part.get("properties", {}).items():
            walk(inner, (*key, name))
        for inner in (part.get("additionalProperties"), part.get("items")):
            if isinstance(inner, dict):
                walk(inner, (*key, ANY_CAMERA))
        for inner in part.get("anyOf", []):
            walk(inner, key)
        if "$ref" in part:
            walk(schema["$defs"][part["$ref"].rpartition("/")[2]], key)

    walk(schema, ())
    assert found == {*PICTURE_KEYS, *CAMERA_FILE_KEYS}


GOOD = {"scene": "small.yaml", "samples": 2, "vary": {"damping": {"uniform": [0.01, 0.02]}}}
FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"sampels": 3}, "sampels: unknown key; did you mean 'samples'?"),
    ({"scene": "none.yaml"}, "scene: none.yaml: no such file or directory"),
    ({"samples": 0}, "samples: 0 is not allowed; expected a whole number, 1 to 10000000"),
    ({"samples": None}, "samples: missing; expected the number of runs, as not every key is a grid"),
    ({"vary": {}}, "vary: no keys; name at least one, such as tissue.young: {uniform: [1e4, 3e4]}"),
    (
        {"vary": {"damping": {"grid": [1]}}},
        "samples: damping is a grid, which gives every combination; take choice, or leave out samples",
    ),
    ({"vary": {"damping": {"uniform": [3, 2]}}}, "vary.damping.uniform: 3 is above 2; give the lower number first"),
    (
        {"vary": {"damping": {"log_uniform": [0, 2]}}},
        "vary.damping.log_uniform: 0 has no logarithm; take numbers above 0, or uniform",
    ),
    (
        {"vary": {"damping": {"normal": [0, -2]}}},
        "vary.damping.normal: a standard deviation of -2 is not possible; take 0 or more",
    ),
    (
        {"vary": {"damping": {"uniform": [[1, 2], [3]]}}},
        "vary.damping.uniform: [1, 2] and [3] differ in shape; give both as many numbers",
    ),
    (
        {"vary": {"damping": {"uniform": ["a", "b"]}}},
        'vary.damping.uniform: ["a", "b"] is not allowed; expected two numbers, or two lists of numbers of one shape',
    ),
    (
        {"vary": {"damping": {"choice": []}}},
        "vary.damping.choice: [] is not allowed; expected a list of values that is not empty",
    ),
    ({"vary": {"damping": {"unifrom": [1, 2]}}}, "vary.damping.unifrom: unknown key; did you mean 'uniform'?"),
    (
        {"vary": {"damping": {"uniform": [1, 2], "choice": [1]}}},
        "vary.damping: expected one of uniform, log_uniform, normal, choice, grid",
    ),
    ({"vary": {"dampign": {"uniform": [1, 2]}}}, "vary.dampign: unknown key; did you mean 'damping'?"),
    (
        {"vary": {"damping": [0.01, 0.02]}},
        "vary.damping: [0.01, 0.02] is no way to vary; take one, such as {uniform: [1, 2]} or {choice: [1, 2]}",
    ),
    (
        {"vary": {"springs": {"shear": {"uniform": [1, 2]}}}},
        "vary.springs: give each key by its dotted path, such as tissue.young: {uniform: [1e4, 3e4]}",
    ),
    ({"set": {"sheet.pionts": [3, 3]}}, "set.sheet.pionts: unknown key; did you mean 'points'?"),
    (
        {"set": {"probes.3.falloff": 5}},
        "set.probes.3.falloff: no such item; the list has 1, numbered from 0, as in probes.0.falloff",
    ),
    ({"set": {"damping": 1}}, "vary: damping replaces damping, which comes before it; keep one"),
    (
        {"set": {"springs.shear": 3}, "vary": {"springs": {"choice": [{"shear": 1}]}}},
        "vary: springs replaces springs.shear, which comes before it; keep one, or give springs first",
    ),
    ({"set": {"damping=1": 1}}, "set.damping=1: not a key; expected a dotted path such as sheet.points"),
    ({"set": {"sprigns.shear": 1}}, "set.sprigns.shear: sprigns: unknown key; did you mean 'springs'?"),
    (
        {"vary": {"damping": {"choice": [math.nan]}}},
        "vary.damping.choice: [NaN] has a number that is not finite; take others",
    ),
    (
        {"vary": {"damping": {"uniform": [0, 1e31]}}},
        "vary.damping.uniform: [0, 1e+31] is not allowed; expected two numbers, or two lists of numbers of one shape",
    ),
    (
        {"vary": {"damping": {"uniform": [[0] * 21202, [1] * 21202]}}},
        "vary: 21202 numbers, more than the 21201 that can vary; take fewer",
    ),
    (
        {"vary": {"image": {"choice": ["a" * 300]}}},
        f"vary.image.choice.0: {'a' * 60}...: no such file; name a picture relative to the sweep file",
    ),
    (
        {"vary": {"image": {"choice": ["textures/c.png"]}}},
        "vary.image.choice.0: textures/c.png: no such file; name a picture relative to the sweep file",
    ),
    (
        {"vary": {"image": {"choice": "textures/*.jpg"}}},
        'vary.image.choice: "textures/*.jpg" matches no picture; give a pattern relative to the sweep file',
    ),
    (
        {"vary": {"image": {"choice": ["/etc/hostname"]}}},
        "vary.image.choice.0: /etc/hostname is neither below the sweep file's folder nor below the scene's; "
        "put the picture there",
    ),
    (
        {"set": {"render.camera": {"calibration": "/etc/hostname"}}},
        "set.render.camera: /etc/hostname is neither below the sweep file's folder nor below the scene's; "
        "put the file there",
    ),
    (
        {"vary": {"render.cameras.left.poses": {"choice": ["../a.txt", [[0, 0, 0, 0, 0, 0, 0, 1]]]}}},
        "vary.render.cameras.left.poses.choice.0: ../a.txt is neither below the sweep file's folder nor below the "
        "scene's; put the file there",
    ),
    (
        {"set": {"render.camera.calibration": "a.yml"}},
        "set.render.camera.calibration: a.yml: no such file; name a file relative to the sweep file",
    ),
    (
        {"samples": None, "vary": {name: {"grid": list(range(4000))} for name in ("damping", "springs.shear")}},
        "vary: 16000000 combinations, more than the 10000000 that can be run; take smaller grids",
    ),
]


@pytest.mark.parametrize(("change", "message"), FAULTS, ids=[message[:50] for _, message in FAULTS])
def test_a_fault_of_a_sweep_file_is_told_at_its_key(folder: Path, change: dict[str, Any], message: str) -> None:
    data = {key: value for key, value in {**GOOD, **change}.items() if value is not None}
    # JSON is YAML.
    (folder / "many.yaml").write_text(json.dumps(data).replace("NaN", ".nan"))
    with pytest.raises(SceneError) as raised:
        load_sweep("many.yaml")
    (line,) = raised.value.lines
    assert line.startswith("many.yaml:1:")
    assert line.endswith(f": {message}")


def test_all_faults_are_told_at_once_in_their_order(folder: Path) -> None:
    (folder / "many.yaml").write_text(
        "scene: small.yaml\nseed: -1\nvary:\n  damping: {uniform: [2, 1]}\n"
        "  image: {choice: [c.png, speckle.png, d.png]}\n  spring.shear: {grid: [1]}\n"
    )
    with pytest.raises(SceneError) as raised:
        load_sweep("many.yaml")
    assert [line.split(": ")[0] for line in raised.value.lines] == [
        f"many.yaml:{at}" for at in ("2:1", "4:13", "5:20", "5:40", "6:3")
    ]


def test_a_scene_and_a_sweep_are_told_apart(folder: Path) -> None:
    with pytest.raises(SceneError, match=r"^small.yaml:1:1: a scene; use `taichi-msm run`, or name it by `scene:` in"):
        load_sweep("small.yaml")
    (folder / "many.yaml").write_text(json.dumps(GOOD))
    with pytest.raises(SceneError, match=r"^many.yaml:1:1: a sweep; use `taichi-msm sweep`$"):
        load_plan("many.yaml")


def test_a_fault_of_the_scene_is_told_before_anything_runs(folder: Path) -> None:
    (folder / "small.yaml").write_text((folder / "small.yaml").read_text() + "dampign: 1\n")
    (folder / "many.yaml").write_text(json.dumps(GOOD))
    with pytest.raises(SceneError, match=r"^many.yaml:1:\d+: scene: dampign: unknown key; did you mean 'damping'\?$"):
        load_sweep("many.yaml")


def test_folders_may_be_links(folder: Path) -> None:
    (folder / "real" / "scenes").mkdir(parents=True)
    (folder / "pictures").mkdir()
    (folder / "textures" / "a.png").rename(folder / "pictures" / "a.png")
    for name in ("small.yaml", "speckle.png"):
        (folder / name).rename(folder / "real" / "scenes" / name)
    (folder / "link").symlink_to(folder / "real" / "scenes")
    (folder / "many.yaml").write_text(
        json.dumps({**GOOD, "scene": "link/small.yaml", "set": {"image": "pictures/a.png"}})
    )
    sweep = load_sweep("many.yaml")
    (override, _) = sweep.overrides([0.01])
    # Beside the link there is no such folder.
    assert (sweep.scene.folder / override.removeprefix("image=")).samefile("pictures/a.png")
    (folder / "far").mkdir()
    (folder / "far" / "sweeps").symlink_to(folder / "real" / "scenes")
    (folder / "real" / "scenes" / "here.yaml").write_text(json.dumps({**GOOD, "scene": "../scenes/small.yaml"}))
    assert load_sweep("far/sweeps/here.yaml").keys == ["damping"]
