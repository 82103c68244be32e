from __future__ import annotations

import json
import math
import os
import random
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from PIL import Image

from taichi_msm.errors import SceneError
from taichi_msm.load import yaml_reader
from taichi_msm.load.scene_file import MAX_LINES, load_scene, parse_override, schema
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PROBES

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
PROBE = """\
probes:
  - force: [0, 0, 1]
    at: [0.5, 0.5]
    load: [[0, 0], [1, 100]]
"""

ROOT_KEYS = "image, region, sheet, tissue, springs, damping, probes, time, render, output"
NO_FORCE = (
    "missing; expected total (whole tool) or, with springs, force (one point): [x, y, z] in newtons; or path, for a "
    "tool that is moved"
)
POINTS = "expected two whole numbers, 2 to 4096: [rows, cols]"
A_PROBE_KEY = "expected keys [[t, percent], ...], t in seconds"
AN_AT = "expected [across, down], fractions from -1 to 2, or keys [[t, across, down], ...]"
A_CAMERA = (
    "expected top, oblique, or a mapping: {eye: [x, y, z], target: [x, y, z], up: [x, y, z], fov: degrees}, with pose "
    "or poses in place of eye, and intrinsics or calibration in place of fov"
)
VECTOR_M = "expected three numbers: [x, y, z] in metres"
EYE = f"{VECTOR_M}, or keys [[t, x, y, z], ...], t in seconds"
CAMERA_KEYS = "calibration, scale, intrinsics, distortion, outside, pose, poses, beside, baseline, eye, target, up, fov"
NO_PICTURE = "image: a picture is needed to draw png, gif or mp4; name one, or set output to [trajectory] or []"

Load = Callable[..., Scene]

# The kinds of output, as errors list them.
OUTPUTS = (
    "png, gif, mp4, trajectory, forces, coordinates, depth, normals, flow, occlusion, disparity, instrument, tracks"
)


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Load a text as the file s.yaml of the current directory."""
    monkeypatch.chdir(tmp_path)

    def load(text: str | bytes, *arguments: Any, **named: Any) -> Scene:
        Path("s.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
        return load_scene("s.yaml", *arguments, **named)

    return load


def lines(load: Load, *arguments: Any, **named: Any) -> list[str]:
    with pytest.raises(SceneError) as caught:
        load(*arguments, **named)
    return list(caught.value.lines)


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("sheet.fixed=boarder", "border"),
        ("sheet.fixed=[rigt]", "right"),
        ("springs.virtual_active=load", "loaded"),
        ("render.camera=tpo", "top"),
        ("render.shading=Headlght", "headlight"),
        ("output=[png, gfi]", "gif"),
        ("time.step=atuo", "auto"),
        ("time.precision=f23", "f32"),
    ],
)
def test_a_word_like_one_that_is_allowed_is_asked_about(override: str, meant: str, load: Load) -> None:
    (line,) = lines(load, GOOD, [override])
    assert line.endswith(f"; did you mean '{meant}'?")
    assert "is not allowed; expected " in line


@pytest.mark.parametrize("override", ["sheet.fixed=all", "sheet.fixed=[boarder]", "output=png", "time.step=[auto]"])
def test_a_value_like_no_word_that_is_allowed_there_is_only_refused(override: str, load: Load) -> None:
    (line,) = lines(load, GOOD, [override])
    assert "is not allowed; expected " in line
    assert "did you mean" not in line


def test_a_scene_and_its_defaults(load: Load) -> None:
    scene = load(GOOD)
    assert scene.sheet.points == (4, 5)
    assert scene.sheet.mass == 1e-3
    assert scene.sheet.fixed == "border"
    assert scene.time.frames == 10
    assert scene.probes == ()
    assert scene.render.camera == "top"


def test_frames_are_counted_in_spite_of_rounding(load: Load) -> None:
    assert 0.29 * 100 < 29
    assert load(GOOD.replace("duration: 0.4", "duration: 0.29\n  frames_per_second: 100")).time.frames == 29


WRONG_KEYS = {
    "unknown, with a near one": (
        GOOD.replace("shear", "shaer"),
        ["s.yaml:7:3: springs.shaer: unknown key; did you mean 'shear'?"],
    ),
    "unknown, with none near": (
        GOOD + "xyz: 1\n",
        [f"s.yaml:11:1: xyz: unknown key; allowed: {ROOT_KEYS}"],
    ),
    "unknown, in a flow mapping of a list": (
        GOOD + "probes: [{force: [0, 0, 1], fallof: 3}]\n",
        ["s.yaml:11:29: probes.0.fallof: unknown key; did you mean 'falloff'?"],
    ),
    "unknown, in a camera": (
        GOOD + "render: {camera: {eye: [0, 0, 1], uup: [0, 1, 0]}}\n",
        ["s.yaml:11:35: render.camera.uup: unknown key; did you mean 'up'?"],
    ),
    "unknown and named as the kind of value": (
        GOOD + "render: {camera: {Camera: {eye: 1}}}\n",
        [
            f"s.yaml:11:10: render.camera.eye: missing; {EYE}",
            f"s.yaml:11:19: render.camera.Camera: unknown key; allowed: {CAMERA_KEYS}",
        ],
    ),
    "missing": (
        GOOD.replace("  mass: 1.0e-3\n", ""),
        ["s.yaml:1:1: sheet.mass: missing; with springs expected a number above 0, in kg"],
    ),
    "missing section": (
        GOOD.replace("time:\n  duration: 0.4\n", ""),
        ["s.yaml:1:1: time: missing; expected a mapping with at least duration"],
    ),
    "missing in an item of a list": (
        GOOD + "probes:\n  - at: [0, 0]\n",
        [f"s.yaml:12:5: probes.0.force: {NO_FORCE}"],
    ),
    "missing in a camera": (
        GOOD + "render:\n  camera: {fov: 30}\n",
        [f"s.yaml:12:3: render.camera.eye: missing; {EYE}"],
    ),
    "duplicate": (
        GOOD.replace("size:", "mass: 1\n  size:"),
        ["s.yaml:5:3: sheet.mass: given twice, first in line 3; keep one"],
    ),
    "duplicate section, whose keys are not mixed with the first": (
        GOOD + "time:\n  step: 1\n",
        ["s.yaml:11:1: time: given twice, first in line 8; keep one"],
    ),
    "not text": (
        GOOD + "1: x\n",
        ["s.yaml:11:1: 1: a key must be text; put it in quotes"],
    ),
    "not text but a list": (
        GOOD + "? [a]\n: x\n",
        ["s.yaml:11:3: a key must be text; put it in quotes"],
    ),
    "merge key": (
        GOOD + "<<: {damping: 1}\n",
        [f"s.yaml:11:1: <<: unknown key; allowed: {ROOT_KEYS}"],
    ),
    "on, which is text in YAML 1.2": (
        GOOD + "on: 1\n",
        [f"s.yaml:11:1: on: unknown key; allowed: {ROOT_KEYS}"],
    ),
    "long": (
        GOOD + f"{'k' * 900}: 1\n",
        [f"s.yaml:11:1: {'k' * 60}...: unknown key; allowed: {ROOT_KEYS}"],
    ),
    "with a line break": (
        GOOD + '"a\\nb": 1\n',
        [f"s.yaml:11:1: a\\nb: unknown key; allowed: {ROOT_KEYS}"],
    ),
}

WRONG_VALUES = {
    "mass 0": (
        GOOD.replace("1.0e-3", "0"),
        ["s.yaml:4:3: sheet.mass: 0 is not allowed; expected a number above 0, in kg"],
    ),
    "mass in a flow mapping": (
        "sheet: {points: [4, 5], size: [1, 1], mass: -1}\n" + GOOD[GOOD.index("springs") :],
        ["s.yaml:1:39: sheet.mass: -1 is not allowed; expected a number above 0, in kg"],
    ),
    "number as text": (
        GOOD.replace("1.0e-3", "'1'"),
        ['s.yaml:4:3: sheet.mass: "1" is not allowed; expected a number above 0, in kg'],
    ),
    "number as truth": (
        GOOD + "damping: true\n",
        ["s.yaml:11:1: damping: true is not allowed; expected a number, 0 or more, in N s/m"],
    ),
    "negative": (
        GOOD + "damping: -1\n",
        ["s.yaml:11:1: damping: -1 is not allowed; expected a number, 0 or more, in N s/m"],
    ),
    "nothing": (
        GOOD.replace("1.0e-3", ""),
        ["s.yaml:4:3: sheet.mass: missing; with springs expected a number above 0, in kg"],
    ),
    "infinite": (
        GOOD + "damping: .inf\n",
        ["s.yaml:11:1: damping: Infinity is not allowed; expected a number, 0 or more, in N s/m"],
    ),
    "infinite by its exponent": (
        GOOD + "damping: 1e999\n",
        ["s.yaml:11:1: damping: Infinity is not allowed; expected a number, 0 or more, in N s/m"],
    ),
    "not a number": (
        GOOD + "damping: .nan\n",
        ["s.yaml:11:1: damping: NaN is not allowed; expected a number, 0 or more, in N s/m"],
    ),
    "too large": (
        GOOD + "damping: 1e31\n",
        ["s.yaml:11:1: damping: 1e+31 is out of range; numbers are from 1e-30 to 1e+30 in size"],
    ),
    "too small": (
        GOOD.replace("1.0e-3", "1e-31"),
        ["s.yaml:4:3: sheet.mass: 1e-31 is out of range; numbers are from 1e-30 to 1e+30 in size"],
    ),
    "more digits than Python reads": (
        GOOD + f"damping: {'1' * 5000}\n",
        [f's.yaml:11:1: damping: "{"1" * 59}... is not allowed; expected a number, 0 or more, in N s/m'],
    ),
    "item of a list": (
        GOOD.replace("[4, 5]", "[4, 1]"),
        [f"s.yaml:2:15: sheet.points.1: 1 is not allowed; {POINTS}"],
    ),
    "not a whole number": (
        GOOD.replace("[4, 5]", "[4, 5.0]"),
        [f"s.yaml:2:15: sheet.points.1: 5.0 is not allowed; {POINTS}"],
    ),
    "short list": (
        GOOD.replace("[4, 5]", "[4]"),
        [f"s.yaml:2:3: sheet.points: [4] is not allowed; {POINTS}"],
    ),
    "short list with a wrong item": (
        GOOD.replace("[4, 5]", "[1]"),
        [f"s.yaml:2:12: sheet.points.0: 1 is not allowed; {POINTS}"],
    ),
    "long list": (
        GOOD.replace("[4, 5]", "[4, 5, 6]"),
        [f"s.yaml:2:3: sheet.points: [4, 5, 6] is not allowed; {POINTS}"],
    ),
    "section that is none": (
        GOOD.replace("springs:\n  structural: 20\n  shear: 20\n", "springs: 3\n"),
        ["s.yaml:5:1: springs: 3 is not allowed; expected a mapping with structural, shear, virtual"],
    ),
    "long value, cut": (
        GOOD + f"region: {'x' * 100}\n",
        [
            f's.yaml:11:1: region: "{"x" * 59}... is not allowed; '
            "expected four whole numbers: [x, y, width, height] in pixels"
        ],
    ),
    "text with a control character": (
        GOOD + 'render: {shading: "\\e[31m"}\n',
        ['s.yaml:11:10: render.shading: "\\u001b[31m" is not allowed; expected none, headlight or tissue'],
    ),
    "yes, which is text in YAML 1.2": (
        GOOD + "render: {wireframe: yes}\n",
        ['s.yaml:11:10: render.wireframe: "yes" is not allowed; expected true or false'],
    ),
    "item of a list that may be left out": (
        GOOD + "region: [0, 0, 1.5, 1]\n",
        ["s.yaml:11:16: region.2: 1.5 is not allowed; expected four whole numbers: [x, y, width, height] in pixels"],
    ),
    "one output without a list": (
        GOOD.replace("[]", "png"),
        [f's.yaml:10:1: output: "png" is not allowed; expected a list of {OUTPUTS}'],
    ),
    "unknown output": (
        GOOD.replace("[]", "[trajectory, avi]"),
        [f's.yaml:10:22: output.1: "avi" is not allowed; expected a list of {OUTPUTS}'],
    ),
    "an instrument without a direction": (
        GOOD + "probes: [{force: [0, 0, 1], instrument: {radius: 0.01, shaft: [0, 0, 0], length: 0.1}}]\n",
        ["s.yaml:11:56: probes.0.instrument.shaft: has no direction; take one such as [0.3, -0.5, 1]"],
    ),
    "light beyond its range": (
        GOOD + "render: {shading: tissue, light: {ambient: 2}}\n",
        ["s.yaml:11:35: render.light.ambient: 2 is not allowed; expected a number, 0 to 1"],
    ),
    "tracks of no point": (
        GOOD + "render: {tracks: 0}\n",
        ["s.yaml:11:10: render.tracks: 0 is not allowed; expected a whole number, 1 to 256"],
    ),
    "too many probes": (
        GOOD + "probes:\n" + "  - {force: [0, 0, 1]}\n" * (MAX_PROBES + 1),
        [
            's.yaml:11:1: probes: [{"force": [0, 0, 1]}, {"force": [0, 0, 1]}, {"force": [0, 0... '
            "is not allowed; expected a list of at most 16 mappings with at, total or force, load, or with path "
            "and instrument"
        ],
    ),
    "nothing to draw": (GOOD.replace("[]", "[png]"), [f"s.yaml:1:1: {NO_PICTURE}"]),
    "image without a name": (
        GOOD + "image: ''\n",
        ['s.yaml:11:1: image: "" is not allowed; expected the path of a picture'],
    ),
    "image of a name that no file can have": (
        GOOD + 'image: "a\\0b"\n',
        ["s.yaml:11:1: image: a\\x00b is not a path; name a picture"],
    ),
    "image of a name longer than any path": (
        GOOD + f"image: {'../' * 300_000}\n",
        [f's.yaml:11:1: image: "{"../" * 19}..... is not allowed; expected the path of a picture'],
    ),
}

SEVERAL_KINDS = {
    "fixed, neither word nor list": (
        GOOD.replace("points", "fixed: 3\n  points"),
        [
            "s.yaml:2:3: sheet.fixed: 3 is not allowed; "
            "expected border, corners, none, or a list of top, bottom, left, right"
        ],
    ),
    "fixed, an item of the list": (
        GOOD.replace("points", "fixed: [top, botom]\n  points"),
        [
            's.yaml:2:16: sheet.fixed.1: "botom" is not allowed; '
            "expected border, corners, none, or a list of top, bottom, left, right; did you mean 'bottom'?"
        ],
    ),
    "step, a word": (
        GOOD.replace("duration", "step: fast\n  duration"),
        ['s.yaml:9:3: time.step: "fast" is not allowed; expected auto, or a number above 0, in seconds'],
    ),
    "step, 0": (
        GOOD.replace("duration", "step: 0\n  duration"),
        ["s.yaml:9:3: time.step: 0 is not allowed; expected auto, or a number above 0, in seconds"],
    ),
    "camera, a word": (
        GOOD + "render: {camera: side}\n",
        [f's.yaml:11:10: render.camera: "side" is not allowed; {A_CAMERA}'],
    ),
    "camera, a number in it": (
        GOOD + "render: {camera: {eye: [0, 0, z]}}\n",
        [f's.yaml:11:19: render.camera.eye: [0, 0, "z"] is not allowed; {EYE}'],
    ),
    "at, one of two numbers": (
        GOOD + PROBE.replace("0.5, 0.5", "0.5, x"),
        [f's.yaml:13:5: probes.0.at: [0.5, "x"] is not allowed; {AN_AT}'],
    ),
    "at, one number": (
        GOOD + PROBE.replace("0.5, 0.5", "0.5"),
        [f"s.yaml:13:5: probes.0.at: [0.5] is not allowed; {AN_AT}"],
    ),
    "at, no key": (
        GOOD + PROBE.replace("0.5, 0.5", ""),
        [f"s.yaml:13:5: probes.0.at: [] is not allowed; {AN_AT}"],
    ),
    "at, in a key": (
        GOOD + PROBE.replace("0.5, 0.5", "[0, 0.5, 0.5], [1, 0.5, x]"),
        [f's.yaml:13:34: probes.0.at.1.2: "x" is not allowed; {AN_AT}'],
    ),
    "at, a short key": (
        GOOD + PROBE.replace("0.5, 0.5", "[0, 0.5, 0.5], [1, 0.5]"),
        [f"s.yaml:13:25: probes.0.at.1: [1, 0.5] is not allowed; {AN_AT}"],
    ),
    "at, back in time": (
        GOOD + PROBE.replace("0.5, 0.5", "[1, 0.5, 0.5], [0, 0.5, 0.5]"),
        ["s.yaml:13:25: probes.0.at.1: goes back in time, from 1 s to 0 s; sort the keys by time"],
    ),
}

LOADS_AND_TIMES = {
    "load, back in time": (
        GOOD + PROBE.replace("[1, 100]", "[1, 100], [0.5, 0]"),
        ["s.yaml:14:30: probes.0.load.2: goes back in time, from 1 s to 0.5 s; sort the keys by time"],
    ),
    "load, three at a time": (
        GOOD + PROBE.replace("[1, 100]", "[1, 1], [1, 2], [1, 3]"),
        ["s.yaml:14:36: probes.0.load.3: third key at 1 s; a jump is two keys at one time, so remove the middle one"],
    ),
    "load, empty": (
        GOOD + PROBE.replace("[0, 0], [1, 100]", ""),
        [f"s.yaml:14:5: probes.0.load: [] is not allowed; {A_PROBE_KEY}"],
    ),
    "load, in a key": (
        GOOD + PROBE.replace("[1, 100]", "[1, x]"),
        [f's.yaml:14:24: probes.0.load.1.1: "x" is not allowed; {A_PROBE_KEY}'],
    ),
    "duration of a part of a frame": (
        GOOD.replace("0.4\noutput", "0.33\noutput"),
        [
            "s.yaml:9:3: time.duration: 0.33 s x 25 frames per second = 8.25 frames, "
            "not a whole number up to 1e9; try 0.32"
        ],
    ),
    "duration of too many frames": (
        GOOD.replace("0.4\noutput", "8e7\noutput"),
        [
            "s.yaml:9:3: time.duration: 80000000 s x 25 frames per second = 2000000000 frames, "
            "not a whole number up to 1e9; try 40000000"
        ],
    ),
    "step above the limit": (
        GOOD.replace("duration", "step: 0.02\n  duration"),
        ["s.yaml:9:3: time.step: 0.02 s is above the stability limit 0.00408248 s; try 0.004, or auto"],
    ),
    "eye in the target": (
        GOOD + "render: {camera: {eye: [0, 0, 0]}}\n",
        ["s.yaml:11:19: render.camera.eye: [0.0, 0.0, 0.0] is also the target; move one of them"],
    ),
}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(*case, id=f"{table}: {name}")
        for table, cases in {
            "key": WRONG_KEYS,
            "value": WRONG_VALUES,
            "kinds": SEVERAL_KINDS,
            "time": LOADS_AND_TIMES,
        }.items()
        for name, case in cases.items()
    ],
)
def test_errors(load: Load, text: str, expected: list[str]) -> None:
    assert lines(load, text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "s.yaml:1:1: no keys; a scene needs at least sheet, tissue or springs, and time"),
        ("# later\n", "s.yaml:1:1: no keys; a scene needs at least sheet, tissue or springs, and time"),
        ("- a\n", 's.yaml:1:1: ["a"] is not a scene; expected keys such as sheet, tissue or springs, and time'),
        (
            "just text",
            's.yaml:1:1: "just text" is not a scene; expected keys such as sheet, tissue or springs, and time',
        ),
        ("a: b\0", "s.yaml:1:5: character U+0000 is not allowed; remove it"),
        ("a: 1\nb: \x1b[0m", "s.yaml:2:4: character U+001B is not allowed; remove it"),
        ("a: 1 # \u2028b", "s.yaml:1:8: character U+2028 is not allowed; remove it"),
        ("é: 1\nü: ".encode() + b"\xfc", "s.yaml:2:4: not UTF-8; save the file as UTF-8"),
        (b"\xef\xbb\xbfa: \xfc", "s.yaml:1:4: not UTF-8; save the file as UTF-8"),
        (GOOD.encode("utf-16"), "s.yaml:1:1: not UTF-8; save the file as UTF-8"),
        (GOOD.encode("utf-16-le"), "s.yaml:1:2: character U+0000 is not allowed; remove it"),
        (GOOD.encode("utf-16-be"), "s.yaml:1:1: character U+0000 is not allowed; remove it"),
        ("a:\n " + "[" * 21 + "]" * 21, "s.yaml:2:22: nested more than 20 deep; write it flatter"),
        ("- " * 1000, "s.yaml:1:43: nested more than 20 deep; write it flatter"),
        ("[" * 1000, "s.yaml:1:22: nested more than 20 deep; write it flatter"),
        # libyaml's own limit, which it reaches before it gives the first event.
        ("a: " + "[" * 20_000, "s.yaml:1:1003: nested more than 20 deep; write it flatter"),
        ("? " * 1000, "s.yaml:1:3: a key must be text; put it in quotes"),
        ("a: {{ b }}\n", "s.yaml:1:5: a key must be text; put it in quotes"),
        ("[" + "1," * 100_000 + "]", "s.yaml:1:200000: more than 100000 values; write fewer"),
        ("a" * (2**20 + 1), "s.yaml: larger than 1 MiB; a scene is smaller"),
    ],
)
def test_unreadable_files(load: Load, text: str | bytes, expected: str) -> None:
    assert lines(load, text) == [expected]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a: [1, 2\nb: 3\n", "s.yaml:2:2: not valid YAML: "),
        ("a: 1\n b: 2\n", "s.yaml:2:3: not valid YAML: "),
        ("a:\n  x: 1\n  b 3\n  c: 4\n", 's.yaml:3:3: no ":" in "b 3"; expected KEY: VALUE'),
        (
            "a:\n  b 3\n  c: 4\n",
            "s.yaml:3:4: not valid YAML: mapping values are not allowed in this context; write one KEY: VALUE a line, "
            "also in the line before",
        ),
        ("a: 1\nsheet", 's.yaml:2:1: no ":" in "sheet"; expected KEY: VALUE'),
        ("a: 'x\n", "s.yaml:2:1: not valid YAML: "),
        ('a: "\\U00110000"\n', "s.yaml:1:"),
        ("a: @x\n", "s.yaml:1:4: not valid YAML: "),
    ],
)
def test_syntax_errors_are_one_line(load: Load, text: str, place: str) -> None:
    (line,) = lines(load, text)
    assert line.startswith(place)


def test_tabs_are_named(load: Load) -> None:
    (line,) = lines(load, "sheet:\n\tmass: 1\n")
    assert line.startswith("s.yaml:2:1: not valid YAML: ")
    assert line.endswith("; indent with spaces, not tabs")


def test_what_yaml_has_and_scenes_do_not(load: Load) -> None:
    text = GOOD.replace("1.0e-3", "&m 1.0e-3").replace("0.4\noutput", "!!float 0.4\noutput")
    assert lines(load, text + "damping: *m\n<<: *m\n---\nmore: 1\n") == [
        "s.yaml:4:9: sheet.mass: anchor &m is not allowed; remove it",
        "s.yaml:9:13: time.duration: tag !!float is not allowed; remove it",
        "s.yaml:11:10: damping: alias *m is not allowed; write the value out",
        "s.yaml:12:5: <<: alias *m is not allowed; write the value out",
        "s.yaml:13:1: a second document begins here; keep one",
    ]


def test_the_first_thousand_faults_are_enough() -> None:
    assert len(yaml_reader.read_yaml("- *a\n" * 2000).faults) == yaml_reader.MAX_FAULTS


@pytest.mark.usefixtures("load")
def test_a_huge_file_is_not_read() -> None:
    with Path("huge.yaml").open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(SceneError, match=r"^huge\.yaml: larger than 1 MiB; a scene is smaller$"):
        load_scene("huge.yaml")


def test_no_object_is_made_of_a_tag(load: Load) -> None:
    assert lines(load, GOOD + "image: !!python/object/apply:os.getcwd []\n") == [
        "s.yaml:11:8: image: tag !!python/object/apply:os.getcwd is not allowed; remove it"
    ]


def test_a_billion_laughs_stay_small(load: Load) -> None:
    text = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 20))
    before = time.perf_counter()
    found = lines(load, text)
    assert time.perf_counter() - before < 1
    assert "s.yaml:1:5: a0: anchor &a0 is not allowed; remove it" in found


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
    found = lines(load, text)
    # 0.3 to 0.7 s on the machine that the limits were chosen on, and up to 4 s where PyYAML lacks its C parser; the
    # rest is for slower machines.
    assert time.process_time() - before < (3 if yaml.__with_libyaml__ else 20)
    assert len(found) == MAX_LINES + 1
    assert found[-1] == "and more"


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("1e4", 1e4),
        ("1.5E+2", 150.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("+3", 3),
        ("010", 10),
        ("0o10", 8),
        ("0x1F", 31),
        ("-.inf", -math.inf),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("NULL", None),
        *((text, text) for text in ("yes", "No", "on", "OFF", "2026-01-01", "1:30", "1_000", "0b1", "nan", "tRue")),
        *((text, text) for text in ("<<", "=", ".", "e1", "+", "0o8", "1e", "inf", "1" * 101)),
        ("'1e4'", "1e4"),
        ('"true"', "true"),
    ],
)
def test_scalars_follow_yaml_1_2(written: str, meant: object) -> None:
    value = parse_override(f"k={written}").value
    assert value == meant
    assert type(value) is type(meant)


def test_not_a_number_is_read() -> None:
    assert math.isnan(parse_override("k=.NaN").value)


@pytest.mark.parametrize("name", ["photo.jpg", "PHOTO.PNG"])
def test_a_picture_in_the_place_of_a_scene(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\x89PNG\xff\xd8")
    with pytest.raises(SceneError) as caught:
        load_scene(tmp_path / name)
    assert str(caught.value) == f"{tmp_path / name}: a picture; name a scene, and the picture by --image"


@pytest.mark.parametrize("encode", [str.encode, lambda text: b"\xef\xbb\xbf" + text.encode()], ids=["plain", "bom"])
@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["lf", "crlf"])
def test_encodings_and_line_ends(load: Load, encode: Callable[[str], bytes], end: str) -> None:
    assert load(encode(GOOD.replace("\n", end))).sheet.points == (4, 5)
    wrong = GOOD.replace("shear", "shaer").replace("\n", end)
    assert lines(load, encode(wrong)) == ["s.yaml:7:3: springs.shaer: unknown key; did you mean 'shear'?"]


def test_all_errors_come_at_once_and_in_order(load: Load) -> None:
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
    assert lines(load, text, ["render.size=[0, 1]", "damping"], image="other.png") == [
        f"s.yaml:2:5: probes.0.force: {NO_FORCE}",
        "s.yaml:2:21: probes.0.load.1: goes back in time, from 0 s to -1 s; sort the keys by time",
        f"s.yaml:4:12: sheet.points.0: 1 is not allowed; {POINTS}",
        "s.yaml:6:3: sheet.mass: 0 is not allowed; expected a number above 0, in kg",
        "s.yaml:7:27: springs.shaer: unknown key; did you mean 'shear'?",
        "s.yaml:8:1: springs: given twice, first in line 7; keep one",
        "s.yaml:11:1: region: [-1, 0, 4, 4] needs x and y of 0 or more, width and height above 0",
        f"s.yaml:12:1: extra: unknown key; allowed: {ROOT_KEYS}",
        "--set render.size=[0, 1]: render.size.0: 0 is not allowed; "
        "expected two whole numbers, 1 to 8192: [width, height] in pixels",
        "--set damping: expected KEY=VALUE, such as sheet.points=[61,61]",
        "--image other.png: image: other.png: no such file or directory; name a picture that can be read",
    ]


def test_checks_across_sections_run_on_the_sections_without_errors(load: Load) -> None:
    text = GOOD.replace("duration", "step: 0.02\n  duration").replace("[]", "[png]") + "render: {sizes: 1}\n"
    assert lines(load, text) == [
        f"s.yaml:1:1: {NO_PICTURE}",
        "s.yaml:9:3: time.step: 0.02 s is above the stability limit 0.00408248 s; try 0.004, or auto",
        "s.yaml:12:10: render.sizes: unknown key; did you mean 'size'?",
    ]


def test_a_faulty_section_brings_up_no_other_error(load: Load) -> None:
    assert lines(load, GOOD.replace("[]", "[png]") + "image: 3\n") == [
        "s.yaml:11:1: image: 3 is not allowed; expected the path of a picture"
    ]
    assert lines(load, GOOD.replace("[]", "[pngs]")) == [
        f"s.yaml:10:10: output.0: \"pngs\" is not allowed; expected a list of {OUTPUTS}; did you mean 'png'?"
    ]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("none.yaml", "none.yaml: no such file or directory"),
        ("./folder/../none.yaml", "./folder/../none.yaml: no such file or directory"),
        ("folder", "folder: a directory; name a scene file"),
        ("pipe", "pipe: not a regular file; name a scene file"),
        ("/dev/zero", "/dev/zero: not a regular file; name a scene file"),
        ("a\0b", "a\\x00b: not a path; name a scene file"),
        ("x" * 300, f"{'x' * 300}: file name too long"),
    ],
)
def test_files_that_cannot_be_opened(load: Load, name: str, expected: str) -> None:
    Path("folder").mkdir()
    os.mkfifo("pipe")
    with pytest.raises(SceneError) as caught:
        load_scene(name)
    assert caught.value.lines == (expected,)
    assert load is not None


def test_overrides(load: Load) -> None:
    scene = load(
        GOOD + PROBE,
        [
            "sheet.points=[6, 7]",
            "probes.0.load=[[0, 100]]",
            "probes.0.force.2=9",
            "render.size=[64, 32]",
            "damping=1e-2",
        ],
    )
    assert scene.sheet.points == (6, 7)
    assert scene.sheet.size == (0.3, 0.4)
    assert scene.probes[0].load == ((0, 100),)
    assert scene.probes[0].force == (0, 0, 9)
    assert scene.render.size == (64, 32)
    assert scene.damping == 0.01


def test_the_last_override_of_a_key_holds(load: Load) -> None:
    assert load(GOOD, ["damping=1", "damping=2"]).damping == 2
    assert load(GOOD, ["render.camera.eye=[0, 0, 1]", "render={camera: top}"]).render.camera == "top"


def test_overrides_from_python(load: Load) -> None:
    scene = load(GOOD, {"sheet.points": (6, 7), "probes": [{"force": [0, 0, 1]}], "probes.0.falloff": 3})
    assert scene.sheet.points == (6, 7)
    assert scene.probes[0].falloff == 3


def test_a_long_override_is_named_in_short(load: Load) -> None:
    assert lines(load, GOOD, [f"image={'x' * 5000}"], image="y" * 5000) == [
        f'--image {"y" * 60}...: image: "{"y" * 59}... is not allowed; expected the path of a picture'
    ]
    assert lines(load, GOOD, [f"sheet.points=[{'1, ' * 5000}1]"]) == [
        f"--set sheet.points=[{'1, ' * 19}1,...: sheet.points: [{'1, ' * 19}1,... is not allowed; {POINTS}"
    ]
    assert lines(load, GOOD, [f"image{'.a' * 60_000}=1"]) == [
        f"--set image{'.a' * 27}....=1: expected KEY=VALUE, such as sheet.points=[61,61]"
    ]


def test_an_override_mends_a_fault_of_the_file(load: Load) -> None:
    assert load(GOOD.replace("1.0e-3", "0"), ["sheet.mass=1"]).sheet.mass == 1


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["springs.shaer=3"], "--set springs.shaer=3: springs.shaer: unknown key; did you mean 'shear'?"),
        (["spring.shear=3"], "--set spring.shear=3: spring: unknown key; did you mean 'springs'?"),
        (
            ["sheet.mass="],
            "--set sheet.mass=: sheet.mass: missing; with springs expected a number above 0, in kg",
        ),
        (
            ["render.camera={fov: 30}"],
            f"--set render.camera={{fov: 30}}: render.camera.eye: missing; {EYE}",
        ),
        (
            ["probes.0.load.1=[-1, 0]"],
            "--set probes.0.load.1=[-1, 0]: probes.0.load.1: goes back in time, from 0 s to -1 s; "
            "sort the keys by time",
        ),
        (
            ["probes.1.offset=1"],
            "--set probes.1.offset=1: probes.1: no such item; the list has 1, numbered from 0, as in probes.0.offset",
        ),
        (
            ["probes.first.offset=1"],
            "--set probes.first.offset=1: probes.first: no such item; the list has 1, numbered from 0, "
            "as in probes.0.first.offset",
        ),
        (
            ["damping.x=1"],
            "--set damping.x=1: damping: 0.5 has no keys to set one of; set it as a whole",
        ),
        (["damping"], "--set damping: expected KEY=VALUE, such as sheet.points=[61,61]"),
        (["=1"], "--set =1: expected KEY=VALUE, such as sheet.points=[61,61]"),
        ([" damping = -1"], "--set  damping = -1: damping: -1 is not allowed; expected a number, 0 or more, in N s/m"),
        (["sheet..mass=1"], "--set sheet..mass=1: expected KEY=VALUE, such as sheet.points=[61,61]"),
        (
            ["damping={a: 1, a: 2}"],
            "--set damping={a: 1, a: 2}: damping.a: given twice, first in line 1; keep one",
        ),
        (["damping=&a 1"], "--set damping=&a 1: damping: anchor &a is not allowed; remove it"),
        (["\udcff=1"], "--set \\udcff=1: expected KEY=VALUE, such as sheet.points=[61,61]"),
        ({"\udcff": 1}, "override \\udcff: expected a key such as sheet.points"),
        (
            {"image": "\udcff"},
            'override image="\\udcff": image: "\\udcff" is not allowed; expected the path of a picture',
        ),
        (["image=\udcff"], "--set image=\\udcff: image: character U+DCFF is not allowed; remove it"),
        (["damping=a\nb\0"], "--set damping=a\\nb\\x00: damping: character U+0000 is not allowed; remove it"),
        (
            {"sheet.mass": 0},
            "override sheet.mass=0: sheet.mass: 0 is not allowed; expected a number above 0, in kg",
        ),
        (
            {"sheet.mass": {1, 2}},
            "override sheet.mass: sheet.mass: a file cannot hold this set; use numbers, text, lists, dicts",
        ),
    ],
    ids=str,
)
def test_errors_in_overrides(load: Load, overrides: Any, expected: str) -> None:
    assert lines(load, GOOD + PROBE + "damping: 0.5\n", overrides) == [expected]


def test_an_item_of_a_list_that_is_not_there(load: Load) -> None:
    assert lines(load, GOOD, ["probes.0.load=[[0, 1]]"]) == [
        "--set probes.0.load=[[0, 1]]: probes.0: no such item; the list is empty, so set it as a whole"
    ]


def test_errors_below_a_later_override_are_its_own(load: Load) -> None:
    found = lines(load, GOOD, ["render.camera.fov=30", "render={camera: {fov: x, eye: [0, 0, 1]}}"])
    assert found == [
        "--set render={camera: {fov: x, eye: [0, 0, 1]}}: render.camera.fov: "
        '"x" is not allowed; expected a number from 0.001 to below 180, in degrees'
    ]


def test_an_override_is_split_at_its_first_equals_sign() -> None:
    assert parse_override("a.b=3")[1:3] == (("a", "b"), 3)
    assert parse_override("probes.0.load=[[0, 1e2]]")[1:3] == (("probes", 0, "load"), [[0, 100.0]])
    assert parse_override("image=a=b.png")[1:3] == (("image",), "a=b.png")
    # Python refuses to read integers of so many digits.
    assert parse_override(f"{'9' * 5000}=1")[1:3] == (("9" * 5000,), 1)


def test_an_override_that_is_not_yaml(load: Load) -> None:
    with pytest.raises(SceneError) as caught:
        load(GOOD, ["damping=[1"])
    assert caught.value.lines[0].startswith("--set damping=[1: damping: not valid YAML: ")


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
    "name", ["../secret.png", "deep/../../secret.png", "{absolute}", "link.png", "away/secret.png"]
)
def test_a_scene_sees_no_picture_outside_its_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenes" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "scenes")
    Image.new("RGB", (4, 3)).save("../secret.png")
    Path("link.png").symlink_to("../secret.png")
    Path("away").symlink_to("..")
    name = name.format(absolute=tmp_path / "secret.png")
    Path("s.yaml").write_text(GOOD + f"image: {name}\nregion: [0, 0, 9, 9]\n")
    opened: list[str] = []
    monkeypatch.setattr("taichi_msm.images._require_file", opened.append)
    with pytest.raises(SceneError) as caught:
        load_scene("s.yaml")
    said = "is not below the scene's folder; put the picture there, or name it with --image"
    assert caught.value.lines == (f"s.yaml:11:1: image: {name} {said}",)
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


def test_a_region_of_the_image(load: Load) -> None:
    Image.new("RGB", (40, 30)).save("a.png")
    text = GOOD + "image: a.png\nregion: "
    assert load(text + "[0, 0, 40, 30]").region == (0, 0, 40, 30)
    for region, fault in {
        "[1, 0, 40, 30]": "[1, 0, 40, 30] ends at 41, 30; the image has 40 x 30 pixels",
        "[0, 1, 40, 30]": "[0, 1, 40, 30] ends at 40, 31; the image has 40 x 30 pixels",
        "[0, 0, 0, 3]": "[0, 0, 0, 3] needs x and y of 0 or more, width and height above 0",
        "[0, -1, 3, 3]": "[0, -1, 3, 3] needs x and y of 0 or more, width and height above 0",
    }.items():
        assert lines(load, text + region) == [f"s.yaml:12:1: region: {fault}"]


@pytest.mark.parametrize("parser", ["CSafeLoader", "SafeLoader"])
@pytest.mark.parametrize("escape", ["\\ud800", "\\U00110000"])
def test_escapes_of_what_is_no_character(load: Load, monkeypatch: pytest.MonkeyPatch, parser: str, escape: str) -> None:
    monkeypatch.setattr(yaml_reader, "_LOADER", getattr(yaml, parser, yaml.SafeLoader))
    (line,) = lines(load, f'{GOOD}"{escape}": 1\n')
    assert re.match(r"s\.yaml:\d+:\d+: not valid YAML: ", line)


@pytest.mark.parametrize("parser", ["CSafeLoader", "SafeLoader"])
def test_no_text_brings_up_any_other_error(load: Load, monkeypatch: pytest.MonkeyPatch, parser: str) -> None:
    monkeypatch.setattr(yaml_reader, "_LOADER", getattr(yaml, parser, yaml.SafeLoader))
    rng = random.Random(1)
    whole = GOOD + PROBE + "render: {camera: {eye: [0, 0, 1]}, size: [64, 64]}\nimage: a.png\n"
    pieces = [
        *"\n\t :-?[]{},&*!|>'\"%@`#=~<.eE019x\\\x85\ud7ff\U0010ffff",
        "\\ud800",
        "\\U00110000",
        "9" * 400,
    ]
    pieces += ["!!int", "<<: ", "---\n", "...\n", "1e999", "-1", ".nan", "null", "%YAML 9\n"]
    outcomes: set[str] = set()
    for _ in range(400):
        text = whole
        for _ in range(rng.randint(1, 4)):
            start = rng.randrange(len(text))
            piece = rng.choice(pieces) * rng.choice((1, 1, 30))
            text = text[:start] + piece + text[start + rng.choice((0, 1, 8)) :]
        if rng.random() < 0.3:
            text = f'{text}{rng.choice(pieces)}: "{rng.choice(pieces)}"\n'
        try:
            load(text)
        except SceneError as error:
            outcomes.update(error.lines)
    assert len(outcomes) > 100
    assert all(line.isprintable() for line in outcomes)


@pytest.mark.parametrize("value", ["1e30", "1e-30", "-1e30", "0", "5e-324", "9" * 99])
def test_no_number_brings_up_any_other_error(load: Load, value: str) -> None:
    Image.new("RGB", (4, 3)).save("a.png")
    whole = load(
        GOOD + PROBE + "render: {camera: {eye: [0, 0, 1]}, size: [64, 64]}\nimage: a.png\nregion: [0, 0, 4, 3]\n"
    )
    count = 0
    for key in number_keys(whole.model_dump(mode="json")):
        for overrides in ([f"{key}={value}"], [f"{key}={value}", "time.step=0.01"]):
            try:
                load(GOOD + PROBE, overrides)
            except SceneError:
                count += 1
    assert count > 0


def number_keys(value: Any, above: str = "") -> list[str]:
    """Name every number of a scene."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        return [key for name, part in parts for key in number_keys(part, f"{above}.{name}" if above else str(name))]
    return [above] if isinstance(value, int | float) else []


def random_scene(seed: int) -> dict[str, Any]:
    """A valid scene in which every key is there or not and every kind of value occurs in some seed."""
    rng = random.Random(seed)

    def some(low: float, high: float) -> float:
        return rng.choice((rng.uniform(low, high), float(math.ceil(low)), math.floor(high)))

    def keys(width: int) -> list[list[float]]:
        times = sorted(rng.sample(range(-5, 40), rng.randint(1, 5)))
        return [[t / 10, *(some(-1, 2) for _ in range(width))] for t in times]

    def thinned(section: dict[str, Any], *kept: str) -> dict[str, Any]:
        return {key: value for key, value in section.items() if key in kept or rng.random() < 0.6}

    def vector() -> list[float]:
        return [some(-9, 9) for _ in range(3)]

    def probe() -> dict[str, Any]:
        at = rng.choice(([some(0, 1), some(0, 1)], keys(2)))
        values = {
            "at": at,
            "force": vector(),
            "load": keys(1),
            "falloff": some(0, 300),
            "offset": some(-50, 100),
        }
        return thinned(values, "force")

    sheet = {
        "points": [rng.randint(2, 40), rng.randint(2, 40)],
        "size": [some(0.1, 9), some(0.1, 9)],
        "mass": rng.uniform(1e-4, 2),
        "fixed": rng.choice(("border", "corners", "none", [], ["top", "left"], ["bottom", "right"])),
    }
    springs = {"structural": some(0, 50), "shear": 0, "virtual": some(0, 9), "virtual_active": "always"}
    rate = rng.choice((25, 30.0, 12.5))
    time = {
        "frames_per_second": rate,
        "duration": rng.randint(1, 90) / rate,
        "step": rng.choice(("auto", 1 / (rate * 2**20))),
        "damping_difference": rng.choice(("central", "backward")),
        "precision": rng.choice(("f32", "f64")),
    }
    camera = thinned({"eye": [some(1, 9), 0, 5], "target": [0, -1, 0], "up": [0, 1, 0], "fov": some(1, 179)}, "eye")
    render = {
        "size": [rng.randint(1, 99), rng.randint(1, 99)],
        "refine": rng.randint(0, 20),
        "camera": rng.choice(("top", "oblique", camera)),
        "shading": rng.choice(("none", "headlight")),
        "wireframe": rng.random() < 0.5,
        "supersample": rng.randint(1, 4),
        "background": [rng.randint(0, 255) for _ in range(3)],
    }
    scene = {
        "image": "a.png",
        "region": rng.choice((None, [0, 0, 4, 3], [1, 1, 2, 1])),
        "sheet": thinned(sheet, "points", "size", "mass"),
        "springs": thinned(springs),
        "damping": some(0, 1),
        "probes": [probe() for _ in range(rng.randint(0, 3))],
        "time": thinned(time, "duration", "frames_per_second"),
        "render": thinned(render),
        "output": rng.sample(("png", "gif", "trajectory"), rng.randint(0, 3)),
    }
    return thinned(scene, "image", "sheet", "springs", "time")


@pytest.fixture
def validator() -> jsonschema.Draft202012Validator:
    described = schema()
    jsonschema.Draft202012Validator.check_schema(described)
    return jsonschema.Draft202012Validator(described)


def test_the_schema_accepts_what_the_loader_accepts(load: Load, validator: jsonschema.Draft202012Validator) -> None:
    Image.new("RGB", (4, 3)).save("a.png")
    for seed in range(200):
        data = random_scene(seed)
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


def test_the_schema_says_what_it_is() -> None:
    described = schema()
    assert described["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert described["title"] == "Scene"
    json.dumps(described, allow_nan=False)
