"""Outputs of a run, and the names of their files.

A new output is a row of the table in this module, and a field with its values.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib.util import find_spec
from typing import Literal, NamedTuple

PYAV_NOT_INSTALLED = "mp4 needs PyAV, which is not installed; pip install av"


def is_pyav_installed() -> bool:
    """Return whether PyAV is installed."""
    return find_spec("av") is not None


# Files of a run without an entry of `output`: the record, and the matrices of a camera.
RUN_RECORD, CAMERA_FILE = "run.json", "camera.json"

# Record in the folder of a sweep; its folder with a folder for each run; pattern of the names of these, run numbers.
SWEEP_RECORD, RUNS_FOLDER = "sweep.json", "runs"
NUMBER_PATTERN = r"[0-9]{6,}"

# Prefix of the default folders of exports.
EXPORT_PREFIX = "export-"

# Names of cameras, which are also names of folders.
MAX_CAMERA_NAME = 64
CAMERA_NAME = rf"[a-z0-9_-]{{1,{MAX_CAMERA_NAME}}}"

# Number of the first frame in the name of its file, and the pattern of the numbers of all frames.
FIRST_FRAME, FRAME_PATTERN = "0000", r"(?:[0-9]{4}|[1-9][0-9]{4,14})"

# Columns of the table of forces.
FORCES_HEADER = ("time", "probe", "tip_x", "tip_y", "tip_z", "force_x", "force_y", "force_z")


class Output(NamedTuple):
    """An output of a run, which an entry of a scene's `output` selects."""

    # Of the sources labels, flow and stereo, also the field of `Labels`, `Flow` or `Stereo` that is written, in the
    # format of the file's suffix.
    name: str
    file: str  # path, or that of the first frame of a series
    source: Literal["picture", "labels", "flow", "stereo", "tracks", "positions", "forces"]
    description: str  # for users
    pixel_bytes: float = 0  # upper bound of the file's size per pixel, of a picture of noise; 0 if independent of them
    needs_camera: bool = False  # whether the values are meaningful only with the camera's matrices
    needs_stereo_pair: bool = False  # whether only the reference camera of a stereo pair has it
    entry: str = ""  # entry of `output` that selects it; empty if it is the name

    @property
    def result(self) -> str:
        """The file, or the folder of a series, as named in `outputs` of run.json."""
        return self.file.partition("/")[0]

    @property
    def is_series(self) -> bool:
        """Whether every frame has a file."""
        return "/" in self.file

    @property
    def is_camera_output(self) -> bool:
        """Whether the values depend on the camera, so that each camera of a run has its own file or series."""
        return self.source not in ("positions", "forces")

    @property
    def is_frame_pair(self) -> bool:
        """Whether the values belong to a frame and the next one, so that the last frame has none."""
        return self.source == "flow"

    @property
    def pattern(self) -> str:
        """Regular expression for the paths of the files."""
        return re.escape(self.file).replace(FIRST_FRAME, FRAME_PATTERN) if self.is_series else re.escape(self.file)

    def path(self, frame: int = 0) -> str:
        """Return the path of the file, or that of a frame of a series."""
        return self.file.replace(FIRST_FRAME, f"{frame:04}")

    def count(self, frames: int) -> int:
        """Return the number of files of a series in a run with a number of frames."""
        return max(0, frames - self.is_frame_pair)


def _all_outputs() -> Iterator[Output]:
    """Iterate over the outputs, in their order in messages and help.

    Upper bounds of the size: PNG stores noise uncompressed, a code of a GIF has 12 bits, a pixel of yuv420p has 12 bits
    before encoding, and a mask has two values. Most pictures take a half or a third of them.
    """
    yield Output("png", "frames/0000.png", "picture", "the picture", pixel_bytes=3.01)
    yield Output("gif", "animation.gif", "picture", "the pictures as an animation", pixel_bytes=1.51)
    description = (
        "the pictures as a video, H.264 in yuv420p; an odd last row or column is repeated; needs PyAV "
        "(`pip install av`)"
    )
    yield Output("mp4", "animation.mp4", "picture", description, pixel_bytes=1.6)
    description = "`time` [s], shape (frames,), and `position` of the mass points [m], shape (frames, rows, cols, 3)"
    yield Output("trajectory", "trajectory.npz", "positions", description)
    description = (
        "a row for each frame and probe: `time` [s], `probe`, `tip_x`, `tip_y`, `tip_z` [m] of the lowest point of a "
        "position-controlled tool, or of the control point on the deformed sheet, and `force_x`, `force_y`, `force_z` "
        "[N] on the mass points that are not fixed; of a position-controlled tool the mean since the previous frame"
    )
    yield Output("forces", "forces.csv", "forces", description)
    description = (
        "float32 (height, width, 2): the material point at the pixel's centre, as fractions of the sheet's width from "
        "its left and of its height from its top; NaN where the sheet is not visible"
    )
    yield Output("coordinates", "coordinates/0000.npy", "labels", description, pixel_bytes=8, needs_camera=True)
    description = (
        "float32 [m], along the optical axis from the eye; with `camera: top` from a plane above the sheet at rest, at "
        "a distance equal to the larger side of the sheet; 0: background"
    )
    yield Output("depth", "depth/0000.tiff", "labels", description, pixel_bytes=4, needs_camera=True)
    description = (
        "float32 (height, width, 3): the unit normal of the drawn triangle, without relief, or of the instrument, "
        "toward the camera, in its axes (x right, y down, z forward); NaN: background"
    )
    yield Output("normals", "normals/0000.npy", "labels", description, pixel_bytes=12, needs_camera=True)
    description = (
        "Middlebury's format: the motion of the visible material point until the next frame, right and down [px], also "
        "where it is hidden there; 1e10: no sheet, or it moves behind the eye or beyond the lens's limit"
    )
    yield Output("flow", "flow/0000.flo", "flow", description, pixel_bytes=8, needs_camera=True)
    description = "255 where the visible material point is hidden or outside the picture in the next frame, else 0"
    yield Output("occlusion", "occlusion/0000.png", "flow", description, pixel_bytes=0.5)
    description = (
        "of the reference camera of a stereo pair: float32 [px], fx × baseline / depth, the distance to the left in "
        "the picture of the first camera that is `beside` it; 0: background"
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
    description = (
        "of the reference camera of a stereo pair: Middlebury's format, from the pixel to the place of its tissue or "
        "instrument in the picture of the first camera that is `beside` it, at the same time, right and down [px], "
        "also where it is hidden there; 1e10: background, or it is behind that camera or beyond its lens's limit"
    )
    yield Output(
        "stereo", "stereo/0000.flo", "stereo", description, pixel_bytes=8, needs_camera=True, needs_stereo_pair=True
    )
    yield Output(
        "stereo_occlusion",
        "stereo-occlusion/0000.png",
        "stereo",
        "255 where the pixel's tissue or instrument is hidden or outside the picture in that camera, else 0",
        pixel_bytes=0.5,
        needs_stereo_pair=True,
        entry="stereo",
    )
    description = "255 where an instrument is visible, else 0"
    yield Output("instrument", "instrument/0000.png", "labels", description, pixel_bytes=0.5)
    description = (
        "of `render.tracks` × `render.tracks` points at the centres of equal cells of the sheet: `coordinates` (N, 2), "
        "`points` (N, frames, 2) [px] from the picture's upper left corner, NaN behind the eye, `occluded` (N, frames) "
        "and `position` (N, frames, 3) [m] in the world, on the drawn surface"
    )
    yield Output("tracks", "tracks.npz", "tracks", description, needs_camera=True)


def zero_padded(number: int) -> str:
    """Format the number of a run of a sweep, or of an item of an export, for the name of its file or folder."""
    return f"{number:06}"


OUTPUTS = {output.name: output._replace(entry=output.entry or output.name) for output in _all_outputs()}

# Entries of `output`.
ENTRIES = list(dict.fromkeys(output.entry for output in OUTPUTS.values()))

# Outputs with a file for every frame, by their folders.
SERIES_FOLDERS = {output.result: output for output in OUTPUTS.values() if output.is_series}

# Regular expressions for the paths of all files of a run. Outputs of a named camera are in its folder.
_CAMERA_PATTERNS = [
    *(output.pattern for output in OUTPUTS.values() if output.is_camera_output),
    re.escape(CAMERA_FILE),
]
RESULT_PATTERNS = (
    *_CAMERA_PATTERNS,
    *(f"{CAMERA_NAME}/{pattern}" for pattern in _CAMERA_PATTERNS),
    *(output.pattern for output in OUTPUTS.values() if not output.is_camera_output),
    re.escape(RUN_RECORD),
)


def result_names(folders: Mapping[str, Collection[str]]) -> list[str]:
    """List the results of a run, as in `outputs` of run.json: folders of series, files, matrices of cameras, record.

    Args:
        folders: names of the outputs, by the folders of the cameras; "" is the folder of the run.
    """
    selected = [(folder, output) for output in OUTPUTS.values() for folder in folders if output.name in folders[folder]]
    selected.sort(key=lambda item: not item[1].is_series)
    # The labels of a stereo pair need the matrices of both cameras.
    cameras = [folder for folder in folders if folder] or folders
    with_matrices = cameras if any(output.needs_camera for _, output in selected) else ()
    names = [(folder, output.result) for folder, output in selected]
    names += [(folder, CAMERA_FILE) for folder in with_matrices]
    return [*(f"{folder}/{name}" if folder else name for folder, name in names), RUN_RECORD]


def file_names(results: Iterable[str], frames: int) -> list[str]:
    """List the files of a run with a number of frames, for results from `result_names`."""
    names: list[str] = []
    for result in results:
        folder, slash, name = result.rpartition("/")
        output = SERIES_FOLDERS.get(name)
        names += [f"{folder}{slash}{output.path(n)}" for n in range(output.count(frames))] if output else [result]
    return names


def is_result(results: Collection[str], frames: int, name: str) -> bool:
    """Return whether a path is in `file_names`, without listing them."""
    folder, _, file = name.rpartition("/")
    output, number = SERIES_FOLDERS.get(folder.rpartition("/")[2]), file.partition(".")[0]
    if output is None or not number.isdecimal():
        return name in results
    return folder in results and int(number) < output.count(frames)
