"""Files of a session: pictures, films and scenes, each written atomically."""

from __future__ import annotations

import filecmp
import io
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import yaml
from PIL import Image

from taichi_msm.errors import FilesError, printable, writing
from taichi_msm.load.scene_file import MAX_BYTES
from taichi_msm.load.yaml_reader import MAX_NODES
from taichi_msm.runs.directory import hidden_folder, move_to_free_name
from taichi_msm.runs.encoder import Encoder, EncodingJob
from taichi_msm.runs.media import Picture
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.render import Render
from taichi_msm.scene.scene import Scene


class Film:
    """Film of a running session, .gif or .mp4, encoded in a hidden folder next to it; `close` removes the folder.

    All methods raise a FilesError, with the command-line option of the path, when the film cannot be written.
    """

    def __init__(self, path: Path, option: str, render: Render, rate: float, subframes: int, begin: int) -> None:
        self.pictures = 0
        self._format = path.suffix.lower().removeprefix(".")
        # Frames of the session per picture of the film, and that at which the film begins.
        self._subframes, self._begin = subframes, begin
        self._location = path.parent, option
        with writing(*self._location), ExitStack() as opened:
            self._hidden = opened.enter_context(hidden_folder(path.parent))
            job = EncodingJob(
                (self._hidden,), render.size, rate / subframes, (self._format,), render.background, render.quality
            )
            self._encoder = Encoder(job)
            opened.callback(self._encoder.abort)
            self._opened = opened.pop_all()

    def add_frame(self, picture: Picture, frame: int) -> None:
        """Append the picture, shape (height, width, 3), of a frame of the session, also in place of skipped ones."""
        with writing(*self._location):
            while self.pictures * self._subframes <= frame - self._begin:
                self._encoder.add(picture[None])
                self.pictures += 1

    def finish(self) -> Path:
        """Finish a film with at least one picture; return its path in the hidden folder, for the caller to move."""
        with writing(*self._location):
            self._encoder.finish()
        return self._hidden / OUTPUTS[self._format].path()

    def close(self) -> None:
        """Stop the encoder, and remove the hidden folder."""
        self._opened.close()


class Captures:
    """Folder for the files of a session, created with the first file; a FilesError if it cannot be written."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.saved: list[Path] = []  # in order
        # Files of each download, in order: one, or those of a ZIP, a scene and its pictures.
        self.downloads: dict[str, list[Path]] = {}
        self._name = name  # of the scene, for a comment in saved scenes

    def save_picture(self, picture: Picture) -> Path:
        """Save a picture, shape (height, width, 3), as PNG; return its path."""
        with writing(self.folder), hidden_folder(self.folder) as hidden:
            Image.fromarray(picture).save(hidden / "picture", "PNG")
            return self._move_to_free_name(hidden / "picture", "picture", ".png")

    def save_scene(self, scene: Scene) -> Path:
        """Save a scene and copies of its pictures; return the path of the scene file."""
        with writing(self.folder), hidden_folder(self.folder) as hidden:
            pictures: list[Path] = []

            def copy(path: str) -> str:
                pictures.append(self._copy_picture(Path(path)))
                return pictures[-1].name

            scene = scene.with_pictures(copy)
            data = scene.model_dump(mode="json", exclude_none=True)
            style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "width": 120}
            # The C emitter is ten times faster, with the same output.
            dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
            text = yaml.dump(data, Dumper=dumper, allow_unicode=True, **style)
            text = f"# Recorded in a live session of {printable(self._name)}; `run` repeats it.\n{text}"
            # Besides the keyframes of its probes, a scene has at most 1000 values.
            if len(text.encode()) > MAX_BYTES or count_probe_values(scene) + 1000 > MAX_NODES:
                raise FilesError("this session is too long for a scene file; reset it (r), and record a shorter one")
            (hidden / "session").write_text(text, "utf-8")
            return self._move_to_free_name(hidden / "session", "session", ".yaml", pictures)

    def save_film(self, film: Film, path: Path | None = None) -> Path:
        """Finish and save a film with at least one picture at a path, by default a free name; return the path."""
        with closing(film), writing(path or self.folder):
            if path is None:
                return self._move_to_free_name(film.finish(), "film", ".gif")
            return self._add(film.finish().replace(path))

    def read_download(self, name: str) -> bytes:
        """Read the content of a download; raise a FilesError if a file has gone."""
        paths, packed = self.downloads[name], io.BytesIO()
        with writing(self.folder):
            if len(paths) == 1:
                return paths[0].read_bytes()
            with ZipFile(packed, "w") as archive:
                for path in paths:
                    archive.write(path, path.name)
        return packed.getvalue()

    def _move_to_free_name(self, draft: Path, stem: str, suffix: str, pictures: Sequence[Path] = ()) -> Path:
        return self._add(move_to_free_name(draft, self.folder, stem, suffix), pictures)

    def _add(self, path: Path, pictures: Sequence[Path] = ()) -> Path:
        self.saved.append(path)
        self.downloads[f"{path.stem}.zip" if pictures else path.name] = [path, *dict.fromkeys(pictures)]
        return path

    def _copy_picture(self, image: Path) -> Path:
        """Copy a picture to the folder unless an equal copy is there; return its path."""
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


def count_probe_values(scene: Scene) -> int:
    """Count the values in the keyframes of a scene's probes."""
    return sum(
        4 * len(probe.at) + 3 * len(probe.load) + 5 * len(probe.path or ()) + 3 * len(probe.grip)
        for probe in scene.probes
    )
