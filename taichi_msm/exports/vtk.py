"""VTK export for ParaView: an unstructured grid per frame (.vtu), and a collection of them with their times (.pvd).

The points of a grid are the mass points in row-major order from the top left, and its triangles are those of the
rendered surface. The data of each point are

    displacement     from the rest position [m]
    speed            central difference of the displacements in the adjacent frames [m/s]
    energy_density   elastic energy of the structural and shear springs, per area at rest [J/m2]; without plate bending
                     and virtual springs
    texture          texture coordinates from the lower left corner of the exported picture

Source: VTK's own writer; for the .pvd file, ParaView's guide.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import NotInstalledError, ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, PICTURE_FILE, picture_png
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import refine_surface
from taichi_msm.runs.directory import write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.solver.planning import make_plan
from taichi_msm.terms.elasticity import energy_density

DISPLACEMENT, SPEED, ENERGY = "displacement", "speed", "energy_density"
UNITS = {DISPLACEMENT: "m", SPEED: "m/s", ENERGY: "J/m2"}

Array = NDArray[np.floating]


@one_folder_per_run
def write(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    """Write the surface of every frame, the collection and the picture; arguments as for `one_folder_per_run`.

    Raises:
        FilesError: as for `FinishedRun.positions`, and when a map has changed since the run.
        SceneError: as for `picture_png`.
        NotInstalledError: when VTK is not installed.
    """
    try:
        import vtkmodules.vtkIOXML  # noqa: F401
    except ImportError:
        raise NotInstalledError("--format vtk: needs VTK, which is not installed; pip install vtk") from None
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
    write_new_file(folder / "surface.pvd", _collection(run.time))
    return []


def speed(positions: Array, time: Array, frame: int) -> Array:
    """Compute the speed of the mass points in a frame by central differences.

    Args:
        positions: positions in all frames [m], shape (frames, rows, cols, 3).
        time: times of the frames [s], shape (frames,).
        frame: index of the frame.

    Returns:
        Speed [m/s], shape (rows, cols); 0 in the first frame, in which the sheet is at rest.

    Order: 2 in the frame interval; 1 in the last frame and where the load jumps.
    """
    if frame == 0:
        return np.zeros(positions.shape[1:3])
    after = min(frame + 1, len(positions) - 1)
    displacement = positions[after].astype(np.float64) - positions[frame - 1]
    return np.linalg.norm(displacement, axis=-1) / (time[after] - time[frame - 1])


def _name(frame: int) -> str:
    return f"{frame:04}.vtu"


def _grid(position: Array, values: dict[str, Array]) -> bytes:
    """Build the content of a .vtu file with point data."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkPoints
    from vtkmodules.vtkCommonDataModel import VTK_TRIANGLE, vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    def named(name: str, data: Array) -> Any:
        # Data are stored in the precision of the run.
        array = numpy_to_vtk(np.ascontiguousarray(data, position.dtype), deep=True)
        array.SetName(name)
        if name in UNITS:
            array.GetInformation().Set(vtkDataArray.UNITS_LABEL(), UNITS[name])
        return array

    mesh = refine_surface(position, EXPORT_REFINE)
    points, cells, grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(named("points", mesh.vertices))
    starts = np.arange(0, mesh.triangles.size + 1, 3)
    cells.SetData(
        numpy_to_vtkIdTypeArray(starts, deep=True),
        numpy_to_vtkIdTypeArray(mesh.triangles.reshape(-1).astype(np.int64), deep=True),
    )
    grid.SetPoints(points)
    grid.SetCells(VTK_TRIANGLE, cells)
    for name, data in values.items():
        grid.GetPointData().AddArray(named(name, data))
    grid.GetPointData().SetActiveVectors(DISPLACEMENT)
    grid.GetPointData().SetTCoords(named("texture", mesh.texture_coordinates * (1, -1) + (0, 1)))
    # VTK writes to a string: to a file, it would only print an error when the disk is full.
    writer = vtkXMLUnstructuredGridWriter()
    writer.WriteToOutputStringOn()
    writer.SetInputData(grid)
    writer.Write()
    return bytes(writer.GetOutputString(), "ascii")


def _collection(time: Array) -> bytes:
    """Build the content of the .pvd file."""
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    collection = ElementTree.SubElement(root, "Collection")
    for frame, seconds in enumerate(time.tolist()):
        ElementTree.SubElement(collection, "DataSet", timestep=repr(seconds), part="0", file=_name(frame))
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
