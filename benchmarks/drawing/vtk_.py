"""Offscreen VTK: a mesh with new vertices and normals for every picture; on a CPU, by llvmpipe."""

from __future__ import annotations

import numpy as np
import vtk
from numpy.typing import NDArray
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

from benchmarks.drawing.problem import SIDE, Picture, Problem
from benchmarks.process import UnavailableError


class Vtk:
    """The mesh, its texture and its window."""

    def __init__(self, problem: Problem) -> None:
        self._window = vtk.vtkRenderWindow()
        self._window.OffScreenRenderingOn()
        if not self._window.SupportsOpenGL():
            raise UnavailableError("no offscreen OpenGL")
        n = problem.vertices
        self._refinement = problem.refinement
        self._position, self._normal = (np.zeros((n * n, 3), np.float32) for _ in range(2))
        self._mesh = vtk.vtkPolyData()
        self._mesh.SetPoints(vtk.vtkPoints())
        self._mesh.GetPoints().SetData(numpy_to_vtk(self._position))
        self._mesh.GetPointData().SetNormals(numpy_to_vtk(self._normal))
        self._mesh.GetPointData().SetTCoords(numpy_to_vtk(self._texture_coordinates(n), deep=True))
        self._mesh.SetPolys(self._triangles(n))
        mapper = vtk.vtkPolyDataMapper()
        mapper.SetInputData(self._mesh)
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.SetTexture(self._texture(problem.texture))
        surface = actor.GetProperty()
        surface.SetAmbient(0 if problem.lit else 1)
        surface.SetDiffuse(1 if problem.lit else 0)
        renderer = vtk.vtkRenderer()
        renderer.AddActor(actor)
        camera = renderer.GetActiveCamera()
        camera.ParallelProjectionOn()
        camera.SetParallelScale(SIDE / 2)
        camera.SetPosition(0, 0, 1)
        camera.SetFocalPoint(0, 0, 0)
        camera.SetClippingRange(0.1, 2)
        self._window.SetMultiSamples(0)
        self._window.SetSize(problem.pixels, problem.pixels)
        self._window.AddRenderer(renderer)
        self._pixels = vtk.vtkUnsignedCharArray()

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Refine by NumPy, draw, and read the picture; VTK's first row is the bottom."""
        across, down = np.gradient(position, axis=1), np.gradient(position, axis=0)
        normal = self._refine(np.cross(across, -down))
        self._position[:] = self._refine(position)
        np.divide(normal, np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None], out=self._normal)
        self._mesh.GetPoints().GetData().Modified()
        self._mesh.GetPoints().Modified()
        self._mesh.GetPointData().GetNormals().Modified()
        self._mesh.Modified()
        self._window.Render()
        width, height = self._window.GetSize()
        self._window.GetPixelData(0, 0, width - 1, height - 1, 0, self._pixels, 0)
        return vtk_to_numpy(self._pixels).reshape(height, width, 3)[::-1]

    def _refine(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Insert vertices along both axes; shape (vertices, 3)."""
        down = np.tensordot(self._refinement, values.astype(np.float32), 1)
        return np.einsum("ai,rik->rak", self._refinement, down, optimize=True).reshape(-1, 3)

    @staticmethod
    def _texture_coordinates(n: int) -> NDArray[np.float32]:
        """Return the texture coordinates, v upwards; shape (vertices, 2)."""
        along = np.linspace(0, 1, n, dtype=np.float32)
        return np.stack(np.meshgrid(along, 1 - along), axis=-1).reshape(-1, 2)

    @staticmethod
    def _triangles(n: int) -> vtk.vtkCellArray:
        """Return two triangles per quad, cut from its top left to its bottom right corner."""
        quad = np.arange(n - 1)[:, None, None] * n + np.arange(n - 1)[:, None]
        corners = np.add(quad, [0, n, n + 1, 0, n + 1, 1]).ravel()
        cells = vtk.vtkCellArray()
        cells.SetData(
            numpy_to_vtkIdTypeArray(np.arange(0, len(corners) + 1, 3), deep=True),
            numpy_to_vtkIdTypeArray(corners, deep=True),
        )
        return cells

    @staticmethod
    def _texture(picture: Picture) -> vtk.vtkTexture:
        image = vtk.vtkImageData()
        image.SetDimensions(picture.shape[1], picture.shape[0], 1)
        image.GetPointData().SetScalars(numpy_to_vtk(picture[::-1].reshape(-1, 3), deep=True))
        texture = vtk.vtkTexture()
        texture.SetInputData(image)
        texture.InterpolateOn()
        texture.SetWrap(vtk.vtkTexture.ClampToEdge)
        return texture


def prepare(problem: Problem, threads: int | None) -> Vtk:
    """Set up the mesh; llvmpipe reads the number of threads from the environment."""
    del threads
    return Vtk(problem)
