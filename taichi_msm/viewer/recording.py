"""The film of a session, which a key starts and stops."""

from __future__ import annotations

from taichi_msm.errors import FilesError
from taichi_msm.outputs.gif import Picture
from taichi_msm.scene import Scene
from taichi_msm.viewer.captures import Captures
from taichi_msm.viewer.film import Film


class Recording:
    """A film that is on or off; its methods return what the person should be told.

    Args:
        captures: where films are kept.
        scene: whose pictures are filmed.
        rate: frames per second of the film.
        parts: frames of the session per frame of the film.
    """

    def __init__(self, captures: Captures, scene: Scene, rate: float, parts: int) -> None:
        self._captures = captures
        self._render = scene.render
        self._rate = rate
        self._parts = parts
        self._film: Film | None = None
        self._from = 0

    @property
    def on(self) -> bool:
        """Whether a film is on."""
        return self._film is not None

    def start(self, beat: int) -> None:
        """Begin a film at a frame of the session."""
        self._film = self._captures.film(self._render.size, self._rate, self._render.background)
        self._from = beat

    def expose(self, picture: Picture, beat: int) -> str:
        """Film a picture; if pictures come too slowly for the film, each fills several of its frames."""
        film = self._film
        if film is None:
            return ""
        try:
            while film.pictures * self._parts <= beat - self._from:
                film.add(picture)
        except FilesError as error:
            self._film = None
            with film:
                return str(error)
        return ""

    def end(self) -> str:
        """End the film that is on, and save it if it has a picture."""
        film, self._film = self._film, None
        if film is None:
            return ""
        if film.pictures > 0:
            return f"saved {self._captures.keep_film(film)}"
        with film:
            return "the film had no picture yet"
