"""The files that a session saves: pictures, films and scenes, each whole or not at all; none replaces another."""

from __future__ import annotations

import filecmp
import os
import shutil
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from taichi_msm.errors import FilesError, printable, writing
from taichi_msm.outputs.gif import Picture
from taichi_msm.results.whole import place, staged
from taichi_msm.scene import Scene
from taichi_msm.scenefile.load import MAX_BYTES
from taichi_msm.scenefile.yaml_reader import MAX_NODES
from taichi_msm.viewer.film import Film

# The C emitter is ten times faster; a PyYAML that was built without it writes the same text.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

# A scene has at most this many values besides the keys of its probes.
VALUES_BESIDES = 1000


class Captures:
    """The folder where a session saves its files; made with the first file.

    Args:
        folder: the folder.
        name: what the session is of; written into its scenes.

    Attributes:
        kept: the saved files, in order.
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
        with writing(self.folder), staged(self.folder) as hidden:
            Image.fromarray(picture).save(hidden / "picture", "PNG")
            return self._place(hidden / "picture", "picture", ".png")

    def keep_scene(self, scene: Scene) -> Path:
        """Save a scene, and beside it copies of its pictures, where a scene file must have them; returns its file."""
        with writing(self.folder), staged(self.folder) as hidden:
            scene = scene.with_pictures(lambda path: self._copied(Path(path)).name)
            data = scene.model_dump(mode="json", exclude_none=True)
            text = yaml.dump(
                data, Dumper=_DUMPER, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
            )
            text = f"# What was done in a live session of {printable(self._name)}; `run` repeats it.\n{text}"
            if len(text.encode()) > MAX_BYTES or values(scene) + VALUES_BESIDES > MAX_NODES:
                raise FilesError("this session is too long for a scene file; reset it, and do less")
            (hidden / "session").write_text(text, "utf-8")
            return self._place(hidden / "session", "session", ".yaml")

    def film(self, size: tuple[int, int], rate: float, background: tuple[int, int, int]) -> Film:
        """Begin a film."""
        return Film(self.folder, size, rate, background)

    def keep_film(self, film: Film) -> Path:
        """End a film that has a picture, and save it; returns its file."""
        with film, writing(self.folder):
            return self._place(film.encoded(), "film", ".gif")

    def _place(self, draft: Path, stem: str, suffix: str) -> Path:
        """Give a file the next free name."""
        self.kept.append(place(draft, self.folder, stem, suffix))
        return self.kept[-1]

    def _copied(self, image: Path) -> Path:
        """Make sure that the folder has a copy of a picture, under the picture's own name if that is free."""
        copy, number = self.folder / image.name, 1
        if not image.is_file():
            raise FilesError(f"{image}: missing; put the picture back, the scene needs a copy of it")
        while os.path.lexists(copy) and not (copy.exists() and filecmp.cmp(image, copy, shallow=False)):
            number += 1
            copy = self.folder / f"{image.stem}-{number}{image.suffix}"
        if not os.path.lexists(copy):
            with staged(self.folder) as hidden:
                shutil.copyfile(image, hidden / "copy")
                (hidden / "copy").replace(copy)
        return copy


def values(scene: Scene) -> int:
    """Count the values that the keys of a scene's probes add to its file, which may have `MAX_NODES` in all."""
    return sum(4 * len(probe.at) + 3 * len(probe.load) for probe in scene.probes)
