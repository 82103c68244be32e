"""What the README says is what the program does."""

from __future__ import annotations

import ast
import doctest
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import taichi_msm
from taichi_msm.scenefile.load import load_scene
from taichi_msm.system import resources
from taichi_msm.system.runtime import Device
from taichi_msm.viewer.script import load_script
from tests.scenes import speckle

SCENES = ["press", "figure-3", "drag", "grasp", "two-tools", "tumour"]


def blocks(root: Path, language: str) -> list[str]:
    text = (root / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.fixture(scope="module")
def examples_folder(root: Path, device: Device, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current directory, with the shipped scenes and a picture, photo.jpg; as many threads as `device` has."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "scenes").symlink_to(root / "scenes")
    Image.fromarray(speckle(90, 120)).save(folder / "photo.jpg")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(resources, "available_threads", lambda: device.threads)
        yield folder


def test_what_is_shown_is_what_is_shipped(root: Path) -> None:
    shipped = [root / "scenes" / "scripts" / "press.yaml", root / "scenes" / "press.yaml"]
    assert blocks(root, "yaml") == [path.read_text(encoding="utf-8") for path in shipped]


def test_the_tables_of_keys_are_made_from_the_program(root: Path) -> None:
    sys.path.insert(0, str(root / "docs"))
    try:
        from make_key_table import tables  # type: ignore[import-not-found,unused-ignore]
    finally:
        sys.path.pop(0)
    for table in tables().values():
        assert table in (root / "README.md").read_text(encoding="utf-8"), "run docs/make_key_table.py"


def test_the_shipped_script_is_valid(root: Path) -> None:
    assert len(load_script(root / "scenes" / "scripts" / "press.yaml", (512, 512)).events) > 3


def test_the_python_shown_runs(root: Path, tmp_path: Path) -> None:
    labels, first, second = blocks(root, "python")
    shown = "print(position.shape, picture.shape, record['status'])\n"
    (tmp_path / "scenes").symlink_to(root / "scenes")
    (tmp_path / "example.py").write_text(first + shown + second)
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, check=True, capture_output=True, text=True)
    shapes, result = done.stdout.splitlines()
    assert shapes == "(41, 41, 3) (512, 512, 3) complete"
    assert result.startswith("6.00 mm deep with 1.")
    command = [sys.executable, "-m", "taichi_msm", "run", "scenes/grasp.yaml", "--set", "output=[trajectory]"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    (tmp_path / "example.py").write_text(labels)
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert done.stdout == "(512, 512, 2) (512, 512) (512, 512, 2) (512, 512)\n"
    assert (tmp_path / "output" / "from-python" / "animation.gif").exists()


# Those whose examples stand in their docstrings. The example of Playback reads what that of run writes.
WITH_EXAMPLES = ["run", "Playback", "load_scene", "Scene"]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_example_of_a_docstring_gives_what_it_shows(name: str, examples_folder: Path) -> None:
    tests = doctest.DocTestFinder(recurse=False).find(getattr(taichi_msm, name), name, globs={})
    assert sum(len(test.examples) for test in tests) >= 3, f"{name} has no example"
    for test in tests:
        outcome = doctest.DocTestRunner().run(test)
        assert outcome.failed == 0, f"the example of {name} fails; see above"


def test_the_notebook_runs(
    root: Path, device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(root)
    monkeypatch.setattr(resources, "available_threads", lambda: device.threads)
    notebook = json.loads((root / "docs" / "notebooks" / "closed-loop.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    pages = []
    for cell in cells:
        # As a notebook does, show the value of a cell's last line.
        tree = ast.parse(cell)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        assert last is None or isinstance(last, ast.Expr)
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            pages += [value._repr_html_()] if hasattr(value, "_repr_html_") else []
    still, film, result = pages
    assert film.count("data:image/jpeg;base64,") == 17
    assert "0.6 s, 61 × 61 points" not in still
    assert "1.6 s, 61 × 61 points" in result
    assert capsys.readouterr().out.startswith("6.00 mm deep")


@pytest.mark.parametrize("name", SCENES)
def test_shipped_scenes_are_valid(name: str, root: Path) -> None:
    scene = load_scene(root / "scenes" / f"{name}.yaml")
    assert scene.time.frames >= 25


def test_every_link_of_the_readme_leads_somewhere(root: Path) -> None:
    def anchors(path: Path) -> set[str]:
        titles = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        return {title.lower().replace(" ", "-") for title in titles}

    readme = root / "README.md"
    links = [link for link in re.findall(r"\]\(([^)]+)\)", readme.read_text(encoding="utf-8")) if "://" not in link]
    assert links
    for link in links:
        name, _, anchor = link.partition("#")
        assert (root / name).exists(), link
        assert not anchor or anchor in anchors(root / (name or "README.md")), link


def test_every_promise_has_its_test(root: Path) -> None:
    named = re.findall(r"`(tests/\w+\.py)::(\w+)`", (root / "docs" / "trust.md").read_text(encoding="utf-8"))
    assert named
    for file, test in named:
        assert f"\ndef {test}(" in (root / file).read_text(encoding="utf-8"), test
