"""Read the size or the pixels of a picture's file, whatever is in it."""

from __future__ import annotations

import hashlib
import stat
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from taichi_msm.system.process import silenced

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL import Image

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")

# The kinds of pixels, by Pillow's names, whose colours are defined; 32-bit and floating-point greys can have any range.
_MODES_16_BIT = ("I;16", "I;16L", "I;16B", "I;16N")
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", *_MODES_16_BIT)

# The longest side of a picture. Pillow needs memory and time for every row, and a picture of one column has many.
MAX_SIDE_PX = 65535

# The largest file: as many pixels as Pillow takes, with 16 bits of four channels, are smaller.
MAX_BYTES = 2**31

# Colour profiles that change no 8-bit colour by more than this are sRGB, and pictures keep their bits.
SRGB_ROUNDING = 2

# Every scan of a JPEG goes over all pixels. Encoders make about ten; more are allowed up to a few seconds of decoding.
USUAL_SCANS = 16
SCANNED_PIXELS = 2 * 10**8

_ORIENTATION = 0x0112
_LYING = (5, 6, 7, 8)


# Where files are read instead of at the paths by which they are known.
_copies: Mapping[str, Path] = {}


class PictureError(Exception):
    """The file cannot be used as a picture; the message says why and what to do."""


@contextmanager
def use_copies(copies: Mapping[str, Path]) -> Iterator[None]:
    """In a block, read copies of some files, by the paths by which they are known."""
    global _copies
    around, _copies = _copies, copies
    try:
        yield
    finally:
        _copies = around


def read_rgb(path: str, background: tuple[int, int, int], sha256: str | None = None) -> Image.Image:
    """Read a picture, upright, in 8-bit RGB; a transparent one is laid over the background.

    Colours are converted from the file's colour profile to sRGB. If a file has several pictures, the first is taken.
    PictureError: it cannot be used, or has not this SHA-256, in hexadecimal.
    """
    from PIL import ImageOps

    with _open(path, sha256) as opened:
        image = ImageOps.exif_transpose(opened)
        return _to_rgb(_to_srgb(path, _to_8_bit(image), image.info.get("icc_profile")), background)


def read_grey(path: str, sha256: str | None = None) -> NDArray[Any]:
    """Read the greys of a picture, upright, shape (height, width): of 16 bits where it has them, else of 8.

    They are numbers, so they are read as stored, whatever the colour profile. Otherwise as `read_rgb`, over black.
    """
    import numpy as np
    from PIL import ImageOps

    with _open(path, sha256) as opened:
        image = ImageOps.exif_transpose(opened)
        if image.mode in _MODES_16_BIT:
            return np.asarray(image).astype(np.uint16)
        return np.asarray(_to_rgb(image, (0, 0, 0)).convert("L"))


def picture_size(path: str) -> tuple[int, int]:
    """Read the width and height of the upright picture [px] from the file's header."""
    from PIL import Image

    with _open(path) as image:
        # For a TIFF, Pillow already gives the size of the upright picture. The base class's getexif() reads only the
        # header; that of PNG would decode the picture to look behind it.
        if image.format != "TIFF" and Image.Image.getexif(image).get(_ORIENTATION) in _LYING:
            return image.height, image.width
        return image.size


def has_transparency(path: str) -> bool:
    """Tell whether any pixel of a picture lets the background through."""
    with _open(path) as image:
        return image.has_transparency_data and image.convert("RGBA").getchannel("A").getextrema() != (255, 255)


def file_sha256(path: str) -> str:
    """Compute the SHA-256 of a file, in hexadecimal."""
    _require_file(path)
    try:
        with actual_path(path).open("rb") as file:
            return _sha256(file)
    except OSError as error:
        raise _unreadable(path, error) from None


@contextmanager
def _open(path: str, sha256: str | None = None) -> Iterator[Image.Image]:
    """Open a picture for a block that decodes it.

    Raises:
        PictureError: instead of any error of Pillow, here or in the block; broken pictures raise many types.
    """
    from PIL import Image, UnidentifiedImageError

    _require_file(path)
    # The output of libtiff and of Pillow's log is silenced: the error that is raised says the same.
    with silenced(2), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with _file(path, sha256) as file, Image.open(file, formats=PICTURE_FORMATS) as image:
                if max(image.size) > MAX_SIDE_PX:
                    said = f"has {image.width} x {image.height} pixels; a side may have at most {MAX_SIDE_PX}, cut it"
                    raise PictureError(f"{path} {said}")
                if image.format in ("JPEG", "MPO"):
                    scans = _scans(file)
                    most = max(USUAL_SCANS, SCANNED_PIXELS // (image.width * image.height))
                    if scans > most:
                        raise PictureError(f"{path} has {scans} scans, and {most} are allowed; save it again")
                if image.mode not in _MODES:
                    raise PictureError(f"{path} has pixels of kind {image.mode}; save it as 8-bit RGB")
                yield image
        except PictureError:
            raise
        except UnidentifiedImageError:
            raise PictureError(f"{path} is not a PNG, JPEG, WebP, BMP or TIFF picture; convert it") from None
        except (Image.DecompressionBombWarning, Image.DecompressionBombError):
            limit = (Image.MAX_IMAGE_PIXELS or 0) // 10**6
            raise PictureError(f"{path} has more than {limit} million pixels; scale it down") from None
        except PermissionError:
            raise PictureError(f"{path} may not be read; change its permissions") from None
        except Exception as error:
            raise PictureError(f"{path} cannot be decoded ({error}); save it again") from None


@contextmanager
def _file(path: str, sha256: str | None) -> Iterator[BinaryIO]:
    """Open a file, which must have a SHA-256 if one is given; raises PictureError."""
    with actual_path(path).open("rb") as file:
        if sha256 is not None:
            if _sha256(file) != sha256:
                raise PictureError(f"{path} is not the file that was run, as its SHA-256 tells; put that one back")
            file.seek(0)
        yield file


def _sha256(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    while data := file.read(1 << 20):
        digest.update(data)
    return digest.hexdigest()


def _scans(file: BinaryIO) -> int:
    """Count the scans of a JPEG, which may be broken."""
    at, scans = 2, 0
    with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        while (at := data.find(b"\xff", at)) >= 0 and (marker := data[at + 1 : at + 2]) not in (b"", b"\xd9"):
            # Stuffed and padding bytes and restarts have no length; they occur within the data of a scan.
            if marker in b"\x00\x01\xff" or b"\xd0" <= marker <= b"\xd8":
                at += 1 if marker == b"\xff" else 2
                continue
            scans += marker == b"\xda"
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return scans


def irregular_kind(path: Path) -> str:
    """Say what a path is instead of a regular file, without opening it: opening a pipe would wait for its other end."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    return "a directory" if stat.S_ISDIR(mode) else "not a regular file"


def actual_path(path: str) -> Path:
    """Find where a file is that is known by a path: there, or its copy."""
    return _copies.get(path) or Path(path)


def _require_file(path: str) -> None:
    try:
        kind = irregular_kind(actual_path(path))
    except ValueError:
        raise PictureError(f"{path} is not a path; name a picture") from None
    except OSError as error:
        raise _unreadable(path, error) from None
    if kind:
        raise PictureError(f"{path} is {kind}; name a picture")
    if actual_path(path).stat().st_size > MAX_BYTES:
        raise PictureError(f"{path} is larger than {MAX_BYTES >> 30} GiB; scale it down")


def _unreadable(path: str, error: OSError) -> PictureError:
    return PictureError(f"{path}: {(error.strerror or str(error)).lower()}; name a picture that can be read")


def _to_8_bit(image: Image.Image) -> Image.Image:
    """Convert 16-bit greys, 65535 to 255, rounded to the nearest; Pillow's own conversion clips at 255."""
    if image.mode not in _MODES_16_BIT:
        return image
    import numpy as np
    from PIL import Image

    grey = np.asarray(image).astype(np.uint32)
    return Image.fromarray(((grey * 255 + 32767) // 65535).astype(np.uint8))


def _to_srgb(path: str, image: Image.Image, profile: bytes | None) -> Image.Image:
    """Convert 8-bit colours from a colour profile, perceptually, to RGB or RGBA; raises PictureError."""
    if not profile:
        return image
    import io

    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        # Greys are kept as those of the profile where it is of greys; all else that is no CMYK is red, green and blue.
        mode = {"GRAY": "L", "CMYK": "CMYK"}.get(space, "RGB")
        pixels = {"L": ("1", "L", "LA"), "CMYK": ("CMYK",)}.get(mode, tuple(m for m in _MODES if m != "CMYK"))
        if image.mode not in pixels:
            raise PictureError(
                f"{path} has pixels of kind {image.mode} and a colour profile of {space}; save it as sRGB"
            )
        change = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (OSError, ImageCms.PyCMSError) as error:
        said = str(error).strip() or "unknown"
        raise PictureError(f"{path} has a colour profile that cannot be used ({said}); save it as sRGB") from None
    if mode == "RGB" and _is_srgb(change):
        return image
    clear = image.convert("RGBA") if image.has_transparency_data else None
    found = ImageCms.applyTransform((clear or image).convert(mode), change)
    assert found is not None
    if clear is not None:
        found.putalpha(clear.getchannel("A"))
    return found


def _is_srgb(change: Any) -> bool:
    """Return whether a transform from RGB to sRGB keeps every colour, by 16 values of each channel."""
    import numpy as np
    from PIL import Image, ImageCms

    colours = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 17, dtype=np.uint8)]), axis=-1).reshape(1, -1, 3)
    changed = np.asarray(ImageCms.applyTransform(Image.fromarray(colours), change))
    return int(np.abs(changed.astype(int) - colours).max()) <= SRGB_ROUNDING


def _to_rgb(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    """Convert pixels of any kind in `_MODES` but those of 16 bits."""
    from PIL import Image

    if not image.has_transparency_data:
        return image.convert("RGB")
    below = Image.new("RGBA", image.size, (*background, 255))
    return Image.alpha_composite(below, image.convert("RGBA")).convert("RGB")
