"""The loader of data sets in docs/ gives what is in the files of the runs."""

from __future__ import annotations

import importlib.util
import json
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates

from docs.loader import Clips, Pairs, read_flow
from taichi_msm import sweep
from tests.golden import Messages

FRAMES, WIDTH, HEIGHT, RUNS = 6, 128, 96, 3
TRACKS = 24
PARTS = ["train", "test", "train"]


@pytest.fixture(scope="module")
def data_set(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set of the shipped scene, whose runs 0 and 2 are for training."""
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
    runs = [{"run": n, "folder": f"runs/{n:06}", "values": {}, "part": part} for n, part in enumerate(PARTS)]
    (directory / "dataset.json").write_text(json.dumps({"runs": runs, "frames": FRAMES, "size": [WIDTH, HEIGHT]}))
    return directory


class MapStyle(Protocol):
    """What PyTorch asks of a map-style data set."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Mapping[str, Any]: ...


def batches(data: MapStyle, size: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Load batches by two workers of PyTorch, or without it by what it does with such a data set."""
    if importlib.util.find_spec("torch"):
        from torch.utils.data import DataLoader

        for batch in DataLoader(data, batch_size=size, num_workers=2, multiprocessing_context="spawn"):
            yield {name: tensor.numpy() for name, tensor in batch.items()}
        return
    sent = pickle.loads(pickle.dumps(data))
    for first in range(0, len(sent), size):
        items = [sent[index] for index in range(first, min(first + size, len(sent)))]
        yield {name: np.stack([item[name] for item in items]) for name in items[0]}


def test_pairs_are_those_of_the_files(data_set: Path) -> None:
    pairs = Pairs(data_set, "train")
    assert len(pairs) == 2 * (FRAMES - 1)
    folder, pair = data_set / "runs/000002", pairs[(FRAMES - 1) + 3]
    shown = [np.array(Image.open(folder / f"frames/000{frame}.png")) for frame in (3, 4)]
    assert [np.array_equal(pair["first"][channel], shown[0][..., channel]) for channel in range(3)] == [True] * 3
    assert np.array_equal(pair["second"], shown[1].transpose(2, 0, 1))
    assert np.array_equal(pair["depth"], np.array(Image.open(folder / "depth/0003.tiff")))
    assert np.array_equal(pair["occluded"], np.array(Image.open(folder / "occlusion/0003.png")) == 255)
    flow = read_flow(folder / "flow/0003.flo")
    assert pair["flow"].shape == flow.shape == (2, HEIGHT, WIDTH)
    assert np.array_equal(pair["valid"], flow[0] < 1e10)
    assert 0 < pair["valid"].mean() < 1
    assert np.array_equal(pair["flow"][:, pair["valid"]], flow[:, pair["valid"]])
    assert not pair["flow"][:, ~pair["valid"]].any()
    with pytest.raises(IndexError):
        pairs[len(pairs)]


def test_clips_follow_one_another(data_set: Path) -> None:
    clips = Clips(data_set, "train", frames=3)
    assert len(clips) == 2 * (FRAMES // 3)
    clip, folder = clips[3], data_set / "runs/000002"
    assert clip["video"].shape == (3, 3, HEIGHT, WIDTH)
    assert np.array_equal(clip["video"][2].transpose(1, 2, 0), np.array(Image.open(folder / "frames/0005.png")))
    with np.load(folder / "tracks.npz") as tracks:
        assert np.array_equal(clip["points"], tracks["points"][:, 3:6])
        assert np.array_equal(clip["visible"], ~tracks["occluded"][:, 3:6])


def test_flow_leads_where_tracks_go(data_set: Path) -> None:
    # Both measure pixels in one way. Flow is interpolated between the centres of pixels; if these were elsewhere, it
    # would be wrong by its gradient.
    pairs, clip = Pairs(data_set, "test"), Clips(data_set, "test", frames=FRAMES)[0]
    pair, (here, there) = pairs[FRAMES - 2], clip["points"][:, -2:].transpose(1, 2, 0)
    inside = ((here > 1) & (here.T < [WIDTH - 1, HEIGHT - 1]).T).all(axis=0)

    def error(centre: float) -> float:
        down_right = here[::-1] - centre
        known = map_coordinates(pair["valid"].astype(float), down_right, order=1) > 1 - 1e-6
        chosen = known & inside & clip["visible"][:, -2]
        assert chosen.sum() > 50
        flow = np.stack([map_coordinates(part, down_right[:, chosen], order=1) for part in pair["flow"]])
        return float(np.abs(flow - (there - here)[:, chosen]).mean())

    assert 10 * error(0.5) < min(error(0), error(1))


def test_batches_are_made_of_the_items(data_set: Path) -> None:
    pairs = Pairs(data_set, "train")
    made = list(batches(pairs, 4))
    assert [len(batch["flow"]) for batch in made] == [4, 4, 2]
    last: dict[str, Any] = {**pairs[-1]}
    assert all(np.array_equal(made[2][name][1], value) for name, value in last.items())
    (clips,) = batches(Clips(data_set, "train", FRAMES), 2)
    assert clips["video"].shape == (2, FRAMES, 3, HEIGHT, WIDTH)
    assert clips["points"].shape == (2, TRACKS**2, FRAMES, 2)


def test_a_part_without_runs_is_refused(data_set: Path, message: Messages) -> None:
    with message.raises(ValueError, "'valid'"):
        Pairs(data_set, "valid")
