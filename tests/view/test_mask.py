"""Sessions of a sheet with a hole: nothing is gripped there; only position-controlled tools cross it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import load_scene, run
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import place_instruments
from taichi_msm.system.runtime import Device
from taichi_msm.view.events import Drag, Hover, Key, Press, Release
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from tests.golden import Messages

# A hole about the centre, 5 of 16 cells wide.
CELLS = np.ones((16, 16), np.uint8)
CELLS[5:10, 6:11] = 0

SCENE: dict[str, Any] = {
    "image": "speckle.png",
    "sheet": {"points": [17, 17], "size": [0.1, 0.1], "fixed": "border", "mask": "mask.png"},
    "tissue": {"young": 2e4, "thickness": 0.002, "density": 1000, "foundation": 4e4, "damping": 30},
    "probes": [
        {"total": [0, 0, -1], "at": [0.1, 0.5], "radius": 0.004,
         "instrument": {"radius": 0.006, "shaft": [0.2, 0, 1], "length": 0.1}},
    ],
    "render": {"size": [96, 80], "refine": 2},
    "time": {"duration": 1, "frames_per_second": 30, "precision": "f64"},
}  # fmt: skip
TUBE = {"sheet.surface": {"tube": {"radius": 0.06}}, "probes.0.total": -1}

# Pixels of mass points: in the middle of the hole, and left and right of it.
HOLE, LEFT, RIGHT = (7, 8), (7, 2), (7, 14)

Begin = Callable[..., Session]


@pytest.fixture
def begin(small: Path, device: Device) -> Iterator[Begin]:
    """Begin a session; its files are saved in ./captures."""
    Image.fromarray(CELLS * np.uint8(255)).save("mask.png")
    Path("masked.yaml").write_text(json.dumps(SCENE))
    with ExitStack() as stack:

        def begin(overrides: dict[str, Any]) -> Session:
            scene = load_scene("masked.yaml", overrides)
            return stack.enter_context(Session(scene, Captures(Path("captures"), "masked.yaml"), threads=2))

        yield begin


def pixel_of(session: Session, row: int, col: int) -> tuple[float, float]:
    """Return the pixel of a mass point at rest."""
    x, y = session.viewport.view.pixels(rest_of(session.scene.sheet).position[row, col])
    return float(x) - 0.5, float(y) - 0.5


def advance(session: Session, frames: int) -> list[np.ndarray]:
    positions = []
    for _ in range(frames):
        session.advance()
        positions.append(session.positions().copy())
    return positions


@pytest.mark.default_cases("flat")
@pytest.mark.parametrize("surface", [{}, TUBE], ids=["flat", "tube"])
def test_force_tool(surface: dict[str, Any], begin: Begin, message: Messages) -> None:
    session, mask = begin(surface), Mask(CELLS > 0)
    assert mask.covers(np.array([session.tool.position]))[0], "the centre is in the hole"
    session.handle(Press(*pixel_of(session, *HOLE)))
    message(session.notice, "no tissue", hide=r"\d+(\.\d+)?")
    assert not session.tool.engaged
    session.handle(Hover(*pixel_of(session, *HOLE)))
    assert session._hover_position() is None
    positions = [session.positions().copy()]
    session.handle(Press(*pixel_of(session, *LEFT)))
    positions += advance(session, 12)
    start = session.tool.position
    session.handle(Drag(*pixel_of(session, *HOLE)))
    positions += advance(session, 4)
    assert session.tool.position == start, "a drag into the hole"
    session.handle(Drag(*pixel_of(session, *RIGHT)))
    positions += advance(session, 4)
    assert session.tool.position == start, "a drag across the hole"
    for corner in ((3, 2), (3, 14), RIGHT):
        session.handle(Drag(*pixel_of(session, *corner)))
        positions += advance(session, 2)
    # The displacement of the pointer, at the accuracy of picking on a deformed sheet.
    assert np.subtract(session.tool.position, start) == pytest.approx([12 / 16, 0], abs=0.02)
    for place in (LEFT, RIGHT):
        session.handle(Release())
        positions += advance(session, 3)
        session.handle(Press(*pixel_of(session, *place)))
        positions += advance(session, 3)
    keys = np.array(session.recorded_scene().probes[-1].at)
    for first, last in pairwise(keys):
        assert first[0] == last[0] or mask.first_gap(first[1:], last[1:]) is None
    assert (np.diff(keys[:, 0]) == 0).sum() == 2, "jumps between presses"
    assert_again(session, positions)


def assert_again(session: Session, positions: list[np.ndarray]) -> None:
    """Compare the run of a saved session with its positions."""
    session.handle(Key("w"))
    assert session.notice == "saved captures/session-1.yaml"
    scene = load_scene("captures/session-1.yaml", {"output": ["trajectory"]})
    assert run(scene, "again", threads=2)["status"] == "complete"
    np.testing.assert_array_equal(np.load("again/trajectory.npz")["position"], np.array(positions))


@pytest.mark.default_cases("tube")
@pytest.mark.parametrize("surface", [{}, TUBE], ids=["flat", "tube"])
def test_position_tool(surface: dict[str, Any], begin: Begin) -> None:
    session = begin(surface)
    session.handle(Key("f"))
    session.handle(Press(*pixel_of(session, *HOLE)))
    assert not session.tool.engaged
    positions = [session.positions().copy()]
    session.handle(Hover(*pixel_of(session, *HOLE)))
    positions += advance(session, 10)
    assert np.array(session.tool.position) * 16 == pytest.approx([8, 7], abs=0.01), "over the hole"
    assert np.ptp(positions, axis=0).max() == 0
    session.handle(Press(*pixel_of(session, *LEFT)))
    positions += advance(session, 15)
    assert session.felt_force() > 0
    session.handle(Drag(*pixel_of(session, *HOLE)))
    positions += advance(session, 25)
    assert np.array(session.tool.position) * 16 == pytest.approx([8, 7], abs=0.2)
    (solid,) = place_instruments(session._simulation.scene, session.positions(), session._simulation.time)
    assert solid.radius == 0.006
    assert session.picture().any()
    assert_again(session, positions)
