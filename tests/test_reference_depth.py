"""Sheets from depth maps against the reference: lenses, directions, regions, masks, holes and smoothing; even grids."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface_checks import aspect
from taichi_msm.scene.scene import Scene
from tests.reference import depth as twin

WIDTH, HEIGHT, POINTS = 24, 18, (7, 9)
REGION = (3, 2, 18, 14)
FISHEYE = (0.05, -0.02, 0.01, -0.003)

# A turn about an oblique axis, by the matrix of its Cayley transform.
SKEW = np.array([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]])
TURN = np.linalg.solve(np.eye(3) + SKEW, np.eye(3) - SKEW) @ np.diag([1.0, -1.0, -1.0])
SHIFT = np.array([0.01, -0.02, 0.08])

CASES: dict[str, dict[str, Any]] = {
    "pinhole": {},
    "fisheye": {"fisheye": FISHEYE},
    "along rays": {"fisheye": FISHEYE, "along": "ray"},
    "not smoothed": {"smooth": 0.0},
    "not smoothed with holes": {"smooth": 0.0, "holes": True, "fisheye": FISHEYE},
    "two pixels": {"smooth": 2.0, "holes": True},
    "region": {"region": REGION, "fisheye": FISHEYE, "along": "ray"},
    "mask": {"region": REGION, "mask": True, "holes": True},
    "counts": {"counts": True, "holes": True, "smooth": 0.0, "along": "ray"},
    "pose": {"pose": True, "fisheye": FISHEYE, "region": REGION},
}


def build(folder: Path, grid: str, case: dict[str, Any]) -> tuple[PicturedRest, twin.Map]:
    """Return the sheet of a scene, and the same in the reference."""
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    numbers: Any = 50 + 8 * x - 5 * y + 3 * np.cos(3 * x + 1) * np.sin(2 * y)
    unit: Any = 1e-3
    if case.get("counts"):
        numbers, unit = np.rint(numbers * 1000).astype(np.uint16), 1e-6
    if case.get("holes"):
        numbers[5:9, 8:13] = 0
        numbers[:2, :4] = 65535 if case.get("counts") else np.nan
    np.save(folder / "depth.npy", numbers)
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "frame.png")
    region, fisheye = case.get("region"), case.get("fisheye", ())
    _, _, width, height = region or (0, 0, WIDTH, HEIGHT)
    is_sheet = np.hypot(np.arange(width) - 8, np.arange(height)[:, None] - 7) < 8 if case.get("mask") else None
    camera: dict[str, Any] = {"intrinsics": {"fx": 20.0, "fy": 21.0, "cx": 11.0, "cy": 9.2}}
    if fisheye:
        camera["distortion"] = {"model": "fisheye", **{f"k{n + 1}": k for n, k in enumerate(fisheye)}}
    pose: dict[str, Any] = {"rotation": TURN, "translation": SHIFT} if case.get("pose") else {}
    if pose:
        camera["pose"] = {name: values.tolist() for name, values in pose.items()}
    section = {"file": str(folder / "depth.npy"), "unit": unit, "along": case.get("along", "axis")}
    section["smooth"] = case.get("smooth", "auto")
    sheet: dict[str, Any] = {"points": POINTS, "surface": {"depth": section, "grid": grid}}
    if is_sheet is not None:
        Image.fromarray(np.uint8(255 * is_sheet)).save(folder / "mask.png")
        sheet["mask"] = str(folder / "mask.png")
    tissue = {"young": 1e4, "thickness": 1e-3, "density": 1000}
    made = Scene.model_validate(
        {
            "image": str(folder / "frame.png"),
            "region": region,
            "sheet": sheet,
            "tissue": tissue,
            "time": {"duration": 1},
            "render": {"camera": camera},
            "output": [],
        }
    )
    rest = rest_of(made.sheet)
    assert isinstance(rest, PicturedRest)
    smooth = case.get("smooth", (width / (POINTS[1] - 1) + height / (POINTS[0] - 1)) / 4)
    seen = twin.Camera((20.0, 21.0), (11.5, 9.7), fisheye, **pose)
    return rest, twin.Map(numbers, unit, seen, smooth, section["along"], region, is_sheet)


@pytest.mark.parametrize("name", CASES)
def test_given_grid(name: str, tmp_path: Path) -> None:
    """Fits and splines are the same but for rounding: 1e-9 of a length of 0.1 m."""
    rest, reference = build(tmp_path, "given", CASES[name])
    expected = reference.surface(twin.given(POINTS))
    np.testing.assert_allclose(rest.position, expected, rtol=0, atol=1e-9 * 0.1)
    np.testing.assert_allclose(rest.texture, twin.given(POINTS), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_even_grid(name: str, tmp_path: Path) -> None:
    """Mass points are on the surface, sides on sides, and any change of the grid raises the objective."""
    rest, reference = build(tmp_path, "even", CASES[name])
    p = rest.texture
    np.testing.assert_allclose(rest.position, reference.surface(p), rtol=0, atol=1e-9 * 0.1)
    for side, value in ((p[:, 0, 0], 0), (p[:, -1, 0], 1), (p[0, :, 1], 0), (p[-1, :, 1], 1)):
        np.testing.assert_allclose(side, value, rtol=0, atol=1e-12)
    start = reference.surface(twin.given(POINTS))
    area = twin.mean_cell_area(start)
    least = twin.objective(rest.position, area)
    assert least < twin.objective(start, area) - 1e-3
    e, g, corner_areas = twin.corners(rest.position)
    assert aspect(rest) == pytest.approx(np.sqrt((e / corner_areas).mean() / (g / corner_areas).mean()), rel=1e-12)
    rng = np.random.default_rng(0)
    for _ in range(3):
        change = rng.normal(size=p.shape) / np.array(POINTS[::-1])
        change[:, [0, -1], 0] = change[[0, -1], :, 1] = 0
        # The objective grows with the square of a change by a hundredth of a cell, and at most 1e-10 of it is left.
        above = [twin.objective(reference.surface(p + size * change), area) - least for size in (-0.01, 0.01)]
        assert min(above) > 1e-6
        assert above[0] == pytest.approx(above[1], rel=0.2)
