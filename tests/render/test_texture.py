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
from tests.golden import Messages
from tests.scenes import speckle

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
    return Scene.model_validate(
        {
            "image": image,
            "sheet": {"points": [2, 2], "size": [1, 1], "mass": 1},
            "springs": {},
            "time": {"duration": 1},
            "render": {"background": BACKGROUND},
            "output": [],
            **keys,
        }
    )


def faults(image: str | None, **keys: Any) -> list[str]:
    return [str(problem) for problem in image_problems(scene(image, **keys))]


def refusal(image: str, **keys: Any) -> str:
    with pytest.raises(SceneError) as caught:
        load_texture(scene(image, **keys))
    (line,) = caught.value.lines
    return line


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


def test_jpeg() -> None:
    Image.new("RGB", (16, 8), (200, 100, 50)).save("a.jpg", quality=100, subsampling=0)
    texture = load_texture(scene("a.jpg"))
    assert texture.shape == (8, 16, 3)
    # Rounding to whole Y, Cb, Cr and back is within 2 of each colour.
    assert np.abs(texture.astype(int) - [200, 100, 50]).max() <= 2


def test_one_pixel() -> None:
    Image.new("RGB", (1, 1), (1, 2, 3)).save("a.png")
    assert_texture("a.png", [[[1, 2, 3]]])


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_16_bit_grey_is_scaled_to_the_nearest(name: str) -> None:
    Image.fromarray(np.array([[0, 128, 129, 257, 32768, 65535]], dtype=np.uint16)).save(name)
    # v / 257: 0, 0.498, 0.502, 1, 127.502, 255
    assert_texture(name, grey(0, 0, 1, 1, 128, 255))


def test_big_endian_16_bit_grey() -> None:
    Image.frombytes("I;16B", (2, 1), bytes([0x01, 0x01, 0xFF, 0xFF])).save("a.tif")
    assert_texture("a.tif", grey(1, 255))


def test_black_and_white() -> None:
    image = Image.new("1", (2, 1))
    image.putpixel((1, 0), 1)
    image.save("a.png")
    assert_texture("a.png", grey(0, 255))


def test_grey() -> None:
    Image.fromarray(np.array([[0, 77, 255]], dtype=np.uint8)).save("a.png")
    assert_texture("a.png", grey(0, 77, 255))


def test_grey_with_alpha_lies_on_the_background() -> None:
    Image.fromarray(np.array([[[200, 255], [200, 0]]], dtype=np.uint8)).save("a.png")
    assert_texture("a.png", [[[200, 200, 200], BACKGROUND]])


def test_colour_with_alpha_lies_on_the_background() -> None:
    pixels = [[[200, 100, 50, 255], [200, 100, 50, 0], [200, 100, 50, 51]]]
    Image.fromarray(np.array(pixels, dtype=np.uint8)).save("a.png")
    # 51 / 255 is a fifth: 10 + 190 / 5, 20 + 80 / 5, 30 + 20 / 5
    assert_texture("a.png", [[[200, 100, 50], BACKGROUND, [48, 36, 34]]])


@pytest.fixture
def palette() -> Image.Image:
    image = Image.new("P", (3, 1))
    image.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255])
    image.putdata([2, 0, 1])
    return image


def test_palette(palette: Image.Image) -> None:
    palette.save("a.png")
    assert_texture("a.png", [[[0, 0, 255], [255, 0, 0], [0, 255, 0]]])


@pytest.mark.parametrize("transparency", [0, bytes([0, 255, 255])], ids=["index", "bytes"])
def test_palette_with_transparency(palette: Image.Image, transparency: int | bytes) -> None:
    palette.save("a.png", transparency=transparency)
    assert_texture("a.png", [[[0, 0, 255], BACKGROUND, [0, 255, 0]]])


def test_a_transparent_colour() -> None:
    Image.fromarray(COLOURS[:1]).save("a.png", transparency=(0, 255, 0))
    assert_texture("a.png", [[[255, 0, 0], BACKGROUND, [0, 0, 255]]])


def test_cmyk() -> None:
    Image.frombytes("CMYK", (3, 1), bytes([0, 0, 0, 0, 255, 0, 0, 0, 0, 0, 0, 255])).save("a.tif")
    assert_texture("a.tif", [[[255, 255, 255], [0, 255, 255], [0, 0, 0]]])


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


def test_exif_orientation_of_a_jpeg_turns_its_size() -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.new("RGB", (16, 8)).save("a.jpg", exif=exif)
    assert image_size(scene("a.jpg")) == (8, 16)
    assert load_texture(scene("a.jpg")).shape == (16, 8, 3)


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
    ("region", "fault"),
    [
        ([1, 0, 3, 2], "region: [1, 0, 3, 2] ends at 4, 2; the image has 3 x 2 pixels"),
        ([0, 1, 3, 2], "region: [0, 1, 3, 2] ends at 3, 3; the image has 3 x 2 pixels"),
        ([-1, 0, 2, 2], "region: [-1, 0, 2, 2] needs x and y of 0 or more, width and height above 0"),
        ([0, -1, 2, 2], "region: [0, -1, 2, 2] needs x and y of 0 or more, width and height above 0"),
        ([0, 0, 0, 2], "region: [0, 0, 0, 2] needs x and y of 0 or more, width and height above 0"),
        ([0, 0, 2, 0], "region: [0, 0, 2, 0] needs x and y of 0 or more, width and height above 0"),
    ],
)
def test_a_region_outside_the_image(region: list[int], fault: str) -> None:
    Image.fromarray(COLOURS).save("a.png")
    assert faults("a.png", region=region) == [fault]
    assert refusal("a.png", region=region) == fault


def test_a_region_without_an_image() -> None:
    assert faults(None, region=[0, 0, 9, 9]) == []
    assert faults(None, region=[0, 0, 9, 0]) != []
    assert faults(None) == []
    assert image_size(scene(None)) is None


def gif_named_png(name: str) -> None:
    Image.new("P", (3, 3)).save(name, format="GIF", save_all=True, append_images=[Image.new("P", (3, 3), 1)])


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda _: None, "no such file or directory; name a picture that can be read"),
        (lambda name: Path(name).mkdir(), "is a directory; name a picture"),
        (os.mkfifo, "is not a regular file; name a picture"),
        (lambda name: Path(name).symlink_to("/dev/zero"), "is not a regular file; name a picture"),
        (
            lambda name: Path(name).write_text("text"),
            "is not a PNG, JPEG, WebP, BMP or TIFF picture; convert it",
        ),
        (lambda name: Path(name).touch(), "is not a PNG, JPEG, WebP, BMP or TIFF picture; convert it"),
        (gif_named_png, "is not a PNG, JPEG, WebP, BMP or TIFF picture; convert it"),
        (
            lambda name: Image.new("F", (3, 3)).save(name, format="TIFF"),
            "has pixels of kind F; save it as 8-bit RGB",
        ),
        (
            lambda name: Image.new("I", (3, 3)).save(name, format="TIFF"),
            "has pixels of kind I; save it as 8-bit RGB",
        ),
    ],
    ids=["missing", "directory", "pipe", "device", "text", "empty", "gif", "float", "32 bits"],
)
def test_files_that_are_no_pictures(make: Any, fault: str) -> None:
    make("a.png")
    colon = ":" if fault.startswith("no such") else ""
    expected = f"image: a.png{colon} {fault}"
    assert faults("a.png") == [expected]
    assert refusal("a.png") == expected
    assert image_size(scene("a.png")) is None


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


@pytest.mark.parametrize("broken", [b"no profile", profile()[:300]])
def test_a_broken_profile_is_refused(broken: bytes) -> None:
    Image.fromarray(COLOURS).save("a.png", icc_profile=broken)
    line = refusal("a.png")
    assert line.startswith("image: a.png has a colour profile that cannot be used (cannot ")
    assert line.endswith("); save it as sRGB")


def test_a_profile_of_other_pixels_is_refused() -> None:
    Image.new("CMYK", (2, 2)).save("a.tif", icc_profile=profile())
    assert refusal("a.tif") == "image: a.tif has pixels of kind CMYK and a colour profile of RGB; save it as sRGB"


def test_a_file_of_any_size_is_not_read() -> None:
    with Path("a.png").open("wb") as file:
        file.truncate(2**31 + 1)
    assert faults("a.png") == ["image: a.png is larger than 2 GiB; scale it down"]


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp", "a.tif", "a.webp"])
def test_truncated_pictures(name: str) -> None:
    rng = np.random.default_rng(1)
    Image.fromarray(rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(name)
    whole = Path(name).read_bytes()
    Path(name).write_bytes(whole[: len(whole) // 2])
    line = refusal(name)
    assert line.startswith(f"image: {name} ")
    assert line.endswith(("; save it again", "; convert it"))


def test_a_picture_that_may_not_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*args: Any, **kwargs: Any) -> None:
        raise PermissionError

    Image.fromarray(COLOURS).save("secret.png")
    monkeypatch.setattr(Image, "open", forbidden)
    assert refusal("secret.png") == "image: secret.png may not be read; change its permissions"


def test_a_name_is_one_line_that_steers_no_terminal() -> None:
    name = "a\n\x1b[31m.png"
    Image.fromarray(COLOURS).save(name)
    Path(name).write_bytes(Path(name).read_bytes()[:45])
    assert refusal(name).startswith("image: a\\n\\x1b[31m.png cannot be decoded (")


def test_broken_pictures_bring_up_no_other_error() -> None:
    rng = np.random.default_rng(1)
    picture = Image.fromarray(rng.integers(0, 256, (8, 8, 3), dtype=np.uint8))
    refused = 0
    for name in ("a.png", "a.jpg", "a.bmp", "a.tif", "a.webp"):
        picture.save(name)
        whole = bytearray(Path(name).read_bytes())
        for _ in range(60):
            broken = whole.copy()
            for at in rng.integers(0, len(whole), 3):
                broken[at] = rng.integers(0, 256)
            Path(name).write_bytes(broken)
            list(image_problems(scene(name)))
            try:
                load_texture(scene(name))
            except SceneError:
                refused += 1
    assert refused > 50


def test_a_jpeg_of_too_many_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each goes over all pixels; those of a preview in the file, and what follows its end, do not count."""
    monkeypatch.chdir(tmp_path)
    file = io.BytesIO()
    preview = Image.Exif()
    preview[0x9286] = b"\xff\xda" * 40
    Image.fromarray(speckle(300, 500)).save(file, "JPEG", progressive=True, exif=preview)
    whole = file.getvalue()
    last = whole[whole.rfind(b"\xff\xc4", 0, whole.rfind(b"\xff\xda")) : -2]
    made = scene(image="a.jpg")
    for copies, refused in ((0, False), (1300, False), (1400, True)):
        Path("a.jpg").write_bytes(whole[:-2] + copies * last + b"\xff\xd9" + b"\xff\xda" * 4000)
        found = [str(problem) for problem in image_problems(made)]
        assert found == (
            [f"image: a.jpg has {copies + 10} scans, and 1333 are allowed; save it again"] if refused else []
        )
    with pytest.raises(SceneError, match="has 1410 scans"):
        load_texture(made)
    # A baseline one has scans too.
    file = io.BytesIO()
    Image.fromarray(speckle(300, 500)).save(file, "JPEG")
    whole = file.getvalue()
    Path("a.jpg").write_bytes(whole[:-2] + 1400 * whole[whole.rfind(b"\xff\xda") : -2] + b"\xff\xd9")
    assert ["1401 scans" in str(problem) for problem in image_problems(made)] == [True]


def test_a_picture_of_too_many_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow needs 24 bytes a row besides the pixels: a column of 89 million took 3 GB and 12 s."""
    monkeypatch.chdir(tmp_path)
    for size in ((1, 65536), (65536, 1)):
        Image.new("L", size).save("a.png")
        expected = f"image: a.png has {size[0]} x {size[1]} pixels; a side may have at most 65535, cut it"
        assert [str(problem) for problem in image_problems(scene(image="a.png"))] == [expected]
    Image.new("L", (1, 65535)).save("a.png")
    assert load_texture(scene(image="a.png")).shape == (65535, 1, 3)


def test_a_picture_of_too_many_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("1", (2000, 1500)).save("a.png")
    # Pillow warns of more pixels than this and refuses twice as many: 3 million are refused both ways.
    for limit in (2_000_000, 1_000_000):
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        expected = f"image: a.png has more than {limit // 10**6} million pixels; scale it down"
        assert faults("a.png") == [expected]
        assert refusal("a.png") == expected


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


def test_a_scene_without_a_picture(message: Messages) -> None:
    with message.raises(SceneError, "image"):
        load_texture(scene(None))
