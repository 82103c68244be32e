"""KITTI's trajectories: a line per pose, three rows of the matrix from the camera to the world; no times."""

from __future__ import annotations

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.trajectory import NORM_TOLERANCE, Trajectory, TrajectoryReader, parse_numbers

COUNT = 12


def _read(file: CameraFile) -> Trajectory | None:
    """Read the matrices; None for another format, without twelve numbers in the first line."""
    lines = [(n, line.split()) for n, line in enumerate(file.text.splitlines(), 1)]
    lines = [(n, words) for n, words in lines if words and not words[0].startswith("#")]
    if not lines or len(lines[0][1]) != COUNT or parse_numbers(lines[0][1]) is None:
        return None
    import numpy as np
    from scipy.spatial.transform import Rotation

    rows: list[list[float]] = []
    for n, words in lines:
        numbers = parse_numbers(words)
        if numbers is None or len(numbers) != COUNT:
            raise file.fault("not twelve numbers, as in the first line; write twelve in each line", n)
        matrix = np.array(numbers).reshape(3, 4)
        rotation = matrix[:, :3]
        if abs(rotation @ rotation.T - np.eye(3)).max() > NORM_TOLERANCE or np.linalg.det(rotation) < 0:
            raise file.fault("its first three columns are not a rotation; write an orthonormal matrix", n)
        rows.append([len(rows), *matrix[:, 3].tolist(), *Rotation.from_matrix(rotation).as_quat().tolist()])
    return Trajectory(rows, [n for n, _ in lines], has_times=False)


KITTI = TrajectoryReader("KITTI", "lines of twelve numbers, without a header; needs `poses_rate`", _read)
