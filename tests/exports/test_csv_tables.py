"""Tables of forces and tracks, as the csv module of Python reads them."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_msm import FilesError, export
from tests.exports.test_cameras import alone

FRAMES, TRACKS = 5, 36


@pytest.fixture
def single(stereo: Path) -> Path:
    return alone(stereo, "left")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="ascii") as file:
        return list(csv.DictReader(file))


def column(path: Path, *names: str) -> np.ndarray[Any, Any]:
    return np.array([[float(row[name] or "nan") for name in names] for row in rows(path)])


def test_every_number_comes_back(single: Path) -> None:
    with np.load(single / "tracks.npz") as archive:
        made = dict(archive)
    made["points"][7, 2], made["occluded"][7, 2] = np.nan, True
    np.savez(single / "tracks.npz", **made)
    done = export(single, "csv")
    assert (done.files, done.notes) == (["forces.csv", "index.csv", "tracks.csv"], [])
    tracks = done.directory / "tracks.csv"
    assert list(rows(tracks)[0]) == [
        *("run", "time", "point", "across", "down", "x", "y", "occluded", "position_x", "position_y", "position_z")
    ]
    shape = FRAMES, TRACKS, -1
    np.testing.assert_array_equal(column(tracks, "point").reshape(shape)[..., 0], [np.arange(TRACKS)] * FRAMES)
    np.testing.assert_array_equal(column(tracks, "time").reshape(shape)[:, 0, 0], np.arange(FRAMES) / 10)
    for names, expected in (
        (("across", "down"), np.tile(made["coordinates"][:, None], (1, FRAMES, 1))),
        (("x", "y"), made["points"]),
        (("occluded",), made["occluded"][..., None]),
        (("position_x", "position_y", "position_z"), made["position"]),
    ):
        found = column(tracks, *names).reshape(shape).transpose(1, 0, 2)
        np.testing.assert_array_equal(found.astype(np.float32), expected)
    assert rows(tracks)[2 * TRACKS + 7]["x"] == "", "behind the eye"
    forces = rows(done.directory / "forces.csv")
    assert {row.pop("run") for row in forces} == {"000000"}
    assert forces == rows(single / "forces.csv")


def test_runs_are_told_apart_by_their_numbers(single: Path) -> None:
    """And one without forces is missing from their table."""
    other = single.parent / "other"
    export(single, "csv", single / "alone")
    shutil.copytree(single, other)
    (other / "forces.csv").unlink()
    done = export([other, single], "csv", single.parent / "all")
    assert [note.partition(";")[0] for note in done.notes] == [
        f"{other}: without forces, which are not among the results"
    ]
    for name in ("tracks.csv", "forces.csv"):
        found, expected = rows(done.directory / name), rows(single / "alone" / name)
        for run in ("000000", "000001") if name == "tracks.csv" else ("000001",):
            part = [row for row in found if row["run"] == run]
            assert [{**row, "run": "000000"} for row in part] == expected


def test_forces_have_no_camera_to_choose(stereo: Path) -> None:
    record = json.loads((stereo / "run.json").read_text())
    record["scene"]["output"].remove("tracks")
    (stereo / "run.json").write_text(json.dumps(record))
    for side in ("left", "right"):
        (stereo / side / "tracks.npz").unlink()
    assert export(stereo, "csv").files == ["forces.csv", "index.csv"]


def test_one_of_both_is_needed(single: Path) -> None:
    (single / "forces.csv").unlink()
    assert export(single, "csv").files == ["index.csv", "tracks.csv"]
    (single / "tracks.npz").unlink()
    with pytest.raises(FilesError, match=r"/left: csv needs forces or tracks; run the scene again with --set"):
        export(single, "csv")


@pytest.mark.parametrize("text", ["", "time\n0\n", "{header}\n0,0,0\n", "{header}\n0,0,0,0,0,0,0,=1+1\n", "\xff"])
def test_damaged_forces_are_one_line(text: str, single: Path) -> None:
    header = (single / "forces.csv").read_text().partition("\n")[0]
    (single / "forces.csv").write_bytes(text.format(header=header).encode("latin1"))
    with pytest.raises(FilesError, match=r"forces\.csv: damaged, or not of this run; run the scene again$"):
        export(single, "csv")
    assert not (single / "export-csv").exists()


def test_damaged_tracks_are_one_line(single: Path) -> None:
    with np.load(single / "tracks.npz") as archive:
        made = dict(archive)
    del made["position"]
    np.savez(single / "tracks.npz", **made)
    with pytest.raises(FilesError, match=r"tracks\.npz: damaged"):
        export(single, "csv")
