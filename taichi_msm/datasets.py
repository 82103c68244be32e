"""Data sets of sweeps for PyTorch.

`Pairs` and `Clips` are map-style data sets of NumPy arrays. PyTorch's `DataLoader` collates them to tensors:

    pairs = Pairs("output/tracking", "train")
    for batch in pairs.loader(batch_size=4, shuffle=True, num_workers=2):
        flow, valid = batch["flow"], batch["valid"]  # (4, 2, height, width), (4, height, width)

Pixel coordinates (x right, y down) have their origin at the picture's upper left corner: the centre of the first pixel
is (0.5, 0.5). For `grid_sample` with `align_corners=False`, convert them to 2 x / width - 1, 2 y / height - 1.

PyTorch is imported by `loader` only.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from itertools import accumulate
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar, TypedDict

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from typing_extensions import Self

from taichi_msm.errors import ArgumentError, FilesError, NotInstalledError, require_path
from taichi_msm.runs.arrays import read_flo
from taichi_msm.scene.outputs import OUTPUTS

REPEAT = "remove the files of this run, and run the sweep again"


class Pair(TypedDict):
    """Two successive frames, and the labels of the first."""

    first: NDArray[np.uint8]  # RGB, shape (3, height, width)
    second: NDArray[np.uint8]  # RGB, shape (3, height, width)
    flow: NDArray[np.float32]  # displacement (x right, y down) [px], 0 where not valid; shape (2, height, width)
    valid: NDArray[np.bool_]  # True on tissue, whose flow is known; shape (height, width)
    occluded: NDArray[np.bool_]  # True on tissue that is hidden or outside in the second frame; shape (height, width)
    depth: NDArray[np.float32]  # along the viewing direction [m], 0 on the background; shape (height, width)


class Clip(TypedDict):
    """Successive frames, with tracks of material points."""

    video: NDArray[np.uint8]  # RGB, shape (frames, 3, height, width)
    points: NDArray[np.float32]  # projected material points [px], shape (points, frames, 2); 0 behind the camera
    visible: NDArray[np.bool_]  # shape (points, frames)


class _Split:
    """Base class: the runs of a split, cut into windows of `length` frames that begin every `stride` frames."""

    outputs: ClassVar[tuple[str, ...]]  # required outputs of the runs

    def __init__(self, directory: str | Path, split: str, length: int, stride: int, camera: str) -> None:
        require_path(directory)
        require_path(camera, "camera", "take the name of a camera")
        self.directory, self._camera, self._length, self._stride = Path(directory), camera, length, stride
        path = self.directory / "dataset.json"
        with _reading(path, "name the folder that `taichi-msm sweep` wrote"):
            content = json.loads(path.read_text(encoding="utf-8"))
            common = {key: content.get(key) for key in ("outputs", "frames", "size")}
            runs = [{**common, **run} for run in content["runs"] if run["part"] == split]
            splits = ", ".join(sorted({run["part"] for run in content["runs"]})) or "none, as no run is complete"
            self._select(runs)
        if not runs:
            raise ArgumentError(f"split: {split!r} has no runs in {directory}; the splits are {splits}")
        files = [Path(camera, OUTPUTS[name].result) for name in self.outputs]
        for run in runs:
            folder = self.directory / run["folder"]
            written = set(map(Path, run["outputs"]))
            if missing := [name for name, file in zip(self.outputs, files, strict=True) if file not in written]:
                remedy = f"run the sweep with set: {{output: [{', '.join(self.outputs)}]}}"
                raise ArgumentError(f"directory: {folder / camera} has no {', '.join(missing)}; {remedy}")
            if not folder.is_dir():
                raise FilesError(f"{folder}: no such folder; run the sweep again")
        if not self.runs:
            longest = max(run["frames"] for run in runs)
            fault = f"frames: {length}; the longest run of {split!r} has {longest}"
            raise ArgumentError(f"{fault}; take fewer, or a sweep of longer runs")

    def _select(self, runs: list[dict[str, Any]]) -> None:
        # Number ("run"), folder, split ("part"), values, frames and frame size [px] of each run with a window.
        self.runs = [run for run in runs if run["frames"] >= self._length]
        windows = [(run["frames"] - self._length) // self._stride + 1 for run in self.runs]
        self._ends = [0, *accumulate(windows)]  # number of windows before each run, and in all

    def __len__(self) -> int:
        return self._ends[-1]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Widths and heights of the frames [px], in the order of the runs."""
        return list(dict.fromkeys((width, height) for width, height in (run["size"] for run in self.runs)))

    def of_size(self, size: tuple[int, int]) -> Self:
        """Return the part of this data set with frames of one size, width and height [px], for batches."""
        if not isinstance(size, (tuple, list)) or tuple(size) not in self.sizes:
            raise ArgumentError(f"size: {size!r}; take one of {', '.join(map(str, self.sizes))}")
        part = copy(self)
        part._select([run for run in self.runs if tuple(run["size"]) == tuple(size)])
        return part

    def loader(self, **options: Any) -> Any:
        """Return a `torch.utils.data.DataLoader` of this data set; `options` are its arguments, such as batch_size."""
        is_batched = options.get("batch_size") not in (None, 1) and "collate_fn" not in options
        if is_batched and len(self.sizes) > 1:
            sizes = ", ".join(map(str, self.sizes))
            raise ArgumentError(f"batch_size: frames of sizes {sizes} cannot be in one batch; use of_size(SIZE).loader")
        try:
            from torch.utils.data import DataLoader
        except ImportError:
            raise NotInstalledError("a loader needs PyTorch, which is not installed; pip install torch") from None
        return DataLoader(self, **options)

    def _find(self, index: int) -> tuple[dict[str, Any], Path, int]:
        """Return a window's run, the folder of the camera in that of the run, and the first frame."""
        index = range(len(self))[index]
        number = bisect_right(self._ends, index) - 1
        run, frame = self.runs[number], (index - self._ends[number]) * self._stride
        return run, self.directory / run["folder"] / self._camera, frame


class Pairs(_Split):
    """Data set of the pairs of successive frames of a split.

    Args:
        directory: folder of the sweep.
        split: train, val or test.
        camera: name of the camera; "" for a scene with a single one.

    Raises:
        ArgumentError: when the split has no runs, or the runs lack outputs or frames.
        FilesError: when dataset.json cannot be read, or a run is missing; of items when a file cannot be read.
    """

    outputs = ("png", "flow", "occlusion", "depth")

    def __init__(self, directory: str | Path, split: str, camera: str = "") -> None:
        super().__init__(directory, split, length=2, stride=1, camera=camera)

    def __getitem__(self, index: int) -> Pair:
        run, folder, frame = self._find(index)
        path = folder / OUTPUTS["flow"].path(frame)
        with _reading(path):
            flow = read_flo(path, tuple(run["size"])).transpose(2, 0, 1)
        valid = np.abs(flow).max(axis=0) < 1e9  # Files mark unknown flow by 1e10 px.
        return {
            "first": _read_image(folder, "png", frame).transpose(2, 0, 1),
            "second": _read_image(folder, "png", frame + 1).transpose(2, 0, 1),
            "flow": np.where(valid, flow, np.float32(0)),
            "valid": valid,
            "occluded": _read_image(folder, "occlusion", frame) > 0,
            "depth": _read_image(folder, "depth", frame),
        }


class Clips(_Split):
    """Data set of the clips of a split, without overlap.

    Args:
        directory, split, camera: as for `Pairs`.
        frames: number of frames in a clip.

    Raises:
        ArgumentError, FilesError: as for `Pairs`.
    """

    outputs = ("png", "tracks")

    def __init__(self, directory: str | Path, split: str, frames: int = 24, camera: str = "") -> None:
        if isinstance(frames, bool) or not isinstance(frames, Integral) or frames < 1:
            raise ArgumentError(f"frames: {frames!r}; take a whole number, 1 or more")
        super().__init__(directory, split, length=frames, stride=frames, camera=camera)

    def __getitem__(self, index: int) -> Clip:
        _, folder, first = self._find(index)
        frames = range(first, first + self._length)
        path = folder / OUTPUTS["tracks"].path()
        with _reading(path), np.load(path) as tracks:
            points, occluded = (tracks[name][:, frames] for name in ("points", "occluded"))
        return {
            "video": np.stack([_read_image(folder, "png", frame).transpose(2, 0, 1) for frame in frames]),
            "points": np.nan_to_num(points),
            "visible": ~occluded,
        }


def _read_image(folder: Path, output: str, frame: int) -> NDArray[Any]:
    path = folder / OUTPUTS[output].path(frame)
    with _reading(path), Image.open(path) as image:
        return np.array(image)


@contextmanager
def _reading(path: Path, remedy: str = REPEAT) -> Iterator[None]:
    """Return a context that converts exceptions to FilesErrors; damaged files raise many types."""
    try:
        yield
    except Exception as error:
        reason = (error.strerror or "cannot be read").lower() if isinstance(error, OSError) else "damaged"
        raise FilesError(f"{path}: {reason}; {remedy}") from None
