"""Window of a session: conversion of pointer and keyboard input to events, and display in real time."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator

import numpy as np

from taichi_msm.errors import DeviceError, FilesError, Pause
from taichi_msm.runs.media import Picture
from taichi_msm.system.process import discarded_output
from taichi_msm.view import overlay
from taichi_msm.view.events import (
    COMPILING,
    KEYS,
    QUIT,
    STRENGTH_STEP,
    SWITCH_TOOL,
    Drag,
    Event,
    Hover,
    Key,
    Press,
    Release,
    StrengthChange,
    Turn,
)
from taichi_msm.view.pacing import Pacing
from taichi_msm.view.session import Session

# Without a greeting on stdout, and without disabling the effects of the desktop.
ENVIRONMENT = {"PYGAME_HIDE_SUPPORT_PROMPT": "1", "SDL_VIDEO_X11_NET_WM_BYPASS_COMPOSITOR": "0"}
if sys.platform not in ("win32", "darwin"):
    # Otherwise SDL falls back to its invisible dummy driver if there is no display.
    ENVIRONMENT["SDL_VIDEODRIVER"] = "x11,wayland"
for _name, _value in ENVIRONMENT.items():
    os.environ.setdefault(_name, _value)

import pygame  # noqa: E402

# Names of keys by text, and by key code.
TEXT_KEYS = {" ": "space", "=": "up", "+": "up", "-": "down", "\x1b": "q"}
ARROW_KEYS = {pygame.K_UP: "up", pygame.K_DOWN: "down"}
SHIFT_KEYS = {pygame.K_LSHIFT, pygame.K_RSHIFT}


class Window:
    """A window that shows pictures, scaled to its size; a context manager.

    A process may have only one at a time, as it receives all events of the process.

    Args:
        title: in the title bar.
        size: width and height of the pictures [px].

    Raises:
        DeviceError: when there is no display.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._size = size
        self._reader = InputReader(size)
        self._picture: Picture = np.zeros((size[1], size[0], 3), np.uint8)
        try:
            with discarded_output(2):
                pygame.display.init()
                if pygame.display.get_driver() == "x11":
                    # OpenGL is slower, several times without a GPU.
                    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
                screen = pygame.display.get_desktop_sizes()[0]
                self._window = pygame.Window(title, initial_window_size(size, screen), resizable=True)
                self._window.get_surface()
        except pygame.error as error:
            raise DeviceError(
                f"no window can be opened (SDL: {error}); set DISPLAY (or WAYLAND_DISPLAY), or film without one: "
                "--record FILE.gif --seconds N"
            ) from None
        pygame.display.set_allow_screensaver(True)
        pygame.key.set_repeat(400, 40)  # delay and interval [ms]

    def show(self, picture: Picture) -> None:
        """Show a picture, shape (height, width, 3)."""
        self._picture = picture
        # A resized window has a new surface.
        surface = self._window.get_surface()
        area = fit_picture(self._size, surface.get_size())
        image = pygame.image.frombuffer(picture.data, self._size, "RGB")
        if surface.get_size() == self._size:
            surface.blit(image, area)
        else:
            surface.fill("black")
            surface.blit(pygame.transform.smoothscale(image, area.size), area)
        self._window.flip()

    def announce(self, text: str) -> None:
        """Write text over the current picture."""
        # Some systems show a new window only after its events were queried.
        pygame.event.pump()
        picture = self._picture.copy()
        overlay.announce(picture, text)
        self.show(picture)

    def events(self) -> Iterator[Event]:
        """Return the events since the last call."""
        yield from self._reader.events(
            pygame.event.get(), fit_picture(self._size, self._window.get_surface().get_size())
        )

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self._window.destroy()


def initial_window_size(picture: tuple[int, int], screen: tuple[int, int]) -> tuple[int, int]:
    """Choose the size of a new window.

    It is the largest integer multiple of the picture's size that fits into half of the screen in both directions,
    otherwise the picture's size, reduced to fit the screen.

    Args:
        picture: width and height of the pictures [px].
        screen: width and height of the screen [px].

    Returns:
        Width and height of the window [px].
    """
    multiple = max(1, min(screen[0] // (2 * picture[0]), screen[1] // (2 * picture[1])))
    return fit_picture(picture, (min(multiple * picture[0], screen[0]), min(multiple * picture[1], screen[1]))).size


def fit_picture(picture: tuple[int, int], window: tuple[int, int]) -> pygame.Rect:
    """Fit a picture into the centre of a window.

    Args:
        picture: width and height of the picture [px].
        window: width and height of the window [px].

    Returns:
        The rectangle of the scaled picture [px].
    """
    scale = min(window[0] / picture[0], window[1] / picture[1])
    width, height = (max(1, round(scale * side)) for side in picture)
    return pygame.Rect((window[0] - width) // 2, (window[1] - height) // 2, width, height)


class InputReader:
    """Converter of pygame events to events of a session.

    Args:
        size: width and height of the pictures [px].
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._pressing = False
        self._turning: tuple[float, float] | None = None
        self._down: set[int] = set()

    def events(self, inputs: Iterable[pygame.Event], area: pygame.Rect) -> Iterator[Event]:
        """Convert events.

        Args:
            inputs: pygame events, in order.
            area: rectangle of the picture in the window [px].
        """
        for event in inputs:
            if event.type == pygame.QUIT:
                yield QUIT
            elif event.type == pygame.KEYDOWN:
                # Only keys of the strength repeat while they are held down.
                if (name := key_name(event)) and (event.key not in self._down or name in ("up", "down")):
                    yield Key(name)
                self._down.add(event.key)
            elif event.type == pygame.KEYUP:
                self._down.discard(event.key)
            elif event.type == pygame.MOUSEWHEEL:
                if event.y != 0:
                    yield StrengthChange(STRENGTH_STEP * event.y)
            elif event.type in (pygame.MOUSEBUTTONDOWN, pygame.MOUSEBUTTONUP):
                yield from self._button(event, *self._pixel(event.pos, area))
            elif event.type == pygame.MOUSEMOTION:
                yield from self._motion(*self._pixel(event.pos, area))
            elif event.type == pygame.WINDOWFOCUSLOST:
                # The window that took the focus may receive the release.
                yield from self._release()
                self._turning = None

    def _pixel(self, position: tuple[int, int], area: pygame.Rect) -> tuple[float, float]:
        """Convert a position in the window to one in the picture [px]; integers are pixel centres."""
        x, y = (
            (at + 0.5 - begin) * pixels / extent - 0.5
            for at, begin, pixels, extent in zip(position, area.topleft, self._size, area.size, strict=True)
        )
        return x, y

    def _button(self, event: pygame.Event, x: float, y: float) -> Iterator[Event]:
        pressed = event.type == pygame.MOUSEBUTTONDOWN
        if event.button == pygame.BUTTON_LEFT and pressed:
            self._pressing = True
            yield Press(x, y, not SHIFT_KEYS.isdisjoint(self._down))
        elif event.button == pygame.BUTTON_LEFT:
            yield from self._release()
        elif event.button == pygame.BUTTON_RIGHT:
            self._turning = (x, y) if pressed else None

    def _motion(self, x: float, y: float) -> Iterator[Event]:
        if self._pressing:
            yield Drag(x, y)
        elif self._turning is None:
            yield Hover(x, y)
        if self._turning is not None:
            yield Turn(x - self._turning[0], y - self._turning[1])
            self._turning = (x, y)

    def _release(self) -> Iterator[Event]:
        if self._pressing:
            self._pressing = False
            yield Release()


def key_name(event: pygame.Event) -> str | None:
    """Return the name of the pressed key in `KEYS`, or None.

    A key is identified by its text, or by its position on layouts without Latin letters.
    """
    typed = event.unicode.lower()
    if not typed.isascii():
        typed = chr(ord("a") + event.scancode - pygame.KSCAN_A)
    name = ARROW_KEYS.get(event.key) or TEXT_KEYS.get(typed, typed)
    return name if name in KEYS else None


def run_session(session: Session, window: Window, pause: Pause) -> None:
    """Run a session in a window until the user quits.

    Args:
        session: a new session.
        window: the window.
        pause: called before every picture; an exception from it ends the session.
    """
    pacing = Pacing(session.frame_rate, time.perf_counter)
    session.show_notice("h: the keys")
    while True:
        pause()
        time.sleep(pacing.delay_s())
        for event in window.events():
            if event == QUIT:
                return
            if event == SWITCH_TOOL:
                window.announce(COMPILING)
            try:
                session.handle(event)
            except FilesError as error:
                # A full disk must not end the session.
                session.show_notice(str(error))
        for _ in pacing.due_frames():
            session.advance()
        if not session.viewport.is_compiled:
            window.announce(COMPILING)
        window.show(session.picture(pacing.status()))
