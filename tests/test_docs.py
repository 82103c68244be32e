"""What the README and the pages say is what the program does."""

from __future__ import annotations

import ast
import doctest
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
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
from taichi_msm.runs.run import run
from taichi_msm.runs.writer import ErrorRecord, RunRecord
from taichi_msm.scene import camera, render, scene, sheet, tools
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
# Those with commands, in an order in which each finds the results that it reads.
ORDER = "first-scene own-tissue endoscope scene keys labels data-set sweep fit export error view study"
WITH_COMMANDS = [README, *(DOCS / f"{name}.md" for name in ORDER.split())]

# How the shipped scenes are made smaller, to run every command of the pages in little time.
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
    """Give the first cells of the rows of a marked table."""
    lines = read(path).split(f"<!-- {name}: ")[1].split("\n\n")[0].splitlines()[3:]
    return [" | ".join(line.strip("| ").split(" | ")[:cells]) for line in lines if line[0] == "|"]


def words(cells: list[str]) -> list[str]:
    """Give what is set as code in cells."""
    return [word for cell in cells for word in re.findall(r"`(\w+)`", cell)]


def commands(path: Path) -> list[list[str]]:
    """Give the arguments of every command of the program that a page has, in blocks and within its text."""
    lines = [line for block in blocks(path, "sh") for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(taichi-msm [^`]+)`", read(path))
    typed = [shlex.split(line.split(" > ")[0], comments=True) for line in lines]
    return [
        words[1:] for words in typed if words and words[0].endswith("taichi-msm") and (words[2:] or "schema" in words)
    ]


def anchors(path: Path) -> set[str]:
    """Give the anchors of a page's titles, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", read(path), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.fixture(scope="module")
def examples_folder(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current directory, with the shipped scenes and a picture, photo.jpg; as many threads as `device` has."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    Image.fromarray(speckle(90, 120)).save(folder / "photo.jpg")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(process, "available_threads", lambda: device.threads)
        yield folder


@pytest.fixture
def small_scenes(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current directory, with the shipped scenes made smaller and a picture, photo.jpg."""
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
    shared = SimpleNamespace(submit=pool.submit, shutdown=lambda cancel_futures=False: None)
    monkeypatch.setattr(sweep, "Pool", lambda workers: shared)
    yield tmp_path
    pool.shutdown()


def test_every_page_is_reached_from_the_index_and_the_readme_is_short() -> None:
    assert read(README).count("\n") <= 120
    linked = set(re.findall(r"\]\(([^)#]+)\)", read(DOCS / "index.md")))
    assert {page.name for page in DOCS.glob("*.md")} - linked == {"index.md"}
    assert "(docs/index.md)" in read(README)


def test_every_link_leads_somewhere() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", read(page)):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            assert "://" in link or target.exists(), f"{page.name}: {link}"
            assert "://" in link or not anchor or anchor in anchors(target), f"{page.name}: {link}"


def test_what_is_shown_is_what_is_shipped() -> None:
    assert blocks(DOCS / "scene.md", "yaml") == [read(ROOT / "scenes" / "press.yaml")]
    assert blocks(DOCS / "sweep.md", "yaml") == [read(ROOT / "scenes" / "sweeps" / "stiffness.yaml")]
    assert blocks(DOCS / "view.md", "yaml") == [read(ROOT / "scenes" / "scripts" / "press.yaml")]


def test_tables_are_made_from_the_program() -> None:
    sys.path.insert(0, str(DOCS))
    try:
        import make_tables  # type: ignore[import-not-found,unused-ignore]
    finally:
        sys.path.pop(0)
    for (page, name), make in make_tables.TABLES.items():
        text = read(DOCS / f"{page}.md")
        assert make_tables.with_table(text, name, make()) == text, "run docs/make_tables.py"


def test_every_public_name_is_in_the_reference() -> None:
    assert sorted(re.findall(r"^::: taichi_msm\.(\w+)$", read(DOCS / "api.md"), flags=re.MULTILINE)) == sorted(
        taichi_msm.__all__
    )


def test_the_table_of_keys_has_their_limits() -> None:
    whole = schema()
    sections = [whole, *whole["$defs"].values()]
    keys = [key for section in sections for key in section.get("properties", {}).values()]
    for key in keys:
        if key.get("type") in ("number", "integer"):
            low, high = (key.get(bound) for bound in ("minimum", "maximum"))
            if low is not None and 0 < low < 1e-20:
                assert "above 0" in key["expects"], key
            elif low == 0 and high > 1e20:
                assert "0 or more" in key["expects"], key
            elif (above := key.get("exclusiveMinimum")) is not None:
                assert f"above {above:g} and below {key['exclusiveMaximum']:g}" in key["expects"], key
            else:
                below = key.get("exclusiveMaximum")
                limits = f"{low:g} to {high:g}" if below is None else f"from {low:g} to below {below:g}"
                assert limits in key["expects"], key


def test_all_parts_of_a_scene_are_exported() -> None:
    modules = (camera, render, scene, sheet, tools)
    found = {name: value for module in modules for name, value in vars(module).items()}
    sections = {name for name, value in found.items() if isinstance(value, type) and issubclass(value, Section)}
    assert {name for name in sections if not name.startswith("_")} - {"Section"} <= set(taichi_msm.__all__)


def test_everything_has_its_row() -> None:
    results, labels = table(DOCS / "files.md", "outputs", 2), table(DOCS / "labels.md", "labels", 2)
    expected = [f"`{output.entry}` | `{output.file}`" for output in OUTPUTS.values()]
    assert results + labels == expected
    assert sorted(words(table(DOCS / "files.md", "record"))) == sorted(get_type_hints(RunRecord))
    assert words(table(DOCS / "error.md", "estimate")) == list(get_type_hints(ErrorRecord))
    assert sorted(words(table(DOCS / "export.md", "formats"))) == sorted(FORMATS)
    codes = {common.DONE, common.BUG, common.INVALID_INPUT, common.DIVERGED, common.FILES, 130, 143}
    assert re.findall(r"\d+", " ".join(table(DOCS / "command-line.md", "exit codes"))) == [*map(str, sorted(codes))]


def test_every_option_of_the_command_line_is_shown() -> None:
    shown: dict[str, set[str]] = {}
    for usage in re.split(r"\n(?=taichi-msm)", blocks(DOCS / "command-line.md", "text")[0]):
        shown.setdefault(usage.split()[1], set()).update(re.findall(r"--[a-z-]+", usage))
    for name, command in cli_options.program.commands.items():
        options = {
            option for param in command.params for option in (*param.opts, *param.secondary_opts) if option[0] == "-"
        }
        assert shown.get(name, set()) == options, name


def test_every_command_is_understood() -> None:
    for page in [*WITH_COMMANDS, DOCS / "command-line.md"]:
        for name, *arguments in commands(page):
            cli_options.program.commands[name].make_context(name, arguments)


@pytest.mark.parametrize("pages", [WITH_COMMANDS[:1], pytest.param(WITH_COMMANDS, marks=pytest.mark.slow)])
def test_the_commands_work(pages: list[Path], small_scenes: Path, program: Program) -> None:
    seen = set()
    for page in pages:
        for arguments in commands(page):
            opens_a_window = arguments[0] == "view" and "--record" not in arguments
            needs_a_session = any("session-1" in word for word in arguments)
            played_elsewhere = arguments[0] in ("study", "fit") or "--resume" in arguments
            if opens_a_window or needs_a_session or played_elsewhere or tuple(arguments) in seen:
                continue
            seen.add(tuple(arguments))
            # The first command, and those of the page on estimates, make one.
            fast = arguments[0] == "run" and page.stem != "error" and len(seen) > 1
            done = program(*arguments, *(["--no-estimate"] if fast else []))
            assert done.returncode == 0, (arguments, done.stderr)
    if DOCS / "sweep.md" in pages:
        exec(blocks(DOCS / "sweep.md", "python")[0], {})


@pytest.mark.slow
def test_the_python_shown_runs(
    examples_folder: Path, program: Program, capfd: pytest.CaptureFixture[str], message: Messages
) -> None:
    (labels,) = blocks(DOCS / "labels.md", "python")
    shown = "print(position.shape, picture.shape, record['status'])\n"
    found: dict[str, Any] = {}
    for number, block in enumerate(blocks(DOCS / "python.md", "python")):
        exec(block + shown * (number == 0), found)
    digits = r"(?<=deep with 1\.)\d+|(?<= at )\(0.*\)|\[.*?\]|-?[\d.]+e-\d+"
    message(capfd.readouterr().out, "6.00 mm deep with 1.", "0.52 N at a depth of 5.0 mm", hide=digits)
    assert program("run", "scenes/grasp.yaml", "--set", "output=[trajectory]", "--no-estimate").returncode == 0
    exec(labels, found)
    exec(blocks(DOCS / "export.md", "python")[0], found)
    message(capfd.readouterr().out)
    assert Path("output/from-python/animation.gif").exists()


def test_the_ways_from_pixels_to_points_are_exact(small: Path, capfd: pytest.CaptureFixture[str]) -> None:
    left = "intrinsics: {fx: 40, fy: 40, cx: 20, cy: 15}, distortion: {k1: -0.3, k2: 0.1, p1: 0.001}"
    right = "intrinsics: {fx: 42, fy: 41, cx: 19, cy: 14}, distortion: {k1: -0.2, p2: 0.001}"
    place = "beside: left, rotation: [[0.9992, 0, 0.04], [0, 1, 0], [-0.04, 0, 0.9992]], translation: [-0.02, 0.002, 0]"
    cameras = f"render.cameras={{left: {{eye: [0, 0, 0.25], {left}}}, right: {{{place}, {right}}}}}"
    settings = [cameras, "output=[depth, stereo]", "render.supersample=1"]
    run(load_scene("small.yaml", settings), "out")
    (pair,) = [block for block in blocks(DOCS / "labels.md", "py") if "stereoRectify" in block]
    exec(pair.replace("output/pair", "out"), {})
    row, depth = map(float, capfd.readouterr().out.split())
    # Coordinates in f32 are good to 3e-5 px, and that of 0.25 m, of which 3 px of disparity tell.
    assert row < 1e-4
    assert depth < 1e-5
    (shown,) = [block for block in blocks(DOCS / "labels.md", "py") if "projectPoints" in block]
    found: dict[str, Any] = {}
    exec(shown.replace("output/grasp", "out/left"), found)
    pixels = np.stack([found["columns"], found["rows"]], axis=-1)
    assert len(pixels) > 500, "the sheet fills the picture"
    # 2e-3 with OpenCV's five iterations.
    assert np.linalg.norm(found["pixels"][:, 0] - pixels, axis=-1).max() < 1e-6


# Those whose examples stand in their docstrings. Those of Playback, export and fit read what that of run writes.
WITH_EXAMPLES = ["run", "Playback", "export", "fit", "gradient", "load_scene", "Scene", "Simulation"]


@pytest.mark.default_cases("run", "gradient", "Playback")
@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_example_of_a_docstring_gives_what_it_shows(name: str, examples_folder: Path) -> None:
    tests = doctest.DocTestFinder(recurse=False).find(getattr(taichi_msm, name), name, globs={})
    assert sum(len(test.examples) for test in tests) >= 2, f"{name} has no example"
    for test in tests:
        outcome = doctest.DocTestRunner().run(test)
        assert outcome.failed == 0, f"the example of {name} fails; see above"


@pytest.mark.slow
@pytest.mark.parametrize("points", [pytest.param("31, 31", id="exact"), "13, 13"])
def test_the_fit_shown_is_what_it_finds(
    points: str, examples_folder: Path, program: Program, capfd: pytest.CaptureFixture[str]
) -> None:
    def smaller(text: str) -> str:
        return re.sub(r"31, ?31", points, text)

    shown, unseen = (block.splitlines() for block in blocks(DOCS / "fit.md", "text"))
    typed = ([smaller(word) for word in words] for words in commands(DOCS / "fit.md") if "beef.yaml" not in words)
    seen, found, pressed, _, with_forces = typed
    assert program(*seen, "--no-estimate").returncode == 0
    done = program(*found)
    assert done.returncode == 0
    capfd.readouterr()
    exec(smaller(blocks(DOCS / "fit.md", "python")[0]), {})
    printed = capfd.readouterr().out
    if points == "31, 31":
        # But for the runs and the seconds.
        assert done.stdout.splitlines()[:-1] == shown[:-1]
        assert printed.splitlines() == blocks(DOCS / "fit.md", "txt")[0].splitlines()
    fewer = "--set", "sheet.points=[13,13]", "--set", "time.frames_per_second=4"
    assert program(*pressed, *fewer, "--no-estimate").returncode == 0
    told = program(*with_forces, *fewer)
    assert told.returncode == 0, told.stderr
    assert "not identifiable" not in told.stdout
    assert "each alone is not: fix one, or give a force (--forces)" in unseen[-1]


@pytest.mark.slow
def test_the_indentation_test_shown_is_what_it_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = DOCS / "fit-indentation.md"
    done = subprocess.run([sys.executable, "-c", blocks(page, "python")[0]], check=True, capture_output=True, text=True)
    # But for the runs and the seconds.
    assert done.stdout.splitlines()[:-1] == blocks(page, "txt")[0].splitlines()


def test_the_error_in_the_readme_is_that_of_the_run(device: Device, tmp_path: Path) -> None:
    (line,) = read(README).split("<!-- error: checked by tests/test_docs.py -->\n```text\n")[1].splitlines()[:1]
    press = load_scene(ROOT / "scenes" / "press.yaml", {"output": ["png"]})
    record = run(press, tmp_path / "press", threads=device.threads, estimate_error=True)
    assert line in record["notes"]
    rows, cols = record["points"]
    assert f"{record['steps']:,} steps of {rows} × {cols} points and {press.time.frames + 1} pictures" in read(README)


def test_the_speed_in_the_readme_is_that_of_the_page() -> None:
    def measured(section: str, name: str, column: int) -> str:
        part = read(DOCS / "performance.md").split(f"\n## {section}\n")[1]
        row = next(line for line in part.splitlines() if line.startswith(f"| {name} "))
        value, unit = re.match(r" *([\d.]+) ?(\w*)", row.split("|")[column + 1]).groups()  # type: ignore[union-attr]
        return f"{float(value):.{max(2, len(value.split('.')[0]))}g} {unit.replace('us', 'µs') or 's'}"

    warm, cold = (measured("The whole run", name, 1) for name in ("warm", "cold"))
    ours, cpp, numba, numpy = (
        measured("Stepping", name, 2) for name in ("taichi_msm", "C++, OpenMP", "Numba", "NumPy")
    )
    lit, opengl = (measured("Drawing", name, 1) for name in ("taichi_msm", "moderngl"))
    said = " ".join(read(README).split())
    assert f"takes {warm}, and {cold} the first time" in said
    assert f"takes {ours}, the same in C++ with OpenMP {cpp}, in Numba {numba} and in NumPy {numpy}." in said
    assert f"512 × 512 pixels takes {lit}, by OpenGL in software (llvmpipe) on the same cores {opengl}." in said


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load(read(ROOT / "CITATION.cff"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == taichi_msm.__version__
    assert citation["references"][0]["title"] in read(README)


@pytest.mark.slow
def test_the_notebook_runs(device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(process, "available_threads", lambda: device.threads)
    notebook = json.loads(read(DOCS / "notebooks" / "closed-loop.ipynb"))
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


def test_shipped_scenes_are_valid() -> None:
    for path in (ROOT / "scenes").glob("*.yaml"):
        assert load_scene(path).time.frames >= 25


def test_scenes_of_measured_tissue_have_the_fitted_numbers() -> None:
    fits = json.loads(read(DOCS / "machine-fits.json"))
    for name, test in ("beef", "230403-FF2A"), ("skin", "pig-skin-05-p-1"):
        document = yaml.safe_load(read(ROOT / "scenes" / f"{name}.yaml"))
        for key, (value, _, _) in fits[test]["parameters"].items():
            if key == "contact":  # of the table, not of the scene
                continue
            number: Any = document
            for part in key.split("."):
                number = number[int(part) if part.isdecimal() else part]
            assert float(number) == pytest.approx(value, rel=2e-3), key


def test_every_promise_has_its_test() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", read(DOCS / "tests.md").split("\n## Mutants\n")[0])
    assert len(named) > 100
    for file, test in named:
        assert f"\ndef {test}(" in read(ROOT / file), test
