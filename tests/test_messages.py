"""Completeness of the golden file of messages, and the messages that no other test provokes."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from taichi_msm.errors import ArgumentError, SceneError
from taichi_msm.fitting.fit import fit
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs.player import Player
from taichi_msm.runs.run import resume, run
from taichi_msm.runs.simulation import Simulation
from taichi_msm.sweeps.spec import load_sweep
from taichi_msm.sweeps.sweep import sweep
from tests.golden import Messages, read
from tests.scenes import scene

EYE = "eye: [0, 0, 1]"

OVERRIDES = {
    "fisheye coefficient": f"render.camera={{{EYE}, distortion: {{model: fisheye, p1: 0.1}}}}",
    "lens without a required coefficient": f"render.camera={{{EYE}, distortion: {{model: omnidir, k1: 0.1}}}}",
    "focal length missing": f"render.camera={{{EYE}, intrinsics: {{fx: 500, cx: 20, cy: 15}}}}",
    "principal point missing": f"render.camera={{{EYE}, distortion: {{model: scaramuzza, a0: 500}}}}",
    "two focal lengths": (
        f"render.camera={{{EYE}, intrinsics: {{fx: 500, cx: 20, cy: 15}}, distortion: {{model: scaramuzza, a0: 501}}}}"
    ),
    "outside without distortion": f"render.camera={{{EYE}, outside: background}}",
    "beside without cameras": "render.camera={beside: left, baseline: 0.01}",
    "no cameras": "render.cameras={}",
    "name of a preset": f"render.cameras={{top: {{{EYE}}}}}",
    "step and tolerance": "time={duration: 0.4, step: 1.0e-3, tolerance: 0.01}",
    "neither springs nor tissue": "springs=",
    "tolerance of springs": "sheet.tolerance=0.01",
    "stereo pair without a baseline": f"render.cameras={{left: {{{EYE}}}, right: {{beside: left}}}}",
    "rotation": f"render.cameras={{left: {{{EYE}}}, right: {{beside: left, rotation: 3}}}}",
    "camera out of reach": "render.camera={pose: {rotation: [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "
    "translation: [1.0e+20, 0, 1]}, intrinsics: {fx: 1.0e+20, fy: 1.0e+20, cx: 20, cy: 15}}",
}


@pytest.mark.parametrize("name", OVERRIDES)
def test_inconsistent_keys(name: str, small: Path, message: Messages) -> None:
    with message.raises(SceneError):
        load_scene("small.yaml", [OVERRIDES[name]])


def test_scene_with_two_keys_in_a_line(small: Path, message: Messages) -> None:
    Path("small.yaml").write_text(f"{Path('small.yaml').read_text()}damping: 0.02 output: [png]\n")
    with message.raises(SceneError):
        load_scene("small.yaml")


def test_stereo_calibration_without_the_pose(small: Path, message: Messages) -> None:
    Path("pair.yaml").write_text("".join(f"K{n}: [60, 0, 20, 0, 60, 15, 0, 0, 1]\nD{n}: [0, 0, 0, 0]\n" for n in "12"))
    right = "{calibration: pair.yaml, calibration_eye: right, beside: left}"
    with message.raises(SceneError, "write R"):
        load_scene("small.yaml", [f"render.cameras={{left: {{{EYE}, calibration: pair.yaml}}, right: {right}}}"])


CALIBRATIONS = {
    "unknown keys": "width: 640\nmatrix: [1, 2]\n",
    "no text": "\xff",
    "no keys": "x" * (2 << 20),
    "no size to scale by": "camera_matrix: [[500, 0, 20], [0, 500, 15], [0, 0, 1]]\ndist_coeffs: [0, 0, 0, 0]\n",
}


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_unusable_calibration_files(name: str, small: Path, message: Messages) -> None:
    Path("c.yaml").write_bytes(CALIBRATIONS[name].encode("latin-1"))
    with message.raises(SceneError, "render.camera.calibration"):
        load_scene("small.yaml", ["render.camera={calibration: c.yaml, scale: true, eye: [0, 0, 1]}"])


@pytest.mark.parametrize("key", ["springs.shear: '=sqrt(1, 2)'", "damping=1: 0.01"], ids=["arguments", "path"])
def test_invalid_keys_of_sweeps(key: str, small: Path, message: Messages) -> None:
    vary = "damping: {uniform: [0.01, 0.02]}"
    Path("sweep.yaml").write_text(f"{{scene: small.yaml, samples: 1, vary: {{{vary}}}, set: {{{key}}}}}")
    with message.raises(SceneError):
        load_sweep("sweep.yaml")


@pytest.mark.parametrize("text", ["", "3"], ids=["no keys", "a number"])
def test_files_without_a_sweep(text: str, small: Path, message: Messages) -> None:
    Path("sweep.yaml").write_text(text)
    with message.raises(SceneError, "sweep.yaml"):
        load_sweep("sweep.yaml")


def test_player_without_frames(message: Messages) -> None:
    with message.raises(ArgumentError, "frames"):
        Player([], 25)


@pytest.mark.parametrize(
    ("free", "options"),
    [
        (["tissue.young"], {"bounds": {"tissue.young": (2.0, 1.0)}}),
        (["probes.0.total"], {}),
        (["tissue.young"], {"drift": 0.0}),
        (["tissue.young"], {"correlation": 3.0}),
    ],
    ids=["bounds", "a list", "seconds", "correlation of positions"],
)
def test_invalid_options_of_fits(free: list[str], options: dict[str, object], message: Messages) -> None:
    tissue = {"young": 1e3, "thickness": 0.01, "density": 1000}
    made = scene(springs=None, damping=0, tissue=tissue, sheet={"points": [4, 5], "size": [0.3, 0.4]},
                 probes=[{"total": [0, 0, 1]}])  # fmt: skip
    observed = {"time": np.arange(11) / 25, "position": np.zeros((11, 4, 5, 3))}
    with message.raises((ArgumentError, SceneError)):
        fit(made, observed, free, workers=1, **options)  # type: ignore[arg-type]


CALLS: dict[str, Callable[[], object]] = {
    "estimate_error": lambda: run("small.yaml", "out", estimate_error="no"),  # type: ignore[arg-type]
    "overrides": lambda: run(scene(), "out", overrides="a=1"),
    "started": lambda: run(scene(), "out", started="now"),  # type: ignore[arg-type]
    "progress": lambda: resume("out", progress=3),  # type: ignore[arg-type]
    "cores": lambda: Simulation(scene(), cores="two"),  # type: ignore[arg-type]
    "executor": lambda: sweep("small.yaml", {}, "out", executor=3),  # type: ignore[arg-type]
    "keys of a scene": lambda: Simulation({1: 2}),  # type: ignore[dict-item]
    "number of 5001 digits": lambda: Simulation({**scene().model_dump(), "damping": 10**5000}),
}


@pytest.mark.parametrize("name", CALLS)
def test_arguments_of_wrong_types(name: str, small: Path, message: Messages) -> None:
    with message.raises((ArgumentError, SceneError), name.split()[0] if "of" not in name else ""):
        CALLS[name]()


# Modules whose texts are help, labels of plots and contents of files, and calls and names with such texts.
WITHOUT_MESSAGES = {
    "__init__.py",
    "cli/console.py",
    "exports/formats.py",
    "exports/obj.py",
    "fitting/panels.py",
    "fitting/plots.py",
    "palpation/plots.py",
    "study/plot.py",
    "view/events.py",
}
CALLS_WITHOUT_MESSAGES = re.compile(
    r"(re|textwrap)\.\w+|key|((click|options)\.)?\w*(option|argument|Option)|CalibrationReader|TrajectoryReader|Coefficient"
    r"|LawKey|Integrator|Continuous"
)


def prose_of(file: Path) -> set[str]:
    """Texts of four words or more in a module, without docstrings and help."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    ignored: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            ignored.add(id(node.value))
        elif isinstance(node, ast.Compare) or (
            isinstance(node, ast.Call) and CALLS_WITHOUT_MESSAGES.fullmatch(ast.unparse(node.func))
        ):
            ignored |= {id(inner) for inner in ast.walk(node)}
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).lower().endswith(("meaning", "names")):
            ignored.add(id(node.value))
    texts = {
        part
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in ignored
        for part in re.split(r"\{\w+\}", re.sub(r"\s+", " ", node.value))
    }
    words = re.compile(r"\b[a-z]{2,}\b")
    return {
        text
        for text in map(str.strip, texts)
        if text.count(" ") > 2 and len(words.findall(text)) > 2 and not re.search("import|script", text)
    }


def test_every_message_is_provoked(root: Path) -> None:
    texts = [text for tests in read().values() for messages in tests.values() for text in messages]
    golden = re.sub(r"\s+", " ", "\n".join(texts))
    package = root / "taichi_msm"
    missing = {
        text: str(file.relative_to(package))
        for file in package.rglob("*.py")
        if str(file.relative_to(package)) not in WITHOUT_MESSAGES
        for text in prose_of(file)
        if text not in golden
    }
    assert not missing


def test_every_entry_has_its_test(root: Path) -> None:
    for file, entries in read().items():
        tree = ast.parse((root / "tests" / file).read_text(encoding="utf-8"))
        names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}
        assert {test.partition("[")[0] for test in entries} <= names, file
