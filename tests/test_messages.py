"""Completeness of the golden file of messages, and the messages that no other test provokes."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from taichi_msm.errors import ArgumentError, SceneError
from taichi_msm.fitting.fit import fit
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs.simulation import Player
from taichi_msm.sweeps.spec import load_sweep
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
}


@pytest.mark.parametrize("name", OVERRIDES)
def test_inconsistent_keys(name: str, small: Path, message: Messages) -> None:
    with message.raises(SceneError):
        load_scene("small.yaml", [OVERRIDES[name]])


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


# Messages of processes killed at a certain moment, of foreign machines and of defects, by their longest fixed part.
NOT_PROVOKED = {
    ", or smaller --bounds",
    "; install the same packages there",
    "; use these, or choose another --out",
    "=LOW,HIGH, factors of young",
    ": missing; put the picture back, the scene needs a copy of it",
    ": no run close to its value succeeds;",
    ": take a number above 0, the standard deviation in newtons",
    ": time: contains NaN or infinity; give all T times in seconds",
    "MB unpacked; save the sheet as CSV",
    "a hard-linked file",
    "a run of the fit ended early:",
    "another command for the same folder has ended meanwhile",
    "interrupted while the sheet was restarted; restart the scene",
    "is neither true nor false",
    "is not numeric; expected",
    "is not a writable directory",
    "lost the scheduler at",
    "no record of itself",
    "pieces), so pictures and labels would be wrong; take --arch cpu",
    "sheet.points: too few to take half of them",
    "the pool was shut down",
    "the scheduler does not answer",
    "the values are out of range",
}


def longest_part(node: ast.AST) -> str:
    parts = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    pieces = [piece for part in parts for piece in re.split(r"\{\w+\}", part)]
    return re.sub(r"\s+", " ", max(pieces, key=len, default="")).strip()


def messages_of(file: Path) -> set[str]:
    """The longest fixed part of every message that a file raises or reports, if it has two words."""
    parts: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        arguments: list[ast.expr] = []
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            arguments = node.exc.args
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("Problem", "scene_fault"):
            arguments = node.args
        parts |= {part for part in map(longest_part, arguments) if len(part) > 13 and " " in part}
    return parts


def test_every_message_is_provoked(root: Path) -> None:
    texts = [text for tests in read().values() for messages in tests.values() for text in messages]
    golden = re.sub(r"\s+", " ", "\n".join(texts))
    missing = {
        part: file.name
        for file in (root / "taichi_msm").rglob("*.py")
        for part in messages_of(file)
        if part not in golden and part not in NOT_PROVOKED
    }
    assert not missing
