"""Reader of .npy and .npz files of numbers, which may be corrupt or malicious."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from taichi_msm.errors import windows_path_hint
from taichi_msm.images import PictureError, actual_path, require_memory
from taichi_msm.system.files import read_regular

if TYPE_CHECKING:
    from numpy.typing import NDArray

ARRAY_SUFFIXES = (".npy", ".npz")

# Largest magnitude of a number [m].
MAX_M = 1e6

# Largest file, and largest array in it [bytes]: 4096 x 4096 points of three float64 numbers, with some margin.
MAX_BYTES = 2**29


# Peak memory of reading a file, in sizes of its array.
MEMORY_FACTOR = 4


@dataclass(frozen=True, eq=False)
class ArrayFile:
    """Numbers of a file, in metres except of depth maps, compared by identity, as arrays have no one ==."""

    values: NDArray[Any]  # float64, of depth maps as in the file
    sha256: str  # of the file
    step: float  # of heights, which are multiples of it but for an offset [m]; 0 for floating-point numbers


def read_array_file(
    path: str, unit: float, names: Sequence[str], is_shape: Callable[[tuple[int, ...]], bool], shapes: str
) -> ArrayFile:
    """Read an .npy, or of an .npz the first of `names` in it or its only array, and convert it from `unit` [m].

    A PictureError reports a file without an array of an allowed shape, `shapes` in words, of finite numbers.
    """
    import numpy as np

    array, sha256 = read_raw_array(path, names, is_shape, shapes)
    values = array.astype(np.float64) * unit
    # NaN also fails this comparison.
    is_small = np.abs(values) <= MAX_M
    if not is_small.all():
        at = ", ".join(map(str, np.unravel_index(int((~is_small).argmax()), array.shape)))
        raise PictureError(f"{path}: [{at}] is {array[~is_small][0]}", f"give finite numbers, of up to {MAX_M:g} m")
    return ArrayFile(values, sha256, unit * quantum(array))


def read_raw_array(
    path: str, names: Sequence[str], is_shape: Callable[[tuple[int, ...]], bool], shapes: str
) -> tuple[NDArray[Any], str]:
    """Return the array of `read_array_file` as it is in the file, and the SHA-256 of the file."""
    try:
        data = read_regular(actual_path(path), MAX_BYTES)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remedy = f"name an .npy or .npz file that can be read{windows_path_hint(path)}"
        raise PictureError(f"{path}: {reason.lower()}", remedy) from None
    remedy = f"with numpy.save, save an array of numbers of shape {shapes}"
    try:
        array = _load(path, data, names)
    except PictureError:
        raise
    except Exception:  # a forged file may raise any type
        raise PictureError(f"{path} is not an .npy or .npz file of numbers", remedy) from None
    if array.dtype.kind not in "fiu":
        raise PictureError(f"{path} has an array of {array.dtype}", remedy)
    if not is_shape(array.shape) or 0 in array.shape:
        raise PictureError(f"{path} has an array of shape {array.shape}", remedy)
    return array, hashlib.sha256(data).hexdigest()


def quantum(values: NDArray[Any]) -> float:
    """Return the greatest common divisor of the differences of integers; 0 for equal and floating-point numbers."""
    import numpy as np

    return float(np.gcd.reduce(np.diff(np.unique(values).astype(np.int64)))) if values.dtype.kind in "iu" else 0.0


def _load(path: str, data: bytes, names: Sequence[str]) -> NDArray[Any]:
    """Return the array of a file's content."""
    import numpy as np

    if data[:2] != b"PK":
        require_memory(path, MEMORY_FACTOR * len(data), "save fewer points")
        return np.load(io.BytesIO(data), allow_pickle=False)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        name = next((name for name in names if name in members), next(iter(members)) if len(members) == 1 else None)
        if name is None:
            present = ", ".join(sorted(members)[:9]) or "no array"
            raise PictureError(f"{path} has {present}", f"name one of its arrays {names[0]}")
        size = members[name].file_size
        if size > MAX_BYTES:
            raise PictureError(f"{path}: {name} has {size:,} bytes", f"take at most {MAX_BYTES:,}")
        require_memory(path, MEMORY_FACTOR * size, "save fewer points")
        with archive.open(members[name]) as member:
            return np.load(io.BytesIO(member.read(MAX_BYTES)), allow_pickle=False)
