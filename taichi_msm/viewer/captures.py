"""What a session keeps: pictures, films and scenes, each whole or not at all, and none in the place of another."""

from __future__ import annotations

import filecmp
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from taichi_msm.errors import FilesError, printable, writing
from taichi_msm.results.gif import Picture
from taichi_msm.scene import Scene
from taichi_msm.scenefile.load import MAX_BYTES
from taichi_msm.scenefile.yaml_reader import MAX_NODES
from taichi_msm.viewer.film import Film

# The C emitter is ten times faster; a PyYAML that was built without it writes the same text.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

# A scene has no more values besides the keys of its probes.
VALUES_BESIDES = 1000


class Captures:
    """A folder of what a session keeps; made when there is something to keep.

    Args:
        folder: where.
        name: what the session is of, for its scenes.

    Attributes:
        kept: the files, in order.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.kept: list[Path] = []
        self._name = name

    def keep_picture(self, picture: Picture) -> Path:
        """Save a picture as PNG; returns its file.

        Raises:
            FilesError: here and below, when the folder cannot be written.
        """
        with _draft(self.folder) as draft:
            Image.fromarray(picture).save(draft, "PNG")
            return self._place(draft, "picture", ".png")

    def keep_scene(self, scene: Scene) -> Path:
        """Save a scene, and copies of its pictures beside it, as a scene file needs them near; returns its file."""
        with _draft(self.folder) as draft:
            if scene.stiffness_map is not None:
                scene = scene.with_map_image(self._copied(Path(scene.stiffness_map.image)).name)
            data = scene.model_dump(mode="json", exclude_none=True)
            if scene.image is not None:
                data["image"] = self._copied(Path(scene.image)).name
            text = yaml.dump(
                data, Dumper=_DUMPER, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
            )
            text = f"# What was done in a live session of {printable(self._name)}; run repeats it.\n{text}"
            if len(text.encode()) > MAX_BYTES or values(scene) + VALUES_BESIDES > MAX_NODES:
                raise FilesError("this session is too long for the file of a scene; reset it, and do less")
            draft.write_text(text, "utf-8")
            return self._place(draft, "session", ".yaml")

    def film(self, size: tuple[int, int], rate: float, background: tuple[int, int, int]) -> Film:
        """Begin a film."""
        return Film(self.folder, size, rate, background)

    def keep_film(self, film: Film) -> Path:
        """Save a film that has a picture, and end it; returns its file."""
        with film, writing(self.folder):
            return self._place(film.encoded(), "film", ".gif")

    def _place(self, draft: Path, stem: str, suffix: str) -> Path:
        """Give a file the next name that no other has."""
        number = 1
        while not _named(draft, path := self.folder / f"{stem}-{number}{suffix}"):
            number += 1
        self.kept.append(path)
        return path

    def _copied(self, image: Path) -> Path:
        """Have a copy of a picture in the folder, under its own name if that is free."""
        copy, number = self.folder / image.name, 1
        if not image.is_file():
            raise FilesError(f"{image}: is gone; put the picture back, the scene needs a copy of it")
        while os.path.lexists(copy) and not (copy.exists() and filecmp.cmp(image, copy, shallow=False)):
            number += 1
            copy = self.folder / f"{image.stem}-{number}{image.suffix}"
        if not os.path.lexists(copy):
            with _draft(self.folder) as draft:
                shutil.copyfile(image, draft)
                draft.replace(copy)
        return copy


@contextmanager
def _draft(folder: Path) -> Iterator[Path]:
    """Give a name out of sight to write a file under; it is gone in the end."""
    # No two processes ever have one name: a draft may be another name of what was kept by one that was killed.
    draft = folder / f".draft-{secrets.token_hex(8)}"
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            yield draft
        finally:
            draft.unlink(missing_ok=True)


def values(scene: Scene) -> int:
    """Count the values that the keys of a scene's probes are in its file, which may have `MAX_NODES`."""
    return sum(4 * len(probe.at) + 3 * len(probe.load) for probe in scene.probes)


def _named(draft: Path, path: Path) -> bool:
    """Give a file a name, unless another has it."""
    try:
        # Unlike a rename, a link takes no other file's place.
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError:
        # A file system without links.
        if path.exists():
            return False
        draft.replace(path)
    return True
