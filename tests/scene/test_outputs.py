"""Table of outputs: sources, formats, and names of files."""

from __future__ import annotations

import re
from pathlib import Path

from taichi_msm.render.labels import Flow, FrameOutputs, Labels, Stereo
from taichi_msm.runs.writer import _LABEL_WRITERS
from taichi_msm.scene.outputs import OUTPUTS, RESULT_PATTERNS, file_names, result_names

FIELDS = {"labels": Labels._fields, "flow": Flow._fields, "stereo": Stereo._fields}


def test_fields_and_formats_of_the_labels() -> None:
    for output in OUTPUTS.values():
        assert output.source in (*FrameOutputs._fields, "positions", "forces")
        if output.source in FIELDS:
            assert output.name in FIELDS[output.source]
            assert Path(output.file).suffix in _LABEL_WRITERS
            assert output.is_series
            assert output.pixel_bytes > 0


def test_file_names_of_a_run() -> None:
    assert result_names({"": ["tracks", "flow", "gif", "png"]}) == [
        *("frames", "flow", "animation.gif", "tracks.npz", "camera.json", "run.json")
    ]
    assert result_names({"": ["forces"], "left": ["flow", "gif"], "right": ["gif"]}) == [
        *("left/flow", "left/animation.gif", "right/animation.gif", "forces.csv", "left/camera.json"),
        *("right/camera.json", "run.json"),
    ]
    assert file_names(["left/flow", "left/camera.json"], 2) == ["left/flow/0000.flo", "left/camera.json"]
    assert file_names(["frames", "flow", "run.json"], 2) == [
        *("frames/0000.png", "frames/0001.png", "flow/0000.flo", "run.json")
    ]
    assert file_names(["flow"], 0) == []
    assert file_names(["frames"], 10001)[-1] == "frames/10000.png"


def test_patterns_match_only_results() -> None:
    camera_outputs = [output.name for output in OUTPUTS.values() if output.is_camera_output]
    names = file_names(result_names({"": OUTPUTS, "left": camera_outputs}), 3)
    pattern = re.compile("|".join(RESULT_PATTERNS))
    assert all(map(pattern.fullmatch, names))
    foreign = ["frames/00001.png", "frames/12.png", "frames/0000.npy", "frames", "run_json"]
    foreign += ["a/run.json", "a/b/camera.json", "a/trajectory.npz"]
    assert not any(map(pattern.fullmatch, foreign))
