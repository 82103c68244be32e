"""The files that a session saves: pictures, films and scenes, each whole or not at all; none replaces another."""

from __future__ import annotations

import filecmp
import os
import shutil
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from taichi_msm.errors import FilesError, Pause, printable, writing
from taichi_msm.load.scene_file import MAX_BYTES
from taichi_msm.load.yaml_reader import MAX_NODES
from taichi_msm.runs.directory import hidden_folder, move_to_free_name
from taichi_msm.runs.encoder import Encoder
from taichi_msm.runs.media import EncodingJob, Picture
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.render import Render
from taichi_msm.scene.scene import Scene

# The C emitter is ten times faster; a PyYAML that was built without it writes the same text.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

# A scene has at most this many values besides the keys of its probes.
OTHER_VALUES = 1000


class Film:
    """A GIF of a session, encoded in a hidden folder while the session runs. On closing, it is removed unless moved.

    It shows `rate` pictures per second, each of `parts` frames of the session, from frame `begin` on. A FilesError,
    here and in the methods, says that it cannot be written, and to choose another folder by `option`.

    Attributes:
        pictures: how many it has.
    """

    def __init__(
        self, folder: Path, render: Render, rate: float, parts: int, begin: int = 0, option: str = "--out"
    ) -> None:
        self.pictures = 0
        self._parts, self._begin, self._place = parts, begin, (folder, option)
        with writing(*self._place), ExitStack() as opened:
            self._hidden = opened.enter_context(hidden_folder(folder))
            job = EncodingJob((self._hidden,), render.size, rate, png=False, gif=True, background=render.background)
            self._encoder = Encoder(job)
            opened.callback(self._encoder.abort)
            self._opened = opened.pop_all()

    def show(self, picture: Picture, frame: int, pause: Pause = lambda: None) -> None:
        """Film a picture of a frame of the session; one that comes late is taken several times. `pause`: as Encoder."""
        with writing(*self._place):
            while self.pictures * self._parts <= frame - self._begin:
                self._encoder.add(picture[None], pause)
                self.pictures += 1

    def encoded(self, pause: Pause = lambda: None) -> Path:
        """Wait until the last picture is encoded; there must be one. Returns the file, which is to be moved away."""
        with writing(*self._place):
            self._encoder.finish(pause)
        return self._hidden / OUTPUTS["gif"].path()

    def close(self) -> None:
        """End it."""
        self._opened.close()


class Captures:
    """The folder where a session of what has this name saves its files; made with the first file.

    Its methods raise a FilesError when the folder cannot be written.

    Attributes:
        saved: the saved files, in order.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.saved: list[Path] = []
        self._name = name

    def save_picture(self, picture: Picture) -> Path:
        """Save a picture as PNG; returns its file."""
        with writing(self.folder), hidden_folder(self.folder) as hidden:
            Image.fromarray(picture).save(hidden / "picture", "PNG")
            return self._place(hidden / "picture", "picture", ".png")

    def save_scene(self, scene: Scene) -> Path:
        """Save a scene, and beside it copies of its pictures, where a scene file must have them; returns its file."""
        with writing(self.folder), hidden_folder(self.folder) as hidden:
            scene = scene.with_pictures(lambda path: self._copied(Path(path)).name)
            data = scene.model_dump(mode="json", exclude_none=True)
            text = yaml.dump(
                data, Dumper=_DUMPER, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
            )
            text = f"# What was done in a live session of {printable(self._name)}; `run` repeats it.\n{text}"
            if len(text.encode()) > MAX_BYTES or probe_values(scene) + OTHER_VALUES > MAX_NODES:
                raise FilesError("this session is too long for a scene file; reset it, and do less")
            (hidden / "session").write_text(text, "utf-8")
            return self._place(hidden / "session", "session", ".yaml")

    def save_film(self, film: Film) -> Path:
        """End a film that has a picture, and save it; returns its file."""
        with closing(film), writing(self.folder):
            return self._place(film.encoded(), "film", ".gif")

    def _place(self, draft: Path, stem: str, suffix: str) -> Path:
        """Give a file the next free name."""
        self.saved.append(move_to_free_name(draft, self.folder, stem, suffix))
        return self.saved[-1]

    def _copied(self, image: Path) -> Path:
        """Make sure that the folder has a copy of a picture, under the picture's own name if that is free."""
        copy, number = self.folder / image.name, 1
        if not image.is_file():
            raise FilesError(f"{image}: missing; put the picture back, the scene needs a copy of it")
        while os.path.lexists(copy) and not (copy.exists() and filecmp.cmp(image, copy, shallow=False)):
            number += 1
            copy = self.folder / f"{image.stem}-{number}{image.suffix}"
        if not os.path.lexists(copy):
            with hidden_folder(self.folder) as hidden:
                shutil.copyfile(image, hidden / "copy").replace(copy)
        return copy


def probe_values(scene: Scene) -> int:
    """Count the values that the keys of a scene's probes add to its file, which may have `MAX_NODES` in all."""
    return sum(
        4 * len(probe.at) + 3 * len(probe.load) + 5 * len(probe.path or ()) + 3 * len(probe.grip)
        for probe in scene.probes
    )
