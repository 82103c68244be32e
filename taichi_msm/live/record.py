"""A session without a window: a script is done, and a film taken of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path

from taichi_msm.errors import FilesError, writing
from taichi_msm.live.events import Event
from taichi_msm.live.film import Film
from taichi_msm.live.session import Session

OPTION = "--record"


def record(
    session: Session,
    path: Path,
    seconds: float,
    events: Iterable[tuple[int, Event]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda notice: None,
) -> None:
    """Let a session go on for some time and film it.

    Args:
        session: the session.
        path: the GIF; one that is there is replaced when the film is whole.
        seconds: how long.
        events: each with the frame of the session before which it happens.
        progress: called with the frames done and the frames in all, often; what it raises stops here.
        say: called with what the person should know.

    Raises:
        FilesError: when the film cannot be written, or, when it is, what an event was to keep could not.
    """
    if path.is_dir():
        raise FilesError(f"{path}: a directory; choose another {OPTION}")
    frames = round(seconds * session.rate)
    happens: dict[int, list[Event]] = defaultdict(list)
    late = 0
    for frame, event in events:
        if frame <= frames:
            happens[frame].append(event)
        else:
            late += 1
    if late:
        say(f"the film ends at {seconds:g} s, before {late} of the script's events")
    failures: list[FilesError] = []
    notice = ""
    render = session.scene.render
    with Film(path.parent, render.size, session.rate / session.parts, render.background, OPTION) as reel:
        for frame in range(frames + 1):
            progress(frame, frames)
            for event in happens[frame]:
                try:
                    session.handle(event)
                except FilesError as error:
                    failures.append(error)
                if session.notice not in ("", notice):
                    say(f"{frame / session.rate:g} s: {session.notice}")
                notice = session.notice
            if frame % session.parts == 0:
                reel.add(session.picture())
            if frame < frames:
                session.advance()
            if session.fault:
                undone = sum(len(happens[later]) for later in range(frame + 1, frames + 1))
                say(session.fault + (f"; {undone} of the script's events come after that" if undone else ""))
                break
        with writing(path, OPTION):
            reel.encoded().replace(path)
    if failures:
        raise failures[0]
