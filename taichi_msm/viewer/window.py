"""The window: it turns the pointer and the keys into events, and shows pictures, and does nothing else."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any

import numpy as np

from taichi_msm.errors import FilesError
from taichi_msm.progress import Pause
from taichi_msm.results.gif import Picture
from taichi_msm.system.runtime import open_window, ti
from taichi_msm.viewer import hud
from taichi_msm.viewer.events import NOTCH, Drag, Event, Harder, Key, Point, Press, Release, Turn
from taichi_msm.viewer.pacing import Pacing
from taichi_msm.viewer.session import Session

# Our names for the window's names of keys.
NAMES = {" ": "space", "Escape": "q"}
NAMES |= dict.fromkeys(("Up", "=", "+", "KP_Add"), "up") | dict.fromkeys(("Down", "-", "KP_Subtract"), "down")

# These keys repeat while they are held down; for all others, the keyboard's repetition is ignored.
REPEATED = ("up", "down")

QUIT = Key("q")


class Window:
    """A window with a picture. Usable in a with statement, which closes it.

    Args:
        title: of the window.
        size: width, height of the picture [px].

    Raises:
        DeviceError: when there is no display.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        self._gui = open_window(title, size)
        # The memory that the window shows: rows from the top; blue, green, red, an unused byte; on a Mac red is first.
        self._shown = self._gui.img.view(np.uint8).reshape(size[1], size[0], 4)
        self._shown[..., 3] = 255
        self._places = (0, 1, 2) if sys.platform == "darwin" else (2, 1, 0)
        self._hand = Hand(size)

    def show(self, picture: Picture) -> None:
        """Show a picture, shape (height, width, 3)."""
        # One colour at a time takes an eighth of the time of all at once.
        for channel, place in enumerate(self._places):
            self._shown[..., place] = picture[..., channel]
        self._gui.show()

    def say(self, text: str) -> None:
        """Write a text over the picture that is shown."""
        picture = self._shown[..., self._places]
        hud.announce(picture, text)
        self.show(picture)

    def events(self) -> Iterator[Event]:
        """Give the events since the last call."""
        # A window collects its events when it is shown.
        self._gui.show()
        yield from self._hand.events(self._gui.get_events())

    def __enter__(self) -> Window:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._gui.close()


class Hand:
    """Turns a window's reports of the pointer and the keyboard into events.

    Args:
        size: width, height of the picture [px].
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._pressing = False
        self._turning: tuple[float, float] | None = None

    def events(self, told: Iterable[Any]) -> Iterator[Event]:
        """Turn the reports of one moment, events of `ti.GUI`, into our events."""
        before = None
        for event in told:
            # For a key that is held down, a release and a press are reported at the same time, again and again.
            repeated = before is not None and before.type == ti.GUI.RELEASE and before.key == event.key
            before = event
            for understood in self._understood(event):
                if not (repeated and isinstance(understood, Key) and understood.name not in REPEATED):
                    yield understood

    def _understood(self, event: Any) -> Iterator[Event]:
        width, height = self._size
        x, y = event.pos[0] * width, height - 1 - event.pos[1] * height
        pressed = event.type == ti.GUI.PRESS
        if event.key == ti.GUI.EXIT:
            yield QUIT
        elif event.key == ti.GUI.LMB:
            self._pressing = pressed
            yield Press(x, y, "Shift" in event.modifier) if pressed else Release()
        elif event.key == ti.GUI.RMB:
            self._turning = (x, y) if pressed else None
        elif event.key == ti.GUI.WHEEL:
            yield Harder(NOTCH if event.delta[1] > 0 else -NOTCH)
        elif event.key == ti.GUI.MOVE:
            if self._pressing:
                yield Drag(x, y)
            elif self._turning is None:
                yield Point(x, y)
            if self._turning is not None:
                yield Turn(x - self._turning[0], y - self._turning[1])
                self._turning = (x, y)
        elif pressed:
            yield Key(NAMES.get(event.key, event.key))


def show(session: Session, window: Window, pause: Pause) -> None:
    """Show a session until the person quits.

    Args:
        session: the session.
        window: the window.
        pause: called before every picture; what it raises ends the session.
    """
    pacing = Pacing(session.rate, time.perf_counter)
    session.say("h: the keys")
    while True:
        pause()
        time.sleep(pacing.wait())
        for event in window.events():
            if event == QUIT:
                return
            try:
                session.handle(event)
            except FilesError as error:
                # The session goes on, so that a full disk does not lose what was done so far.
                session.say(str(error))
        for _ in pacing.due():
            session.advance()
        if not session.viewport.compiled:
            window.say("one moment: compiling")
        window.show(session.picture(pacing.said()))
