from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from PIL import Image

from taichi_msm.errors import SceneError, printable
from taichi_msm.load.check import parse_model
from taichi_msm.load.scene_file import MAX_LINES, load_scene, parse_override, schema
from taichi_msm.load.yaml_reader import read_yaml
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from tests.golden import Messages
from tests.scenes import random_contact, random_scene, random_tissue

GOOD = """\
sheet:
  points: [4, 5]
  size: [0.3, 0.4]
  mass: 1.0e-3
springs:
  structural: 20
  shear: 20
time:
  duration: 0.4
output: []
"""
SPRINGS = """\
springs:
  structural: 20
  shear: 20
"""
PROBE = """\
probes:
  - force: [0, 0, 1]
    at: [0.5, 0.5]
    load: [[0, 0], [1, 100]]
"""


Load = Callable[..., Scene]

# Text of libyaml, which depends on its version.
PYYAML_TEXT = r"(?<=not valid YAML: )[^;\n]*"


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Load a text as the file s.yaml of the current directory."""
    monkeypatch.chdir(tmp_path)

    def load(text: str | bytes, *arguments: Any, **named: Any) -> Scene:
        Path("s.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
        return load_scene("s.yaml", *arguments, **named)

    return load


@pytest.mark.parametrize(
    ("override", "similar"),
    [
        ("sheet.fixed=boarder", True),
        ("output=[png, gfi]", True),
        ("sheet.fixed=all", False),
        ("sheet.fixed=[boarder]", False),
    ],
)
def test_suggestion_of_a_similar_word(override: str, similar: bool, load: Load, message: Messages) -> None:
    with message.raises(SceneError, override.partition("=")[0], "is not allowed") as caught:
        load(GOOD, [override])
    assert ("did you mean" in str(caught.value)) == similar


def test_defaults(load: Load) -> None:
    scene = load(GOOD)
    assert (scene.sheet.points, scene.sheet.mass, scene.time.frames) == ((4, 5), 1e-3, 10)
    assert (scene.sheet.fixed, scene.probes, scene.render.camera) == ("border", (), "top")
    assert 0.29 * 100 < 29, "frames are counted in spite of rounding"
    assert load(GOOD.replace("duration: 0.4", "duration: 0.29\n  frames_per_second: 100")).time.frames == 29


# Texts of a scene, and position and key of each fault.
FAULTS = {
    "near key": (GOOD.replace("shear", "shaer"), "7:3: springs.shaer"),
    "unknown key": (GOOD + "xyz: 1\n", "11:1: xyz"),
    "key in a flow mapping of a list": (GOOD + "probes: [{force: [0, 0, 1], fallof: 3}]\n", "11:29: probes.0.fallof"),
    "key named as the kind of value": (
        GOOD + "render: {camera: {Camera: {eye: 1}}}\n",
        "11:10: render.camera.eye",
        "11:19: render.camera.Camera",
    ),
    "missing": (GOOD.replace("  mass: 1.0e-3\n", ""), "1:1: sheet.mass"),
    "duplicate": (GOOD.replace("size:", "mass: 1\n  size:"), "5:3: sheet.mass"),
    "key that is a number": (GOOD + "1: x\n", "11:1: 1"),
    "on, which is text in YAML 1.2": (GOOD + "on: 1\n", "11:1: on"),
    "key with a line break": (GOOD + '"a\\nb": 1\n', "11:1: a\\nb"),
    "mass 0": (GOOD.replace("1.0e-3", "0"), "4:3: sheet.mass: 0"),
    "empty": (GOOD.replace("1.0e-3", ""), "4:3: sheet.mass"),
    "infinite by its exponent": (GOOD + "damping: 1e999\n", "11:1: damping: Infinity"),
    "not a number": (GOOD + "damping: .nan\n", "11:1: damping: NaN"),
    "too small": (GOOD.replace("1.0e-3", "1e-31"), "4:3: sheet.mass: 1e-31"),
    "more digits than Python reads": (GOOD + f"damping: {'1' * 5000}\n", '11:1: damping: "1'),
    "short list with a wrong item": (GOOD.replace("[4, 5]", "[1]"), "2:12: sheet.points.0: 1"),
    "number in place of a section": (GOOD.replace(SPRINGS, "springs: 3\n"), "5:1: springs: 3"),
    "control character": (GOOD + 'render: {shading: "\\e[31m"}\n', '11:10: render.shading: "\\u001b[31m"'),
    "yes, which is text in YAML 1.2": (GOOD + "render: {wireframe: yes}\n", '11:10: render.wireframe: "yes"'),
    "instrument without a direction": (
        GOOD + "probes: [{force: [0, 0, 1], instrument: {radius: 0.01, shaft: [0, 0, 0], length: 0.1}}]\n",
        "11:56: probes.0.instrument.shaft",
    ),
    "nothing to draw": (GOOD.replace("[]", "[png]"), "1:1: image"),
    "empty path of an image": (GOOD + "image: ''\n", '11:1: image: ""'),
    "long path of an image": (GOOD + f"image: {'../' * 300_000}\n", "11:1: image"),
    "short keyframe": (GOOD + PROBE.replace("0.5, 0.5", "[0, 0.5, 0.5], [1, 0.5]"), "13:25: probes.0.at.1"),
    "decreasing times of a path": (GOOD + PROBE.replace("0.5, 0.5", "[1, 0, 0], [0, 0, 0]"), "13:21: probes.0.at.1"),
    "decreasing times of a load": (GOOD + PROBE.replace("[1, 100]", "[1, 100], [0.5, 0]"), "14:30: probes.0.load.2"),
    "three loads at a time": (GOOD + PROBE.replace("[1, 100]", "[1, 1], [1, 2], [1, 3]"), "14:36: probes.0.load.3"),
    "duration that is not a multiple of a frame": (
        GOOD.replace("0.4\noutput", "0.33\noutput"),
        "9:3: time.duration: 0.33",
    ),
    "step above the limit": (GOOD.replace("duration", "step: 0.02\n  duration"), "9:3: time.step: 0.02"),
    "eye at the target": (GOOD + "render: {camera: {eye: [0, 0, 0]}}\n", "11:19: render.camera.eye"),
    "faults of several sections": (
        GOOD.replace("duration", "step: 0.02\n  duration").replace("[]", "[png]") + "render: {sizes: 1}\n",
        "1:1: image",
        "9:3: time.step",
        "12:10: render.sizes",
    ),
    "unknown output": (GOOD.replace("[]", "[pngs]"), '10:10: output.0: "pngs"'),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_with_their_positions(name: str, load: Load, message: Messages) -> None:
    text, *positions = FAULTS[name]
    with message.raises(SceneError) as caught:
        load(text)
    for line, position in zip(str(caught.value).splitlines(), positions, strict=True):
        assert line.startswith(f"s.yaml:{position}")


@pytest.mark.parametrize(
    ("text", "position"),
    [
        pytest.param("", "1:1", id="empty"),
        pytest.param("- a\n", '1:1: ["a"]', id="list"),
        pytest.param("a: b\0", "1:5: character U+0000", id="null"),
        pytest.param("é: 1\nü: ".encode() + b"\xfc", "2:4", id="Latin-1"),
        pytest.param(GOOD.encode("utf-16"), "1:1", id="UTF-16"),
        pytest.param("a:\n " + "[" * 21 + "]" * 21, "2:22", id="nested lists"),
        # The limit of libyaml, reached before its first event.
        pytest.param("a: " + "[" * 20_000, "1:1003", id="limit of libyaml"),
        pytest.param("[" + "1," * 100_000 + "]", "1:200000", id="many values"),
        pytest.param("a" * (2**20 + 1), "", id="large"),
        # Not valid YAML.
        pytest.param("a: [1, 2\nb: 3\n", "2:2", id="open list"),
        pytest.param("a:\n  x: 1\n  b 3\n  c: 4\n", "3:3", id="no colon"),
        pytest.param('a: "\\U00110000"\n', "1:", id="code point above Unicode"),
        pytest.param("sheet:\n\tmass: 1\n", "2:1", id="tab"),
    ],
)
def test_unreadable_files(load: Load, text: str | bytes, position: str, message: Messages) -> None:
    with message.raises(SceneError, f"s.yaml:{position}", hide=PYYAML_TEXT) as caught:
        load(text)
    assert len(str(caught.value).splitlines()) == 1


def test_excluded_features_of_yaml(load: Load, message: Messages) -> None:
    text = GOOD.replace("1.0e-3", "&m 1.0e-3").replace("0.4\noutput", "!!float 0.4\noutput")
    positions = "4:9: sheet.mass", "9:13: time.duration", "11:10: damping", "12:5: <<", "13:8: image", "14:1: "
    with message.raises(SceneError, *positions):
        load(text + "damping: *m\n<<: *m\nimage: !!python/object/apply:os.getcwd []\n---\nmore: 1\n")


def test_expansion_of_aliases(load: Load) -> None:
    text = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 20))
    before = time.perf_counter()
    with pytest.raises(SceneError, match=r"s\.yaml:1:5: a0: .*&a0"):
        load(text)
    assert time.perf_counter() - before < 1


@pytest.mark.default_cases("probes")
@pytest.mark.parametrize(
    "text",
    [
        "k: 1\n" * 49_900,
        GOOD + "probes:\n" + "- {}\n" * 49_000,
    ],
    ids=["duplicates", "probes"],
)
def test_file_with_many_faults(load: Load, text: str) -> None:
    before = time.process_time()
    with pytest.raises(SceneError) as caught:
        load(text)
    # 0.3 to 0.7 s on the machine on which the limits were chosen; the margin is for slower ones.
    assert time.process_time() - before < 3
    assert len(caught.value.lines) == MAX_LINES + 1
    assert caught.value.lines[-1] == "and more"


@pytest.mark.parametrize(
    ("written", "value"),
    [
        *(("1e4", 1e4), ("1.5E+2", 150.0), (".5", 0.5), ("5.", 5.0), ("-.inf", -math.inf), (".NaN", math.nan)),
        *(("+3", 3), ("010", 10), ("0o10", 8), ("0x1F", 31)),
        *(("true", True), ("FALSE", False), ("~", None), ("", None), ("NULL", None)),
        *((text, text) for text in ("yes", "No", "on", "OFF", "2026-01-01", "1:30", "1_000", "0b1", "nan", "tRue")),
        *((text, text) for text in ("<<", "=", ".", "e1", "+", "0o8", "1e", "inf", "1" * 101)),
        *(("'1e4'", "1e4"), ('"true"', "true")),
    ],
)
def test_scalars_follow_yaml_1_2(written: str, value: object) -> None:
    assert repr(parse_override(f"k={written}").value) == repr(value)


def test_picture_in_place_of_a_scene(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "PHOTO.PNG").write_bytes(b"\x89PNG\xff\xd8")
    with message.raises(SceneError, "PHOTO.PNG", "--image"):
        load_scene(tmp_path / "PHOTO.PNG")


@pytest.mark.parametrize("encode", [str.encode, lambda text: b"\xef\xbb\xbf" + text.encode()], ids=["plain", "bom"])
@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["lf", "crlf"])
def test_encodings_and_line_ends(load: Load, encode: Callable[[str], bytes], end: str, message: Messages) -> None:
    assert load(encode(GOOD.replace("\n", end))).sheet.points == (4, 5)
    with message.raises(SceneError, "s.yaml:7:3: springs.shaer"):
        load(encode(GOOD.replace("shear", "shaer").replace("\n", end)))


def test_order_of_all_errors(load: Load, message: Messages) -> None:
    text = """\
probes:
  - {load: [[0, 0], [-1, 0]]}
sheet:
  points: [1, 5]
  size: [0.3, 0.4]
  mass: 0
springs: {structural: 20, shaer: 20}
springs: {}
time: {duration: 0.4, step: 1e-3}
image: none.png
region: [-1, 0, 4, 4]
extra: 1
"""
    with message.raises(SceneError) as caught:
        load(text, ["render.size=[0, 1]", "damping"], image="other.png")
    assert [line.partition(": ")[0].removeprefix("s.yaml:") for line in str(caught.value).splitlines()] == [
        *("2:5", "2:21", "4:12", "6:3", "7:27", "8:1", "11:1", "12:1"),
        *("--set render.size=[0, 1]", "--set damping", "--image other.png"),
    ]


@pytest.mark.parametrize(
    "name",
    ["none.yaml", "folder", "pipe", "/dev/zero", "a\0b", "x" * 300, "huge.yaml"],
    ids=["missing", "folder", "pipe", "device", "null character", "long", "huge"],
)
@pytest.mark.usefixtures("load")
def test_invalid_paths(name: str, message: Messages) -> None:
    Path("folder").mkdir()
    os.mkfifo("pipe")
    Path("huge.yaml").touch()
    os.truncate("huge.yaml", 10**10)
    with message.raises(SceneError, name.replace("\0", "\\x00")):
        load_scene(name)


def test_suggestion_of_another_suffix(tmp_path: Path, message: Messages) -> None:
    (tmp_path / "scene.yaml").touch()
    with message.raises(SceneError, "/scene.yaml"):
        load_scene(tmp_path / "scene.yml")


def test_missing_files_of_a_scene(load: Load, message: Messages) -> None:
    map_ = "map: {image: map.png, range: [1, 2]}"
    cameras = "cameras: {left: {calibration: left.yml, poses: left.txt}, right: {beside: left, calibration: right.yml}}"
    text = GOOD.replace("shear: 20", map_) + f"image: none.png\nrender: {{{cameras}}}\n"
    with message.raises(SceneError) as caught:
        load(text)
    names = ["map.png", "none.png", "left.yml", "left.txt", "right.yml"]
    assert all(f": {name}: no such file" in line for line, name in zip(caught.value.lines, names, strict=True))


def test_overrides(load: Load) -> None:
    overrides = ["sheet.points=[6, 7]", "probes.0.load=[[0, 100]]", "probes.0.force.2=9", "damping=1e-2"]
    scene = load(GOOD + PROBE, overrides)
    assert (scene.sheet.points, scene.sheet.size, scene.damping) == ((6, 7), (0.3, 0.4), 0.01)
    assert (scene.probes[0].load, scene.probes[0].force) == (((0, 100),), (0, 0, 9))
    scene = load(GOOD, {"sheet.points": (6, 7), "probes": [{"force": [0, 0, 1]}], "probes.0.falloff": 3})
    assert (scene.sheet.points, scene.probes[0].falloff) == ((6, 7), 3)
    # The last override counts, and may correct a fault of the file.
    assert load(GOOD, ["render.camera.eye=[0, 0, 1]", "render={camera: top}"]).render.camera == "top"
    assert load(GOOD.replace("1.0e-3", "0"), ["sheet.mass=2", "sheet.mass=1"]).sheet.mass == 1


@pytest.mark.parametrize(
    ("overrides", "image"),
    [
        pytest.param([f"image={'x' * 5000}"], "y" * 5000, id="value and image"),
        pytest.param([f"sheet.points=[{'1, ' * 5000}1]"], None, id="list"),
        pytest.param([f"image{'.a' * 60_000}=1"], None, id="key"),
    ],
)
def test_long_overrides(overrides: list[str], image: str | None, load: Load, message: Messages) -> None:
    with message.raises(SceneError) as caught:
        load(GOOD, overrides, image=image)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("overrides", "place"),
    [
        (["springs.shaer=3"], "springs.shaer"),
        (["probes.0.load.1=[-1, 0]"], "probes.0.load.1"),
        (["probes.1.offset=1"], "probes.1"),
        (["probes.\u0661.offset=1"], "probes.\u0661"),
        (["probes=[]", "probes.0.load=[[0, 1]]"], "probes.0"),
        (["damping.x=1"], "damping"),
        (["damping"], ""),
        (["damping={a: 1, a: 2}"], "damping.a"),
        (["damping=[1"], "damping"),
        (["image=\udcff"], "image"),
        (["damping=a\nb\0"], "damping"),
        (["render.camera.fov=30", "render={camera: {fov: x, eye: [0, 0, 1]}}"], "render.camera.fov"),
        ({"\udcff": 1}, ""),
        ({"sheet.mass": {1, 2}}, "sheet.mass"),
    ],
    ids=ascii,
)
def test_errors_in_overrides(load: Load, overrides: Any, place: str, message: Messages) -> None:
    """A line with the invalid override."""
    with message.raises(SceneError, hide=PYYAML_TEXT) as caught:
        load(GOOD + PROBE + "damping: 0.5\n", overrides)
    (line,) = str(caught.value).splitlines()
    last = f"--set {overrides[-1]}: {place}" if isinstance(overrides, list) else f"override {next(iter(overrides))}"
    assert line.startswith(printable(last))


def test_unknown_keys_are_marked() -> None:
    _, problems = parse_model(Scene, {"sheet": {"points": 3, "mas": 1}, "time": {"duration": 0}, "dampign": 0})
    assert [problem.key for problem in problems if problem.is_unknown_key] == ["sheet.mas", "dampign"]


def test_parsed_overrides() -> None:
    assert parse_override("a.b=3")[1:3] == (("a", "b"), 3)
    assert parse_override("probes.0.load=[[0, 1e2]]")[1:3] == (("probes", 0, "load"), [[0, 100.0]])
    assert parse_override("image=a=b.png")[1:3] == (("image",), "a=b.png")
    # Python cannot convert integers of 5000 digits.
    assert parse_override(f"{'9' * 5000}=1")[1:3] == (("9" * 5000,), 1)


def test_paths_of_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scenes").mkdir()
    Image.new("RGB", (4, 3)).save("scenes/own.png")
    Image.new("RGB", (5, 3)).save("other.png")
    Path("scenes/s.yaml").write_text(GOOD + "image: own.png\n")
    assert load_scene("scenes/s.yaml").image == str(Path("scenes/own.png"))
    assert load_scene("scenes/s.yaml", image="other.png").image == "other.png"
    assert load_scene("scenes/s.yaml", image=Path("other.png")).image == "other.png"
    assert load_scene("scenes/s.yaml", ["image=../other.png"]).image == str(Path("scenes/../other.png"))
    absolute = str(tmp_path / "other.png")
    assert load_scene("scenes/s.yaml", {"image": absolute}).image == absolute


@pytest.mark.parametrize(
    "name",
    ["deep/../../secret.png", "{absolute}", "link.png", "away/secret.png"],
    ids=["above", "absolute", "link", "link of a folder"],
)
def test_picture_outside_the_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    (tmp_path / "scenes" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "scenes")
    Image.new("RGB", (4, 3)).save("../secret.png")
    Path("link.png").symlink_to("../secret.png")
    Path("away").symlink_to("..")
    Path("s.yaml").write_text(GOOD + f"image: {name.format(absolute=tmp_path / 'secret.png')}\nregion: [0, 0, 9, 9]\n")
    opened: list[str] = []
    monkeypatch.setattr("taichi_msm.images._require_file", opened.append)
    with message.raises(SceneError, "s.yaml:11:1: image", "--image"):
        load_scene("s.yaml")
    assert not opened


def test_links_within_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder may be a link, and a picture may be a link within it."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "link").symlink_to("scenes")
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (4, 3)).save("scenes/own.png")
    Path("scenes/same.png").symlink_to("own.png")
    Path("scenes/s.yaml").write_text(GOOD + "image: same.png\n")
    assert load_scene("link/s.yaml").image == str(Path("link/same.png"))


@pytest.fixture
def validator() -> jsonschema.Draft202012Validator:
    described = schema()
    jsonschema.Draft202012Validator.check_schema(described)
    return jsonschema.Draft202012Validator(described)


def test_schema_accepts_valid_scenes(load: Load, validator: jsonschema.Draft202012Validator) -> None:
    Image.new("RGB", (4, 3)).save("a.png")
    sections: list[dict[str, Any]] = [
        {"image": "a.png", "output": ["png", "gif", "trajectory"]},
        {"image": "a.png", "region": [1, 1, 2, 1], "render": {"size": [1, 99], "refine": 20, "supersample": 4}},
        {"render": {"camera": {"eye": [9, 0, 5], "target": [0, -1, 0], "up": [0, 1, 0], "fov": 179}}},
        {"render": {"camera": "oblique", "shading": "tissue", "wireframe": True, "background": [0, 9, 255]}},
        {"render": {"cameras": {"left": "top", "right": {"eye": [[0, 0, 0, 1], [1, 0, 0, 2]]}}}},
    ]
    for seed in range(10):
        for made in (random_scene(seed), random_tissue(seed, "a.png"), random_contact(seed, "a.png")):
            # With all keys, and with the given ones only.
            for short in (False, True):
                keys = made.model_dump(mode="json", exclude_unset=short, exclude_none=True)
                data = keys | sections[seed % len(sections)]
                load(json.dumps(data))
                validator.validate(data)
    for text in (GOOD, GOOD + PROBE, GOOD + "image:\nregion: null\nrender: {}\n"):
        load(text)
        validator.validate(parse_override(f"scene={text}").value)


@pytest.mark.parametrize(
    ("section", "path"),
    [
        ({"springs": {"shear": -1}}, ["springs", "shear"]),
        ({"springs": {"shaer": 1}}, ["springs"]),
        ({"springs": 3}, ["springs"]),
        ({"render": {"camera": {"eye": [0, 0, 1], "fov": -3}}}, ["render", "camera", "fov"]),
        ({"render": {"camera": {"eye": [0, 0, 1], "fvo": 3}}}, ["render", "camera"]),
        ({"probes": [{"path": [[0, 0, 0, 0]], "instrument": {"radius": 0, "shaft": [0, 0, 1], "length": 1}}]},
         ["probes", 0, "instrument", "radius"]),
    ],
    ids=["value", "unknown key", "number", "value in a union", "unknown key in a union", "value of a tool"],
)  # fmt: skip
def test_schema_blames_one_key(section: dict[str, Any], path: list[Any], validator: jsonschema.Validator) -> None:
    """An editor marks one key, and not the optional section that contains it as of no type of a union."""
    good = parse_override(f"scene={GOOD}").value
    (error,) = validator.iter_errors(good | section)
    assert list(error.absolute_path) == path
    assert error.validator not in ("anyOf", "oneOf")


def test_schema_rejects_invalid_scenes(validator: jsonschema.Draft202012Validator) -> None:
    good = parse_override(f"scene={GOOD}").value
    assert validator.is_valid(good)
    invalid: dict[str, Any]
    for invalid in (
        {"extra": 1},
        {"sheet": None},
        {"sheet": good["sheet"] | {"mass": 0}},
        {"sheet": good["sheet"] | {"points": [4]}},
        {"springs": {"shaer": 1}},
        {"damping": "1"},
        {"probes": [{}]},
        {"render": {"camera": "side"}},
        {"output": ["avi"]},
    ):
        assert not validator.is_valid(good | invalid), invalid
    for key in ("sheet", "springs", "time"):
        assert not validator.is_valid({name: value for name, value in good.items() if name != key})


def test_surface_whose_file_was_read_stays_valid(root: Path) -> None:
    # Sections that hold it validate it again.
    sheet = load_scene(root / "scenes" / "kidney.yaml").sheet
    assert sheet.surface is not None
    assert sheet.surface.file is not None
    assert Sheet(points=(2, 2), size=(1, 1), surface=sheet.surface).surface is sheet.surface


def test_changed_file_of_a_surface_is_read_again(tmp_path: Path) -> None:
    def heights() -> float:
        sheet = Sheet(points=(5, 5), size=(1, 1), surface={"height": {"file": str(tmp_path / "z.npy"), "unit": "mm"}})
        return float(rest_of(sheet).position[..., 2].max())

    for value in (1.0, 2.0, 2.0):
        np.save(tmp_path / "z.npy", np.full((3, 3), value))
        assert heights() == pytest.approx(value / 1000)


TISSUE = """\
sheet:
  points: [4, 5]
  size: [0.3, 0.4]
tissue:
  young: 3.0e+4
  thickness: 0.003
  density: 1050
  foundation: 10
time:
  duration: 0.4
output: []
"""


@pytest.mark.parametrize(
    ("key", "text", "number"),
    [
        ("young", "30 kPa", "write 3.0e+4, the number in Pa"),
        ("young", "0.03MPa", "write 3.0e+4, the number in Pa"),
        ("young", "3,0e4", "write 3.0e+4, with a point"),
        ("young", '"3.0e4"', "write 3.0e+4, without quotes"),
        ("thickness", "3 mm", "write 0.003, the number in metres"),
        ("thickness", "0,003", "write 0.003, with a point"),
        ("density", "1,050", "write 1050 or 1.050,"),
        ("density", "1.05 g/cm3", "write 1050, the number in kg/m3"),
        ("density", "10 N", "write the number alone, in SI units"),
        ("foundation", "30 kPa", "write the number alone, in SI units"),
        ("young", "1.2.3", "expected a number above 0, in Pa"),
        ("young", "soft", "expected a number above 0, in Pa"),
    ],
)
def test_number_to_write(key: str, text: str, number: str, load: Load, message: Messages) -> None:
    with message.raises(SceneError, f"tissue.{key}: ", number):
        load("\n".join(f"  {key}: {text}" if line.startswith(f"  {key}:") else line for line in TISSUE.splitlines()))


SINGLE_FAULTS = {
    "list without dashes": (GOOD + PROBE.replace("  - force", "    force"), "begin each item with a dash: - force: "),
    "path in double quotes": (GOOD + 'image: "C:\\Users\\a.png"\n', "single quotes, or write it with forward slashes"),
    "another path": (GOOD + 'image: "D:\\pictures\\a.png"\n', "single quotes, or write it with forward slashes"),
    "misspelt key": (TISSUE.replace("young", "yuong"), "tissue.yuong: unknown key; did you mean 'young'?"),
    "misspelt section": (TISSUE.replace("tissue:", "tisue:"), "tisue: unknown key; did you mean 'tissue'?"),
    "misspelt sheet": (TISSUE.replace("sheet:", "shete:"), "shete: unknown key; did you mean 'sheet'?"),
    "surface as a text": (TISSUE.replace("size: [0.3, 0.4]", "surface: depth.png"), 'sheet.surface: "depth.png" is'),
    "misspelt kind of surface": (
        TISSUE.replace("size: [0.3, 0.4]", "surface: {dpeth: {file: d.png, unit: mm}}"),
        "sheet.surface.dpeth: unknown key; did you mean 'depth'?",
    ),
}


@pytest.mark.parametrize("name", SINGLE_FAULTS)
def test_one_fault_is_one_error(name: str, load: Load, message: Messages) -> None:
    text, expected = SINGLE_FAULTS[name]
    with message.raises(SceneError, expected, hide=PYYAML_TEXT) as caught:
        load(text + ("render: {camera: {fov: 60}}\n" if "surface" in name else ""))
    assert len(caught.value.lines) == 1


def test_yaml_1_1_reads_the_numbers_of_shipped_scenes(root: Path) -> None:
    """PyYAML's safe_load, by YAML 1.1, and this parser, by YAML 1.2, give equal data."""
    shipped = [path for folder in ("scenes", "examples", "docs") for path in sorted((root / folder).rglob("*.yaml"))]
    assert len(shipped) > 15
    for path in shipped:
        text = path.read_text(encoding="utf-8")
        assert yaml.safe_load(text) == read_yaml(text).data, path
