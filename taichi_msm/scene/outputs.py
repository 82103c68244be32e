"""Outputs of a run, and the names of their files.

docs/architecture.md has the steps to add an output.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from importlib.util import find_spec
from typing import Literal, NamedTuple

PYAV_NOT_INSTALLED = "mp4 needs PyAV, which is not installed; pip install av"


def is_pyav_installed() -> bool:
    """Return whether PyAV is installed."""
    return find_spec("av") is not None


# Files of a run that no entry of `output` selects: the record, and the matrices of a camera.
RUN_RECORD, CAMERA_FILE = "run.json", "camera.json"

# Folder of a sweep: its record, the folder of the runs, and the pattern of their folders' names, the run numbers.
SWEEP_RECORD, RUNS_FOLDER = "sweep.json", "runs"
NUMBER_PATTERN = r"[0-9]{6,}"

# Prefix of the default folders of exports.
EXPORT_PREFIX = "export-"

# Camera names, which are also folder names: longest length, pattern.
MAX_CAMERA_NAME = 64
CAMERA_NAME = rf"[a-z0-9_-]{{1,{MAX_CAMERA_NAME}}}"

# Frame number in the file name of the first frame.
FIRST_FRAME = "0000"

# Columns of forces.csv.
FORCES_HEADER = ("time", "probe", "tip_x", "tip_y", "tip_z", "force_x", "force_y", "force_z")


class Output(NamedTuple):
    """An output of a run, which an entry of a scene's `output` selects."""

    name: str  # also the field of `Labels`, `Flow` or `Stereo`, for outputs of these sources
    file: str  # path of the file, or of the first file of a series; its suffix is the format
    source: Literal["picture", "labels", "flow", "stereo", "tracks", "positions", "forces"]
    pixel_bytes: float = 0  # largest file size per pixel, that of noise [bytes]; 0 if independent of the pixels
    needs_camera: bool = False  # whether the values are meaningful only with the camera's matrices
    needs_stereo_pair: bool = False  # whether only the reference camera of a stereo pair has it
    entry: str = ""  # entry of `output` that selects it; empty for `name`

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
        path = re.escape(self.file)
        return path.replace(FIRST_FRAME, r"(?:[0-9]{4}|[1-9][0-9]{4,14})") if self.is_series else path

    def path(self, frame: int = 0) -> str:
        """Return the path of the file, or that of a frame of a series."""
        return self.file.replace(FIRST_FRAME, f"{frame:04}")

    def count(self, frames: int) -> int:
        """Return the number of files of a series in a run of `frames` frames."""
        return max(0, frames - self.is_frame_pair)


# The outputs, in their order in messages and help; docs/files.md and docs/labels.md describe them. The bounds of the
# size are those of noise: PNG stores it uncompressed, GIF in codes of 12 bits, MP4 from yuv420p with 12 bits per pixel;
# a mask has two values. Most pictures take a half or a third of the bound.
_ROWS = (
    Output("png", "frames/0000.png", "picture", pixel_bytes=3.01),
    Output("gif", "animation.gif", "picture", pixel_bytes=1.51),
    Output("mp4", "animation.mp4", "picture", pixel_bytes=1.6),
    Output("trajectory", "trajectory.npz", "positions"),
    Output("forces", "forces.csv", "forces"),
    Output("coordinates", "coordinates/0000.npy", "labels", pixel_bytes=8, needs_camera=True),
    Output("depth", "depth/0000.tiff", "labels", pixel_bytes=4, needs_camera=True),
    Output("normals", "normals/0000.npy", "labels", pixel_bytes=12, needs_camera=True),
    Output("flow", "flow/0000.flo", "flow", pixel_bytes=8, needs_camera=True),
    Output("occlusion", "occlusion/0000.png", "flow", pixel_bytes=0.5),
    Output("disparity", "disparity/0000.tiff", "stereo", pixel_bytes=4, needs_camera=True, needs_stereo_pair=True),
    Output("stereo", "stereo/0000.flo", "stereo", pixel_bytes=8, needs_camera=True, needs_stereo_pair=True),
    Output(
        "stereo_occlusion",
        "stereo-occlusion/0000.png",
        "stereo",
        pixel_bytes=0.5,
        needs_stereo_pair=True,
        entry="stereo",
    ),
    Output("instrument", "instrument/0000.png", "labels", pixel_bytes=0.5),
    Output("tracks", "tracks.npz", "tracks", needs_camera=True),
)


OUTPUTS = {output.name: output._replace(entry=output.entry or output.name) for output in _ROWS}

# Entries of `output`.
ENTRIES = list(dict.fromkeys(output.entry for output in OUTPUTS.values()))

# Outputs with a file for every frame, by their folders.
SERIES_FOLDERS = {output.result: output for output in OUTPUTS.values() if output.is_series}

# Positions, areas and normals at rest of a curved sheet.
REST_FILE = "rest.npz"

# Regular expressions for the paths of all files of a run. Outputs of a named camera are in its folder.
_CAMERA_PATTERNS = [
    *(output.pattern for output in OUTPUTS.values() if output.is_camera_output),
    re.escape(CAMERA_FILE),
]
RESULT_PATTERNS = (
    *_CAMERA_PATTERNS,
    *(f"{CAMERA_NAME}/{pattern}" for pattern in _CAMERA_PATTERNS),
    *(output.pattern for output in OUTPUTS.values() if not output.is_camera_output),
    re.escape(REST_FILE),
    re.escape(RUN_RECORD),
)


def result_names(folders: Mapping[str, Collection[str]]) -> list[str]:
    """Return the results of a run, as in `outputs` of run.json, from the outputs of each folder (`Scene.folders`)."""
    selected = [(folder, output) for output in OUTPUTS.values() for folder in folders if output.name in folders[folder]]
    selected.sort(key=lambda item: not item[1].is_series)
    # The labels of a stereo pair need the matrices of both cameras.
    cameras = [folder for folder in folders if folder] or folders
    with_matrices = cameras if any(output.needs_camera for _, output in selected) else ()
    names = [(folder, output.result) for folder, output in selected]
    names += [(folder, CAMERA_FILE) for folder in with_matrices]
    return [*(f"{folder}/{name}" if folder else name for folder, name in names), RUN_RECORD]


def file_names(results: Iterable[str], frames: int) -> list[str]:
    """Return the paths of the files of a run, from its `result_names` and its number of frames."""
    names: list[str] = []
    for result in results:
        folder, slash, name = result.rpartition("/")
        output = SERIES_FOLDERS.get(name)
        names += [f"{folder}{slash}{output.path(n)}" for n in range(output.count(frames))] if output else [result]
    return names


def is_result(results: Collection[str], frames: int, name: str) -> bool:
    """Return whether a path within the folder of a run is one of its `file_names`, without listing them."""
    folder, _, file = name.rpartition("/")
    output, number = SERIES_FOLDERS.get(folder.rpartition("/")[2]), file.partition(".")[0]
    if output is None or not number.isdecimal():
        return name in results
    return folder in results and int(number) < output.count(frames)


def is_formula(text: str) -> bool:
    """Return whether a spreadsheet takes the text of a CSV cell for a formula."""
    return text.startswith(("=", "+", "-", "@", "\t", "\r"))


def zero_padded(number: int) -> str:
    """Format the number of a run of a sweep, or of an item of an export, for the name of its file or folder."""
    return f"{number:06}"
