from __future__ import annotations

import io
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms

from taichi_msm.errors import SceneError
from taichi_msm.images import read_grey
from taichi_msm.render.texture import image_problems, image_size, load_texture
from taichi_msm.scene.scene import Scene
from tests import scenes
from tests.golden import Messages
from tests.scenes import speckle

# The words of Pillow, which depend on its version.
OF_PILLOW = r"(?<= \().*(?=\); )"

BACKGROUND = (10, 20, 30)
ORIENTATION = 0x0112

# Chosen so that every wrong turn, mirror or channel order shows: 2 rows of 3 different colours.
COLOURS = np.array(
    [[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[255, 255, 0], [0, 255, 255], [255, 255, 255]]], dtype=np.uint8
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene(image: str | None, **keys: Any) -> Scene:
    return scenes.scene(image=image, render={"background": BACKGROUND}, **keys)


def faults(image: str | None, **keys: Any) -> list[str]:
    return [str(problem) for problem in image_problems(scene(image, **keys))]


def assert_refused(message: Messages, image: str, key: str = "image", *, known: bool = True, **keys: Any) -> None:
    """A picture is refused in one line, which is known before its pixels are read."""
    with message.raises(SceneError, key, hide=OF_PILLOW) as caught:
        load_texture(scene(image, **keys))
    (line,) = str(caught.value).splitlines()
    assert faults(image, **keys) == [line] * known


def assert_texture(image: str, expected: Any, **keys: Any) -> None:
    """The texture is as expected, and no problem is seen in it; of a whole picture the size is known beforehand."""
    texture = load_texture(scene(image, **keys))
    assert texture.dtype == np.uint8
    np.testing.assert_array_equal(texture, np.array(expected, dtype=np.uint8))
    if "region" not in keys:
        assert image_size(scene(image, **keys)) == (texture.shape[1], texture.shape[0])
    assert faults(image, **keys) == []


def grey(*values: int) -> NDArray[np.uint8]:
    """One row of grey pixels, shape (1, n, 3)."""
    return np.repeat(np.array(values, dtype=np.uint8)[None, :, None], 3, axis=2)


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.tif", "a.webp", "a.with.no.known.ending"])
def test_lossless_formats_keep_every_bit(name: str) -> None:
    kind = {"bmp": "BMP", "tif": "TIFF", "webp": "WEBP"}.get(name[2:], "PNG")
    Image.fromarray(COLOURS).save(name, format=kind, lossless=True)
    assert_texture(name, COLOURS)


PALETTE = Image.new("P", (3, 1))
PALETTE.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
PALETTE.putdata([2, 0, 1])


def picture(*pixels: Any, kind: Any = np.uint8) -> Image.Image:
    """A picture of one row."""
    return Image.fromarray(np.array([pixels], dtype=kind))


@pytest.mark.parametrize(
    ("stored", "expected", "options"),
    [
        pytest.param(picture(0, 77, 255), grey(0, 77, 255), {}, id="grey"),
        pytest.param(picture(False, True, kind=bool), grey(0, 255), {}, id="black and white"),
        # v / 257: 0, 0.498, 0.502, 1, 127.502, 255
        pytest.param(
            picture(0, 128, 129, 257, 32768, 65535, kind=np.uint16), grey(0, 0, 1, 1, 128, 255), {}, id="16 bits"
        ),
        pytest.param(Image.frombytes("I;16B", (2, 1), b"\x01\x01\xff\xff"), grey(1, 255), {}, id="big-endian"),
        pytest.param(picture([200, 255], [200, 0]), [[[200, 200, 200], BACKGROUND]], {}, id="grey with alpha"),
        # 51 / 255 is a fifth: 10 + 190 / 5, 20 + 80 / 5, 30 + 20 / 5
        pytest.param(
            picture([200, 100, 50, 255], [200, 100, 50, 0], [200, 100, 50, 51]),
            [[[200, 100, 50], BACKGROUND, [48, 36, 34]]],
            {},
            id="alpha",
        ),
        pytest.param(PALETTE, [[[0, 0, 255], [255, 0, 0], [0, 255, 0]]], {}, id="palette"),
        *(
            pytest.param(
                PALETTE, [[[0, 0, 255], BACKGROUND, [0, 255, 0]]], {"transparency": clear}, id=f"clear {clear!r}"
            )
            for clear in (0, bytes([0, 255, 255]))
        ),
        pytest.param(
            Image.fromarray(COLOURS[:1]),
            [[[255, 0, 0], BACKGROUND, [0, 0, 255]]],
            {"transparency": (0, 255, 0)},
            id="transparent colour",
        ),
        pytest.param(
            Image.frombytes("CMYK", (3, 1), bytes([0, 0, 0, 0, 255, 0, 0, 0, 0, 0, 0, 255])),
            [[[255, 255, 255], [0, 255, 255], [0, 0, 0]]],
            {},
            id="CMYK",
        ),
    ],
)
def test_pixels_of_every_kind(stored: Image.Image, expected: Any, options: dict[str, Any]) -> None:
    names = {"CMYK": ["a.tif"], "I;16B": ["a.tif"], "I;16": ["a.png", "a.tif"]}.get(stored.mode, ["a.png"])
    for name in names:
        stored.save(name, **options)
        assert_texture(name, expected)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
@pytest.mark.parametrize(
    ("orientation", "upright"),
    [
        (1, COLOURS),
        (2, COLOURS[:, ::-1]),
        (3, COLOURS[::-1, ::-1]),
        (4, COLOURS[::-1]),
        (5, COLOURS.swapaxes(0, 1)),
        (6, np.rot90(COLOURS, -1)),
        (7, COLOURS[::-1, ::-1].swapaxes(0, 1)),
        (8, np.rot90(COLOURS)),
    ],
)
def test_exif_orientation(name: str, orientation: int, upright: NDArray[np.uint8]) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(COLOURS).save(name, exif=exif, lossless=True)
    assert_texture(name, upright)
    height, width = upright.shape[:2]
    assert_texture(name, upright[1:, 1:], region=[1, 1, width - 1, height - 1])


def test_the_first_of_several_pictures() -> None:
    first, second = Image.fromarray(COLOURS), Image.fromarray(COLOURS[::-1])
    for name in ("a.png", "a.tif", "a.webp"):
        first.save(name, save_all=True, append_images=[second], lossless=True)
        assert_texture(name, COLOURS)


def test_region() -> None:
    Image.fromarray(COLOURS).save("a.png")
    assert_texture("a.png", COLOURS[1:2, 0:2], region=[0, 1, 2, 1])
    assert_texture("a.png", COLOURS[0:2, 2:3], region=[2, 0, 1, 2])


@pytest.mark.parametrize(
    "region", [[1, 0, 3, 2], [0, 1, 3, 2], [-1, 0, 2, 2], [0, -1, 2, 2], [0, 0, 0, 2], [0, 0, 2, 0]]
)
def test_a_region_outside_the_image(region: list[int], message: Messages) -> None:
    Image.fromarray(COLOURS).save("a.png")
    assert_refused(message, "a.png", "region", region=region)


def test_without_an_image(message: Messages) -> None:
    assert faults(None, region=[0, 0, 9, 9]) == []
    assert faults(None, region=[0, 0, 9, 0]) != []
    assert faults(None) == []
    assert image_size(scene(None)) is None
    with message.raises(SceneError, "image"):
        load_texture(scene(None))


def large_file(name: str) -> None:
    with Path(name).open("wb") as file:
        file.truncate(2**31 + 1)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda _: None, id="missing"),
        pytest.param(os.mkdir, id="folder"),
        pytest.param(os.mkfifo, id="pipe"),
        pytest.param(lambda name: Path(name).symlink_to("/dev/zero"), id="device"),
        pytest.param(lambda name: Path(name).write_text("text"), id="text"),
        pytest.param(lambda name: Path(name).touch(), id="empty"),
        pytest.param(lambda name: Image.new("P", (3, 3)).save(name, "GIF"), id="GIF"),
        pytest.param(lambda name: Image.new("F", (3, 3)).save(name, "TIFF"), id="float"),
        pytest.param(lambda name: Image.new("I", (3, 3)).save(name, "TIFF"), id="32 bits"),
        pytest.param(large_file, id="large"),
    ],
)
def test_files_that_are_no_pictures(make: Any, message: Messages) -> None:
    make("a.png")
    assert_refused(message, "a.png", "image: a.png")


def test_a_link_is_followed() -> None:
    Image.fromarray(COLOURS).save("b.png")
    Path("a.png").symlink_to("b.png")
    assert_texture("a.png", COLOURS)


def profile(**tags: str) -> bytes:
    """The profile of sRGB, with tags of other names."""
    found = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    count = int.from_bytes(found[128:132], "big")
    head = bytearray(found)
    for at in range(132, 132 + 12 * count, 12):
        name = found[at : at + 4].decode()
        head[at : at + 4] = tags.get(name, name).encode()
    return bytes(head)


SWAPPED = {"rXYZ": "gXYZ", "gXYZ": "rXYZ"}


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_colours_of_a_profile_become_srgb(mode: str) -> None:
    picture = Image.fromarray(COLOURS).convert(mode)
    picture.save("srgb.png", icc_profile=profile())
    assert_texture("srgb.png", COLOURS)
    # What its profile says is red is sRGB's green.
    picture.save("a.png", icc_profile=profile(**SWAPPED))
    np.testing.assert_allclose(load_texture(scene("a.png")).astype(int), COLOURS[..., [1, 0, 2]], atol=2)


def test_a_transparent_picture_keeps_its_alpha_through_a_profile() -> None:
    picture = Image.fromarray(COLOURS).convert("RGBA")
    picture.putalpha(0)
    picture.save("a.png", icc_profile=profile(**SWAPPED))
    assert_texture("a.png", np.broadcast_to(BACKGROUND, COLOURS.shape))


def test_greys_of_a_profile_become_srgb_and_maps_stay() -> None:
    # A profile of greys whose curve is 1.0: half the light is sRGB's 188.
    white = b"XYZ \0\0\0\0" + b"".join(round(65536 * n).to_bytes(4, "big") for n in (0.9642, 1.0, 0.8249))
    curve = b"curv" + bytes(8)
    places = ((b"wtpt", 156, 20), (b"kTRC", 176, 12))
    tags = b"".join(name + at.to_bytes(4, "big") + size.to_bytes(4, "big") for name, at, size in places)
    head = bytearray(profile()[:128])
    head[:4], head[16:20] = (188).to_bytes(4, "big"), b"GRAY"
    linear = bytes(head) + (2).to_bytes(4, "big") + tags + white + curve
    Image.new("L", (2, 2), 128).save("a.png", icc_profile=linear)
    np.testing.assert_allclose(load_texture(scene("a.png")).astype(int), 188, atol=1)
    np.testing.assert_array_equal(read_grey("a.png"), 128)


@pytest.mark.parametrize("broken", [b"no profile", profile()[:300]], ids=["text", "half"])
def test_a_broken_profile_is_refused(broken: bytes, message: Messages) -> None:
    Image.fromarray(COLOURS).save("a.png", icc_profile=broken)
    assert_refused(message, "a.png", "image: a.png", known=False)
    Image.new("CMYK", (2, 2)).save("a.tif", icc_profile=profile())
    assert_refused(message, "a.tif", "image: a.tif", known=False)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp", "a.tif", "a.webp"])
def test_truncated_pictures(name: str, message: Messages) -> None:
    Image.fromarray(speckle(64, 64)).save(name)
    os.truncate(name, Path(name).stat().st_size // 2)
    assert_refused(message, name, f"image: {name}", known=name == "a.webp")


def test_a_picture_that_may_not_be_read(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    def forbidden(*args: Any, **kwargs: Any) -> None:
        raise PermissionError

    Image.fromarray(COLOURS).save("secret.png")
    monkeypatch.setattr(Image, "open", forbidden)
    assert_refused(message, "secret.png")


def test_a_name_is_one_line_that_steers_no_terminal(message: Messages) -> None:
    name = "a\n\x1b[31m.png"
    Image.fromarray(COLOURS).save(name)
    os.truncate(name, 45)
    assert_refused(message, name, "image: a\\n\\x1b[31m.png", known=False)


def test_a_jpeg_of_too_many_scans(message: Messages) -> None:
    """Each goes over all pixels; those of a preview in the file, and what follows its end, do not count."""
    file = io.BytesIO()
    preview = Image.Exif()
    preview[0x9286] = b"\xff\xda" * 40
    Image.fromarray(speckle(300, 500)).save(file, "JPEG", progressive=True, exif=preview)
    whole = file.getvalue()
    last = whole[whole.rfind(b"\xff\xc4", 0, whole.rfind(b"\xff\xda")) : -2]
    Path("a.jpg").write_bytes(whole[:-2] + 1300 * last + b"\xff\xd9" + b"\xff\xda" * 4000)
    assert faults("a.jpg") == []
    Path("a.jpg").write_bytes(whole[:-2] + 1400 * last + b"\xff\xd9")
    assert_refused(message, "a.jpg", "image: a.jpg has 1410 scans")
    # A baseline one has scans too.
    file = io.BytesIO()
    Image.fromarray(speckle(300, 500)).save(file, "JPEG")
    whole = file.getvalue()
    Path("a.jpg").write_bytes(whole[:-2] + 1400 * whole[whole.rfind(b"\xff\xda") : -2] + b"\xff\xd9")
    assert_refused(message, "a.jpg", "image: a.jpg has 1401 scans")


def test_a_picture_of_too_many_rows(message: Messages) -> None:
    """Pillow needs 24 bytes a row besides the pixels: a column of 89 million took 3 GB and 12 s."""
    for size in ((1, 65536), (65536, 1)):
        Image.new("L", size).save("a.png")
        assert_refused(message, "a.png", f"image: a.png has {size[0]} x {size[1]} pixels")
    Image.new("L", (1, 65535)).save("a.png")
    assert load_texture(scene("a.png")).shape == (65535, 1, 3)


def test_a_picture_of_too_many_pixels(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    Image.new("1", (2000, 1500)).save("a.png")
    # Pillow warns of more pixels than this and refuses twice as many: 3 million are refused both ways.
    for limit in (2_000_000, 1_000_000):
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        assert_refused(message, "a.png", "image: a.png")


def test_the_size_is_read_from_the_header_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.png", "a.jpg", "a.bmp", "a.tif", "a.webp"):
        Image.fromarray(COLOURS).save(name)
        with monkeypatch.context() as patch:
            patch.setattr(Image.Image, "load", pytest.fail)
            assert image_size(scene(name)) == (3, 2)
            assert faults(name) == []


def test_no_warning_is_left_behind() -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(COLOURS).save("a.jpg", exif=exif)
    broken = Path("a.jpg").read_bytes().replace(exif.tobytes()[:14], exif.tobytes()[:10] + b"\xff\xff\xff\xff")
    Path("a.jpg").write_bytes(broken)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_texture(scene("a.jpg"))
