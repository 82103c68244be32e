"""The surface for ParaView: an unstructured grid for every frame (.vtu), and a list of them with their times (.pvd).

Points are the mass points, row after row from the top left; the triangles between them are cut as in the picture. Each
point has

    displacement     from rest [m]
    speed            [m/s], from the frames before and after it: the difference of their displacements over their time
    energy_density   elastic energy of the springs per area at rest [J/m2], without that of bending and of the virtual
                     springs
    texture          texture coordinates, from the picture's lower left; the picture is beside the files

Source: VTK's own writer; for the .pvd file, ParaView's guide.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Count, NotInstalledError
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, PICTURE_FILE, picture_png
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import surface
from taichi_msm.runs.directory import write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.solver.planning import make_plan
from taichi_msm.terms.elasticity import energy_density

COLLECTION_FILE = "surface.pvd"

DISPLACEMENT, SPEED, ENERGY = "displacement", "speed", "energy_density"
UNITS = {DISPLACEMENT: "m", SPEED: "m/s", ENERGY: "J/m2"}

Array = NDArray[np.floating]


@one_folder_per_run
def write(run: FinishedRun, folder: Path, progress: Count) -> list[str]:
    """Write the surface of every frame, their times and the picture.

    Raises as `gltf.write` does; and a NotInstalledError when VTK is not installed.
    """
    try:
        import vtkmodules.vtkIOXML  # noqa: F401
    except ImportError:
        said = "--format vtk: needs VTK, which is not installed; pip install vtk"
        raise NotInstalledError(said) from None
    positions, picture = run.positions(), picture_png(run)
    run.require_same_pictures(drawn=False)
    plan, rest = make_plan(run.scene), rest_positions(run.scene.sheet)
    for frame in range(run.frames):
        progress(frame, run.frames)
        displacement = positions[frame] - rest
        values = {
            DISPLACEMENT: displacement.reshape(-1, 3),
            SPEED: speed(positions, run.time, frame).ravel(),
            ENERGY: energy_density(plan, displacement).ravel(),
        }
        write_new_file(folder / _name(frame), _grid(positions[frame], values))
    if picture is not None:
        write_new_file(folder / PICTURE_FILE, picture)
    write_new_file(folder / COLLECTION_FILE, _collection(run.time))
    return []


def speed(positions: Array, time: Array, frame: int) -> Array:
    """Give the speed of the points in a frame [m/s], shape (rows, cols), by the difference of the frames beside it.

    It is 0 in the first, which is at rest. `positions` [m] are of all frames, shape (frames, rows, cols, 3).

    Order: 2 in the time of a frame; 1 in the last frame, and wherever the load jumps.
    """
    if frame == 0:
        return np.zeros(positions.shape[1:3])
    after = min(frame + 1, len(positions) - 1)
    moved = positions[after].astype(np.float64) - positions[frame - 1]
    return np.linalg.norm(moved, axis=-1) / (time[after] - time[frame - 1])


def _name(frame: int) -> str:
    return f"{frame:04}.vtu"


def _grid(position: Array, values: dict[str, Array]) -> bytes:
    """Write a surface with the data of its points as a file's content."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkPoints
    from vtkmodules.vtkCommonDataModel import VTK_TRIANGLE, vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    def named(name: str, data: Array) -> Any:
        # The data have the precision of the run.
        array = numpy_to_vtk(np.ascontiguousarray(data, position.dtype), deep=True)
        array.SetName(name)
        if name in UNITS:
            array.GetInformation().Set(vtkDataArray.UNITS_LABEL(), UNITS[name])
        return array

    shown = surface(position, EXPORT_REFINE)
    points, cells, grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(named("points", shown.vertices))
    starts = np.arange(0, shown.triangles.size + 1, 3)
    cells.SetData(
        numpy_to_vtkIdTypeArray(starts, deep=True),
        numpy_to_vtkIdTypeArray(shown.triangles.reshape(-1).astype(np.int64), deep=True),
    )
    grid.SetPoints(points)
    grid.SetCells(VTK_TRIANGLE, cells)
    for name, data in values.items():
        grid.GetPointData().AddArray(named(name, data))
    grid.GetPointData().SetActiveVectors(DISPLACEMENT)
    grid.GetPointData().SetTCoords(named("texture", shown.texture_coordinates * (1, -1) + (0, 1)))
    # VTK makes a text that Python writes, so that a full disk is Python's error; VTK would print one of its own.
    writer = vtkXMLUnstructuredGridWriter()
    writer.WriteToOutputStringOn()
    writer.SetInputData(grid)
    writer.Write()
    return bytes(writer.GetOutputString(), "ascii")


def _collection(time: Array) -> bytes:
    """Write the list of the files with their times as a file's content."""
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    collection = ElementTree.SubElement(root, "Collection")
    for frame, seconds in enumerate(time.tolist()):
        ElementTree.SubElement(collection, "DataSet", timestep=repr(seconds), part="0", file=_name(frame))
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
