"""The README and the pages against the program."""

from __future__ import annotations

import ast
import doctest
import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import yaml
from PIL import Image

import taichi_msm
from taichi_msm.cli import common
from taichi_msm.cli import options as cli_options
from taichi_msm.exports.formats import FORMATS
from taichi_msm.load.scene_file import load_scene, schema
from taichi_msm.load.yaml_reader import read_yaml
from taichi_msm.runs.run import run
from taichi_msm.runs.writer import ErrorRecord, RunRecord
from taichi_msm.scene import camera, render, scene, sheet, surface, tools
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.section import Section
from taichi_msm.sweeps import sweep
from taichi_msm.sweeps.pool import Pool
from taichi_msm.system import process
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import speckle

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("**/*.md"))]
# Pages with commands, in an order in which each finds the results that it reads.
ORDER = "first-scene own-tissue endoscope surfaces frame scene keys labels data-set sweep fit export error view study"
WITH_COMMANDS = [README, *(DOCS / f"{name}.md" for name in ORDER.split())]

# Replacements in the shipped scenes, to run all commands of the pages in little time.
SMALLER = {
    r"points: \[\d+, \d+\]": "points: [13, 13]",
    r"size: \[\d+, \d+\]": "size: [48, 48]",
    r"duration: \S+": "duration: 0.2",
    r"samples: \d+": "samples: 4",
}


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", read(path), flags=re.DOTALL)


def table(path: Path, name: str, cells: int = 1) -> list[str]:
    """Return the first cells of the rows of a marked table."""
    lines = read(path).split(f"<!-- {name}: ")[1].split("\n\n")[0].splitlines()[3:]
    return [" | ".join(line.strip("| ").split(" | ")[:cells]) for line in lines if line[0] == "|"]


def words(cells: list[str]) -> list[str]:
    """Return the words set as code in cells."""
    return [word for cell in cells for word in re.findall(r"`(\w+)`", cell)]


def commands(path: Path) -> list[list[str]]:
    """Return the arguments of the program's commands on a page, in blocks and in its text."""
    lines = [line for block in blocks(path, "sh") for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(taichi-msm [^`]+)`", read(path))
    typed = [shlex.split(line.split(" > ")[0], comments=True) for line in lines]
    return [
        words[1:] for words in typed if words and words[0].endswith("taichi-msm") and (words[2:] or "schema" in words)
    ]


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's titles, by GitHub's rule."""
    titles = re.findall(r"^#+ (.*)$", read(path), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.fixture(scope="module")
def examples_folder(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current directory, with the shipped scenes and a picture, photo.jpg; runs take the threads of `device`."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    Image.fromarray(speckle(90, 120)).save(folder / "photo.jpg")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(process, "available_threads", lambda: device.threads)
        yield folder


@pytest.fixture
def small_scenes(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current directory, with smaller copies of the shipped scenes and a picture, photo.jpg."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    for path in [*tmp_path.glob("scenes/*.yaml"), *tmp_path.glob("scenes/sweeps/*.yaml")]:
        text = read(path)
        for pattern, smaller in SMALLER.items():
            text = re.sub(pattern, smaller, text)
        path.write_text(text, encoding="utf-8")
    Image.fromarray(speckle(90, 120)).save(tmp_path / "photo.jpg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "available_threads", lambda: device.threads)
    # All sweeps share one process.
    pool = Pool(1)
    monkeypatch.setattr(sweep, "Pool", lambda workers: nullcontext(pool))
    yield tmp_path
    pool.shutdown()


def test_index_links_every_page() -> None:
    assert read(README).count("\n") <= 120
    linked = set(re.findall(r"\]\(([^)#]+)\)", read(DOCS / "index.md")))
    assert {page.name for page in DOCS.glob("*.md")} - linked == {"index.md"}
    assert "(docs/index.md)" in read(README)


def test_links() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", read(page)):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            assert "://" in link or target.exists(), f"{page.name}: {link}"
            assert "://" in link or not anchor or anchor in anchors(target), f"{page.name}: {link}"


def test_shown_files_are_the_shipped_ones() -> None:
    assert blocks(DOCS / "scene.md", "yaml") == [read(ROOT / "scenes" / "press.yaml")]
    assert blocks(DOCS / "sweep.md", "yaml") == [read(ROOT / "scenes" / "sweeps" / "stiffness.yaml")]
    assert blocks(DOCS / "machine-tables.md", "yaml") == [read(ROOT / "examples" / "ball.yaml")]
    assert blocks(DOCS / "view.md", "yaml") == [read(ROOT / "scenes" / "scripts" / "press.yaml")]


def test_yaml_of_pages_has_numbers_of_yaml_1_1() -> None:
    """PyYAML's safe_load, by YAML 1.1, reads the scenes of pages as this parser, by YAML 1.2."""
    texts = [textwrap.dedent(block) for page in PAGES for block in blocks(page, "yaml")]
    assert len(texts) >= 5
    for text in texts:
        assert yaml.safe_load(text) == read_yaml(text).data, text


def test_generated_tables_are_up_to_date() -> None:
    sys.path.insert(0, str(DOCS))
    try:
        import make_tables  # type: ignore[import-not-found,unused-ignore]
    finally:
        sys.path.pop(0)
    for (page, name), make in make_tables.TABLES.items():
        text = read(DOCS / f"{page}.md")
        assert make_tables.with_table(text, name, make()) == text, "run docs/make_tables.py"
    listed = [name for names in make_tables.NAMES.values() for name in names.split() if "." not in name]
    assert sorted(listed) == sorted(taichi_msm.__all__)


def test_descriptions_of_keys_contain_their_limits() -> None:
    root = schema()
    sections = [root, *root["$defs"].values()]
    for key in (key for section in sections for key in section.get("properties", {}).values()):
        if key.get("type") in ("number", "integer"):
            low, high = (key.get(bound) for bound in ("minimum", "maximum"))
            if low is not None and 0 < low < 1e-20:
                assert "above 0" in key["expects"], key
            elif low == 0 and high > 1e20:
                assert "0 or more" in key["expects"], key
            elif low == -1e30:
                assert "a number other than 0" in key["expects"], key
            elif (above := key.get("exclusiveMinimum")) is not None:
                assert f"above {above:g} and below {key['exclusiveMaximum']:g}" in key["expects"], key
            else:
                below = key.get("exclusiveMaximum")
                limits = f"{low:g} to {high:g}" if below is None else f"from {low:g} to below {below:g}"
                assert limits in key["expects"], key


def test_sections_of_a_scene_are_exported() -> None:
    values = [item for module in (camera, render, scene, sheet, surface, tools) for item in vars(module).items()]
    sections = {name for name, value in values if isinstance(value, type) and issubclass(value, Section)}
    assert {name for name in sections if not name.startswith("_")} - {"Section"} <= set(taichi_msm.__all__)


def test_tables_are_complete() -> None:
    results, labels = table(DOCS / "files.md", "outputs", 2), table(DOCS / "labels.md", "labels", 2)
    expected = [f"`{output.entry}` | `{output.file}`" for output in OUTPUTS.values()]
    assert results + labels == expected
    assert sorted(words(table(DOCS / "files.md", "record"))) == sorted(get_type_hints(RunRecord))
    assert words(table(DOCS / "error.md", "estimate")) == list(get_type_hints(ErrorRecord))
    assert sorted(words(table(DOCS / "export.md", "formats"))) == sorted(FORMATS)
    codes = {
        common.DONE,
        common.BUG,
        common.INVALID_INPUT,
        common.DIVERGED,
        common.FILES,
        *(128 + number for number in process.SIGNALS),
    }
    assert re.findall(r"\d+", " ".join(table(DOCS / "command-line.md", "exit codes"))) == [*map(str, sorted(codes))]


def test_documented_options() -> None:
    shown: dict[str, set[str]] = {}
    for usage in re.split(r"\n(?=taichi-msm)", blocks(DOCS / "command-line.md", "text")[0]):
        shown.setdefault(usage.split()[1], set()).update(re.findall(r"--[a-z-]+", usage))
    for name, command in cli_options.program.commands.items():
        options = {
            option for param in command.params for option in (*param.opts, *param.secondary_opts) if option[0] == "-"
        }
        assert shown.get(name, set()) == options, name


def test_commands_parse() -> None:
    for page in [*WITH_COMMANDS, DOCS / "command-line.md"]:
        for name, *arguments in commands(page):
            cli_options.program.commands[name].make_context(name, arguments)


@pytest.mark.parametrize("pages", [WITH_COMMANDS[:1], pytest.param(WITH_COMMANDS, marks=pytest.mark.slow)])
def test_commands_run(pages: list[Path], small_scenes: Path, program: Program) -> None:
    done_before = set()
    for page in pages:
        for arguments in commands(page):
            opens_a_window = arguments[0] == "view" and "--record" not in arguments
            needs_a_session = any("session-1" in word for word in arguments)
            tested_elsewhere = arguments[0] in ("study", "fit", "palpation") or "--resume" in arguments
            if opens_a_window or needs_a_session or tested_elsewhere or tuple(arguments) in done_before:
                continue
            done_before.add(tuple(arguments))
            # Only the first command and the page on error estimates estimate errors.
            fast = arguments[0] == "run" and page.stem != "error" and len(done_before) > 1
            done = program(*arguments, *(["--no-estimate"] if fast else []))
            assert done.returncode == 0, (arguments, done.stderr)
    if DOCS / "sweep.md" in pages:
        exec(blocks(DOCS / "sweep.md", "python")[0], {})


@pytest.mark.slow
def test_python_blocks_run(
    examples_folder: Path, program: Program, capfd: pytest.CaptureFixture[str], message: Messages
) -> None:
    shown = "print(position.shape, picture.shape, record['status'])\n"
    names: dict[str, Any] = {}
    for number, block in enumerate(blocks(DOCS / "python.md", "python")):
        exec(block + shown * (number == 0), names)
    digits = r"(?<=deep with 1\.)\d+|(?<= at )\(0.*\)|\[.*?\]|-?[\d.]+e-\d+"
    message(capfd.readouterr().out, "6.00 mm deep with 1.", "0.52 N at a depth of 5.0 mm", hide=digits)
    assert program("run", "scenes/grasp.yaml", "--set", "output=[trajectory]", "--no-estimate").returncode == 0
    for page in ("labels", "export"):
        exec(blocks(DOCS / f"{page}.md", "python")[0], names)
    message(capfd.readouterr().out)
    assert Path("output/from-python/animation.gif").exists()


def test_camera_examples_are_exact(small: Path, capfd: pytest.CaptureFixture[str]) -> None:
    left = "intrinsics: {fx: 40, fy: 40, cx: 20, cy: 15}, distortion: {k1: -0.3, k2: 0.1, p1: 0.001}"
    right = "intrinsics: {fx: 42, fy: 41, cx: 19, cy: 14}, distortion: {k1: -0.2, p2: 0.001}"
    pose = "beside: left, rotation: [[0.9992, 0, 0.04], [0, 1, 0], [-0.04, 0, 0.9992]], translation: [-0.02, 0.002, 0]"
    cameras = f"render.cameras={{left: {{eye: [0, 0, 0.25], {left}}}, right: {{{pose}, {right}}}}}"
    run(load_scene("small.yaml", [cameras, "output=[depth, stereo]", "render.supersample=1"]), "out")
    (pair,) = [block for block in blocks(DOCS / "labels.md", "py") if "stereoRectify" in block]
    exec(pair.replace("output/pair", "out"), {})
    row, depth = map(float, capfd.readouterr().out.split())
    # Coordinates in f32 are exact to 3e-5 px; a disparity of 3 px corresponds to a depth of 0.25 m.
    assert row < 1e-4
    assert depth < 1e-5
    (shown,) = [block for block in blocks(DOCS / "labels.md", "py") if "projectPoints" in block]
    names: dict[str, Any] = {}
    exec(shown.replace("output/grasp", "out/left"), names)
    pixels = np.stack([names["columns"], names["rows"]], axis=-1)
    assert len(pixels) > 500, "the sheet fills the picture"
    # 2e-3 with OpenCV's five iterations.
    assert np.linalg.norm(names["pixels"][:, 0] - pixels, axis=-1).max() < 1e-6


# The examples of Playback, export and fit read results of that of run.
WITH_EXAMPLES = ["run", "Playback", "export", "fit", "gradient", "load_scene", "Scene", "Simulation"]


@pytest.mark.default_cases("run", "gradient", "Playback")
@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_docstring_examples(name: str, examples_folder: Path) -> None:
    # Most examples read the results of that of `run`.
    for each in [name] if Path("output/press").exists() else dict.fromkeys(["run", name]):
        tests = doctest.DocTestFinder(recurse=False).find(getattr(taichi_msm, each), each, globs={})
        assert sum(len(test.examples) for test in tests) >= 2, f"{each} has no example"
        for test in tests:
            assert doctest.DocTestRunner().run(test).failed == 0, f"the example of {each} fails; see above"


@pytest.mark.slow
@pytest.mark.parametrize("points", [pytest.param("31, 31", id="exact"), "13, 13"])
def test_fit_page(points: str, examples_folder: Path, program: Program, capfd: pytest.CaptureFixture[str]) -> None:
    def smaller(text: str) -> str:
        return re.sub(r"31, ?31", points, text)

    estimate, unidentifiable = (block.splitlines() for block in blocks(DOCS / "fit.md", "text"))
    typed = ([smaller(word) for word in words] for words in commands(DOCS / "fit.md") if "TABLE.xlsx" not in words)
    observe, fit, press, _, fit_with_forces = typed
    assert program(*observe, "--no-estimate").returncode == 0
    done = program(*fit)
    assert done.returncode == 0
    capfd.readouterr()
    exec(smaller(blocks(DOCS / "fit.md", "python")[0]), {})
    printed = capfd.readouterr().out
    if points == "31, 31":
        # The last line has the runs and the seconds.
        assert done.stdout.splitlines()[:-1] == estimate[:-1]
        assert printed.splitlines() == blocks(DOCS / "fit.md", "txt")[0].splitlines()
    fewer = "--set", "sheet.points=[13,13]", "--set", "time.frames_per_second=4"
    assert program(*press, *fewer, "--no-estimate").returncode == 0
    with_forces = program(*fit_with_forces, *fewer)
    assert with_forces.returncode == 0, with_forces.stderr
    assert "not identifiable" not in with_forces.stdout
    assert "each alone is not: fix one, or give a force (--forces)" in unidentifiable[-1]


@pytest.mark.slow
def test_indentation_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = DOCS / "fit-indentation.md"
    done = subprocess.run([sys.executable, "-c", blocks(page, "python")[0]], check=True, capture_output=True, text=True)
    # The last line has the runs and the seconds.
    assert done.stdout.splitlines()[:-1] == blocks(page, "txt")[0].splitlines()


def test_error_in_the_readme(device: Device, tmp_path: Path) -> None:
    (line,) = read(README).split("<!-- error: checked by tests/test_docs.py -->\n```text\n")[1].splitlines()[:1]
    press = load_scene(ROOT / "scenes" / "press.yaml", {"output": ["png"]})
    record = run(press, tmp_path / "press", threads=device.threads, estimate_error=True)
    assert line in record["notes"]


def test_speed_in_the_readme() -> None:
    def measured(section: str, name: str, column: int) -> str:
        part = read(DOCS / "performance.md").split(f"\n## {section}\n")[1]
        row = next(line for line in part.splitlines() if line.startswith(f"| {name} "))
        value, unit = re.match(r" *([\d.]+) ?(\w*)", row.split("|")[column + 1]).groups()  # type: ignore[union-attr]
        return f"{float(value):.{max(2, len(value.split('.')[0]))}g} {unit.replace('us', 'µs') or 's'}"

    warm = measured("The whole run", "warm", 1)
    step, cpp = (measured("Stepping", name, 2) for name in ("taichi_msm", "C++, OpenMP"))
    lit, opengl = (measured("Drawing", name, 1) for name in ("taichi_msm", "moderngl"))
    text = " ".join(read(README).split())
    assert f"press.yaml` takes {warm}, a step of 101 × 101 points takes {step} (C++ with OpenMP: {cpp})" in text
    assert f"a lit picture {lit} (OpenGL in software: {opengl})" in text


def test_citation() -> None:
    citation = yaml.safe_load(read(ROOT / "CITATION.cff"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == taichi_msm.__version__
    assert citation["references"][0]["title"] in read(README)
    assert f'authors = [{{ name = "{citation["authors"][0]["name"]}" }}]' in read(ROOT / "pyproject.toml")


@pytest.mark.slow
def test_notebook(device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(process, "available_threads", lambda: device.threads)
    notebook = json.loads(read(DOCS / "notebooks" / "closed-loop.ipynb"))
    names: dict[str, Any] = {}
    pages = []
    for cell in ("".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"):
        # A notebook displays the value of a cell's last line.
        tree = ast.parse(cell)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            pages += [value._repr_html_()] if hasattr(value, "_repr_html_") else []
    still, film, result = pages
    assert film.count("data:image/jpeg;base64,") == 17
    assert "0.6 s, 61 × 61 points" not in still
    assert "1.6 s, 61 × 61 points" in result
    assert capsys.readouterr().out.startswith("6.00 mm deep")


def test_shipped_scenes_are_valid() -> None:
    for path in (ROOT / "scenes").glob("*.yaml"):
        assert load_scene(path).time.frames >= 25


def test_scenes_have_the_fitted_parameters() -> None:
    fits = json.loads(read(DOCS / "machine-fits.json"))
    for name, test in ("beef", "230403-FF2A"), ("skin", "pig-skin-05-p-1"):
        document = yaml.safe_load(read(ROOT / "scenes" / f"{name}.yaml"))
        for key, (value, _, _) in fits[test]["parameters"].items():
            if key == "contact":  # a parameter of the table, not of the scene
                continue
            number: Any = document
            for part in key.split("."):
                number = number[int(part) if part.isdecimal() else part]
            assert float(number) == pytest.approx(value, rel=2e-3), key


def test_tests_named_on_pages_exist() -> None:
    named = [name for page in PAGES for name in re.findall(r"`(tests/[\w/.]+)`", read(page))]
    assert len(named) > 20
    assert not [name for name in named if not (ROOT / name).exists()]
