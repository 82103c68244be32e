"""Size, pixels and checksum of picture files, which may be corrupt or malicious."""

from __future__ import annotations

import hashlib
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from taichi_msm.errors import windows_path_hint
from taichi_msm.system.process import available_memory, discarded_output

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL import Image

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")

# Accepted pixel modes of Pillow, without 32-bit and floating-point greys, whose range is not defined.
_MODES_16_BIT = ("I;16", "I;16L", "I;16B", "I;16N")
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", *_MODES_16_BIT)

# Largest side [px]. Pillow spends memory and time on every row, even of a single column.
MAX_SIDE_PX = 65535

# Memory per pixel of a file, while it is decoded and converted [bytes].
DECODING_BYTES = 20

# Largest file [bytes], larger than Pillow's largest picture with four channels of 16 bits.
MAX_BYTES = 2**31

# Path of the copy that is read in place of a file, by path of the file.
_copies: Mapping[str, Path] = {}

# Folder to which other paths are relative.
_folder = Path()


class PictureError(Exception):
    """A file cannot be used as a picture."""

    def __init__(self, fault: str, remedy: str) -> None:
        super().__init__(fault, remedy)
        self.fault = fault

    def __str__(self) -> str:
        return "; ".join(self.args)


@contextmanager
def use_copies(copies: Mapping[str, Path]) -> Iterator[None]:
    """Read copies of files within the block; `copies` has their paths by path of the file."""
    global _copies
    previous, _copies = _copies, copies
    try:
        yield
    finally:
        _copies = previous


@contextmanager
def use_folder(folder: str | Path) -> Iterator[None]:
    """Let paths of files be relative to a folder within the block."""
    global _folder
    previous, _folder = _folder, Path(folder)
    try:
        yield
    finally:
        _folder = previous


def read_rgb(path: str, background: tuple[int, int, int], sha256: str | None = None) -> Image.Image:
    """Read the first picture of a file, upright, as 8-bit sRGB, with `background` behind transparent pixels.

    If the file has another SHA-256 than `sha256`, in hexadecimal, it is an error.
    """
    from PIL import ImageOps

    with _open(path, sha256) as opened:
        image = ImageOps.exif_transpose(opened)
        return _to_rgb(_to_srgb(path, _to_8_bit(image), image.info.get("icc_profile")), background)


def read_grey(path: str, sha256: str | None = None) -> NDArray[Any]:
    """Read the grey values of an upright picture, shape (height, width): uint16 for a file of 16 bits, else uint8.

    Grey values are data, not colours: the colour profile is ignored. Transparent pixels are black. `sha256` is as for
    `read_rgb`.
    """
    import numpy as np
    from PIL import ImageOps

    with _open(path, sha256) as opened:
        image = ImageOps.exif_transpose(opened)
        if image.mode in _MODES_16_BIT:
            return np.asarray(image).astype(np.uint16)
        return np.asarray(_to_rgb(image, (0, 0, 0)).convert("L"))


def read_depth(path: str, sha256: str | None = None) -> NDArray[Any]:
    """Read the numbers of an upright picture with one channel, of 8 or 16 bits or floating-point, shape (h, w)."""
    import numpy as np
    from PIL import ImageOps

    with _open(path, sha256, (*_MODES_16_BIT, "L", "F")) as opened:
        require_memory(path, DECODING_BYTES * opened.width * opened.height, "scale it down")
        image = ImageOps.exif_transpose(opened)
        return np.asarray(image).astype(np.uint16) if image.mode in _MODES_16_BIT else np.asarray(image)


def picture_size(path: str) -> tuple[int, int]:
    """Return the width and height of the upright picture [px], from the file's header."""
    from PIL import Image

    with _open(path) as image:
        # Orientations (tag 0x0112) 5 to 8 swap width and height; for TIFF, Pillow does it. The base class reads only
        # the header, the getexif of PNG decodes the picture.
        if image.format != "TIFF" and Image.Image.getexif(image).get(0x0112) in (5, 6, 7, 8):
            return image.height, image.width
        return image.size


def require_memory(path: str, needed: int, remedy: str) -> None:
    """Raise a PictureError if reading a file needs more memory [bytes] than is free."""
    if needed > (free := available_memory()):
        fault = f"{path} needs {needed / 2**20:.3g} MiB of memory, and {free / 2**20:.3g} MiB is free"
        raise PictureError(fault, remedy)


def has_transparency(path: str) -> bool:
    """Return whether any pixel of a picture is fully or partly transparent."""
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
def _open(path: str, sha256: str | None = None, modes: Sequence[str] = _MODES) -> Iterator[Image.Image]:
    """Open and check a picture; convert all errors, also of the block, to a PictureError."""
    from PIL import Image, UnidentifiedImageError

    _require_file(path)
    is_colour, one_channel = modes == _MODES, "save one number a pixel, or an .npy array"
    # libtiff and Pillow also print the errors that they raise.
    with discarded_output(2), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with ExitStack() as opened:
                file = opened.enter_context(actual_path(path).open("rb"))
                if sha256 is not None and _sha256(file) != sha256:
                    fault = f"{path} differs from the file of the run (SHA-256)"
                    raise PictureError(fault, "restore the original file")
                file.seek(0)
                image = opened.enter_context(Image.open(file, formats=PICTURE_FORMATS))
                if max(image.size) > MAX_SIDE_PX:
                    fault = f"{path} has {image.width} x {image.height} pixels"
                    raise PictureError(fault, f"crop it to at most {MAX_SIDE_PX} a side")
                if image.format in ("JPEG", "MPO"):
                    scans = _count_scans(file)
                    # A scan is a pass over the picture, and encoders write about ten. More are allowed up to 200
                    # million pixels in all, which take a few seconds.
                    limit = max(16, 200_000_000 // (image.width * image.height))
                    if scans > limit:
                        raise PictureError(f"{path} has {scans} scans, more than {limit}", "save it again")
                if image.mode not in modes:
                    remedy = "save it as 8-bit RGB" if is_colour else one_channel
                    raise PictureError(f"{path} has pixels of kind {image.mode}", remedy)
                yield image
        except PictureError:
            raise
        except UnidentifiedImageError:
            remedy = "convert it" if is_colour else one_channel
            raise PictureError(f"{path} is not a PNG, JPEG, WebP, BMP or TIFF picture", remedy) from None
        except (Image.DecompressionBombWarning, Image.DecompressionBombError):
            limit = (Image.MAX_IMAGE_PIXELS or 0) // 10**6
            raise PictureError(f"{path} has more than {limit} million pixels", "scale it down") from None
        except PermissionError as error:
            raise _unreadable(path, error) from None
        except Exception as error:
            raise PictureError(f"{path} cannot be decoded ({error})", "save it again") from None


def _sha256(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    while data := file.read(1 << 20):
        digest.update(data)
    return digest.hexdigest()


def _count_scans(file: BinaryIO) -> int:
    """Count the scans of a JPEG file, even of a corrupt one."""
    offset, scans = 2, 0
    with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        while (offset := data.find(b"\xff", offset)) >= 0 and (marker := data[offset + 1 : offset + 2]) not in (
            b"",
            b"\xd9",
        ):
            # Stuffed bytes, padding and restart markers have no length field.
            if marker in b"\x00\x01\xff" or b"\xd0" <= marker <= b"\xd8":
                offset += 1 if marker == b"\xff" else 2
                continue
            scans += marker == b"\xda"
            offset += 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
    return scans


def irregular_kind(path: Path) -> str:
    """Return the kind of a path that is no regular file, else ""; the path is not opened, as a pipe would block."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    return "a directory" if stat.S_ISDIR(mode) else "not a regular file"


def actual_path(path: str) -> Path:
    """Return the path to read: within `use_copies` that of its copy, within `use_folder` that in the folder."""
    return _copies.get(path) or _folder / path


def _require_file(path: str) -> None:
    try:
        kind = irregular_kind(actual_path(path))
    except ValueError:
        raise PictureError(f"{path} is not a path", "name a picture") from None
    except OSError as error:
        raise _unreadable(path, error) from None
    if kind:
        raise PictureError(f"{path} is {kind}", "name a picture")
    if actual_path(path).stat().st_size > MAX_BYTES:
        raise PictureError(f"{path} is larger than {MAX_BYTES >> 30} GiB", "scale it down")


def _unreadable(path: str, error: OSError) -> PictureError:
    if isinstance(error, PermissionError):
        return PictureError(f"{path} may not be read", "change its permissions")
    remedy = f"name a picture that can be read{windows_path_hint(path)}"
    return PictureError(f"{path}: {(error.strerror or str(error)).lower()}", remedy)


def _to_8_bit(image: Image.Image) -> Image.Image:
    """Scale 16-bit greys to 8 bits, rounded to the nearest; Pillow's conversion clips at 255."""
    if image.mode not in _MODES_16_BIT:
        return image
    import numpy as np
    from PIL import Image

    grey = np.asarray(image).astype(np.uint32)
    return Image.fromarray(((grey * 255 + 32767) // 65535).astype(np.uint8))


def _to_srgb(path: str, image: Image.Image, profile: bytes | None) -> Image.Image:
    """Convert 8-bit colours of a colour profile to sRGB, with the perceptual intent."""
    if not profile:
        return image
    import io

    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        # A profile of any other space is for RGB pixels.
        mode = {"GRAY": "L", "CMYK": "CMYK"}.get(space, "RGB")
        valid_modes = {"L": ("1", "L", "LA"), "CMYK": ("CMYK",)}.get(mode, tuple(m for m in _MODES if m != "CMYK"))
        if image.mode not in valid_modes:
            fault = f"{path} has pixels of kind {image.mode} and a colour profile of {space}"
            raise PictureError(fault, "save it as sRGB")
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (OSError, ImageCms.PyCMSError) as error:
        reason = str(error).strip() or "unknown"
        raise PictureError(f"{path} has a colour profile that cannot be used ({reason})", "save it as sRGB") from None
    if mode == "RGB" and _is_identity(transform):
        return image
    transparent = image.convert("RGBA") if image.has_transparency_data else None
    converted = ImageCms.applyTransform((transparent or image).convert(mode), transform)
    assert converted is not None
    if transparent is not None:
        converted.putalpha(transparent.getchannel("A"))
    return converted


def _is_identity(transform: Any) -> bool:
    """Return whether a transform from RGB to sRGB changes 16 x 16 x 16 colours by at most 2 of 255 per channel."""
    import numpy as np
    from PIL import Image, ImageCms

    colours = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 17, dtype=np.uint8)]), axis=-1).reshape(1, -1, 3)
    converted = np.asarray(ImageCms.applyTransform(Image.fromarray(colours), transform))
    return int(np.abs(converted.astype(int) - colours).max()) <= 2


def _to_rgb(image: Image.Image, background: tuple[int, int, int]) -> Image.Image:
    """Convert a picture of any mode but 16-bit grey to RGB, with the background behind transparent pixels."""
    from PIL import Image

    if not image.has_transparency_data:
        return image.convert("RGB")
    backdrop = Image.new("RGBA", image.size, (*background, 255))
    return Image.alpha_composite(backdrop, image.convert("RGBA")).convert("RGB")
