from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from PIL import Image

from taichi_msm.errors import SceneError, printable
from taichi_msm.load.scene_file import MAX_LINES, load_scene, parse_override, schema
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PROBES
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

# The words of a parser of YAML, which depend on its version.
OF_PYYAML = r"(?<=not valid YAML: )[^;\n]*"


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
        ("sheet.fixed=[rigt]", True),
        ("render.camera=tpo", True),
        ("output=[png, gfi]", True),
        ("time.step=atuo", True),
        ("sheet.fixed=all", False),
        ("sheet.fixed=[boarder]", False),
        ("output=png", False),
    ],
)
def test_only_a_similar_word_that_is_allowed_there_is_suggested(
    override: str, similar: bool, load: Load, message: Messages
) -> None:
    with message.raises(SceneError, override.partition("=")[0], "is not allowed") as caught:
        load(GOOD, [override])
    assert ("did you mean" in str(caught.value)) == similar


def test_a_scene_and_its_defaults(load: Load) -> None:
    scene = load(GOOD)
    assert (scene.sheet.points, scene.sheet.mass, scene.time.frames) == ((4, 5), 1e-3, 10)
    assert (scene.sheet.fixed, scene.probes, scene.render.camera) == ("border", (), "top")


def test_frames_are_counted_in_spite_of_rounding(load: Load) -> None:
    assert 0.29 * 100 < 29
    assert load(GOOD.replace("duration: 0.4", "duration: 0.29\n  frames_per_second: 100")).time.frames == 29


# Texts of a scene, and place and key of each fault.
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
    "missing in an item of a list": (GOOD + "probes:\n  - at: [0, 0]\n", "12:5: probes.0.force"),
    "duplicate": (GOOD.replace("size:", "mass: 1\n  size:"), "5:3: sheet.mass"),
    "key that is no text": (GOOD + "1: x\n", "11:1: 1"),
    "key that is a list": (GOOD + "? [a]\n: x\n", "11:3"),
    "merge key": (GOOD + "<<: {damping: 1}\n", "11:1: <<"),
    "on, which is text in YAML 1.2": (GOOD + "on: 1\n", "11:1: on"),
    "long key": (GOOD + f"{'k' * 900}: 1\n", f"11:1: {'k' * 60}..."),
    "key with a line break": (GOOD + '"a\\nb": 1\n', "11:1: a\\nb"),
    "mass 0": (GOOD.replace("1.0e-3", "0"), "4:3: sheet.mass: 0"),
    "number as text": (GOOD.replace("1.0e-3", "'1'"), '4:3: sheet.mass: "1"'),
    "nothing": (GOOD.replace("1.0e-3", ""), "4:3: sheet.mass"),
    "infinite by its exponent": (GOOD + "damping: 1e999\n", "11:1: damping: Infinity"),
    "not a number": (GOOD + "damping: .nan\n", "11:1: damping: NaN"),
    "too large": (GOOD + "damping: 1e31\n", "11:1: damping: 1e+31"),
    "too small": (GOOD.replace("1.0e-3", "1e-31"), "4:3: sheet.mass: 1e-31"),
    "more digits than Python reads": (GOOD + f"damping: {'1' * 5000}\n", '11:1: damping: "1'),
    "item of a list": (GOOD.replace("[4, 5]", "[4, 1]"), "2:15: sheet.points.1: 1"),
    "short list": (GOOD.replace("[4, 5]", "[4]"), "2:3: sheet.points: [4]"),
    "short list with a wrong item": (GOOD.replace("[4, 5]", "[1]"), "2:12: sheet.points.0: 1"),
    "section that is none": (
        GOOD.replace(SPRINGS, "springs: 3\n"),
        "5:1: springs: 3",
    ),
    "long value": (GOOD + f"region: {'x' * 100}\n", '11:1: region: "x'),
    "control character": (GOOD + 'render: {shading: "\\e[31m"}\n', '11:10: render.shading: "\\u001b[31m"'),
    "yes, which is text in YAML 1.2": (GOOD + "render: {wireframe: yes}\n", '11:10: render.wireframe: "yes"'),
    "instrument without a direction": (
        GOOD + "probes: [{force: [0, 0, 1], instrument: {radius: 0.01, shaft: [0, 0, 0], length: 0.1}}]\n",
        "11:56: probes.0.instrument.shaft",
    ),
    "too many probes": (GOOD + "probes:\n" + "  - {force: [0, 0, 1]}\n" * (MAX_PROBES + 1), "11:1: probes"),
    "nothing to draw": (GOOD.replace("[]", "[png]"), "1:1: image"),
    "image without a name": (GOOD + "image: ''\n", '11:1: image: ""'),
    "image of a name that no file can have": (GOOD + 'image: "a\\0b"\n', "11:1: image"),
    "image of a name longer than any path": (GOOD + f"image: {'../' * 300_000}\n", "11:1: image"),
    "camera, a word": (GOOD + "render: {camera: side}\n", '11:10: render.camera: "side"'),
    "camera, a number in it": (GOOD + "render: {camera: {eye: [0, 0, z]}}\n", "11:19: render.camera.eye"),
    "at, one of two numbers": (GOOD + PROBE.replace("0.5, 0.5", "0.5, x"), "13:5: probes.0.at"),
    "at, no key": (GOOD + PROBE.replace("0.5, 0.5", ""), "13:5: probes.0.at: []"),
    "at, a short key": (GOOD + PROBE.replace("0.5, 0.5", "[0, 0.5, 0.5], [1, 0.5]"), "13:25: probes.0.at.1"),
    "at, back in time": (GOOD + PROBE.replace("0.5, 0.5", "[1, 0, 0], [0, 0, 0]"), "13:21: probes.0.at.1"),
    "load, back in time": (GOOD + PROBE.replace("[1, 100]", "[1, 100], [0.5, 0]"), "14:30: probes.0.load.2"),
    "load, three at a time": (GOOD + PROBE.replace("[1, 100]", "[1, 1], [1, 2], [1, 3]"), "14:36: probes.0.load.3"),
    "load, empty": (GOOD + PROBE.replace("[0, 0], [1, 100]", ""), "14:5: probes.0.load: []"),
    "duration of a part of a frame": (GOOD.replace("0.4\noutput", "0.33\noutput"), "9:3: time.duration: 0.33"),
    "duration of too many frames": (GOOD.replace("0.4\noutput", "8e7\noutput"), "9:3: time.duration: 80000000"),
    "step above the limit": (GOOD.replace("duration", "step: 0.02\n  duration"), "9:3: time.step: 0.02"),
    "eye in the target": (GOOD + "render: {camera: {eye: [0, 0, 0]}}\n", "11:19: render.camera.eye"),
    "below two sections": (
        GOOD.replace("duration", "step: 0.02\n  duration").replace("[]", "[png]") + "render: {sizes: 1}\n",
        "1:1: image",
        "9:3: time.step",
        "12:10: render.sizes",
    ),
    # Checks across sections leave out the sections that are wrong.
    "image, needed and wrong": (GOOD.replace("[]", "[png]") + "image: 3\n", "11:1: image: 3"),
    "output that may need an image": (GOOD.replace("[]", "[pngs]"), '10:10: output.0: "pngs"'),
}


@pytest.mark.parametrize("name", FAULTS)
def test_errors(name: str, load: Load, message: Messages) -> None:
    text, *places = FAULTS[name]
    with message.raises(SceneError) as caught:
        load(text)
    for line, place in zip(str(caught.value).splitlines(), places, strict=True):
        assert line.startswith(f"s.yaml:{place}")


@pytest.mark.parametrize(
    ("text", "place"),
    [
        pytest.param("", "1:1", id="empty"),
        pytest.param("- a\n", '1:1: ["a"]', id="list"),
        pytest.param("just text", '1:1: "just text"', id="text"),
        pytest.param("a: b\0", "1:5: character U+0000", id="null"),
        pytest.param("a: 1\nb: \x1b[0m", "2:4: character U+001B", id="escape"),
        pytest.param("a: 1 # \u2028b", "1:8: character U+2028", id="line separator"),
        pytest.param("é: 1\nü: ".encode() + b"\xfc", "2:4", id="Latin-1"),
        pytest.param(b"\xef\xbb\xbfa: \xfc", "1:4", id="Latin-1 after a byte-order mark"),
        pytest.param(GOOD.encode("utf-16"), "1:1", id="UTF-16"),
        pytest.param(GOOD.encode("utf-16-le"), "1:2: character U+0000", id="UTF-16 of low bytes first"),
        pytest.param("a:\n " + "[" * 21 + "]" * 21, "2:22", id="nested lists"),
        # libyaml's own limit, which it reaches before it gives the first event.
        pytest.param("a: " + "[" * 20_000, "1:1003", id="limit of libyaml"),
        pytest.param("? " * 1000, "1:3", id="nested keys"),
        pytest.param("a: {{ b }}\n", "1:5", id="template"),
        pytest.param("[" + "1," * 100_000 + "]", "1:200000", id="many values"),
        pytest.param("a" * (2**20 + 1), "", id="large"),
        # Not valid YAML.
        pytest.param("a: [1, 2\nb: 3\n", "2:2", id="open list"),
        pytest.param("a:\n  x: 1\n  b 3\n  c: 4\n", "3:3", id="no colon"),
        pytest.param("a:\n  b 3\n  c: 4\n", "3:4", id="no colon in the line before"),
        pytest.param("a: 1\nsheet", "2:1", id="no colon at the end"),
        pytest.param("a: 'x\n", "2:1", id="open quote"),
        pytest.param('a: "\\U00110000"\n', "1:", id="no character"),
        pytest.param("sheet:\n\tmass: 1\n", "2:1", id="tab"),
    ],
)
def test_unreadable_files(load: Load, text: str | bytes, place: str, message: Messages) -> None:
    with message.raises(SceneError, f"s.yaml:{place}", hide=OF_PYYAML) as caught:
        load(text)
    assert len(str(caught.value).splitlines()) == 1


def test_what_yaml_has_and_scenes_do_not(load: Load, message: Messages) -> None:
    text = GOOD.replace("1.0e-3", "&m 1.0e-3").replace("0.4\noutput", "!!float 0.4\noutput")
    places = "4:9: sheet.mass", "9:13: time.duration", "11:10: damping", "12:5: <<", "13:8: image", "14:1: "
    with message.raises(SceneError, *places):
        load(text + "damping: *m\n<<: *m\nimage: !!python/object/apply:os.getcwd []\n---\nmore: 1\n")


@pytest.mark.usefixtures("load")
def test_a_huge_file_is_not_read(message: Messages) -> None:
    with Path("huge.yaml").open("wb") as file:
        file.truncate(10**10)
    with message.raises(SceneError, "huge.yaml"):
        load_scene("huge.yaml")


def test_a_billion_laughs_stay_small(load: Load) -> None:
    text = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 20))
    before = time.perf_counter()
    with pytest.raises(SceneError, match=r"s\.yaml:1:5: a0: .*&a0"):
        load(text)
    assert time.perf_counter() - before < 1


@pytest.mark.default_cases("probes")
@pytest.mark.parametrize(
    "text",
    [
        "".join(f"k{n}: 1\n" for n in range(49_900)),
        "k: 1\n" * 49_900,
        GOOD.replace("[]", "[" + "x," * 99_000 + "]"),
        GOOD + "probes:\n" + "- {}\n" * 49_000,
    ],
    ids=["unknown", "duplicates", "outputs", "probes"],
)
def test_a_large_wrong_file_is_answered_soon_and_in_short(load: Load, text: str) -> None:
    before = time.process_time()
    with pytest.raises(SceneError) as caught:
        load(text)
    # 0.3 to 0.7 s on the machine that the limits were chosen on; the rest is for slower machines.
    assert time.process_time() - before < 3
    assert len(caught.value.lines) == MAX_LINES + 1
    assert caught.value.lines[-1] == "and more"


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        *(("1e4", 1e4), ("1.5E+2", 150.0), (".5", 0.5), ("5.", 5.0), ("-.inf", -math.inf), (".NaN", math.nan)),
        *(("+3", 3), ("010", 10), ("0o10", 8), ("0x1F", 31)),
        *(("true", True), ("FALSE", False), ("~", None), ("", None), ("NULL", None)),
        *((text, text) for text in ("yes", "No", "on", "OFF", "2026-01-01", "1:30", "1_000", "0b1", "nan", "tRue")),
        *((text, text) for text in ("<<", "=", ".", "e1", "+", "0o8", "1e", "inf", "1" * 101)),
        *(("'1e4'", "1e4"), ('"true"', "true")),
    ],
)
def test_scalars_follow_yaml_1_2(written: str, meant: object) -> None:
    assert repr(parse_override(f"k={written}").value) == repr(meant)


@pytest.mark.parametrize("name", ["photo.jpg", "PHOTO.PNG"])
def test_a_picture_in_the_place_of_a_scene(name: str, tmp_path: Path, message: Messages) -> None:
    (tmp_path / name).write_bytes(b"\x89PNG\xff\xd8")
    with message.raises(SceneError, name, "--image"):
        load_scene(tmp_path / name)


@pytest.mark.parametrize("encode", [str.encode, lambda text: b"\xef\xbb\xbf" + text.encode()], ids=["plain", "bom"])
@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["lf", "crlf"])
def test_encodings_and_line_ends(load: Load, encode: Callable[[str], bytes], end: str, message: Messages) -> None:
    assert load(encode(GOOD.replace("\n", end))).sheet.points == (4, 5)
    with message.raises(SceneError, "s.yaml:7:3: springs.shaer"):
        load(encode(GOOD.replace("shear", "shaer").replace("\n", end)))


def test_all_errors_come_at_once_and_in_order(load: Load, message: Messages) -> None:
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
    ["none.yaml", "./folder/../none.yaml", "folder", "pipe", "/dev/zero", "a\0b", "x" * 300],
    ids=["none", "none in a folder", "folder", "pipe", "device", "no path", "long"],
)
@pytest.mark.usefixtures("load")
def test_files_that_cannot_be_opened(name: str, message: Messages) -> None:
    Path("folder").mkdir()
    os.mkfifo("pipe")
    with message.raises(SceneError, name.replace("\0", "\\x00")):
        load_scene(name)


@pytest.mark.parametrize("name", ["scene.yml", "scene"])
def test_a_scene_of_another_suffix_is_suggested(name: str, tmp_path: Path, message: Messages) -> None:
    (tmp_path / "scene.yaml").touch()
    with message.raises(SceneError, "/scene.yaml"):
        load_scene(tmp_path / name)


def test_all_files_of_a_scene_that_are_missing_are_named_at_once(load: Load, message: Messages) -> None:
    map_ = "map: {image: map.png, range: [1, 2]}"
    cameras = "cameras: {left: {calibration: left.yml, poses: left.txt}, right: {beside: left, calibration: right.yml}}"
    text = GOOD.replace("shear: 20", map_) + f"image: none.png\nrender: {{{cameras}}}\n"
    with message.raises(SceneError) as caught:
        load(text)
    for line, name in zip(
        caught.value.lines, ("map.png", "none.png", "left.yml", "left.txt", "right.yml"), strict=True
    ):
        assert f": {name}: no such file" in line


def test_a_trajectory_that_is_shorter_than_the_run_is_named(load: Load, message: Messages) -> None:
    Path("poses.txt").write_text("0 0 0 1 0 0 0 1\n0.3 0 0 1 0 0 0 1\n")
    with message.raises(SceneError, "s.yaml:12:12: render.camera.poses: poses.txt: covers"):
        load(GOOD + "render:\n  camera: {poses: poses.txt}\n")


def test_overrides(load: Load) -> None:
    overrides = ["sheet.points=[6, 7]", "probes.0.load=[[0, 100]]", "probes.0.force.2=9", "damping=1e-2"]
    scene = load(GOOD + PROBE, overrides)
    assert (scene.sheet.points, scene.sheet.size, scene.damping) == ((6, 7), (0.3, 0.4), 0.01)
    assert (scene.probes[0].load, scene.probes[0].force) == (((0, 100),), (0, 0, 9))
    scene = load(GOOD, {"sheet.points": (6, 7), "probes": [{"force": [0, 0, 1]}], "probes.0.falloff": 3})
    assert (scene.sheet.points, scene.probes[0].falloff) == ((6, 7), 3)


def test_the_last_override_of_a_key_holds_and_may_mend_the_file(load: Load) -> None:
    assert load(GOOD, ["damping=1", "damping=2"]).damping == 2
    assert load(GOOD, ["render.camera.eye=[0, 0, 1]", "render={camera: top}"]).render.camera == "top"
    assert load(GOOD.replace("1.0e-3", "0"), ["sheet.mass=1"]).sheet.mass == 1


@pytest.mark.parametrize(
    ("overrides", "image"),
    [
        pytest.param([f"image={'x' * 5000}"], "y" * 5000, id="value and image"),
        pytest.param([f"sheet.points=[{'1, ' * 5000}1]"], None, id="list"),
        pytest.param([f"image{'.a' * 60_000}=1"], None, id="key"),
    ],
)
def test_a_long_override_is_named_in_short(
    overrides: list[str], image: str | None, load: Load, message: Messages
) -> None:
    with message.raises(SceneError) as caught:
        load(GOOD, overrides, image=image)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("overrides", "place"),
    [
        (["springs.shaer=3"], "springs.shaer"),
        (["sheet.mass="], "sheet.mass"),
        (["render.camera={fov: 30}"], "render.camera.eye"),
        (["probes.0.load.1=[-1, 0]"], "probes.0.load.1"),
        (["probes.1.offset=1"], "probes.1"),
        (["probes.first.offset=1"], "probes.first"),
        (["probes=[]", "probes.0.load=[[0, 1]]"], "probes.0"),
        (["damping.x=1"], "damping"),
        (["damping"], ""),
        (["=1"], ""),
        ([" damping = -1"], "damping"),
        (["damping={a: 1, a: 2}"], "damping.a"),
        (["damping=[1"], "damping"),
        (["\udcff=1"], ""),
        (["image=\udcff"], "image"),
        (["damping=a\nb\0"], "damping"),
        (["render.camera.fov=30", "render={camera: {fov: x, eye: [0, 0, 1]}}"], "render.camera.fov"),
        ({"\udcff": 1}, ""),
        ({"image": "\udcff"}, "image"),
        ({"sheet.mass": 0}, "sheet.mass"),
        ({"sheet.mass": {1, 2}}, "sheet.mass"),
    ],
    ids=ascii,
)
def test_errors_in_overrides(load: Load, overrides: Any, place: str, message: Messages) -> None:
    """Each is in one line, that of the override that is wrong."""
    with message.raises(SceneError, hide=OF_PYYAML) as caught:
        load(GOOD + PROBE + "damping: 0.5\n", overrides)
    (line,) = str(caught.value).splitlines()
    last = f"--set {overrides[-1]}: {place}" if isinstance(overrides, list) else f"override {next(iter(overrides))}"
    assert line.startswith(printable(last))


def test_an_override_is_split_at_its_first_equals_sign() -> None:
    assert parse_override("a.b=3")[1:3] == (("a", "b"), 3)
    assert parse_override("probes.0.load=[[0, 1e2]]")[1:3] == (("probes", 0, "load"), [[0, 100.0]])
    assert parse_override("image=a=b.png")[1:3] == (("image",), "a=b.png")
    # Python refuses to read integers of so many digits.
    assert parse_override(f"{'9' * 5000}=1")[1:3] == (("9" * 5000,), 1)


def test_the_image_is_relative_to_the_scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    ["../secret.png", "deep/../../secret.png", "{absolute}", "link.png", "away/secret.png"],
    ids=["above", "above below", "absolute", "link", "link of a folder"],
)
def test_a_scene_sees_no_picture_outside_its_folder(
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


def test_a_scene_sees_what_links_in_its_folder_lead_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder itself may be a link, and a picture may be one to its neighbour."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "link").symlink_to("scenes")
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (4, 3)).save("scenes/own.png")
    Path("scenes/same.png").symlink_to("own.png")
    Path("scenes/s.yaml").write_text(GOOD + "image: same.png\n")
    assert load_scene("link/s.yaml").image == str(Path("link/same.png"))


def test_a_region_of_the_image(load: Load, message: Messages) -> None:
    Image.new("RGB", (40, 30)).save("a.png")
    text = GOOD + "image: a.png\nregion: "
    assert load(text + "[0, 0, 40, 30]").region == (0, 0, 40, 30)
    with message.raises(SceneError, "s.yaml:12:1: region"):
        load(text + "[1, 0, 40, 30]")


@pytest.mark.parametrize("escape", ["\\ud800", "\\U00110000"], ids=["surrogate", "large"])
def test_escapes_of_what_is_no_character(load: Load, escape: str, message: Messages) -> None:
    with message.raises(SceneError, "s.yaml:11:", hide=OF_PYYAML):
        load(f'{GOOD}"{escape}": 1\n')


@pytest.mark.parametrize("value", ["1e30", "1e-30", "-1e30", "0"])
def test_no_number_brings_up_any_other_error(load: Load, value: str) -> None:
    whole = load(GOOD + PROBE + "render: {camera: {eye: [0, 0, 1]}, size: [64, 64]}\nregion: [0, 0, 4, 3]\n")
    count = 0
    for key in number_keys(whole.model_dump(mode="json")):
        for overrides in ([f"{key}={value}"], [f"{key}={value}", "time.step=0.01"]):
            try:
                load(GOOD + PROBE, overrides)
            except SceneError:
                count += 1
    assert count > 0


def number_keys(value: Any, above: tuple[str, ...] = ()) -> list[str]:
    """Name every number of a scene."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        return [key for name, part in parts for key in number_keys(part, (*above, str(name)))]
    return [".".join(above)] if isinstance(value, int | float) else []


@pytest.fixture
def validator() -> jsonschema.Draft202012Validator:
    described = schema()
    jsonschema.Draft202012Validator.check_schema(described)
    return jsonschema.Draft202012Validator(described)


def test_the_schema_accepts_what_the_loader_accepts(load: Load, validator: jsonschema.Draft202012Validator) -> None:
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
            # With every key, and with those alone that were given.
            for short in (False, True):
                data = (
                    made.model_dump(mode="json", exclude_unset=short, exclude_none=True)
                    | sections[seed % len(sections)]
                )
                load(json.dumps(data))
                validator.validate(data)
    for text in (GOOD, GOOD + PROBE, GOOD + "image:\nregion: null\nrender: {}\n"):
        load(text)
        validator.validate(parse_override(f"scene={text}").value)


def test_the_schema_rejects_what_is_wrong(validator: jsonschema.Draft202012Validator) -> None:
    good = parse_override(f"scene={GOOD}").value
    assert validator.is_valid(good)
    wrong: dict[str, Any]
    for wrong in (
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
        assert not validator.is_valid(good | wrong), wrong
    for key in ("sheet", "springs", "time"):
        assert not validator.is_valid({name: value for name, value in good.items() if name != key})
