"""A session without a window: the events of a script happen, and the session is filmed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

from taichi_msm.errors import FilesError, writing
from taichi_msm.viewer.captures import Film
from taichi_msm.viewer.events import Event
from taichi_msm.viewer.session import Session

OPTION = "--record"


def record(
    session: Session,
    path: Path,
    seconds: float,
    events: Iterable[tuple[int, Event]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda notice: None,
) -> None:
    """Run a session for some time and film it.

    Args:
        session: the session.
        path: the GIF; an earlier one is replaced when the film is whole.
        seconds: how long.
        events: each with the frame of the session before which it happens, in order; read one at a time.
        progress: called often, with the frames done and the frames in all; what it raises stops the session there.
        say: called with what the person should know.

    Raises:
        FilesError: when the film cannot be written; or, after it was written, when a file that an event was to save
            could not be.
    """
    if path.is_dir():
        raise FilesError(f"{path}: a directory; choose another {OPTION}")
    frames = round(seconds * session.rate)
    events = iter(events)
    upcoming = next(events, None)
    failures: list[FilesError] = []
    notice = ""
    rate, parts = session.rate / session.parts, session.parts
    with closing(Film(path.parent, session.scene.render, rate, parts, option=OPTION)) as film:
        for frame in range(frames + 1):
            progress(frame, frames)
            while upcoming is not None and upcoming[0] <= frame:
                try:
                    session.handle(upcoming[1])
                except FilesError as error:
                    failures.append(error)
                if session.notice not in ("", notice):
                    say(f"{frame / session.rate:g} s: {session.notice}")
                notice = session.notice
                upcoming = next(events, None)
            if frame % parts == 0:
                film.show(session.picture(), frame, partial(progress, frame, frames))
            if frame < frames:
                session.advance()
            if session.fault:
                say(session.fault)
                break
        if upcoming is not None:
            say(f"the film ends at {frame / session.rate:g} s, before some of the script's events")
        with writing(path, OPTION):
            film.encoded(partial(progress, frames, frames)).replace(path)
    if failures:
        raise failures[0]
