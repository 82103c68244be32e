"""A scene is resolved once, into a plan that all other parts use."""

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

MAP = "tissue.map={image: textures/tumour.png, range: [1, 13]}"

RESOLVING = [
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
    """Number of calls of each of these functions, in every module that imports it."""
    counted: Counter[str] = Counter()

    def count(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        counted[name] += 1
        return function(*arguments)

    for module, name in RESOLVING:
        function: Callable[..., Any] = getattr(module, name)
        for importer in [each for key, each in sys.modules.items() if key.startswith(taichi_msm.__name__)]:
            if getattr(importer, name, None) is function:
                monkeypatch.setattr(importer, name, partial(count, name, function))
    return counted


def test_scene_is_resolved_once(root: Path, tmp_path: Path, calls: Counter[str]) -> None:
    made = [str(root / "scenes/press.yaml"), "--set", MAP]
    short = [*made, "--set", "time.duration=0.08", "--set", "output=[]", "--quiet", "--out"]
    for command in (["check", *made], ["run", *short, str(tmp_path / "plain"), "--no-estimate"]):
        assert main(command) == 0
        assert calls == dict.fromkeys((name for _, name in RESOLVING), 1)
        calls.clear()
    # With a mesh estimate: the run, the two companion runs, and the finer mesh of the remedy.
    assert main(["run", *short, str(tmp_path / "estimated"), "--estimate-error"]) == 0
    assert {calls[name] for name in ("derive_material", "fixed_points", "map_factors", "stable_step")} == {4}
    assert calls["read_map"] == 1


def test_variant_of_a_plan_without_its_map(root: Path) -> None:
    mapped = make_plan(load_scene(root / "scenes/press.yaml", [MAP]))
    assert mapped.scene.tissue is not None
    tissue = mapped.scene.tissue.model_copy(update={"map": None})
    plain = plan_variant(mapped, mapped.scene.model_copy(update={"tissue": tissue}))
    assert plain.material.factors is None
