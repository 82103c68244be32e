"""The export formats by name: the files of each, and the function that writes them; and how they are published."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from taichi_msm.export import gltf, kitti, obj, tapvid, vtk
from taichi_msm.progress import Count
from taichi_msm.results.finished_run import FinishedRun
from taichi_msm.results.folder import Folder, Tree, allows
from taichi_msm.results.publication import Kind


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
    write: Callable[[FinishedRun, Folder, Count], list[str]]


FORMATS = {
    "kitti": Format(("flow",), ("occlusion", "png"), kitti.FILES, kitti.write_kitti),
    "tapvid": Format(("tracks", "png"), (), tapvid.FILES, tapvid.write_tapvid),
    "vtk": Format(("trajectory",), (), vtk.FILES, vtk.write_vtk),
    "gltf": Format(("trajectory",), (), gltf.FILES, gltf.write_gltf),
    "obj": Format(("trajectory",), (), obj.FILES, obj.write_obj),
}

# The file that lists the others.
RECORD = "export.json"

# The files of all formats: any of them may have been exported to a folder before, or been about to be.
FILES: Tree = {
    r"export\.json": None,
    **{name: below for one in FORMATS.values() for name, below in one.files.items()},
}


def _is_ours(name: object) -> bool:
    return isinstance(name, str) and allows(FILES, name)


def _listed(record: Any) -> Callable[[str], bool]:
    return {RECORD, *record["files"]}.__contains__


# A folder with anything else in it is refused, as nobody would find it again among so many files.
EXPORT = Kind("export", RECORD, FILES, _is_ours, _listed, alone=True, beside={})
