"""Replace the files that an export has put into a folder by new ones: those of one export, and each of them whole.

A record in the folder lists the files that exports have put there, and only these are replaced or removed. It lists new
ones before they come and earlier ones until they are gone, so an export that is killed leaves nothing that the next one
does not know.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from taichi_msm.errors import FilesError, ForeignError, writing
from taichi_msm.results.folder import Folder, Tree

RECORD, LOCK, DRAFT, PREFIX = "export.json", ".lock", ".draft", ".partial-"

# A record of so many files that no export writes them is smaller [bytes].
MAX_RECORD = 1 << 24


@contextmanager
def staging(directory: Path, files: Tree) -> Iterator[Path]:
    """Make a folder to write the new files in; where the block ends well, they take the place of the earlier ones.

    Args:
        directory: where they go; made where it does not exist, and removed again where nothing comes of it.
        files: all that an export writes, by patterns of its names.

    Raises:
        ForeignError: when anything is there that no export has put there; nothing of it is touched.
        FilesError: when the directory cannot be written, or another export writes there.
    """
    created = not directory.exists()
    try:
        with writing(directory), Folder.at(directory, create=True) as folder:
            try:
                lock = folder.lock(LOCK)
            except BlockingIOError:
                raise FilesError(f"{directory}: another export is writing there; choose another --out") from None
            with lock:
                try:
                    earlier = _earlier(folder)
                    # Folders of exports that were killed have names that nobody else gives.
                    ours = {**_tree([*earlier, RECORD, LOCK, DRAFT]), rf"\{PREFIX}.*": files}
                    folder.require_only(ours)
                    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=directory) as name:
                        staged = Path(name)
                        yield staged
                        new = sorted(
                            path.relative_to(staged).as_posix() for path in staged.rglob("*") if path.is_file()
                        )
                        _record(folder, {*earlier, *new})
                        folder.clear(ours, keep=(staged.name, RECORD, LOCK))
                        for entry in sorted(staged.iterdir()):
                            entry.rename(directory / entry.name)
                        _record(folder, new)
                finally:
                    folder.remove(LOCK)
    finally:
        if created:
            with suppress(OSError):  # there is something in it, or never was a directory
                directory.rmdir()


def _earlier(folder: Folder) -> list[str]:
    """List the files that exports have put into a folder, as the record tells."""
    if folder.kind(RECORD) is None:
        return []
    try:
        with folder.open(RECORD) as file:
            names = json.loads(file.read(MAX_RECORD))["files"]
        if not all(isinstance(name, str) for name in names):
            raise TypeError
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ForeignError.at(folder.path / RECORD, "a file") from None
    return list(names)


def _record(folder: Folder, names: Iterable[str]) -> None:
    """Write the record."""
    folder.write(RECORD, (json.dumps({"files": sorted(names)}, indent=1) + "\n").encode(), DRAFT)


def _tree(names: Iterable[str]) -> Tree:
    """Allow exactly these files, which may be in folders."""
    tree: dict[str, Tree | None] = {}
    below: dict[str, list[str]] = {}
    for name in names:
        head, _, rest = name.partition("/")
        if rest:
            below.setdefault(head, []).append(rest)
        else:
            tree[re.escape(head)] = None
    return {**tree, **{re.escape(head): _tree(rest) for head, rest in below.items()}}
