"""Read the arrays of observations from an .npz."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.images import irregular_kind
from taichi_msm.system.process import available_memory

NEEDS = "time (T,), coordinates (N, 2) and position (N, T, 3) or pixel (N, T, 2)"
MEMBERS = ("time", "coordinates", "position", "pixel", "sigma", "points", "occluded", "visible")

# Parts of array names that suggest data of observations.
SUGGESTIVE_NAME_PARTS = (
    "visib",
    "occlu",
    "mask",
    "valid",
    "missing",
    "lost",
    "status",
    "score",
    "weight",
    "confid",
    "sigma",
    "std",
    "unit",
    "scale",
)


def read_archive(name: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Read the arrays of observations from an .npz, and the names of all its arrays.

    Raises:
        SceneError: when the file is not an .npz, or an array cannot be used.
    """
    path, remedy = Path(name), f"name an .npz with {NEEDS}, or a run's trajectory.npz or tracks.npz"
    try:
        if kind := irregular_kind(path):
            raise SceneError([f"{name}: {'a folder' if path.is_dir() else kind}; {remedy}"])
        with path.open("rb") as file:
            signature = file.read(6)
        if signature.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive:
                return _members(name, archive)
        reason = "a single array, as np.save writes" if signature == b"\x93NUMPY" else "not an .npz"
    except FileNotFoundError:
        reason = "no such file"
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
    except (ValueError, NotImplementedError, zipfile.BadZipFile):
        reason = "not an .npz"
    raise SceneError([f"{name}: {reason}; {remedy}"])


def require_understood(name: str, keys: list[str]) -> None:
    """Check that no array is ignored whose name suggests data of observations; SceneError: lists such arrays."""
    ignored = [key for key in keys if key not in MEMBERS and any(word in key.lower() for word in SUGGESTIVE_NAME_PARTS)]
    if ignored:
        fault = "not understood; take NaN where not observed, or visible or occluded (N, T), and sigma for errors"
        raise SceneError([f"{name}: {', '.join(map(ascii, ignored))}: {fault}"])


def _members(name: str, archive: zipfile.ZipFile) -> tuple[dict[str, NDArray[Any]], list[str]]:
    infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    require_understood(name, list(infos))
    members = {key: info for key, info in infos.items() if key in MEMBERS}
    if (size := sum(info.file_size for info in members.values())) > (limit := available_memory() // 4):
        fault = (
            f"{size / 1e9:.1f} GB of arrays, and there is memory for {limit / 1e9:.1f} GB; leave points or times out"
        )
        raise SceneError([f"{name}: {fault}"])
    arrays = {}
    for key, info in members.items():
        try:
            with archive.open(info) as member:
                arrays[key] = np.lib.format.read_array(member, allow_pickle=False)
        except Exception as error:  # zipfile, its decompressors and NumPy raise any kind
            reason = str(error).partition("\n")[0] or type(error).__name__
            reason = "encrypted" if info.flag_bits & 1 else reason
            reason = "an array of Python objects" if reason.startswith("Object arrays") else f"cannot be read: {reason}"
            raise SceneError([f"{name}: {key}: {reason}; write it again by np.savez, as numbers"]) from None
    return arrays, list(infos)
