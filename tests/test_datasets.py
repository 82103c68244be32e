"""Data sets for training equal the files of the runs."""

from __future__ import annotations

import importlib.util
import json
import pickle
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
    with message.raises(FilesError, "dataset.json"):
        Pairs(tmp_path, "train")
    record = json.loads((data_set / "dataset.json").read_text())
    (tmp_path / "dataset.json").write_text(json.dumps({**record, "outputs": ["frames", "run.json"]}))
    with message.raises(ArgumentError, "flow"):
        Pairs(tmp_path, "train")
    (tmp_path / "dataset.json").write_text(json.dumps({**record, "runs": []}))
    with message.raises(ArgumentError, "split"):
        Pairs(tmp_path, "train")


def test_pytorch_is_not_installed(data_set: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    pairs = Pairs(data_set, "train")
    with message.raises(NotInstalledError, "PyTorch"):
        pairs.loader()
