"""pose.txt of C3VD: a line per pose, the matrix from the camera to the world by columns, in millimetres; no times."""

from __future__ import annotations

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, build_rows, parse_numbers

COUNT = 16


def _read(file: CameraFile) -> Trajectory | None:
    """Read the matrices; None for another format, without sixteen numbers in the first line."""
    lines = [(n, line) for n, line in file.lines if line[0] != "#"]
    if [len(line.split()) for _, line in lines[:4]] == [4] * 4 and parse_numbers(lines[3][1].split()) == [0, 0, 0, 1]:
        fault = "a 4 x 4 matrix in four lines; write its first twelve numbers in one, from the camera to the world"
        raise file.fault(fault, lines[0][0])
    rows = [parse_numbers(line.replace(",", " ").split()) for _, line in lines[:1]]
    if not rows or rows[0] is None or len(rows[0]) != COUNT:
        return None
    import numpy as np

    poses: list[list[float]] = []
    for n, line in lines:
        numbers = parse_numbers(line.split(","))
        # The last row of a matrix is its last number of every column.
        if numbers is None or len(numbers) != COUNT or numbers[3::4] != [0, 0, 0, 1]:
            fault = "a 4 x 4 matrix, but not as in C3VD: by columns, with commas, and 0, 0, 0, 1 in its last row"
            remedy = "if it is by rows, from the camera to the world, write its first twelve numbers, without commas"
            raise file.fault(f"{fault}; {remedy}", n)
        poses.append(numbers)
    matrices = np.array(poses).reshape(-1, 4, 4).swapaxes(1, 2)[:, :3]
    return Trajectory(build_rows(file, [n for n, _ in lines], range(len(poses)), matrices), has_times=False)


C3VD = TrajectoryReader(
    "C3VD",
    "pose.txt: lines of sixteen numbers with commas, in millimetres; needs `poses_rate`",
    ("poses: pose.txt, poses_rate: 30",),
    _read,
    unit=1e-3,
)
