"""Replace the files that an export has put into a folder by new ones: those of one export, and each of them whole."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from taichi_msm.errors import writing
from taichi_msm.results.folder import Folder, Tree

PREFIX = ".partial-"


@contextmanager
def staging(directory: Path, files: Tree) -> Iterator[Path]:
    """Make a folder to write the new files in; where the block ends well, they take the place of the earlier ones.

    Args:
        directory: where they go; made where it does not exist, and removed again where nothing comes of it.
        files: all that may be there, by patterns of its names.

    Raises:
        ForeignError: when anything else is there; nothing of it is touched.
        FilesError: when the directory cannot be written.
    """
    ours = {**files, rf"\{PREFIX}.*": files}
    created = not directory.exists()
    try:
        with writing(directory), Folder.at(directory, create=True) as folder:
            folder.require_only(ours)
            with tempfile.TemporaryDirectory(prefix=PREFIX, dir=directory) as name:
                staged = Path(name)
                yield staged
                folder.clear(ours, keep=(staged.name,))
                for entry in sorted(staged.iterdir()):
                    entry.rename(directory / entry.name)
    finally:
        if created:
            with suppress(OSError):  # there is something in it, or never was a directory
                directory.rmdir()
