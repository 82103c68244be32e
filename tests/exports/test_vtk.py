"""Surface and point data, read with VTK."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.exports.export import export
from taichi_msm.exports.vtk import speed
from taichi_msm.model.sheet import rectangle_shares, rest_positions
from taichi_msm.runs.finished import read_run
from tests import reference


@pytest.fixture(scope="module")
def out(ran: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("vtkmodules")
    out = tmp_path_factory.mktemp("vtk")
    export(ran, "vtk", out)
    return out


def read(path: Path) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return the grid of a file, and its point data by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput()
    data = grid.GetPointData()
    arrays = {data.GetArrayName(n): vtk_to_numpy(data.GetArray(n)) for n in range(data.GetNumberOfArrays())}
    return grid, arrays | {"points": vtk_to_numpy(grid.GetPoints().GetData())}


def test_point_data_of_every_frame(ran: Path, out: Path) -> None:
    run = read_run(ran)
    for frame, position in enumerate(run.positions()):
        grid, arrays = read(out / f"000{frame}.vtu")
        assert set(arrays) == {"points", "displacement", "speed", "energy_density", "texture"}
        assert {array.dtype for array in arrays.values()} == {np.dtype(np.float64)}, "precision of the run"
        np.testing.assert_array_equal(arrays["points"], position.reshape(-1, 3))
        displacement = position - rest_positions(run.scene.sheet)
        np.testing.assert_array_equal(arrays["displacement"], displacement.reshape(-1, 3))
        np.testing.assert_array_equal(arrays["speed"], speed(run.positions(), run.time, frame).ravel())
        # The energy of all springs, by the reference implementation.
        area = rectangle_shares(run.scene.sheet).ravel() * (0.3 / 8) * (0.4 / 10)
        total = reference.energy(run.scene, displacement)
        assert (arrays["energy_density"] * area).sum() == pytest.approx(total, rel=1e-12)
        assert grid.GetNumberOfCells() == 2 * 8 * 10
    assert total > 0


def test_orientation_and_texture_coordinates(out: Path) -> None:
    from vtkmodules.vtkFiltersCore import vtkPolyDataNormals
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    grid, arrays = read(out / "0000.vtu")
    for name, unit in (("displacement", "m"), ("speed", "m/s"), ("energy_density", "J/m2")):
        array = grid.GetPointData().GetArray(name)
        assert array.GetInformation().Get(array.UNITS_LABEL()) == unit
    assert grid.GetPointData().GetTCoords().GetName() == "texture"
    assert grid.GetPointData().GetVectors().GetName() == "displacement"
    np.testing.assert_allclose(arrays["texture"], arrays["points"][:, :2] / (0.4, 0.3) + 0.5, rtol=0, atol=1e-15)
    shell, normals = vtkGeometryFilter(), vtkPolyDataNormals()
    shell.SetInputData(grid)
    normals.SetInputConnection(shell.GetOutputPort())
    normals.ConsistencyOff()
    normals.SplittingOff()
    normals.Update()
    data = normals.GetOutput().GetPointData().GetNormals()
    assert [data.GetTuple(n) for n in range(data.GetNumberOfTuples())] == [(0, 0, 1)] * 99


def test_collection(out: Path) -> None:
    collection = ElementTree.parse(out / "surface.pvd").getroot()
    assert (collection.tag, collection.get("type")) == ("VTKFile", "Collection")
    times = {float(entry.attrib["timestep"]): entry.attrib["file"] for entry in collection.iter("DataSet")}
    assert times == {frame / 10: f"000{frame}.vtu" for frame in range(5)}
    assert all((out / name).exists() for name in times.values())
    assert (out / "picture.png").exists()


def test_speed_is_of_order_2() -> None:
    """Of the motion sin^2 t, whose speed is 5 sin 2t."""
    errors = []
    for frames in (20, 40, 80):
        time = np.linspace(0, 1, frames + 1)
        position = (np.sin(time) ** 2)[:, None, None, None] * np.tile([3.0, 0, 4], (2, 2, 1))
        exact = 5 * np.sin(2 * time)
        assert (speed(position, time, 0) == 0).all()
        errors.append(max(np.abs(speed(position, time, n) - exact[n]).max() for n in range(1, frames)))
        # One-sided: at most half the frame interval times the acceleration.
        assert np.abs(speed(position, time, frames) - exact[-1]).max() < 10 / frames / 2
    assert (speed(np.ones((1, 2, 3, 3)), np.zeros(1), 0) == 0).all(), "single frame"
    # h^2 / 6 times the third derivative, 20 at most.
    assert errors[0] < 20 / 20**2 / 6
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx([2, 2], abs=0.05)
