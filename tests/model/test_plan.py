"""A scene is resolved once, into a plan that everything after takes."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import taichi_msm
import taichi_msm.runs.run
from taichi_msm import load_scene, terms
from taichi_msm.cli.main import main
from taichi_msm.model import plan, sheet
from taichi_msm.solver import planning
from taichi_msm.solver.planning import make_plan, plan_variant

# Gives a scene a map.
MAP = "tissue.map={image: textures/tumour.png, range: [1, 13]}"

DERIVED = [
    (terms, "derive_material"),
    (terms, "highest_frequency"),
    (plan, "probe_slots"),
    (sheet, "fixed_points"),
    (sheet, "read_map"),
    (sheet, "map_factors"),
    (planning, "stable_step"),
    (planning, "steps_per_frame"),
]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How many times each of these functions is called, wherever it was imported."""
    counted: Counter[str] = Counter()

    def count(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        counted[name] += 1
        return function(*arguments)

    for module, name in DERIVED:
        function: Callable[..., Any] = getattr(module, name)
        for other in [one for key, one in sys.modules.items() if key.startswith(taichi_msm.__name__)]:
            if getattr(other, name, None) is function:
                monkeypatch.setattr(other, name, partial(count, name, function))
    return counted


def test_a_run_and_a_check_derive_everything_once(root: Path, tmp_path: Path, calls: Counter[str]) -> None:
    short = ["--set", "time.duration=0.08", "--set", "output=[trajectory]", "--no-estimate", "--quiet"]
    scene = [str(root / "scenes/press.yaml"), "--set", MAP]
    for command in (["check", *scene], ["run", *scene, "--out", str(tmp_path / "out"), *short]):
        assert main(command) == 0
        assert calls == dict.fromkeys((name for _, name in DERIVED), 1)
        calls.clear()


def test_pilots_with_fewer_points_derive_their_own_sheets_once(root: Path, tmp_path: Path, calls: Counter[str]) -> None:
    short = ["--set", "time.duration=0.08", "--set", "output=[]", "--estimate-error", "--quiet"]
    assert main(["run", str(root / "scenes/press.yaml"), "--set", MAP, "--out", str(tmp_path / "out"), *short]) == 0
    # The run, the two companions, and the finer sheet that is advised.
    assert {calls[name] for name in ("derive_material", "fixed_points", "map_factors", "stable_step")} == {4}
    assert calls["read_map"] == 1, "the map's file"


def test_a_scene_without_the_map_of_another_one_has_none(root: Path) -> None:
    mapped = make_plan(load_scene(root / "scenes/press.yaml", [MAP]))
    assert mapped.scene.tissue is not None
    tissue = mapped.scene.tissue.model_copy(update={"map": None})
    plain = plan_variant(mapped, mapped.scene.model_copy(update={"tissue": tissue}))
    assert plain.material.factors is None
