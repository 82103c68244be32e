"""The outputs of a run. A new output is a row of this table, and what computes its values."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib.util import find_spec
from typing import Literal, NamedTuple

PYAV_NOT_INSTALLED = "mp4 needs PyAV, which is not installed; pip install av"


def is_pyav_installed() -> bool:
    """Tell whether PyAV is installed."""
    return find_spec("av") is not None


# Of a run's files these two belong to no entry of `output`: the record, and the matrices of the camera.
RUN_RECORD, CAMERA_FILE = "run.json", "camera.json"

# In the folder of a sweep: its record, and the folder with a folder for each run, as `run` writes it, by its number.
SWEEP_RECORD, RUNS_FOLDER = "sweep.json", "runs"
NUMBER_PATTERN = r"[0-9]{6,}"

# What the names of folders begin with that exports go to by default.
EXPORT_PREFIX = "export-"

# The names of cameras, of which each has a folder.
MAX_NAME = 64
CAMERA_NAME = rf"[a-z0-9_-]{{1,{MAX_NAME}}}"

# The number in the name of a frame's file.
FIRST_FRAME, FRAME_PATTERN = "0000", r"(?:[0-9]{4}|[1-9][0-9]{4,14})"


# The columns of the table of forces.
FORCES_HEADER = ("time", "probe", "tip_x", "tip_y", "tip_z", "force_x", "force_y", "force_z")


class Output(NamedTuple):
    """An entry of a scene's `output`.

    Of labels, flow and stereo, the field of `Labels`, `Flow` or `Stereo` with the output's name is written, in the
    format of the suffix.
    """

    name: str
    file: str  # with a folder, that of the first frame of a series
    # Field of `Observed`; positions and forces: none.
    source: Literal["picture", "labels", "flow", "stereo", "tracks", "positions", "forces"]
    description: str  # what the file holds, for users
    pixel_bytes: float = 0  # the most that a pixel takes in a file, as one of noise; 0: the size is not by pixels
    needs_camera: bool = False  # whether it can be used only with the camera's matrices
    needs_stereo_pair: bool = False  # whether only a camera that others are beside has it

    @property
    def result(self) -> str:
        """The file, or the folder with a file for every frame; so `outputs` in run.json names it."""
        return self.file.partition("/")[0]

    @property
    def is_series(self) -> bool:
        """Whether there is a file for every frame."""
        return "/" in self.file

    @property
    def is_camera_output(self) -> bool:
        """Whether it depends on what a camera sees; in a run with several cameras each has its own."""
        return self.source not in ("positions", "forces")

    @property
    def is_frame_pair(self) -> bool:
        """Whether it tells of a frame what happens until the next one; then there is none of the last frame."""
        return self.source == "flow"

    @property
    def pattern(self) -> str:
        """A regular expression for the names of its files."""
        return re.escape(self.file).replace(FIRST_FRAME, FRAME_PATTERN) if self.is_series else re.escape(self.file)

    def path(self, frame: int = 0) -> str:
        """Name the file, of a frame if there is one for each."""
        return self.file.replace(FIRST_FRAME, f"{frame:04}")

    def count(self, frames: int) -> int:
        """Count the files of a series in a run with this many frames."""
        return max(0, frames - self.is_frame_pair)


def _rows() -> Iterator[Output]:
    """Give the table, in the order in which errors and help name the outputs.

    PNGs store pixels of noise, codes of a GIF have 12 bits, films in yuv420p 12 bits a pixel before they are encoded,
    and masks two values; most pictures take a half or a third of that.
    """
    yield Output("png", "frames/0000.png", "picture", "the picture", pixel_bytes=3.01)
    yield Output("gif", "animation.gif", "picture", "the pictures as an animation", pixel_bytes=1.51)
    description = (
        "the pictures as a film, H.264 in yuv420p; an odd last row or column is repeated; needs PyAV (`pip install av`)"
    )
    yield Output("mp4", "animation.mp4", "picture", description, pixel_bytes=1.6)
    description = "`time` [s], shape (frames,), and `position` of the mass points [m], shape (frames, rows, cols, 3)"
    yield Output("trajectory", "trajectory.npz", "positions", description)
    description = (
        "a row for each frame and probe: `time` [s], `probe`, `tip_x`, `tip_y`, `tip_z` [m], of the lowest point of a "
        "tool that is moved, or of the control point on the deformed sheet, and `force_x`, `force_y`, `force_z` [N] on "
        "the points that are not fixed; of a tool that is moved the mean since the frame before"
    )
    yield Output("forces", "forces.csv", "forces", description)
    description = (
        "float32 (height, width, 2): the material point at the pixel's centre, as fractions of the sheet's width from "
        "its left and of its height from its top; NaN where no sheet is seen"
    )
    yield Output("coordinates", "coordinates/0000.npy", "labels", description, pixel_bytes=8, needs_camera=True)
    description = (
        "float32 [m] along the direction of view, from the eye; with `camera: top` from as far above the sheet at rest "
        "as its larger side is long; 0: background"
    )
    yield Output("depth", "depth/0000.tiff", "labels", description, pixel_bytes=4, needs_camera=True)
    description = (
        "float32 (height, width, 3): the unit normal of what is seen, of the drawn triangle without relief or of the "
        "instrument, toward the camera, in its axes (x right, y down, z forward); NaN: background"
    )
    yield Output("normals", "normals/0000.npy", "labels", description, pixel_bytes=12, needs_camera=True)
    description = (
        "Middlebury's format: how far what is seen moves until the next frame, right and down [px], hidden there or "
        "not; 1e10: no sheet, or it goes behind the eye or beyond the lens's limit"
    )
    yield Output("flow", "flow/0000.flo", "flow", description, pixel_bytes=8, needs_camera=True)
    description = "255 where what is seen is hidden or outside the picture in the next frame, else 0"
    yield Output("occlusion", "occlusion/0000.png", "flow", description, pixel_bytes=0.5)
    description = (
        "of a camera that another one is beside: float32, how far to the left what is seen is in the picture of the "
        "first of those [px], fx × baseline / depth; 0: background"
    )
    yield Output(
        "disparity",
        "disparity/0000.tiff",
        "stereo",
        description,
        pixel_bytes=4,
        needs_camera=True,
        needs_stereo_pair=True,
    )
    description = "255 where an instrument is seen, else 0"
    yield Output("instrument", "instrument/0000.png", "labels", description, pixel_bytes=0.5)
    description = (
        "of `render.tracks` × `render.tracks` points in the middle of equal fields of the sheet: `coordinates` (N, 2), "
        "`points` (N, frames, 2) [px] from the picture's upper left corner, NaN behind the eye, `occluded` (N, frames) "
        "and `position` (N, frames, 3) [m] in the world, on the drawn surface"
    )
    yield Output("tracks", "tracks.npz", "tracks", description, needs_camera=True)


def zero_padded(number: int) -> str:
    """Name a run by its number in a sweep or an export, or a pair of frames by its number in an export."""
    return f"{number:06}"


OUTPUTS = {output.name: output for output in _rows()}

# The folders with a file for every frame, each with its output.
SERIES_FOLDERS = {output.result: output for output in OUTPUTS.values() if output.is_series}

# The names of all files that a run writes, as regular expressions. What a camera with a name sees is in its folder.
_SEEN = [*(output.pattern for output in OUTPUTS.values() if output.is_camera_output), re.escape(CAMERA_FILE)]
RESULT_PATTERNS = (
    *_SEEN,
    *(f"{CAMERA_NAME}/{pattern}" for pattern in _SEEN),
    *(output.pattern for output in OUTPUTS.values() if not output.is_camera_output),
    re.escape(RUN_RECORD),
)


def result_names(folders: Mapping[str, Collection[str]]) -> list[str]:
    """Name the results of a run, whose outputs go to these folders, as run.json does.

    They are: folders with a file for every frame; files; those of the cameras; the record.
    """
    chosen = [(folder, output) for output in OUTPUTS.values() for folder in folders if output.name in folders[folder]]
    chosen.sort(key=lambda each: not each[1].is_series)
    described = dict.fromkeys(folder for folder, output in chosen if output.needs_camera)
    names = [*((folder, output.result) for folder, output in chosen), *((folder, CAMERA_FILE) for folder in described)]
    return [*(f"{folder}/{name}" if folder else name for folder, name in names), RUN_RECORD]


def file_names(results: Iterable[str], frames: int) -> list[str]:
    """List the files of a run with this many frames, by the names of its results."""
    names: list[str] = []
    for result in results:
        folder, slash, name = result.rpartition("/")
        output = SERIES_FOLDERS.get(name)
        names += [f"{folder}{slash}{output.path(n)}" for n in range(output.count(frames))] if output else [result]
    return names


def is_result(results: Collection[str], frames: int, name: str) -> bool:
    """Tell whether a file is one of a run with these results and so many frames."""
    folder, _, file = name.rpartition("/")
    output, number = SERIES_FOLDERS.get(folder.rpartition("/")[2]), file.partition(".")[0]
    if output is None or not number.isdecimal():
        return name in results
    return folder in results and int(number) < output.count(frames)
