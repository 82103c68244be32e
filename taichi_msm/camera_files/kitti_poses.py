"""KITTI's trajectories: a line per pose, three rows of the matrix from the camera to the world; no times."""

from __future__ import annotations

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.trajectory import NORM_TOLERANCE, Trajectory, TrajectoryReader, parse_numbers

COUNT = 12


def _read(file: CameraFile) -> Trajectory | None:
    """Read the matrices; None for another format, without twelve numbers in the first line."""
    lines = [(n, line) for n, line in file.lines if line[0] != "#"]
    if not lines or len(lines[0][1].split()) != COUNT or parse_numbers(lines[0][1].split()) is None:
        return None
    import numpy as np
    from scipy.spatial.transform import Rotation

    poses: list[list[float]] = []
    for n, line in lines:
        numbers = parse_numbers(line.split())
        if numbers is None or len(numbers) != COUNT:
            raise file.fault("not twelve numbers, as in the first line; write twelve in each line", n)
        poses.append(numbers)
    matrices = np.array(poses).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    deviations = abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    if (faults := (deviations > NORM_TOLERANCE) | (np.linalg.det(rotations) < 0)).any():
        fault = "its first three columns are not a rotation; write an orthonormal matrix"
        raise file.fault(fault, lines[int(faults.argmax())][0])
    quaternions = Rotation.from_matrix(rotations).as_quat()
    rows = np.column_stack([np.arange(len(poses)), matrices[:, :, 3], quaternions]).tolist()
    return Trajectory([(n, row) for (n, _), row in zip(lines, rows, strict=True)], has_times=False)


KITTI = TrajectoryReader("KITTI", "lines of twelve numbers, without a header; needs `poses_rate`", _read)
