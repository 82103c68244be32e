"""The window: it turns the pointer and the keys into events, and shows pictures in real time."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from taichi_msm.errors import DeviceError, FilesError, Pause
from taichi_msm.runs.media import Picture
from taichi_msm.system.process import discarded_output
from taichi_msm.view import overlay
from taichi_msm.view.events import KEYS, NOTCH, Drag, Event, Harder, Hover, Key, Press, Release, Turn
from taichi_msm.view.session import Session

# No greeting on stdout, and the desktop's effects stay on.
ENVIRONMENT = {"PYGAME_HIDE_SUPPORT_PROMPT": "1", "SDL_VIDEO_X11_NET_WM_BYPASS_COMPOSITOR": "0"}
if sys.platform not in ("win32", "darwin"):
    # Without this SDL draws into memory that nobody sees where there is no display.
    ENVIRONMENT["SDL_VIDEODRIVER"] = "x11,wayland"
for _name, _value in ENVIRONMENT.items():
    os.environ.setdefault(_name, _value)

import pygame  # noqa: E402

# Our names for keys: by what they type, and by their codes in pygame.
TYPED = {" ": "space", "=": "up", "+": "up", "-": "down", "\x1b": "q"}
ARROWS = {pygame.K_UP: "up", pygame.K_DOWN: "down"}
SHIFT = {pygame.K_LSHIFT, pygame.K_RSHIFT}

# These keys repeat while they are held down: after this time, and at this interval [ms].
REPEATED = ("up", "down")
REPETITION = 400, 40

LEFT, RIGHT = 1, 3

QUIT = Key("q")

# This key compiles another kernel.
SWITCH = Key("f")
COMPILING = "one moment: compiling"

# A delay beyond this is not made up for; and no picture waits longer than this for its frames [s].
LONGEST = 0.1

# The speed is averaged over this time [s].
OBSERVED = 1.0

# Below this share of real time the speed is reported as too slow.
SLOW = 0.95


class Window:
    """A window with a picture of a width and height [px], as large as fits. A with statement closes it.

    There may be one at a time: it takes all events of the process. Raises a DeviceError when there is no display.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._size = size
        self._hand = Hand(size)
        self._shown: Picture = np.zeros((size[1], size[0], 3), np.uint8)
        try:
            with discarded_output(2):
                pygame.display.init()
                if pygame.display.get_driver() == "x11":
                    # By way of OpenGL a picture takes longer, without a GPU several times as long.
                    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
                screen = pygame.display.get_desktop_sizes()[0]
                self._window = pygame.Window(title, opening(size, screen), resizable=True)
                self._window.get_surface()
        except pygame.error as error:
            raise DeviceError(
                f"no window can be opened (SDL: {error}); set DISPLAY (or WAYLAND_DISPLAY), or film without one: "
                "--record FILE.gif --seconds N"
            ) from None
        pygame.display.set_allow_screensaver(True)
        pygame.key.set_repeat(*REPETITION)

    def show(self, picture: Picture) -> None:
        """Show a picture, shape (height, width, 3)."""
        self._shown = picture
        # After the window was resized, its surface is another.
        surface = self._window.get_surface()
        area = placed(self._size, surface.get_size())
        drawn = pygame.image.frombuffer(picture.data, self._size, "RGB")
        if surface.get_size() == self._size:
            surface.blit(drawn, area)
        else:
            surface.fill("black")
            surface.blit(pygame.transform.smoothscale(drawn, area.size), area)
        self._window.flip()

    def say(self, text: str) -> None:
        """Write a text over the picture that is shown."""
        # Some systems show a new window only when it asks for its events.
        pygame.event.pump()
        picture = self._shown.copy()
        overlay.announce(picture, text)
        self.show(picture)

    def events(self) -> Iterator[Event]:
        """Give the events since the last call."""
        yield from self._hand.events(pygame.event.get(), placed(self._size, self._window.get_surface().get_size()))

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self._window.destroy()


def opening(picture: tuple[int, int], screen: tuple[int, int]) -> tuple[int, int]:
    """Choose the size of a new window; all sizes are width, height [px].

    It is the largest whole multiple of the picture's in half of the screen each way, or the picture's own if that fits.
    """
    times = max(1, min(screen[0] // (2 * picture[0]), screen[1] // (2 * picture[1])))
    return placed(picture, (min(times * picture[0], screen[0]), min(times * picture[1], screen[1]))).size


def placed(picture: tuple[int, int], window: tuple[int, int]) -> pygame.Rect:
    """Place a picture in the middle of a window, as large as fits; both sizes are width, height [px]."""
    scale = min(window[0] / picture[0], window[1] / picture[1])
    width, height = (max(1, round(scale * side)) for side in picture)
    return pygame.Rect((window[0] - width) // 2, (window[1] - height) // 2, width, height)


class Hand:
    """Turns a window's reports of the pointer and the keyboard into events; `size`: of the picture [px]."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._pressing = False
        self._turning: tuple[float, float] | None = None
        self._down: set[int] = set()

    def events(self, reports: Iterable[pygame.Event], area: pygame.Rect) -> Iterator[Event]:
        """Turn pygame's events, in their order, into ours; `area`: where the picture is in the window."""
        for event in reports:
            if event.type == pygame.QUIT:
                yield QUIT
            elif event.type == pygame.KEYDOWN:
                # A key that is held down is reported again and again.
                if (name := key_name(event)) and (event.key not in self._down or name in REPEATED):
                    yield Key(name)
                self._down.add(event.key)
            elif event.type == pygame.KEYUP:
                self._down.discard(event.key)
            elif event.type == pygame.MOUSEWHEEL:
                if event.y != 0:
                    yield Harder(NOTCH * event.y)
            elif event.type in (pygame.MOUSEBUTTONDOWN, pygame.MOUSEBUTTONUP):
                yield from self._button(event, *self._pixel(event.pos, area))
            elif event.type == pygame.MOUSEMOTION:
                yield from self._motion(*self._pixel(event.pos, area))
            elif event.type == pygame.WINDOWFOCUSLOST:
                # Whatever took the focus may get the release.
                yield from self._release()
                self._turning = None

    def _pixel(self, position: tuple[int, int], area: pygame.Rect) -> tuple[float, float]:
        """Find the picture's pixel that is shown at a position in the window; whole numbers are pixels' centres."""
        x, y = (
            (at + 0.5 - begin) * pixels / extent - 0.5
            for at, begin, pixels, extent in zip(position, area.topleft, self._size, area.size, strict=True)
        )
        return x, y

    def _button(self, event: pygame.Event, x: float, y: float) -> Iterator[Event]:
        pressed = event.type == pygame.MOUSEBUTTONDOWN
        if event.button == LEFT and pressed:
            self._pressing = True
            yield Press(x, y, not SHIFT.isdisjoint(self._down))
        elif event.button == LEFT:
            yield from self._release()
        elif event.button == RIGHT:
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
    """Name the key that was pressed, as in `KEYS`; None if it is none of them.

    A key is what it types, on every layout; where that is no Latin letter, it is the letter of a US keyboard there.
    """
    typed = event.unicode.lower()
    if not typed.isascii():
        typed = chr(ord("a") + event.scancode - pygame.KSCAN_A)
    name = ARROWS.get(event.key) or TYPED.get(typed, typed)
    return name if name in KEYS else None


class Pacing:
    """Decides how many frames to simulate before the next picture, so that simulated time keeps up with real time."""

    def __init__(self, rate: float, clock: Callable[[], float]) -> None:
        self._rate = rate
        self._clock = clock
        self._next = clock()
        # For each of the last pictures, when it began and how many frames were simulated for it.
        self._pictures: deque[tuple[float, int]] = deque()

    def wait(self) -> float:
        """Tell how long it is until the next frame is due [s]."""
        return max(0.0, self._next - self._clock())

    def due(self) -> Iterator[int]:
        """Count the frames that are due; ends when no more are due, or when the picture must not wait any longer."""
        begun = self._clock()
        self._next = max(self._next, begun - LONGEST)
        count = 0
        while self._next <= self._clock() and (count == 0 or self._clock() < begun + LONGEST):
            self._next += 1 / self._rate
            yield count
            count += 1
        self._pictures.append((begun, count))
        while begun - self._pictures[0][0] > OBSERVED:
            self._pictures.popleft()

    def said(self) -> str:
        """Say how many pictures are shown per second, and, if simulated time is too slow, how fast it goes."""
        if len(self._pictures) < 2:
            return ""
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        shown = f"{(len(self._pictures) - 1) / seconds:.0f} pictures/s"
        # The last picture is not counted, as its time is not over.
        speed = sum(count for _, count in list(self._pictures)[:-1]) / self._rate / seconds
        return shown if speed >= SLOW else f"{shown}  ·  too slow: {speed:.2f} x real time"


def show(session: Session, window: Window, pause: Pause) -> None:
    """Show a session in a window until the person quits; `pause` is called before every picture."""
    pacing = Pacing(session.rate, time.perf_counter)
    session.say("h: the keys")
    while True:
        pause()
        time.sleep(pacing.wait())
        for event in window.events():
            if event == QUIT:
                return
            if event == SWITCH:
                window.say(COMPILING)
            try:
                session.handle(event)
            except FilesError as error:
                # The session goes on, so that a full disk does not lose what was done so far.
                session.say(str(error))
        for _ in pacing.due():
            session.advance()
        if not session.viewport.compiled:
            window.say(COMPILING)
        window.show(session.picture(pacing.said()))
