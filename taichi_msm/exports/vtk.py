"""VTK export for ParaView: an unstructured grid per frame (.vtu), and a collection of the grids with times (.pvd).

The points of a grid are the mass points of the sheet in row-major order from the top left, and its triangles are those
of the rendered surface. The data of each point are

    displacement     from the rest position [m]
    speed            central difference of the displacements in the adjacent frames [m/s]
    energy_density   elastic energy of the structural and shear springs, per area at rest [J/m2]; without plate bending
                     and virtual springs
    texture          texture coordinates from the lower left corner of the exported picture

Source: VTK's documentation of its XML formats; for the .pvd file, ParaView's guide.
"""

from __future__ import annotations

import struct
import zlib
from base64 import b64encode
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import EXPORT_REFINE, PICTURE_FILE, mass_points, picture_png
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Surface, refine_surface
from taichi_msm.runs.directory import write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.solver.planning import make_plan
from taichi_msm.terms.elasticity import energy_density

TYPES = {"f": "Float", "i": "Int", "u": "UInt"}
UNITS = {"displacement": "m", "speed": "m/s", "energy_density": "J/m2"}

Array = NDArray[np.floating]


def _write_run(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    positions, rest, picture = run.positions(), run.rest(), picture_png(run)
    mask = rest.mask if rest else None
    run.require_same_pictures(drawn=False)
    plan, start = make_plan(run.scene), rest_positions(run.scene.sheet)
    collection = Element("VTKFile", type="Collection", version="0.1")
    files = SubElement(collection, "Collection")
    for frame, seconds in enumerate(run.time.tolist()):
        progress(frame, run.frames)
        displacement, name = positions[frame] - start, f"{frame:04}.vtu"
        values = {
            "displacement": displacement,
            "speed": speed(positions, run.time, frame),
            "energy_density": energy_density(plan, displacement),
        }
        values = {key: mass_points(array, mask) for key, array in values.items()}
        mesh = refine_surface(positions[frame], EXPORT_REFINE, rest)
        write_new_file(folder / name, _document(_grid(mesh, values)))
        SubElement(files, "DataSet", timestep=repr(seconds), part="0", file=name)
    if picture is not None:
        write_new_file(folder / PICTURE_FILE, picture)
    write_new_file(folder / "surface.pvd", _document(collection))
    return []


write = one_folder_per_run(_write_run)


def speed(positions: Array, time: Array, frame: int) -> Array:
    """Compute the speed of the mass points in a frame [m/s], shape (rows, cols), by central differences.

    It is 0 in the first frame, in which the sheet is at rest. The positions in all frames [m] have shape (frames, rows,
    cols, 3).

    Order: 2 in the frame interval; 1 in the last frame and where the load jumps.
    """
    if frame == 0:
        return np.zeros(positions.shape[1:3])
    after = min(frame + 1, len(positions) - 1)
    displacement = positions[after].astype(np.float64) - positions[frame - 1]
    return np.linalg.norm(displacement, axis=-1) / (time[after] - time[frame - 1])


def _grid(mesh: Surface, values: dict[str, Array]) -> Element:
    """Build a .vtu file with point data in the precision of the run."""
    root = Element("VTKFile", type="UnstructuredGrid", version="1.0", byte_order="LittleEndian")
    root.attrib |= {"header_type": "UInt64", "compressor": "vtkZLibDataCompressor"}
    sizes = {"NumberOfPoints": str(len(mesh.vertices)), "NumberOfCells": str(len(mesh.triangles))}
    piece = SubElement(SubElement(root, "UnstructuredGrid"), "Piece", sizes)
    data = SubElement(piece, "PointData", Vectors="displacement", TCoords="texture")
    for name, array in {**values, "texture": mesh.texture_coordinates * (1, -1) + (0, 1)}.items():
        _add_array(data, name, array.astype(mesh.vertices.dtype))
    _add_array(SubElement(piece, "Points"), "points", mesh.vertices)
    cells = SubElement(piece, "Cells")
    _add_array(cells, "connectivity", mesh.triangles.reshape(-1).astype(np.int64))
    _add_array(cells, "offsets", np.arange(3, mesh.triangles.size + 1, 3))
    _add_array(cells, "types", np.full(len(mesh.triangles), 5, np.uint8))  # VTK_TRIANGLE
    return root


def _add_array(parent: Element, name: str, array: NDArray[Any]) -> None:
    """Add an array as a single compressed block, after a header with its sizes."""
    kind, components = f"{TYPES[array.dtype.kind]}{8 * array.itemsize}", str(array[0].size)
    element = SubElement(parent, "DataArray", type=kind, Name=name, NumberOfComponents=components, format="binary")
    content = array.astype(array.dtype.newbyteorder("<")).tobytes()
    packed = zlib.compress(content)
    element.text = (b64encode(struct.pack("<4Q", 1, len(content), 0, len(packed))) + b64encode(packed)).decode()
    if name in UNITS:
        SubElement(element, "InformationKey", name="UNITS_LABEL", location="vtkDataArray").text = UNITS[name]


def _document(root: Element) -> bytes:
    indent(root)
    return tostring(root, encoding="utf-8", xml_declaration=True)
