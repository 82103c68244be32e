"""The export formats by name: the files of each, and the function that writes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from taichi_msm.export import gltf, kitti, obj, tapvid, vtk
from taichi_msm.progress import Count
from taichi_msm.results.finished_run import FinishedRun
from taichi_msm.results.folder import Tree


class Format(NamedTuple):
    """An export format.

    Attributes:
        needs: the entries of a scene's `output` that it is made from.
        uses: further entries of which it would have more.
        files: the files in its folder, as patterns of names.
        write: writes the files of a run into an empty folder, reports its progress, and returns what the user should
            know about the files.
    """

    needs: tuple[str, ...]
    uses: tuple[str, ...]
    files: Tree
    write: Callable[[FinishedRun, Path, Count], list[str]]


FORMATS = {
    "kitti": Format(("flow",), ("occlusion", "png"), kitti.FILES, kitti.write_kitti),
    "tapvid": Format(("tracks", "png"), (), tapvid.FILES, tapvid.write_tapvid),
    "vtk": Format(("trajectory",), (), vtk.FILES, vtk.write_vtk),
    "gltf": Format(("trajectory",), (), gltf.FILES, gltf.write_gltf),
    "obj": Format(("trajectory",), (), obj.FILES, obj.write_obj),
}
