"""A session without a window: a script is done, and a film taken of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path

from taichi_msm.live.album import Film
from taichi_msm.live.events import Event
from taichi_msm.live.session import Session


def film(
    session: Session,
    path: Path,
    seconds: float,
    events: Iterable[tuple[int, Event]] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[str]:
    """Let a session go on for some time and film it.

    Args:
        session: the session.
        path: the GIF.
        seconds: how long.
        events: each with the frame of the session before which it happens.
        progress: called with the frames done and the frames in all, often; what it raises stops here.

    Returns:
        What the person should know, in order.

    Raises:
        FilesError: when a file cannot be written.
    """
    happens: dict[int, list[Event]] = defaultdict(list)
    for frame, event in events:
        happens[frame].append(event)
    notices: list[str] = []
    frames = round(seconds * session.rate)
    render = session.scene.render
    with Film(path, render.size, session.rate / session.parts, render.background) as reel:
        for frame in range(frames + 1):
            progress(frame, frames)
            for event in happens[frame]:
                session.handle(event)
            if session.notice and session.notice not in notices[-1:]:
                notices.append(session.notice)
            if frame % session.parts == 0:
                reel.add(session.picture())
            if session.fault:
                break
            if frame < frames:
                session.advance()
    return notices
