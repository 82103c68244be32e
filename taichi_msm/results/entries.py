"""What is in a folder that we write in: only files of ours, or something that a link, a device or a person put there.

A folder is checked once, when work in it begins. What is created later is created exclusively.
"""

from __future__ import annotations

import re
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from taichi_msm.errors import FilesError, ForeignError

FILE, FOLDER = "a file", "a folder"


def kind(path: Path) -> str | None:
    """Give the kind of an entry, not of what it links to: FILE, FOLDER or other words; None if missing."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISREG(mode):
        return FILE
    if stat.S_ISDIR(mode):
        return FOLDER
    return "a symbolic link" if stat.S_ISLNK(mode) else "a pipe or a device"


def require(path: Path, wanted: str) -> Path:
    """Make sure that an entry, if it exists, is of a kind, or raise a ForeignError; returns its path."""
    if (actual := kind(path)) not in (None, wanted):
        raise ForeignError.at(path, str(actual))
    return path


def without_link(folder: Path, option: str) -> Path:
    """Make sure that a folder which the user did not name is no symbolic link: it may have come with the scene."""
    try:
        is_link = folder.is_symlink()
    except OSError as error:
        raise FilesError(f"{folder}: {(error.strerror or str(error)).lower()}") from None
    if is_link:
        raise FilesError(f"{folder}: a symbolic link; name the folder it leads to with {option}")
    return folder


def files(top: Path, patterns: Collection[str], *, strict: bool, besides: Collection[str] = ()) -> Iterator[str]:
    """List the files in a folder and below whose names, with slashes, match a pattern; no link is followed.

    Patterns are regular expressions for whole names, and those for the folders are what is before their last slash. If
    `strict`, the first other entry is a ForeignError, but for those `besides`.
    """
    allowed, folders = re.compile("|".join(patterns)), re.compile("|".join(parents(patterns)))

    def look(folder: Path, prefix: str) -> Iterator[str]:
        for path in folder.iterdir():
            actual, name = kind(path), prefix + path.name
            if actual is None or name in besides:
                continue
            if actual == FOLDER and folders.fullmatch(name):
                yield from look(path, f"{name}/")
            elif actual == FILE and allowed.fullmatch(name):
                yield name
            elif strict:
                raise ForeignError.at(path, actual)

    return look(top, "")


def clear(top: Path, patterns: Collection[str], keep: Collection[str] = ()) -> None:
    """Remove all entries of a folder but those to keep; before, raise a ForeignError if `files` does not allow one."""
    list(files(top, patterns, strict=True))
    for path in list(top.iterdir()):
        if path.name in keep:
            continue
        if kind(path) == FOLDER:
            shutil.rmtree(path)
        else:
            path.unlink()


def parents(names: Iterable[str]) -> set[str]:
    """List the folders that names with slashes are in, and those around them."""
    inner = {name.rpartition("/")[0] for name in names if "/" in name}
    return inner | parents(inner) if inner else inner
