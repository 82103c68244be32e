"""Sweep files: values of the runs, and faults."""

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
from scipy.stats import qmc, triang

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_plan, names_file, parse_override, plan_file
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PATH
from taichi_msm.sweeps.distribution import CONTINUOUS, Continuous, Distribution
from taichi_msm.sweeps.expressions import ExpressionError, evaluate
from taichi_msm.sweeps.spec import Sweep, SweepSettings, format_override, load_sweep, make_sweep
from tests.golden import Messages
from tests.scenes import speckle
from tests.sweeps.conftest import CALIBRATION, POSES


def sobol_points(dimensions: int, samples: int, seed: int) -> Any:
    """Points of SciPy's scrambled Sobol sequence, without its warning about other numbers than powers of two."""
    return qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed)).random(
        2 ** math.ceil(math.log2(samples))
    )


def values(samples: int | None, **vary: dict[str, Any]) -> list[list[Any]]:
    return sweep_of(samples, **vary).values()


def sweep_of(samples: int | None, **vary: dict[str, Any]) -> Sweep:
    scene: Any = None
    return Sweep(scene, SweepSettings(scene="any.yaml", samples=samples, seed=3, vary=vary))


def test_dimensions_in_the_order_of_the_keys() -> None:
    rows = values(
        5,
        a={"uniform": [2, 3]},
        b={"log_uniform": [[1, 10], [100, 10]]},
        c={"choice": ["x", "y", "z"]},
        d={"normal": [1, 0.5]},
    )
    assert len(rows) == 5
    for row, u in zip(rows, sobol_points(5, 5, 3)[:5], strict=True):
        # Rounding of a few operations.
        assert row[0] == pytest.approx(2 + u[0], rel=1e-15)
        assert row[1] == pytest.approx([100 ** u[1], 10.0], rel=1e-14)
        assert row[2] == "xyz"[int(3 * u[3])]
        assert row[3] == pytest.approx(1 + 0.5 * ndtri(u[4]), rel=1e-14)


def test_distribution_of_three_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """SciPy's triangular distribution: a quarter of the samples are below the mode of [0, 1, 4]."""

    def quantile(fraction: float, low: float, mode: float, high: float) -> float:
        return float(triang((mode - low) / (high - low), low, high - low).ppf(fraction))

    row = Continuous("triangular", ("low", "mode", "high"), quantile, lambda low, mode, high: "" if mode else "mode 0")
    monkeypatch.setitem(CONTINUOUS, "normal", row)
    distribution = Distribution(normal=[[0, 1], [1, 5], [4, 9]])
    assert distribution.dimensions == 2
    assert distribution.value([0.25, 0.5]) == pytest.approx([1, 5], rel=1e-14)
    for parameters in ([0, 4], [0, 1, [4]], [0, 0, 4]):
        with pytest.raises(SceneError):
            Distribution(normal=parameters)


def test_more_samples_extend_the_sequence() -> None:
    vary = {"a": {"uniform": [0, 1]}, "b": {"normal": [0, 1]}}
    assert values(1000, **vary)[:3] == values(3, **vary)
    assert values(1, **vary) == values(3, **vary)[:1]
    assert math.isfinite(Distribution(normal=[0, 1]).value([0.0]))


def test_lists_keep_their_shape() -> None:
    (((first, (time, force)),),) = values(1, load={"uniform": [[[0, 0], [0.2, 100]], [[0, 0], [0.4, 100]]]})
    assert (first, force) == ([0, 0], 100)
    assert 0.2 <= time <= 0.4


def test_grids_give_every_combination() -> None:
    assert values(None, a={"grid": [1, 2]}, b={"grid": ["x", [3, 4]]}) == [[1, "x"], [1, [3, 4]], [2, "x"], [2, [3, 4]]]
    ten = {"grid": list(range(10))}
    grids = sweep_of(None, a=ten, b={"grid": list(range(1000))})
    assert grids.values()[1234] == [1, 234]
    assert grids.values(4) == [[1, 250], [3, 750], [6, 250], [8, 750]], "evenly spaced runs"
    assert sweep_of(None, a=ten).values(100) == [[n] for n in range(10)]


def test_keys_of_a_group_vary_row_by_row(folder: Path) -> None:
    """A group is one dimension of the grids, and its rows are the values at one index of its lists."""
    young, thickness, damping = [1e4, 2e4], [1e-3, 2e-3], {"grid": [0.01, 0.02]}
    together: list[dict[str, Any]] = [
        {"a.young": young, "a.thickness": thickness},
        {"image": ["textures/b.png", "textures/a.png", 3]},
    ]
    rows = SweepSettings(scene="any.yaml", vary={"damping": damping}, together=together)
    expected = [
        [number, *row, image]
        for number in damping["grid"]
        for row in zip(young, thickness, strict=True)
        for image in together[1]["image"]
    ]
    sweep = Sweep(None, rows)  # type: ignore[arg-type]
    assert sweep.values() == expected
    assert sweep.keys == ["damping", "a.young", "a.thickness", "image"]
    assert sweep.overrides(expected[0])[1:3] == ("a.young=10000.0", "a.thickness=0.001")
    text = "scene: small.yaml\ntogether: [{image: [textures/a.png, speckle.png], damping: [0.02, 0.01]}]\n"
    Path("rows.yaml").write_text(text)
    loaded = load_sweep("rows.yaml")
    assert loaded.values() == [["textures/a.png", 0.02], ["speckle.png", 0.01]]
    assert {Path(name).name for name in loaded.files} == {"a.png", "speckle.png"}
    assert loaded.description()["together"] == loaded.settings.together


CELLS: list[Any] = [
    *(0.1, 1e-7, 1 / 3, 5, -2.5e300, True, None, [0.1, [2, "x"]], {"a": [1]}),
    *("none", "a b, c", "1e3", "true", "#a", "ü", ""),
]


@pytest.mark.parametrize("value", CELLS)
def test_cells_are_arguments_of_set(value: Any) -> None:
    assert parse_override(f"key={format_override(value)}").value == value


@pytest.fixture
def folder(small: Path) -> Path:
    """`small` with a folder of pictures, and a scene below another folder."""
    (small / "textures").mkdir()
    for name in ("b", "a"):
        Image.fromarray(speckle(30, 40, ord(name))).save(small / "textures" / f"{name}.png")
    (small / "textures" / "notes.txt").write_text("not a picture")
    return small


def test_paths_of_files(folder: Path) -> None:
    for below in ("scenes", "lab"):
        (folder / below).mkdir()
    for name in ("small.yaml", "speckle.png"):
        (folder / name).rename(folder / "scenes" / name)
    for name, text in (("a.yml", CALIBRATION), ("b.yml", CALIBRATION), ("t.txt", POSES)):
        (folder / "lab" / name).write_text(text)
    (folder / "many.yaml").write_text(
        "scene: scenes/small.yaml\nsamples: 4\nvary:\n"
        '  image: {choice: "textures/*.png"}\n'
        '  render.cameras.left.calibration: {choice: "lab/*.yml"}\n'
        "  render.cameras.7: {choice: [{poses: lab/t.txt}]}\n"
        "set:\n  springs.map: {image: textures/a.png, range: [1, 2]}\n"
        "  render.cameras: {left: {calibration: lab/a.yml, poses: lab/t.txt}}\n"
    )
    sweep = load_sweep("many.yaml")
    assert [distribution.values for distribution in sweep.settings.vary.values()] == [
        ["../textures/a.png", "../textures/b.png"],
        ["../lab/a.yml", "../lab/b.yml"],
        [{"poses": "../lab/t.txt"}],
    ]
    overrides = sweep.overrides(["../textures/b.png", "../lab/b.yml", {"poses": "../lab/t.txt"}])
    assert overrides == (
        'springs.map={"image": "../textures/a.png", "range": [1, 2]}',
        'render.cameras={"left": {"calibration": "../lab/a.yml", "poses": "../lab/t.txt"}}',
        "image=../textures/b.png",
        "render.cameras.left.calibration=../lab/b.yml",
        'render.cameras.7={"poses": "../lab/t.txt"}',
    )
    assert {os.path.relpath(path) for path in sweep.files} == {
        *("textures/a.png", "textures/b.png", "lab/a.yml", "lab/b.yml", "lab/t.txt", "scenes/speckle.png"),
    }
    plan = load_plan("scenes/small.yaml", overrides)
    assert plan.scene.pictures == {
        "image": "scenes/../textures/b.png",
        "springs.map.image": "scenes/../textures/a.png",
    }
    poses = hashlib.sha256(POSES.encode()).hexdigest()
    assert plan.sha256 == {
        "render.cameras.left.calibration": hashlib.sha256(CALIBRATION.encode()).hexdigest(),
        "render.cameras.left.poses": poses,
        "render.cameras.7.poses": poses,
    }


def test_both_files_of_a_trajectory(folder: Path) -> None:
    """Workers of a cluster get the rotations of SimCol3D with the positions that the sweep names."""
    for name in ("SavedPosition_S1.txt", "SavedRotationQuaternion_S1.txt"):
        (folder / name).write_text("0 0 1\n")
    (folder / "poses.yaml").write_text(
        "scene: small.yaml\nsamples: 1\nvary: {render.camera.poses: {choice: [SavedPosition_S1.txt]}}\n"
    )
    assert {Path(path).name for path in load_sweep("poses.yaml").files} >= {
        "SavedPosition_S1.txt",
        "SavedRotationQuaternion_S1.txt",
    }


def test_keys_that_name_files() -> None:
    schema = Scene.model_json_schema()
    keys = set()

    def walk(part: dict[str, Any], key: tuple[str, ...]) -> None:
        if part.get("maxLength") == MAX_PATH:
            keys.add(key)
        for name, inner in part.get("properties", {}).items():
            walk(inner, (*key, name))
        for inner in (part.get("additionalProperties"), part.get("items")):
            if isinstance(inner, dict):
                walk(inner, (*key, "any"))
        for inner in part.get("anyOf", []):
            walk(inner, key)
        if "$ref" in part:
            walk(schema["$defs"][part["$ref"].rpartition("/")[2]], key)

    walk(schema, ())
    assert len(keys) == 13
    assert all(map(names_file, keys))


def test_variables_and_their_columns(folder: Path) -> None:
    varied = {"damping": {"uniform": [0.01, 0.02]}}
    expressions = {"probes.0.at": ["=x", "=1 - x"], "time.duration": "=n / 10", "sheet.points": ["=2*n**2 + 1", 9]}
    variables = {"x": {"uniform": [0, 1]}, "n": {"choice": [2, 3]}}
    swept = make_sweep("small.yaml", {"samples": 4, "variables": variables, "vary": varied, "set": expressions})
    assert swept.keys == ["x", "n", "damping"]
    for row, u in zip(swept.values(), sobol_points(3, 4, 1), strict=True):
        assert row == pytest.approx([u[0], 2 + int(2 * u[1]), 0.01 + 0.01 * u[2]], rel=1e-15)
        x, n, damping = row
        assert swept.overrides(row) == (
            f"probes.0.at=[{x!r}, {1 - x!r}]",
            f"time.duration={n / 10!r}",
            f"sheet.points=[{2 * n * n + 1}, 9]",
            f"damping={damping!r}",
        )
    assert swept.description()["variables"] == variables
    alone = make_sweep("small.yaml", {"variables": {"n": {"grid": [2, 3]}}, "set": {"time.duration": "=n / 10"}})
    assert [alone.overrides(row) for row in alone.values()] == [("time.duration=0.2",), ("time.duration=0.3",)]
    # Sweeps without variables keep the description that is in their sweep.json.
    assert "variables" not in make_sweep("small.yaml", {"samples": 4, "vary": varied}).description()


@pytest.mark.parametrize("key", ["scene", "image", "render.camera.calibration", "sheet.surface"])
def test_paths_of_windows(key: str, folder: Path, message: Messages) -> None:
    path: Any = {"height": {"file": "textures\\a.npy", "unit": "m"}} if key == "sheet.surface" else "textures\\a.png"
    with message.raises(SceneError, "write /"):
        if key == "scene":
            load_plan(path)
        else:
            load_plan("small.yaml", [f"{key}={json.dumps(path)}"])
    if key != "scene":
        with message.raises(SceneError, key, "write /"):
            make_sweep("small.yaml", {"vary": {key: {"grid": [path]}}})


def test_patterns_of_files_in_a_group(folder: Path) -> None:
    group = {"image": "textures/*.png", "damping": [0.02, 0.01]}
    swept = make_sweep("small.yaml", {"together": [group]})
    assert swept.values() == [["textures/a.png", 0.02], ["textures/b.png", 0.01]]


@pytest.mark.parametrize(
    "text", ["=log(x - 1)", "=1 / (x - x)", "=exp(800 * x)", "=floor(x, 2)", "=x**-0.5 + sqrt(-x)"]
)
def test_expressions_without_a_value(text: str, message: Messages) -> None:
    with message.raises(ExpressionError, text):
        evaluate(text, {"x": 1.0})


def test_expression_without_a_value_refuses_its_run(folder: Path, message: Messages) -> None:
    settings = {"variables": {"x": {"grid": [0, 1]}}, "set": {"probes.0.at": [0.5, "=sqrt(x - 1)"]}}
    swept = make_sweep("small.yaml", settings)
    refused, valid = swept.values()
    with message.raises(SceneError, "probes.0.at", "sqrt(x - 1)"):
        swept.overrides(refused)
    assert plan_file(swept.scene, swept.overrides(valid)).scene.probes[0].at == (0.5, 0.0)


EXPRESSIONS = {
    "=2**10 - 0x18": 1000,
    "=-x**2 + max(x, 1, 2) * 3": 5.75,
    "=min(x, cos(pi)) / (1 + 1)": -0.5,
    "= sin(+x) / sqrt(4)": math.sin(0.5) / 2,
    "=" + "-" * 198 + "1": 1,
    "=exp(log(abs(-x)))": 0.5,
    "=floor(-x) + floor(7)": 6,
}


@pytest.mark.parametrize("text", EXPRESSIONS)
def test_expressions(text: str) -> None:
    value = evaluate(text, {"x": 0.5})
    assert (value, type(value)) == (EXPRESSIONS[text], type(EXPRESSIONS[text]))
    evaluate(text, {"x": math.nan})  # the check of a file, before the values are known


GOOD = {"scene": "small.yaml", "samples": 2, "vary": {"damping": {"uniform": [0.01, 0.02]}}}


def vary(distribution: Any, key: str = "damping") -> dict[str, Any]:
    return {"vary": {key: distribution}}


def expression(text: str, **variables: Any) -> dict[str, Any]:
    return {"variables": variables, "set": {"probes.0.force": [0, text, 1]}}


# Changes of GOOD by their ids, and the key of the fault.
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"sampels": 3}, "sampels"),
    "no scene": ({"scene": "none.yaml"}, "scene"),
    "samples missing": ({"samples": None}, "samples"),
    "nothing varies": ({"vary": {}}, "vary"),
    "samples of a grid": (vary({"grid": [1]}), "samples"),
    "high below low": (vary({"uniform": [3, 2]}), "vary.damping.uniform"),
    "logarithm": (vary({"log_uniform": [0, 2]}), "vary.damping.log_uniform"),
    "deviation": (vary({"normal": [0, -2]}), "vary.damping.normal"),
    "shapes": (vary({"uniform": [[1, 2], [3]]}), "vary.damping.uniform"),
    "no choice": (vary({"choice": []}), "vary.damping.choice"),
    "unknown distribution": (vary({"unifrom": [1, 2]}), "vary.damping.unifrom"),
    "two distributions": (vary({"uniform": [1, 2], "choice": [1]}), "vary.damping"),
    "no distribution": (vary([0.01, 0.02]), "vary.damping"),
    "not finite": (vary({"choice": [math.nan]}), "vary.damping.choice"),
    "too large": (vary({"uniform": [0, 1e31]}), "vary.damping.uniform"),
    "dimensions": (vary({"uniform": [[0] * 21202, [1] * 21202]}), "vary"),
    "unknown key varies": (vary({"uniform": [1, 2]}, "dampign"), "vary.dampign"),
    "a section varies": (vary({"shear": {"uniform": [1, 2]}}, "springs"), "vary.springs"),
    "no picture": (vary({"choice": ["textures/c.png"]}, "image"), "vary.image.choice.0"),
    "no match": (vary({"choice": "textures/*.jpg"}, "image"), "vary.image.choice"),
    "picture outside": (vary({"choice": ["/etc/hostname"]}, "image"), "vary.image.choice.0"),
    "poses outside": (
        vary({"choice": ["../a.txt", [[0, 0, 0, 0, 0, 0, 0, 1]]]}, "render.cameras.left.poses"),
        "vary.render.cameras.left.poses.choice.0",
    ),
    "unknown key set": ({"set": {"sheet.pionts": [3, 3]}}, "set.sheet.pionts"),
    "replaced": ({"set": {"damping": 1}}, "vary"),
    "section replaced": ({"set": {"springs.shear": 3}, **vary({"choice": [{"shear": 1}]}, "springs")}, "vary"),
    "a variable of texts": ({"variables": {"x": {"choice": ["a"]}}}, "variables.x.choice"),
    "a column": ({"variables": {"seconds": {"uniform": [0, 1]}}}, "variables.seconds"),
    "not a name": ({"variables": {"x y": {"uniform": [0, 1]}}}, "variables.x y"),
    "a varied key": ({"variables": {"damping": {"uniform": [0, 1]}}}, "variables.damping"),
    "a function": ({"variables": {"max": {"uniform": [0, 1]}}}, "variables.max"),
    "unknown variable": (expression("=radius + 1", radios={"uniform": [0, 1]}), "set.probes.0.force.1"),
    "no variables": (expression("=radius + 1"), "set.probes.0.force.1"),
    "too large a power": (expression("=x * 9**9**9", x={"uniform": [0, 1]}), "set.probes.0.force.1"),
    "not allowed": (expression("=__import__('os').getpid()"), "set.probes.0.force.1"),
    "no expression": (expression("=2 x"), "set.probes.0.force.1"),
    "a long expression": (expression("=" + "-" * 200), "set.probes.0.force.1"),
    "lengths": (
        {"samples": None, "vary": None, "together": [{"damping": [0.1, 0.2], "springs.shear": [1, 2, 3]}]},
        "together.0.springs.shear",
    ),
    "no keys together": ({"together": [{}]}, "together.0"),
    "not a group": ({"together": [[1]]}, "together.0"),
    "samples of a group": ({"together": [{"springs.shear": [1]}]}, "samples"),
    "unknown key together": ({"samples": None, "vary": None, "together": [{"dampign": [1]}]}, "together.0.dampign"),
    "twice in groups": (
        {"samples": None, "vary": None, "together": [{"damping": [1]}, {"springs.shear": [1], "damping": [2]}]},
        "together.1",
    ),
    "a grouped key": (
        {"samples": None, "vary": None, "variables": {"damping": {"grid": [1]}}, "together": [{"damping": [1]}]},
        "variables.damping",
    ),
    "no values together": ({"together": [{"damping": 3}]}, "together.0.damping"),
    "not finite together": (
        {"samples": None, "vary": None, "together": [{"damping": [math.nan]}]},
        "together.0.damping",
    ),
    "no picture together": (
        {"samples": None, "vary": None, "together": [{"image": ["textures/c.png"]}]},
        "together.0.image.0",
    ),
    "twice": ({"samples": None, **vary({"grid": [1]}), "together": [{"damping": [1]}]}, "together.0"),
    "no calibration": ({"set": {"render.camera.calibration": "a.yml"}}, "set.render.camera.calibration"),
    "combinations": (
        {"samples": None, "vary": {key: {"grid": list(range(4000))} for key in ("damping", "springs.shear")}},
        "vary",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_names_its_key(folder: Path, name: str, message: Messages) -> None:
    change, key = FAULTS[name]
    data = {key: value for key, value in {**GOOD, **change}.items() if value is not None}
    (folder / "many.yaml").write_text(json.dumps(data).replace("NaN", ".nan"))
    with message.raises(SceneError, "many.yaml:1:", f": {key}: ") as raised:
        load_sweep("many.yaml")
    assert "\n" not in str(raised.value)


def test_all_faults_are_reported_in_order(folder: Path) -> None:
    (folder / "many.yaml").write_text(
        "scene: small.yaml\nseed: -1\nvary:\n  damping: {uniform: [2, 1]}\n"
        "  image: {choice: [c.png, speckle.png, d.png]}\n  spring.shear: {grid: [1]}\n"
    )
    with pytest.raises(SceneError) as raised:
        load_sweep("many.yaml")
    assert [line.split(": ")[0] for line in raised.value.lines] == [
        f"many.yaml:{at}" for at in ("2:1", "4:13", "5:20", "5:40", "6:3")
    ]


def test_files_of_the_wrong_kind(folder: Path, message: Messages) -> None:
    with message.raises(SceneError, "small.yaml:1:1", "taichi-msm run"):
        load_sweep("small.yaml")
    (folder / "many.yaml").write_text(json.dumps(GOOD))
    with message.raises(SceneError, "many.yaml:1:1", "taichi-msm sweep"):
        load_plan("many.yaml")
    (folder / "small.yaml").write_text((folder / "small.yaml").read_text() + "dampign: 1\n")
    with message.raises(SceneError, "many.yaml:1:", "dampign"):
        load_sweep("many.yaml")
