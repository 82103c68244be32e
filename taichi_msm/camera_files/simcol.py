"""Trajectories of SimCol3D: positions [cm] in one file and quaternions in another, of a left-handed world; no times."""

from __future__ import annotations

from pathlib import Path

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.trajectory import Row, Trajectory, TrajectoryReader, parse_numbers

POSITIONS, ROTATIONS = "SavedPosition", "SavedRotationQuaternion"
MAX_BYTES = 2**27


def simcol_files(path: str) -> list[str]:
    """Return the paths of positions and rotations of a sequence, of which one is `path`; [] for another format."""
    name = Path(path).name
    if not name.startswith((POSITIONS, ROTATIONS)):
        return []
    names = (name.replace(ROTATIONS, kind).replace(POSITIONS, kind) for kind in (POSITIONS, ROTATIONS))
    return [str(Path(path).with_name(each)) for each in names]


def _read(file: CameraFile) -> Trajectory | None:
    """Read positions `x y z` and, from the companion file, quaternions `x y z w`; None for another format.

    Unity's axes are x right, y up, z forward. With y turned over in the world and in the camera they are OpenCV's:
    positions (x, -y, z), quaternions (-x, y, -z, w).
    """
    if not (paths := simcol_files(file.path)):
        return None
    files = [CameraFile(path, MAX_BYTES) for path in paths]
    positions, rotations = (_table(each, count) for each, count in zip(files, (3, 4), strict=True))
    if len(positions) != len(rotations):
        counts = f"{len(positions)} positions and {len(rotations)} rotations, of {paths[1]}"
        raise file.fault(f"{counts}; name files of one sequence")
    rows: list[Row] = []
    for index, ((n, (x, y, z)), (_, (qx, qy, qz, qw))) in enumerate(zip(positions, rotations, strict=True)):
        rows.append((n, [index, x, -y, z, -qx, qy, -qz, qw]))
    return Trajectory(rows, has_times=False)


def _table(file: CameraFile, count: int) -> list[tuple[int, list[float]]]:
    rows = [(n, parse_numbers(line.split()) or []) for n, line in file.lines]
    for n, numbers in rows:
        if len(numbers) != count:
            raise file.fault(f"not {count} numbers; write {'x y z' if count == 3 else 'x y z w'} in each line", n)
    return rows


SIMCOL = TrajectoryReader(
    "SimCol3D",
    "SavedPosition_S1.txt, in centimetres, with SavedRotationQuaternion_S1.txt in its folder; needs `poses_rate`",
    ("poses: SavedPosition_S1.txt, poses_rate: 30",),
    _read,
    unit=1e-2,
)
