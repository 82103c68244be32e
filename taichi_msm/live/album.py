"""What a session keeps: pictures, films and scenes, each whole or not at all, and none in the place of another."""

from __future__ import annotations

import filecmp
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import yaml
from PIL import Image

from taichi_msm.encoding import Encoder, Job
from taichi_msm.errors import FilesError, SceneError, writing
from taichi_msm.gif import Picture
from taichi_msm.publication import ANIMATION
from taichi_msm.scene import Scene
from taichi_msm.scene_file import load_scene


class Film:
    """A GIF, encoded in a process of its own. Left with an exception, or without a picture, it leaves no file.

    Args:
        path: the file; one that is there is replaced at the end.
        size: width, height of the pictures [px].
        rate: pictures per second.
        background: a colour that is kept exactly.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate: float, background: tuple[int, int, int]) -> None:
        self.path = path
        self.pictures = 0
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=".film-", dir=path.parent))
            try:
                self._encoder = Encoder(Job(self._folder, size, rate, png=False, gif=True, background=background))
            except OSError:
                shutil.rmtree(self._folder, ignore_errors=True)
                raise

    def add(self, picture: Picture) -> None:
        """Add the next picture, shape (height, width, 3)."""
        with writing(self.path):
            self._encoder.add(picture)
        self.pictures += 1

    def finish(self) -> None:
        """Put the film in its place."""
        try:
            with writing(self.path):
                self._encoder.finish()
                if self.pictures:
                    (self._folder / ANIMATION).replace(self.path)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def abort(self) -> None:
        """Give it up."""
        self._encoder.abort()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abort()


class Album:
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
        with self._new("picture", ".png") as (path, draft):
            Image.fromarray(picture).save(draft, "PNG")
        return self._note(path)

    def keep_scene(self, scene: Scene) -> Path:
        """Save a scene, and beside it a copy of its picture, which a scene file needs near itself; returns its file."""
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            image = None if scene.image is None else self._copied(Path(scene.image))
        scene = scene.model_copy(update={"image": image and str(image)})
        data = scene.model_dump(mode="json", exclude_none=True) | ({"image": image.name} if image else {})
        text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
        with self._new("session", ".yaml") as (path, draft):
            draft.write_text(f"# What was done in a live session of {self._name}; run repeats it.\n{text}", "utf-8")
            try:
                same = load_scene(draft) == scene
            except SceneError as error:
                raise FilesError(f"{path}: this session is no scene that run takes: {error.lines[0]}") from None
            assert same, "the file says what the session is"
        return self._note(path)

    def film(self, size: tuple[int, int], rate: float, background: tuple[int, int, int]) -> Film:
        """Begin a film."""
        return Film(self._free("film", ".gif"), size, rate, background)

    def keep_film(self, film: Film) -> Path:
        """End a film; returns its file."""
        film.finish()
        return self._note(film.path)

    def _note(self, path: Path) -> Path:
        self.kept.append(path)
        return path

    def _free(self, stem: str, suffix: str) -> Path:
        """Find the next name that no file has."""
        number = 1
        while (path := self.folder / f"{stem}-{number}{suffix}").exists():
            number += 1
        return path

    @contextmanager
    def _new(self, stem: str, suffix: str) -> Iterator[tuple[Path, Path]]:
        """Make a new file: its name, and where it is written before it has it."""
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self._free(stem, suffix)
            draft = path.with_name(f".{os.getpid()}-{path.name}")
            try:
                yield path, draft
                draft.replace(path)
            finally:
                draft.unlink(missing_ok=True)

    def _copied(self, image: Path) -> Path:
        """Have a copy of a picture in the folder, under its own name if that is free."""
        copy, number = self.folder / image.name, 1
        while copy.exists() and not filecmp.cmp(image, copy, shallow=False):
            number += 1
            copy = self.folder / f"{image.stem}-{number}{image.suffix}"
        if not copy.exists():
            draft = copy.with_name(f".{os.getpid()}-{copy.name}")
            try:
                shutil.copyfile(image, draft)
                draft.replace(copy)
            finally:
                draft.unlink(missing_ok=True)
        return copy
