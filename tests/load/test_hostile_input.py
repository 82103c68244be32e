"""Fuzzing of input files: clean errors within bounds of time and memory, and no leftovers."""

from __future__ import annotations

import io
import json
import math
import random
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.render.texture import image_problems, image_size, load_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.motion import dynamics_of
from tests.scenes import SHEET, SPRINGS, speckle

resource: Any = pytest.importorskip("resource")

WORDS = re.compile(rb"[A-Za-z_.\-0-9]+|[\[\]{}:,#\n]")

# Extreme values, features of YAML that scenes exclude, and bytes that are not text.
TOKENS = [
    *(b"null", b"~", b"true", b"0", b"-1", b"4096", b"4097", b"1000000000000", b"png", b"oblique", b"auto"),
    *(b"1e999", b"-1e999", b".nan", b".inf", b"-.inf", b"1e-320", b"1e308", b"1_000", b"0o17"),
    *(b"1:30:00", b"2001-01-01"),
    *(b"9" * 5000, b"0x" + b"f" * 300, b"[" * 3000, b"/etc/passwd", b"../x.png"),
    *(b"[", b"]", b"{", b"}", b"? ", b"- ", b": ", b"#", b"|", b">", b"'", b'"', b"\\", b"@", b"`", b"\t"),
    *(b"&a", b"*a", b"<<: *a", b"!x", b"!!python/object/apply:os.system [id]", b"---", b"...", b"%YAML 1.2"),
    *(b"\x00", b"\x7f", b"\xff\xfe", b"\xef\xbb\xbf", b"\r\n", b"\r", b"\xe2\x80\xa8", b"\xf0\x9f\xa7\xa0"),
]


def damaged_text(rng: random.Random, data: bytes) -> bytes:
    """Change, insert, delete or repeat a few bytes or words."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at, end = sorted(rng.randrange(len(changed) + 1) for _ in range(2))
        kind = rng.choice(("byte", "token", "word", "word", "drop", "repeat", "cut"))
        if kind == "byte":
            changed[at : at + rng.randrange(2)] = bytes([rng.randrange(256)])
        elif kind == "token":
            changed[at:at] = rng.choice(TOKENS)
        elif kind == "word" and (words := list(WORDS.finditer(bytes(changed)))):
            word = rng.choice(words)
            new = rng.choice(TOKENS) if rng.random() < 0.5 else rng.choice(words).group()
            changed[word.start() : word.end()] = new
        elif kind == "drop":
            del changed[at : at + rng.choice((1, 2, 5, 40))]
        elif kind == "repeat":
            changed[at:at] = changed[at : min(end, at + 200)]
        elif kind == "cut":
            del changed[at:]
    return bytes(changed)


def damaged_picture(rng: random.Random, data: bytes) -> bytes:
    """Change, insert or delete a few bytes or numbers, or truncate."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 10))):
        at = rng.randrange(len(changed) + 1)
        kind = rng.choice(("byte", "number", "drop", "add"))
        if kind == "byte":
            changed[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == "number":
            changed[at : at + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\0\0\xff\xff"))
        elif kind == "drop":
            del changed[at : at + rng.choice((1, 4, len(changed)))]
        else:
            changed[at:at] = rng.randbytes(4)
    return bytes(changed)


def tries(total: int, part: int = 10) -> pytest.MarkDecorator:
    """Parametrise the number of tries: a part of them by default, and all by -m fuzz."""
    counts = [total // part, pytest.param(total, marks=pytest.mark.fuzz)]
    return pytest.mark.parametrize("tries", counts, ids=["some", "all"])


@pytest.fixture
def folder(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with the textures of the shipped scenes."""
    (tmp_path / "textures").mkdir()
    for picture in (root / "scenes" / "textures").glob("*.[pj][np]g"):
        shutil.copy(picture, tmp_path / "textures")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@contextmanager
def in_bounds(folder: Path) -> Iterator[Callable[[Callable[[], object]], bool]]:
    """Yield a function that tries an input and returns whether it was accepted, and check bounds at the end."""
    before, slowest, sizes = sorted(folder.rglob("*")), 0.0, []

    def attempt(work: Callable[[], object]) -> bool:
        nonlocal slowest
        refused: tuple[str, ...] | None = None
        start = time.perf_counter()
        try:
            work()
        except SceneError as error:
            refused = error.lines
        slowest = max(slowest, time.perf_counter() - start)
        sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        if refused is None:
            return True
        assert refused
        assert all(line.isprintable() for line in refused)
        return False

    yield attempt
    assert slowest < 1  # [s]
    # After a tenth of the inputs, all caches are filled.
    assert sizes[-1] - sizes[len(sizes) // 10] < 50_000  # [KiB]
    assert sorted(folder.rglob("*")) == before


@tries(20_000, 30)
def test_damaged_scenes(tries: int, folder: Path, root: Path) -> None:
    rng = random.Random(1)
    scenes = [path.read_bytes() for path in sorted((root / "scenes").glob("*.yaml"))]
    file = folder / "damaged.yaml"
    file.touch()
    with in_bounds(folder) as attempt:
        accepted = 0
        for _ in range(tries):
            file.write_bytes(damaged_text(rng, rng.choice(scenes)))
            accepted += attempt(lambda: load_scene("damaged.yaml"))
    assert 0 < accepted < tries / 2, "some damage is harmless"


@tries(2_000)
def test_damaged_overrides(tries: int, folder: Path, root: Path) -> None:
    rng = random.Random(2)
    shutil.copy(root / "scenes" / "press.yaml", folder)
    keys = ["sheet.points", "probes.0.load", "probes.9.at", "render.camera.eye", "time.step", "image", "a.b", "0", ""]
    values = ["[61,61]", "[[0,100]]", "1e4", "-1", "null", "{a: 1}", "[", "top", "!!x 1", "&a 1", "[]", "é", "\ud800"]
    with in_bounds(folder) as attempt:
        for _ in range(tries):
            text = rng.choice(keys) + rng.choice(("=", "=", "", "==")) + rng.choice(values)
            if rng.random() < 0.5:
                # As Python decodes arguments that are not UTF-8.
                damaged = damaged_text(rng, text.encode("utf-8", "surrogatepass"))
                text = damaged.decode("utf-8", "surrogateescape")
            attempt(partial(load_scene, "press.yaml", [text]))


def pictures() -> list[bytes]:
    """Small pictures of all formats and kinds of pixels."""
    colours = Image.fromarray(speckle(13, 17))
    turned = Image.Exif()
    turned[0x0112] = 6
    kinds: list[tuple[str, str, dict[str, Any]]] = [
        *(("PNG", mode, {}) for mode in ("RGB", "P", "RGBA", "LA", "I;16", "1")),
        *(("JPEG", mode, {"exif": turned}) for mode in ("RGB", "L", "CMYK")),
        *(("WEBP", mode, {"lossless": mode == "RGBA"}) for mode in ("RGB", "RGBA")),
        *(("TIFF", "RGB", {"compression": name}) for name in ("raw", "tiff_lzw", "jpeg", "tiff_deflate")),
        *(("BMP", "RGB", {}), ("GIF", "P", {})),
    ]
    made = []
    for form, mode, options in kinds:
        file = io.BytesIO()
        (colours.convert("L") if mode == "I;16" else colours).convert(mode).save(file, form, **options)
        made.append(file.getvalue())
    return made


@tries(5_000)
def test_damaged_pictures(tries: int, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rng = random.Random(3)
    whole = pictures()
    scene = Scene.model_validate(
        {"image": "damaged.png", "sheet": SHEET, "springs": SPRINGS, "time": {"duration": 0.04}}
    )
    file = folder / "damaged.png"
    file.touch()

    def read() -> None:
        image_size(scene)
        list(image_problems(scene))
        texture = load_texture(scene)
        assert texture.dtype == np.uint8
        assert texture.ndim == 3

    with in_bounds(folder) as attempt:
        accepted = 0
        for _ in range(tries):
            file.write_bytes(damaged_picture(rng, rng.choice(whole)))
            accepted += attempt(read)
    assert 0 < accepted < tries / 2
    assert capfd.readouterr() == ("", ""), "libraries print nothing"


def valid_scene(rng: random.Random) -> dict[str, Any]:
    """A random valid scene; with few structures, so that few kernels are compiled."""

    def size(low: float, high: float) -> float:
        """A number with a uniformly distributed logarithm."""
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    rate = rng.choice((10, 24, 25, 30, 60))
    load = [[t / 100, rng.uniform(-100, 100)] for t in sorted(rng.sample(range(100), rng.randrange(1, 5)))]
    if rng.random() < 0.5:
        load.append([load[-1][0], rng.uniform(-100, 100)])
    probe = {
        "at": [rng.random(), rng.random()],
        "force": [rng.uniform(-1e3, 1e3) for _ in range(3)],
        "load": load,
        "falloff": rng.choice((0, size(1e-3, 1e3))),
        "offset": rng.uniform(0, 20),
    }
    sheet = {"points": [5, 7], "size": [size(0.01, 10), size(0.01, 10)], "mass": size(1e-6, 1e3)}
    springs = {name: size(1e-3, 1e6) for name in ("structural", "shear", "virtual")}
    return {
        "sheet": {**sheet, "fixed": rng.choice(("border", "none"))},
        "springs": {**springs, "virtual_active": rng.choice(("loaded", "always"))},
        "damping": size(1e-6, 10),
        "probes": [probe],
        "time": {
            "duration": rng.randrange(1, 10) / rate,
            "frames_per_second": rate,
            "damping_difference": rng.choice(("central", "backward")),
            "precision": rng.choice(("f32", "f64")),
        },
        "output": [],
    }


@tries(500)
def test_valid_scenes_run(tries: int, folder: Path, device: Device) -> None:
    rng = random.Random(4)
    for _ in range(tries):
        text = json.dumps(valid_scene(rng))
        Path("valid.yaml").write_text(text)
        dynamics = dynamics_of(load_scene("valid.yaml"), device)
        dynamics.advance(3)
        displacement = dynamics.displacement()
        dynamics.close()
        assert np.isfinite(displacement).all(), text
