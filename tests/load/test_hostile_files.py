"""Files of a megabyte of one character: every reader refuses or reads them within seconds.

A pattern of quadratic cost takes minutes for a megabyte, one of linear cost less than a second.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from taichi_msm.array_files import read_array_file
from taichi_msm.camera_files.camera_file import CameraFileError
from taichi_msm.camera_files.readers import PoseKeys, read_calibration, read_poses
from taichi_msm.errors import MsmError
from taichi_msm.fitting.archive import read_observations
from taichi_msm.images import PictureError
from taichi_msm.load.scene_file import load_scene, parse_override
from taichi_msm.sweeps.spec import load_sweep

SIZE = 1_000_000  # [bytes]; scenes may have 2^20
LIMIT_S = 20.0  # of the processor, for each file

# Repeated texts: single characters, and pairs that patterns may split in several ways.
REPEATED = [*" \n\t([{\"'0-.,;:#%=ae\\", "a ", "1:", "1a", " \n", "[a]\n", "a=1\n", "- ", "\r"]

CAMERA = "K1: [60, 0, 20, 0, 60, 15, 0, 0, 1]\nD1: [0, 0, 0, 0]\n"
IMAGE = "1 1 0 0 0 0 0 0 1 "

# Reader of a file, and valid beginnings of its formats.
READERS: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "calibration": (
        lambda path: read_calibration(str(path), "right"),
        (
            *("", "%YAML:1.0\n---\nK: ", CAMERA + CAMERA.replace("1:", "2:") + "a", '{"K": "', "<a>\n<K>"),
            *("[StereoLeft]\nb=1\n", "[StereoLeft]\nb", "#polynomial coefficients\n", "1 PINHOLE 40 ", "1 PINHOLE\n"),
            *('{"frames": [{"transform_matrix": "', "cam0=[", "cam0=[1 0 1; 0 1 1; 0 0 1]\n", "<document><sensor>"),
            *("Pinhole 1 1 1 1 0\n4 3\ncrop\n", "Pinhole ", "[LEFT_CAM_HD]\nfx=1\n", '{"camera-calibration": {"'),
        ),
    ),
    "trajectory": (
        lambda path: read_poses(str(path), PoseKeys(poses_rate=5.0)),
        (
            *(
                "",
                "# ",
                "t tx ty tz qx qy qz qw ",
                "0 0 0 0 0 0 0 1\n",
                "1 0 0 0 0 1 0 0 0 0 1 0\n",
                IMAGE,
                f"{IMAGE}1a",
            ),
            *(
                '{"frames": [{"transform_matrix": [',
                '{"camera-pose": [',
                "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n",
                "1 0 0 0\n",
            ),
        ),
    ),
    "scene": (load_scene, ("", "image: ", "sheet: {points: ")),
    "override": (lambda path: parse_override(path.read_text()), ("", "image=")),
    "sweep": (load_sweep, ("", "scene: s.yaml\nvary: {image: {choice: '", "scene: s.yaml\nvariables: {")),
    "array": (
        lambda path: read_array_file(str(path), 1.0, ("points",), lambda shape: len(shape) == 3, "(r, c, 3)"),
        ("", "PK\x03\x04", "\x93NUMPY\x01\x00v\x00{", "\x93NUMPY\x02\x00\x00\x00\x02\x00{'shape': ("),
    ),
    "points": (lambda path: read_observations(path, 25.0), ("", "PK\x03\x04", "PK\x05\x06")),
}


def cases() -> Iterator[tuple[str, str]]:
    """Yield the name of a reader, and the content of a file."""
    for reader, (_, heads) in READERS.items():
        for repeated in REPEATED:
            body = repeated * (SIZE // len(repeated))
            yield reader, body
            # A last line that does not match makes a pattern try all ways to split the line before it.
            yield from ((reader, f"{head}{body[: SIZE - 100]}x\n1") for head in heads)


def read_all(folder: Path) -> None:
    """Read every file, and print its reader and beginning before; a process that exceeds the limit is ended."""
    for reader, text in cases():
        sys.stdout.write(f"{reader} {text[:100]!r}\n")
        sys.stdout.flush()
        path = folder / "hostile"
        path.write_bytes(text.encode("latin-1"))
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
        with suppress(CameraFileError, MsmError, PictureError):
            READERS[reader][0](path)
    signal.setitimer(signal.ITIMER_PROF, 0)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of the processor's time")
def test_a_megabyte_of_one_character(tmp_path: Path, root: Path) -> None:
    code = f"from tests.load.test_hostile_files import Path, read_all; read_all(Path({str(tmp_path)!r}))"
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout.splitlines()[-1:]} {done.stderr[-1000:]}"
    assert done.stdout.count("\n") == len(list(cases()))
