"""The command `example`."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import yaml

from taichi_msm.cli import example
from taichi_msm.load.scene_file import load_plan
from taichi_msm.sweeps.spec import load_sweep
from tests.conftest import Program
from tests.golden import Messages


def test_shipped_scenes_and_their_pictures(root: Path, tmp_path: Path, program: Program, message: Messages) -> None:
    listed = program("example").stdout
    message(listed)
    names = [line.split()[0] for line in listed.splitlines()]
    assert sorted(names) == sorted(
        path.stem for folder in ("", "sweeps") for path in root.glob(f"scenes/{folder}/*.yaml")
    )
    for name in names:
        *files, last = program("example", name, str(tmp_path / name)).stdout.splitlines()
        assert all(Path(file).is_file() for file in files)
        command, scene = last.split()[-2:]
        assert (command, scene) == ("sweep" if name in ("stiffness", "tracking") else "run", files[0])
    assert load_sweep(tmp_path / "tracking/sweeps/tracking.yaml").files.keys() >= set(
        map(str, (tmp_path / "tracking/sweeps/textures").iterdir())
    )
    plan = load_plan(tmp_path / "tumour/tumour.yaml")
    assert Path(str(plan.scene.image)).is_relative_to(tmp_path)


def test_no_file_is_overwritten(tmp_path: Path, program: Program, message: Messages) -> None:
    directory = str(tmp_path)
    assert program("example", "press", directory).returncode == program("example", "drag", directory).returncode == 0
    again = program("example", "press", directory)
    assert again.returncode == 4
    message(again.stderr, "press.yaml")
    (tmp_path / "textures" / "mucosa.png").write_text("another picture")
    grasp = program("example", "grasp", directory)
    assert grasp.returncode == 4
    message(grasp.stderr, "mucosa.png")
    assert (tmp_path / "textures" / "mucosa.png").read_text() == "another picture"
    assert not (tmp_path / "grasp.yaml").exists()
    unknown = program("example", "pres")
    assert unknown.returncode == 2
    message(unknown.stderr, "press")


def test_schema_for_editors(tmp_path: Path, program: Program) -> None:
    """Every scene names the schema next to the written ones, which accepts it as read by YAML 1.1."""
    for name, scene in (("press", "press.yaml"), ("tracking", "sweeps/tracking-scene.yaml")):
        program("example", name, str(tmp_path))
        text = (tmp_path / scene).read_text(encoding="utf-8")
        comment, named = text.splitlines()[0].split("$schema=")
        assert comment == "# yaml-language-server: "
        schema = (tmp_path / scene).parent / named
        assert schema.resolve() == tmp_path / "scene.schema.json"
        jsonschema.validate(yaml.safe_load(text), json.loads(schema.read_text(encoding="utf-8")))
    assert schema.read_text(encoding="utf-8") == program("schema").stdout
    assert (tmp_path / "sweeps" / "tracking.yaml").read_text(encoding="utf-8").count("$schema") == 0


def test_wheel_contains_the_scenes(root: Path) -> None:
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    assert '[tool.hatch.build.targets.wheel.force-include]\n"scenes" = "taichi_msm/scenes"\n' in text
    assert example.scenes_folder() == root / "scenes"
