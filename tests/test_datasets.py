"""Data sets for training equal the files of the runs."""

from __future__ import annotations

import importlib.util
import json
import pickle
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import sweep
from taichi_msm.datasets import Clips, Pairs
from taichi_msm.errors import ArgumentError, FilesError, NotInstalledError
from taichi_msm.runs.arrays import read_flo
from tests.golden import Messages

FRAMES, WIDTH, HEIGHT, RUNS = 6, 128, 96, 3
TRACKS = 24
SPLITS = ["train", "test", "train"]


@pytest.fixture(scope="module")
def data_set(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set of the shipped scene, with runs 0 and 2 for training."""
    directory = tmp_path_factory.mktemp("loader") / "data"
    overrides = {
        "sheet.points": [21, 21],
        "time.duration": (FRAMES - 1) / 25,
        "render.size": [WIDTH, HEIGHT],
        "render.tracks": TRACKS,
        # One kernel draws pictures and labels.
        "render.supersample": 1,
        "render.shading": "none",
        "output": ["png", "depth", "flow", "occlusion", "tracks"],
    }
    vary = {"probes.1.at": {"uniform": [[0.55, 0.5], [0.65, 0.6]]}}
    scene = root / "scenes/sweeps/tracking-scene.yaml"
    rows = list(sweep(scene, vary, directory, samples=RUNS, overrides=overrides, workers=1))
    assert {row.status for row in rows} == {"complete"}
    record = json.loads((directory / "dataset.json").read_text())
    for run, split in zip(record["runs"], SPLITS, strict=True):
        run["part"] = split
    (directory / "dataset.json").write_text(json.dumps(record))
    return directory


def batches(data: Any, batch_size: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the batches of PyTorch's DataLoader with one worker."""
    data = pickle.loads(pickle.dumps(data))
    for first in range(0, len(data), batch_size):
        items = [data[index] for index in range(first, min(first + batch_size, len(data)))]
        yield {name: np.stack([item[name] for item in items]) for name in items[0]}


@pytest.fixture
def torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch, or a stand-in where it is not installed."""
    if importlib.util.find_spec("torch") is None:
        for name in ("torch", "torch.utils", "torch.utils.data"):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        monkeypatch.setattr(sys.modules["torch.utils.data"], "DataLoader", batches, raising=False)


def test_pairs(data_set: Path) -> None:
    pairs = Pairs(data_set, "train")
    assert len(pairs) == 2 * (FRAMES - 1)
    folder, pair = data_set / "runs/000002", pairs[(FRAMES - 1) + 3]
    frames = [np.array(Image.open(folder / f"frames/000{frame}.png")) for frame in (3, 4)]
    assert np.array_equal(pair["first"], frames[0].transpose(2, 0, 1))
    assert np.array_equal(pair["second"], frames[1].transpose(2, 0, 1))
    assert np.array_equal(pair["depth"], np.array(Image.open(folder / "depth/0003.tiff")))
    assert np.array_equal(pair["occluded"], np.array(Image.open(folder / "occlusion/0003.png")) == 255)
    flow = read_flo(folder / "flow/0003.flo", (WIDTH, HEIGHT)).transpose(2, 0, 1)
    assert pair["flow"].shape == flow.shape == (2, HEIGHT, WIDTH)
    assert np.array_equal(pair["valid"], flow[0] < 1e10)
    assert 0 < pair["valid"].mean() < 1
    assert np.array_equal(pair["flow"][:, pair["valid"]], flow[:, pair["valid"]])
    assert not pair["flow"][:, ~pair["valid"]].any()
    with pytest.raises(IndexError):
        pairs[len(pairs)]


def test_clips(data_set: Path) -> None:
    clips = Clips(data_set, "train", frames=3)
    assert len(clips) == 2 * (FRAMES // 3)
    clip, folder = clips[3], data_set / "runs/000002"
    assert clip["video"].shape == (3, 3, HEIGHT, WIDTH)
    assert np.array_equal(clip["video"][2].transpose(1, 2, 0), np.array(Image.open(folder / "frames/0005.png")))
    with np.load(folder / "tracks.npz") as tracks:
        assert np.array_equal(clip["points"], tracks["points"][:, 3:6])
        assert np.array_equal(clip["visible"], ~tracks["occluded"][:, 3:6])


def test_batches_of_a_loader(data_set: Path, torch: None) -> None:
    pairs = Pairs(data_set, "train")
    loaded = list(pairs.loader(batch_size=4))
    assert [len(batch["flow"]) for batch in loaded] == [4, 4, 2]
    last: dict[str, Any] = {**pairs[-1]}
    assert all(np.array_equal(loaded[2][name][1], value) for name, value in last.items())
    (clips,) = Clips(data_set, "train", FRAMES).loader(batch_size=2)
    assert tuple(clips["video"].shape) == (2, FRAMES, 3, HEIGHT, WIDTH)
    assert tuple(clips["points"].shape) == (2, TRACKS**2, FRAMES, 2)


def test_invalid_data_set(data_set: Path, tmp_path: Path, message: Messages) -> None:
    with message.raises(ArgumentError, "'valid'"):
        Pairs(data_set, "valid")
    with message.raises(ArgumentError, "camera: 3"):
        Pairs(data_set, "train", 3)  # type: ignore[arg-type]
    with message.raises(FilesError, "dataset.json"):
        Pairs(tmp_path, "train")
    record = json.loads((data_set / "dataset.json").read_text())
    (tmp_path / "dataset.json").write_text(json.dumps({**record, "outputs": ["frames", "run.json"]}))
    with message.raises(ArgumentError, "flow"):
        Pairs(tmp_path, "train")
    (tmp_path / "dataset.json").write_text(json.dumps({**record, "runs": []}))
    with message.raises(ArgumentError, "split"):
        Pairs(tmp_path, "train")


@pytest.fixture(scope="module")
def mixed(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of 3 and 5 frames, each with landscape and portrait frames, all for training."""
    directory = tmp_path_factory.mktemp("mixed") / "data"
    overrides = {"sheet.points": [21, 21], "render.tracks": 4, "render.supersample": 1, "render.shading": "none"}
    overrides |= {"output": ["png", "depth", "flow", "occlusion", "tracks"]}
    vary: dict[str, dict[str, Any]] = {
        "time.duration": {"grid": [2 / 25, 4 / 25]},
        "render.size": {"grid": [[64, 48], [48, 64]]},
    }
    scene = root / "scenes/sweeps/tracking-scene.yaml"
    assert {row.status for row in sweep(scene, vary, directory, overrides=overrides, workers=1)} == {"complete"}
    text = (directory / "dataset.json").read_text()
    (directory / "dataset.json").write_text(re.sub('"part": "[a-z]*"', '"part": "train"', text))
    return directory


def test_runs_of_different_lengths(mixed: Path) -> None:
    """n frames are n - 1 pairs, and the clips of each run come one after the other."""
    pairs = Pairs(mixed, "train")
    assert len(pairs) == 2 * (2 + 4)
    folders = [0] * 2 + [1] * 2 + [2] * 4 + [3] * 4
    for index, (run, frame) in enumerate(zip(folders, [*range(2)] * 2 + [*range(4)] * 2, strict=True)):
        first = np.array(Image.open(mixed / f"runs/00000{run}/frames/000{frame}.png"))
        assert np.array_equal(pairs[index]["first"], first.transpose(2, 0, 1))
    assert [len(Clips(mixed, "train", frames)) for frames in (1, 2, 3, 4, 5)] == [16, 6, 4, 2, 2]


def test_sizes_of_frames(mixed: Path, torch: None, message: Messages) -> None:
    pairs = Pairs(mixed, "train")
    assert pairs.sizes == [(64, 48), (48, 64)]
    (wide,), (tall,) = (list(pairs.of_size(size).loader(batch_size=6)) for size in pairs.sizes)
    assert (tuple(wide["flow"].shape), tuple(tall["flow"].shape)) == ((6, 2, 48, 64), (6, 2, 64, 48))
    assert [len(batch["flow"]) for batch in pairs.loader(batch_size=1)] == [1] * 12
    with message.raises(ArgumentError, "batch_size", "of_size"):
        pairs.loader(batch_size=2)
    with message.raises(ArgumentError, "size"):
        pairs.of_size((64, 64))


def test_clips_longer_than_any_run(mixed: Path, message: Messages) -> None:
    with message.raises(ArgumentError, "frames: 6"):
        Clips(mixed, "train", 6)
    with message.raises(ArgumentError, "frames: 0"):
        Clips(mixed, "train", 0)


def test_missing_and_damaged_runs(mixed: Path, tmp_path: Path, message: Messages) -> None:
    shutil.copytree(mixed, tmp_path / "data")
    pairs, clips = Pairs(tmp_path / "data", "train"), Clips(tmp_path / "data", "train", 3)
    (tmp_path / "data/runs/000001/tracks.npz").write_bytes(b"PK")
    with message.raises(FilesError, "runs/000001"):
        clips[1]
    shutil.rmtree(tmp_path / "data/runs/000001")
    with message.raises(FilesError, "runs/000001"):
        pairs[2]
    with message.raises(FilesError, "runs/000001"):
        Pairs(tmp_path / "data", "train")
    (tmp_path / "data/dataset.json").write_text("{")
    with message.raises(FilesError, "dataset.json"):
        Pairs(tmp_path / "data", "train")


def test_pytorch_is_not_installed(data_set: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    pairs = Pairs(data_set, "train")
    with message.raises(NotInstalledError, "PyTorch"):
        pairs.loader()
