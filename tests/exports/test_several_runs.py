"""Exports of several runs and of a sweep equal those of each run, numbered."""

from __future__ import annotations

import csv
import json
import pickle
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import taichi_msm
from taichi_msm import ArgumentError, FilesError
from taichi_msm.exports.export import export
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files
from tests.runs.test_finished import change, rewrite

FRAMES, WIDTH, HEIGHT = 5, 40, 30


@pytest.fixture
def pair(results: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two runs with different results, the second with two frames less, in the current folder."""
    monkeypatch.chdir(results.parent)
    for seed, (name, frames) in enumerate([("a", FRAMES), ("b", FRAMES - 2)]):
        run = Path(shutil.copytree(results, name))
        rng = np.random.default_rng(seed)
        change(run, frames=frames)
        rewrite(run, edit=partial(with_motion, seed, frames))
        (run / "flow").mkdir()
        for number in range(frames - 1):
            flow = rng.normal(0, 9, (HEIGHT, WIDTH, 2)).astype("<f4")
            head = np.float32(202021.25).tobytes() + np.array([WIDTH, HEIGHT], "<i4").tobytes()
            (run / "flow" / f"{number:04}.flo").write_bytes(head + flow.tobytes())
        points = rng.uniform(0, 30, (6, frames, 2)).astype(np.float32)
        np.savez(run / "tracks.npz", points=points, occluded=np.zeros((6, frames), bool))
    return ["a", "b"]


def with_motion(seed: int, frames: int, position: NDArray[Any]) -> NDArray[Any]:
    position[1:, ..., 2] -= 1e-3 * seed
    return position[:frames]


def index(out: Path) -> list[list[str]]:
    with (out / "index.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def contents(out: Path) -> dict[str, bytes]:
    """Return the files of an export, without the index and the record."""
    return {name: data for name, data in files(out).items() if name not in ("index.csv", "export.json")}


def test_names_that_look_like_formulas(pair: list[str]) -> None:
    """A spreadsheet takes cells that begin with = + - @ or a tab for formulas."""
    names = ["=1+2", "-run", "+1", "@run", "\trun", "1=2"]
    for name in names:
        shutil.copytree(pair[0], name)
    export(names, "obj", "all")
    _, *rows = index(Path("all"))
    assert not any(cell.startswith(("=", "+", "-", "@", "\t")) for row in rows for cell in row)
    assert [Path(run) for _, run in rows] == [Path(name) for name in names]
    assert rows[-1][1] == names[-1]
    assert export([run for _, run in rows], "obj", "again").files == export(names, "obj", "all").files


@pytest.mark.parametrize("name", ["vtk", "gltf", "obj"])
def test_folder_per_run(name: str, pair: list[str], tmp_path: Path) -> None:
    export(pair, name, "all")
    expected: dict[str, bytes] = {}
    for number, run in enumerate(pair):
        export(run, name)
        assert index(Path(run, f"export-{name}")) == [["number", "run"], ["000000", run]]
        alone = contents(Path(run, f"export-{name}"))
        expected |= {f"{number:06}/{path}": data for path, data in alone.items()}
    assert contents(Path("all")) == expected
    assert index(Path("all")) == [["number", "run"], ["000000", "a"], ["000001", "b"]]
    assert json.loads(Path("all", "export.json").read_text())["files"] == sorted([*expected, "index.csv"])


def test_numbers_of_frame_pairs(pair: list[str]) -> None:
    export(pair, "kitti", "all")
    pairs = [*(("a", frame) for frame in range(FRAMES - 1)), *(("b", frame) for frame in range(FRAMES - 3))]
    rows = [[f"{number:06}", run, str(frame)] for number, (run, frame) in enumerate(pairs)]
    assert index(Path("all")) == [["number", "run", "frame"], *rows]
    alone = {run: contents(export(run, "kitti").directory) for run in pair}
    expected: dict[str, bytes] = {}
    for number, (run, frame) in enumerate(pairs):
        files_of_pair = {path: data for path, data in alone[run].items() if f"/{frame:06}_1" in path}
        expected |= {path.replace(f"/{frame:06}", f"/{number:06}"): data for path, data in files_of_pair.items()}
    assert contents(Path("all")) == expected


def test_names_of_videos(pair: list[str]) -> None:
    export(pair, "tapvid", "all")
    videos = pickle.loads(Path("all", "tapvid.pkl").read_bytes())
    assert list(videos) == ["000000", "000001"]
    for run, video in zip(pair, videos.values(), strict=True):
        export(run, "tapvid", Path(run, "alone"))
        alone = pickle.loads(Path(run, "alone", "tapvid.pkl").read_bytes())[run]
        assert alone.keys() == video.keys()
        for key, values in alone.items():
            np.testing.assert_array_equal(video[key], values)


def test_progress(pair: list[str]) -> None:
    calls: list[tuple[int, int]] = []
    export(pair, "obj", "all", lambda done, total: calls.append((done, total)))
    assert calls == [(done, 8) for done in (0, *range(8))]


def test_warnings_name_their_runs(pair: list[str], message: Messages) -> None:
    message(export("a", "kitti").notes, "flow_noc")
    message(export(pair, "kitti", "all").notes, "a and 1 more")
    shutil.rmtree("b/frames")
    message(export(pair, "kitti", "all").notes, "a and 1 more", "b: ")


@pytest.fixture
def sweep(pair: list[str]) -> Path:
    """A sweep of five runs, of which two are complete, two have failed and one is missing."""
    for number, (run, status) in enumerate([("a", "diverged"), ("a", "complete"), ("a", "interrupted")]):
        change(Path(shutil.copytree(run, f"sweep/runs/{number:06}")), status=status)
    shutil.copytree("b", "sweep/runs/1000000")
    Path("sweep", "sweep.json").write_text('{"values": [[], [], [], [], []]}')
    return Path("sweep")


def test_complete_runs_of_a_sweep(sweep: Path, program: Program, message: Messages) -> None:
    done = program("export", "sweep", "--format", "kitti", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    output = json.loads(done.stdout)
    assert output["directory"] == "sweep/export-kitti"
    message(output["notes"][0], "3 of 5")
    rows = [("sweep/runs/000001", frame) for frame in range(4)] + [("sweep/runs/1000000", frame) for frame in range(2)]
    expected = [[f"{number:06}", run, str(frame)] for number, (run, frame) in enumerate(rows)]
    assert index(sweep / "export-kitti")[1:] == expected


def test_sweeps_and_runs(sweep: Path, program: Program, message: Messages) -> None:
    """A run given by its folder is exported whatever its status; links are not followed."""
    (sweep / "runs" / "000003").symlink_to(Path("a").resolve())
    done = program("export", "./sweep/runs/000002", "sweep", "b/", "--format", "gltf")
    assert (done.returncode, done.stderr) == (0, "")
    message(done.stdout, "output/export-gltf", "3 of 7")
    runs = ["sweep/runs/000002", "sweep/runs/000001", "sweep/runs/1000000", "b"]
    assert index(Path("output/export-gltf"))[1:] == [[f"{number:06}", run] for number, run in enumerate(runs)]
    assert export(sweep / "runs" / "000000", "obj").notes == []


def test_incomplete_sweep(sweep: Path, message: Messages) -> None:
    shutil.rmtree(sweep / "runs" / "1000000" / "flow")
    with message.raises(FilesError, "sweep/runs/1000000", "flow"):
        export("sweep", "kitti")
    Path("sweep", "sweep.json").write_text("?")
    with message.raises(FilesError, "sweep/sweep.json"):
        export("sweep", "kitti")
    Path("sweep", "sweep.json").write_text('{"values": [[]]}')
    for folder in ("000001", "1000000"):
        shutil.rmtree(sweep / "runs" / folder)
    with message.raises(FilesError, "table.csv"):
        export("sweep", "obj")


def test_invalid_arguments(results: Path, message: Messages) -> None:
    wrong: list[tuple[Any, ...]] = [(results, "glft"), ([], "obj"), ([results, None], "obj"), (results, "obj", 3)]
    for arguments in wrong:
        with message.raises(ArgumentError):
            taichi_msm.export(*arguments)
