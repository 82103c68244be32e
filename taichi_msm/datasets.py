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
from pathlib import Path
from typing import Any, ClassVar, TypedDict

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import ArgumentError, FilesError, NotInstalledError
from taichi_msm.runs.arrays import read_flo
from taichi_msm.scene.outputs import OUTPUTS


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
        self.directory, self._camera = Path(directory), camera
        try:
            content = json.loads((self.directory / "dataset.json").read_text(encoding="utf-8"))
        except OSError as error:
            fault = f"{self.directory / 'dataset.json'}: {error.strerror}"
            raise FilesError(f"{fault}; name the folder that `taichi-msm sweep` wrote") from None
        # Number ("run"), folder, split ("part") and varied values of each run.
        self.runs: list[dict[str, Any]] = [run for run in content["runs"] if run["part"] == split]
        if not self.runs:
            splits = ", ".join(sorted({run["part"] for run in content["runs"]})) or "none, as no run is complete"
            raise ArgumentError(f"split: {split!r} has no runs in {directory}; the splits are {splits}")
        written = {Path(name) for name in content["outputs"]}
        if missing := [name for name in self.outputs if Path(camera, OUTPUTS[name].result) not in written]:
            remedy = f"run the sweep with set: {{output: [{', '.join(self.outputs)}]}}"
            raise ArgumentError(f"directory: {self.directory / camera} has no {', '.join(missing)}; {remedy}")
        self._size, self._length, self._stride = content["size"], length, stride
        self._windows = max(0, (content["frames"] - length) // stride + 1)  # windows per run

    def __len__(self) -> int:
        return len(self.runs) * self._windows

    def loader(self, **options: Any) -> Any:
        """Return a `torch.utils.data.DataLoader` of this data set.

        Args:
            **options: keyword arguments of `DataLoader`, such as batch_size, shuffle and num_workers.

        Raises:
            NotInstalledError: when PyTorch is not installed.
        """
        try:
            from torch.utils.data import DataLoader
        except ImportError:
            raise NotInstalledError("a loader needs PyTorch, which is not installed; pip install torch") from None
        return DataLoader(self, **options)

    def _find(self, index: int) -> tuple[Path, int]:
        """Return the folder of the camera, within that of the run, and the first frame of a window."""
        run, window = divmod(range(len(self))[index], self._windows)
        return self.directory / self.runs[run]["folder"] / self._camera, window * self._stride


class Pairs(_Split):
    """Data set of the pairs of successive frames of a split.

    Args:
        directory: folder of the sweep.
        split: train, val or test.
        camera: name of the camera; "" for a scene with a single one.

    Raises:
        ArgumentError: when the split has no runs, or the runs lack outputs.
        FilesError: when dataset.json cannot be read.
    """

    outputs = ("png", "flow", "occlusion", "depth")

    def __init__(self, directory: str | Path, split: str, camera: str = "") -> None:
        super().__init__(directory, split, length=2, stride=1, camera=camera)

    def __getitem__(self, index: int) -> Pair:
        folder, frame = self._find(index)
        width, height = self.runs[index // self._windows].get("size", self._size)
        flow = read_flo(folder / OUTPUTS["flow"].path(frame), (width, height)).transpose(2, 0, 1)
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
        super().__init__(directory, split, length=frames, stride=frames, camera=camera)

    def __getitem__(self, index: int) -> Clip:
        folder, first = self._find(index)
        frames = range(first, first + self._length)
        with np.load(folder / OUTPUTS["tracks"].path()) as tracks:
            points, occluded = (tracks[name][:, frames] for name in ("points", "occluded"))
        return {
            "video": np.stack([_read_image(folder, "png", frame).transpose(2, 0, 1) for frame in frames]),
            "points": np.nan_to_num(points),
            "visible": ~occluded,
        }


def _read_image(folder: Path, output: str, frame: int) -> NDArray[Any]:
    with Image.open(folder / OUTPUTS[output].path(frame)) as image:
        return np.array(image)
