"""KITTI's trajectories: a line per pose, three rows of the matrix from the camera to the world; no times."""

from __future__ import annotations

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, build_rows, parse_numbers

COUNT = 12


def _read(file: CameraFile) -> Trajectory | None:
    """Read the matrices; None for another format, without twelve numbers in the first line."""
    lines = [(n, line) for n, line in file.lines if line[0] != "#"]
    if not lines or len(lines[0][1].split()) != COUNT or parse_numbers(lines[0][1].split()) is None:
        return None
    import numpy as np

    poses: list[list[float]] = []
    for n, line in lines:
        numbers = parse_numbers(line.split())
        if numbers is None or len(numbers) != COUNT:
            raise file.fault("not twelve numbers, as in the first line; write twelve in each line", n)
        poses.append(numbers)
    matrices = np.array(poses).reshape(-1, 3, 4)
    return Trajectory(build_rows(file, [n for n, _ in lines], range(len(poses)), matrices), has_times=False)


KITTI = TrajectoryReader(
    "KITTI",
    "lines of twelve numbers, without a header; needs `poses_rate`",
    ("poses: 00.txt, poses_rate: 10",),
    _read,
)
