"""Warnings about runs of curved sheets: depths and heights are along the normals at rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from taichi_msm import Simulation
from taichi_msm.accuracy.buckling import buckling_warnings
from taichi_msm.accuracy.path_dependence import PathDependence
from taichi_msm.model.rest import rest_normals, rest_of
from taichi_msm.model.tools import solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.system.runtime import Device

TUBE: dict[str, Any] = {"tube": {"radius": 0.02}}
# At the side of the tube, where the normal is along x.
SIDE = [0.25, 0.5]


def scene(probes: list[dict[str, Any]], **tissue: Any) -> Scene:
    """Half a tube, quasi-static."""
    return Scene.model_validate(
        {
            "sheet": {"points": [9, 17], "size": [0.04, 0.0628], "fixed": ["left"], "surface": TUBE},
            "tissue": {"young": 2e4, "thickness": 2e-3, "foundation": 2e5, "foundation_active": "always", **tissue},
            "probes": probes,
            "time": {"motion": "quasistatic", "duration": 1, "frames_per_second": 4},
            "output": [],
        }
    )


def test_depth_is_along_the_normals(device: Device) -> None:
    made = scene([{"at": SIDE, "total": -0.2, "radius": 0.006, "load": [[0, 0], [1, 100]]}])
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(4)
        displacement = simulation.positions() - rest_of(made.sheet).position
        height = (displacement * rest_normals(made.sheet)).sum(axis=-1)
        assert simulation.progress.deepest == pytest.approx(-height.min(), rel=1e-12)
        assert simulation.progress.highest == pytest.approx(max(height.max(), 0.0), rel=1e-12)


def test_a_compressed_tube_does_not_buckle_to_an_arbitrary_side(device: Device) -> None:
    """In contrast to a flat strip, see test_buckling.py, it has no mirror image."""
    made = scene([{"clamp": "right", "path": [[0, 0, 0, 0], [1, 0.004, 0, 0]]}], foundation=2e4)
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(4)
        assert max(simulation.progress.highest, simulation.progress.deepest) > 1e-3
        assert not list(buckling_warnings(simulation._plan, simulation.progress))


def test_change_of_a_moving_load_is_the_distance_along_the_surface() -> None:
    """The load moves by a 64th of the sheet per frame, in units of the box's largest side."""
    made = scene([{"at": [[0, 0.25, 0.5], [1, 0.3125, 0.5]], "total": -0.2, "radius": 0.006, "load": [[0, 100]]}])
    expected = 0.0628 / 64 / rest_of(made.sheet).extent
    assert PathDependence(make_plan(made))._load_change(1) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("height", "reaches"), [(0.0005, False), (-0.001, True)])
def test_tool_between_the_mass_points_reaches_the_sheet(height: float, reaches: bool) -> None:
    """A needle in the middle of a cell at the side of a tube: none of the mass points, 3 mm away, touches it."""
    needle = {"radius": 2e-4, "shaft": [1, 0, 0], "length": 0.01}
    across, down = 0.28125, 0.4375
    path = [[0, across, down, 0.002], [1, across, down, height]]
    made = scene([{"path": path, "instrument": needle}])
    (tool,) = solid_tools(make_plan(made).tools).values()
    assert tool.gap_at(tool.path_at(np.array([1.0]))[0], made.sheet) > 1e-3
    assert tool.reaches(made) == reaches
