"""Replace the files of an earlier export by new ones, so that the folder has the whole files of a single export."""

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
    """Make a folder to write the new files in; if the block ends without an error, they replace the earlier ones.

    Args:
        directory: where they go; made if it does not exist, and then removed again if the block fails.
        files: all that may be there, as patterns of names.

    Raises:
        ForeignError: when anything else is there; nothing is touched then.
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
            with suppress(OSError):  # it is not empty, or it was never made
                directory.rmdir()
