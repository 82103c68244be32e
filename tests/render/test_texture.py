"""Pictures as textures: formats, orientation, colour profiles, and files that are refused."""

from __future__ import annotations

import io
import os
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms

from taichi_msm.errors import SceneError
from taichi_msm.images import PictureError, file_sha256, read_grey
from taichi_msm.model import sheet
from taichi_msm.model.sheet import read_map
from taichi_msm.render import shading, texture
from taichi_msm.render.shading import pyramid
from taichi_msm.render.texture import image_problems, image_size, load_texture
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import StiffnessMap
from tests import scenes
from tests.golden import Messages
from tests.scenes import speckle

# The words of Pillow, which depend on its version.
PILLOW_ERROR = r"(?<= \().*(?=\); )"

BACKGROUND = (10, 20, 30)
ORIENTATION = 0x0112

# 2 rows of 3 different colours, in which every wrong rotation, mirror or order of channels is visible.
COLOURS = np.array(
    [[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[255, 255, 0], [0, 255, 255], [255, 255, 255]]], dtype=np.uint8
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene(image: str | None, **keys: Any) -> Scene:
    return scenes.scene(image=image, render={"background": BACKGROUND}, **keys)


def problems(image: str | None, **keys: Any) -> list[str]:
    return [str(problem) for problem in image_problems(scene(image, **keys))]


def assert_refused(message: Messages, image: str, key: str = "image", *, by_header: bool = True, **keys: Any) -> None:
    """A picture is refused in one line; `by_header` before its pixels are read."""
    with message.raises(SceneError, key, hide=PILLOW_ERROR) as caught:
        load_texture(scene(image, **keys))
    (line,) = str(caught.value).splitlines()
    assert problems(image, **keys) == [line] * by_header


def assert_texture(image: str, expected: Any, **keys: Any) -> None:
    """The texture is as expected, without problems; the header of a whole picture contains its size."""
    texture = load_texture(scene(image, **keys))
    assert texture.dtype == np.uint8
    np.testing.assert_array_equal(texture, np.array(expected, dtype=np.uint8))
    if "region" not in keys:
        assert image_size(scene(image, **keys)) == (texture.shape[1], texture.shape[0])
    assert problems(image, **keys) == []


def grey(*values: int) -> NDArray[np.uint8]:
    """One row of grey pixels, shape (1, n, 3)."""
    return np.repeat(np.array(values, dtype=np.uint8)[None, :, None], 3, axis=2)


def row(*pixels: Any, kind: Any = np.uint8) -> Image.Image:
    """A picture of one row."""
    return Image.fromarray(np.array([pixels], dtype=kind))


PALETTE = Image.new("P", (3, 1))
PALETTE.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
PALETTE.putdata([2, 0, 1])

# Kind of pixels: picture, expected colours, options of `save`.
PIXELS: dict[str, tuple[Image.Image, Any, dict[str, Any]]] = {
    "grey": (row(0, 77, 255), grey(0, 77, 255), {}),
    "black and white": (row(False, True, kind=bool), grey(0, 255), {}),
    # v / 257: 0, 0.498, 0.502, 1, 127.502, 255
    "16 bits": (row(0, 128, 129, 257, 32768, 65535, kind=np.uint16), grey(0, 0, 1, 1, 128, 255), {}),
    "big-endian": (Image.frombytes("I;16B", (2, 1), b"\x01\x01\xff\xff"), grey(1, 255), {}),
    "grey with alpha": (row([200, 255], [200, 0]), [[[200, 200, 200], BACKGROUND]], {}),
    # 51 / 255 is a fifth: 10 + 190 / 5, 20 + 80 / 5, 30 + 20 / 5
    "alpha": (row([200, 100, 50, 0], [200, 100, 50, 51]), [[BACKGROUND, [48, 36, 34]]], {}),
    "palette": (PALETTE, [[[0, 0, 255], [255, 0, 0], [0, 255, 0]]], {}),
    "transparent entry": (PALETTE, [[[0, 0, 255], BACKGROUND, [0, 255, 0]]], {"transparency": 0}),
    "alpha of a palette": (PALETTE, [[[0, 0, 255], BACKGROUND, [0, 255, 0]]], {"transparency": bytes([0, 255, 255])}),
    "transparent colour": (
        Image.fromarray(COLOURS[:1]),
        [[[255, 0, 0], BACKGROUND, [0, 0, 255]]],
        {"transparency": (0, 255, 0)},
    ),
    "CMYK": (
        Image.frombytes("CMYK", (3, 1), bytes([0, 0, 0, 0, 255, 0, 0, 0, 0, 0, 0, 255])),
        [[[255, 255, 255], [0, 255, 255], [0, 0, 0]]],
        {},
    ),
}


@pytest.mark.parametrize("kind", PIXELS)
def test_pixels_of_every_kind(kind: str) -> None:
    stored, expected, options = PIXELS[kind]
    names = {"CMYK": ["a.tif"], "I;16B": ["a.tif"], "I;16": ["a.png", "a.tif"]}.get(stored.mode, ["a.png"])
    for name in names:
        stored.save(name, **options)
        assert_texture(name, expected)


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif", "a.webp", "a.with.unknown.ending"])
def test_lossless_formats(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first picture of a file keeps every bit; its size is read from the header, also of a linked file."""
    kind = {"bmp": "BMP", "tif": "TIFF", "webp": "WEBP"}.get(name[2:], "PNG")
    options = {} if kind == "BMP" else {"save_all": True, "append_images": [Image.fromarray(COLOURS[::-1])]}
    Image.fromarray(COLOURS).save(name, format=kind, lossless=True, **options)
    assert_texture(name, COLOURS)
    Path("link").symlink_to(name)
    assert_texture("link", COLOURS)
    monkeypatch.setattr(Image.Image, "load", pytest.fail)
    assert image_size(scene(name)) == (3, 2)
    assert problems(name) == []


# By EXIF orientation, from 1.
UPRIGHT = [COLOURS, COLOURS[:, ::-1], COLOURS[::-1, ::-1], COLOURS[::-1], COLOURS.swapaxes(0, 1)]
UPRIGHT += [np.rot90(COLOURS, -1), COLOURS[::-1, ::-1].swapaxes(0, 1), np.rot90(COLOURS)]


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(name: str, orientation: int) -> None:
    exif, upright = Image.Exif(), UPRIGHT[orientation - 1]
    exif[ORIENTATION] = orientation
    Image.fromarray(COLOURS).save(name, exif=exif, lossless=True)
    assert_texture(name, upright)
    height, width = upright.shape[:2]
    assert_texture(name, upright[1:, 1:], region=[1, 1, width - 1, height - 1])


@pytest.mark.parametrize("region", [[1, 0, 3, 2], [0, -1, 2, 2], [0, 0, 0, 2]])
def test_region_outside_the_picture(region: list[int], message: Messages) -> None:
    Image.fromarray(COLOURS).save("a.png")
    assert_refused(message, "a.png", "region", region=region)


def test_scene_without_a_picture(message: Messages) -> None:
    assert problems(None, region=[0, 0, 9, 9]) == problems(None) == []
    assert problems(None, region=[0, 0, 9, 0]) != []
    assert image_size(scene(None)) is None
    with message.raises(SceneError, "image"):
        load_texture(scene(None))


def write_large_file(name: str) -> None:
    with Path(name).open("wb") as file:
        file.truncate(2**31 + 1)


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda _: None, id="missing"),
        pytest.param(os.mkdir, id="folder"),
        pytest.param(os.mkfifo, id="pipe"),
        pytest.param(lambda name: Path(name).write_text("text"), id="text"),
        pytest.param(lambda name: Image.new("P", (3, 3)).save(name, "GIF"), id="GIF"),
        pytest.param(lambda name: Image.new("F", (3, 3)).save(name, "TIFF"), id="float"),
        pytest.param(write_large_file, id="large"),
    ],
)
def test_files_that_are_not_pictures(write: Any, message: Messages) -> None:
    write("a.png")
    assert_refused(message, "a.png", "image: a.png")


def srgb_profile(**tags: str) -> bytes:
    """The profile of sRGB, with tags of other names."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    for start in range(132, 132 + 12 * int.from_bytes(profile[128:132], "big"), 12):
        name = profile[start : start + 4].decode()
        profile[start : start + 4] = tags.get(name, name).encode()
    return bytes(profile)


# Its red is the green of sRGB.
SWAPPED = srgb_profile(rXYZ="gXYZ", gXYZ="rXYZ")


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_colour_profile(mode: str) -> None:
    picture = Image.fromarray(COLOURS).convert(mode)
    picture.save("srgb.png", icc_profile=srgb_profile())
    assert_texture("srgb.png", COLOURS)
    picture.save("a.png", icc_profile=SWAPPED)
    np.testing.assert_allclose(load_texture(scene("a.png")).astype(int), COLOURS[..., [1, 0, 2]], atol=2)
    if mode == "RGBA":
        picture.putalpha(0)
        picture.save("a.png", icc_profile=SWAPPED)
        assert_texture("a.png", np.broadcast_to(BACKGROUND, COLOURS.shape))


def test_grey_profile_applies_to_colours_only() -> None:
    # A profile of greys whose curve is 1.0: half the light is sRGB's 188.
    white = b"XYZ \0\0\0\0" + b"".join(round(65536 * n).to_bytes(4, "big") for n in (0.9642, 1.0, 0.8249))
    curve = b"curv" + bytes(8)
    entries = ((b"wtpt", 156, 20), (b"kTRC", 176, 12))
    tags = b"".join(name + start.to_bytes(4, "big") + size.to_bytes(4, "big") for name, start, size in entries)
    header = bytearray(srgb_profile()[:128])
    header[:4], header[16:20] = (188).to_bytes(4, "big"), b"GRAY"
    linear = bytes(header) + (2).to_bytes(4, "big") + tags + white + curve
    Image.new("L", (2, 2), 128).save("a.png", icc_profile=linear)
    np.testing.assert_allclose(load_texture(scene("a.png")).astype(int), 188, atol=1)
    np.testing.assert_array_equal(read_grey("a.png"), 128)


def test_invalid_colour_profiles(message: Messages) -> None:
    Image.fromarray(COLOURS).save("a.png", icc_profile=srgb_profile()[:300])
    assert_refused(message, "a.png", "image: a.png", by_header=False)
    Image.new("CMYK", (2, 2)).save("a.tif", icc_profile=srgb_profile())
    assert_refused(message, "a.tif", "image: a.tif", by_header=False)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp", "a.tif", "a.webp"])
def test_truncated_pictures(name: str, message: Messages) -> None:
    Image.fromarray(speckle(64, 64)).save(name)
    os.truncate(name, Path(name).stat().st_size // 2)
    assert_refused(message, name, f"image: {name}", by_header=name == "a.webp")


def test_unreadable_picture(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def forbidden(*args: Any, **kwargs: Any) -> None:
        raise PermissionError

    Image.fromarray(COLOURS).save("secret.png")
    monkeypatch.setattr(Image, "open", forbidden)
    assert_refused(message, "secret.png")


def test_fault_of_a_picture_with_a_semicolon_in_its_name() -> None:
    with pytest.raises(PictureError) as caught:
        file_sha256("a; b.png")
    assert caught.value.fault == "a; b.png: no such file or directory"
    assert str(pickle.loads(pickle.dumps(caught.value))) == f"{caught.value.fault}; name a picture that can be read"


def test_control_sequences_in_a_name(message: Messages) -> None:
    name = "a\n\x1b[31m.png"
    Image.fromarray(COLOURS).save(name)
    os.truncate(name, 45)
    assert_refused(message, name, "image: a\\n\\x1b[31m.png", by_header=False)


def test_jpeg_with_too_many_scans(message: Messages) -> None:
    """Each visits all pixels; those of a preview in the file, and bytes after its end, are not counted."""

    def jpeg(**options: Any) -> bytes:
        file = io.BytesIO()
        Image.fromarray(speckle(300, 500)).save(file, "JPEG", **options)
        return file.getvalue()

    preview = Image.Exif()
    preview[0x9286] = b"\xff\xda" * 40
    data = jpeg(progressive=True, exif=preview)
    last_scan = data[data.rfind(b"\xff\xc4", 0, data.rfind(b"\xff\xda")) : -2]
    Path("a.jpg").write_bytes(data[:-2] + 1300 * last_scan + b"\xff\xd9" + b"\xff\xda" * 4000)
    assert problems("a.jpg") == []
    Path("a.jpg").write_bytes(data[:-2] + 1400 * last_scan + b"\xff\xd9")
    assert_refused(message, "a.jpg", "image: a.jpg has 1410 scans")
    # A baseline JPEG has scans too.
    data = jpeg()
    Path("a.jpg").write_bytes(data[:-2] + 1400 * data[data.rfind(b"\xff\xda") : -2] + b"\xff\xd9")
    assert_refused(message, "a.jpg", "image: a.jpg has 1401 scans")


def test_picture_with_too_many_rows(message: Messages) -> None:
    """Pillow needs 24 bytes a row in addition to the pixels: a column of 89 million took 3 GB and 12 s."""
    for size in ((1, 65536), (65536, 1)):
        Image.new("L", size).save("a.png")
        assert_refused(message, "a.png", f"image: a.png has {size[0]} x {size[1]} pixels")
    Image.new("L", (1, 65535)).save("a.png")
    assert load_texture(scene("a.png")).shape == (65535, 1, 3)


def test_picture_with_too_many_pixels(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    Image.new("1", (2000, 1500)).save("a.png")
    # Pillow warns of more pixels than this and refuses twice as many: 3 million are refused both ways.
    for limit in (2_000_000, 1_000_000):
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        assert_refused(message, "a.png", "image: a.png")


def test_warnings_of_pillow_are_discarded() -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(COLOURS).save("a.jpg", exif=exif)
    broken = Path("a.jpg").read_bytes().replace(exif.tobytes()[:14], exif.tobytes()[:10] + b"\xff\xff\xff\xff")
    Path("a.jpg").write_bytes(broken)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_texture(scene("a.jpg"))


def test_decoded_pictures_are_cached_until_the_file_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(COLOURS).save("a.png")
    first, grey_map = load_texture(scene("a.png")), read_map(StiffnessMap(image="a.png", range=(1, 2)))
    assert not first.flags.writeable
    assert not grey_map.grey.flags.writeable
    assert_texture("a.png", COLOURS[:1], region=[0, 0, 3, 1])
    status, changed = Path("a.png").stat(), COLOURS.copy()
    changed[0, 0] = 7, 8, 9
    Path("copy.png").write_bytes(Path("a.png").read_bytes())
    Image.fromarray(changed).save("a.png")
    os.utime("a.png", ns=(status.st_atime_ns, status.st_mtime_ns))
    assert_texture("a.png", changed)
    assert read_map(StiffnessMap(image="a.png", range=(1, 2))).grey[0, 0] == Image.open("a.png").convert("L").getpixel(
        (0, 0)
    )
    with monkeypatch.context() as patch:
        patch.setattr(texture, "read_rgb", pytest.fail)
        patch.setattr(sheet, "read_grey", pytest.fail)
        assert load_texture(scene("copy.png")) is first
        assert read_map(StiffnessMap(image="copy.png", range=(1, 2))).grey is grey_map.grey
        assert_texture("a.png", changed)
    # A required digest is compared with the file, not with the cache.
    with pytest.raises(SceneError, match="differs from the file of the run"):
        load_texture(scene("a.png"), file_sha256("copy.png"))


def test_mipmap_levels_are_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    colours = speckle(9, 14)
    levels = pyramid(colours, minified=True)
    expected = shading._build_pyramid(colours, minified=True)
    for cached, built in zip(levels, expected, strict=True):
        np.testing.assert_array_equal(cached, built)
        assert not cached.flags.writeable
    assert len(pyramid(colours, minified=False)[1]) == 1
    assert len(pyramid(colours.reshape(14, 9, 3), minified=True)[1]) == len(levels[1])
    colours[0, 0] ^= 1
    assert pyramid(colours, minified=True)[0][0] != levels[0][0]
    colours[0, 0] ^= 1
    monkeypatch.setattr(shading, "_build_pyramid", pytest.fail)
    assert pyramid(colours, minified=True)[0] is levels[0]
