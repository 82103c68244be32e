"""Read the data set of a sweep, for training: copy this file, which needs NumPy and Pillow only.

`Pairs` and `Clips` are map-style data sets of PyTorch, whose `DataLoader` makes tensors of their arrays:

    pairs = Pairs("output/tracking", "train")
    for batch in DataLoader(pairs, batch_size=4, shuffle=True, num_workers=2):
        flow, valid = batch["flow"], batch["valid"]  # (4, 2, height, width), (4, height, width)

Places are in pixels to the right and down from the picture's upper left corner, so that the centre of the first pixel
is at (0.5, 0.5); `grid_sample` with `align_corners=False` takes them as 2 x / width - 1, 2 y / height - 1. A file has
1e10 where flow is not known; here `valid` is False there and the flow 0, which spoils no sum.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray
from PIL import Image

UNKNOWN = 1e9  # Flow beyond this is not known.


class Pair(TypedDict):
    """Two successive frames, and what is known of the first."""

    first: NDArray[np.uint8]  # RGB, shape (3, height, width)
    second: NDArray[np.uint8]
    flow: NDArray[np.float32]  # how far what is seen moves to the right and down [px], shape (2, height, width)
    valid: NDArray[np.bool_]  # where flow is known: tissue, not an instrument or the background; shape (height, width)
    occluded: NDArray[np.bool_]  # where what is seen is hidden or outside the picture in the second
    depth: NDArray[np.float32]  # along the direction of view [m]; 0: background


class Clip(TypedDict):
    """Successive frames, and the material points that are followed through them."""

    video: NDArray[np.uint8]  # RGB, shape (frames, 3, height, width)
    points: NDArray[np.float32]  # their places [px], shape (points, frames, 2); 0 behind the eye
    visible: NDArray[np.bool_]  # whether they are seen, shape (points, frames)


class _Part:
    """The runs of a part of a data set, cut into items of so many frames that begin every so many frames."""

    def __init__(self, directory: str | Path, part: str, length: int, every: int, camera: str) -> None:
        self.directory = Path(directory)
        self._camera = camera
        content = json.loads((self.directory / "dataset.json").read_text(encoding="utf-8"))
        # Of each its number, folder, part, and under "values" what varied.
        self.runs: list[dict[str, Any]] = [run for run in content["runs"] if run["part"] == part]
        if not self.runs:
            parts = ", ".join(sorted({run["part"] for run in content["runs"]}))
            raise ValueError(f"{directory}: no runs in part {part!r}; take one of {parts}")
        self._length, self._every = length, every
        self._items = max(0, (content["frames"] - length) // every + 1)  # of a run

    def __len__(self) -> int:
        return len(self.runs) * self._items

    def _find(self, index: int) -> tuple[Path, int]:
        """Give the folder of what the camera saw of an item's run, and the item's first frame."""
        run, item = divmod(range(len(self))[index], self._items)
        return self.directory / self.runs[run]["folder"] / self._camera, item * self._every


class Pairs(_Part):
    """All pairs of successive frames of a part, such as train, val or test, of the data set in a folder.

    Of several cameras it takes the one of a name.
    """

    def __init__(self, directory: str | Path, part: str, camera: str = "") -> None:
        super().__init__(directory, part, length=2, every=1, camera=camera)

    def __getitem__(self, index: int) -> Pair:
        folder, frame = self._find(index)
        flow = read_flow(folder / f"flow/{frame:04}.flo")
        valid = np.abs(flow).max(axis=0) < UNKNOWN
        return {
            "first": _picture(folder, frame),
            "second": _picture(folder, frame + 1),
            "flow": np.where(valid, flow, np.float32(0)),
            "valid": valid,
            "occluded": _pixels(folder / f"occlusion/{frame:04}.png") > 0,
            "depth": _pixels(folder / f"depth/{frame:04}.tiff"),
        }


class Clips(_Part):
    """Clips of so many successive frames, one after the other, of a part of the data set in a folder; as `Pairs`."""

    def __init__(self, directory: str | Path, part: str, frames: int = 24, camera: str = "") -> None:
        super().__init__(directory, part, length=frames, every=frames, camera=camera)

    def __getitem__(self, index: int) -> Clip:
        folder, first = self._find(index)
        frames = range(first, first + self._length)
        with np.load(folder / "tracks.npz") as tracks:
            points, occluded = (tracks[name][:, frames] for name in ("points", "occluded"))
        return {
            "video": np.stack([_picture(folder, frame) for frame in frames]),
            "points": np.nan_to_num(points),
            "visible": ~occluded,
        }


def read_flow(path: Path) -> NDArray[np.float32]:
    """Read flow in Middlebury's format: to the right and down [px], shape (2, height, width)."""
    width, height = np.fromfile(path, "<i4", count=2, offset=4)
    return np.fromfile(path, "<f4", offset=12).reshape(height, width, 2).transpose(2, 0, 1)


def _picture(folder: Path, frame: int) -> NDArray[np.uint8]:
    return _pixels(folder / f"frames/{frame:04}.png").transpose(2, 0, 1)


def _pixels(path: Path) -> NDArray[Any]:
    with Image.open(path) as image:
        return np.array(image)
