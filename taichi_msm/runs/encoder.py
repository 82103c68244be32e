"""Encode pictures as PNG, GIF and MP4 in a separate process, in parallel with the simulation.

Pillow releases Python's GIL while it encodes, but Taichi holds it while a kernel runs. Measured with launches of 25 ms
and PNGs of 512 x 512 pixels, which take 18 ms: encoding in threads lengthens a frame by 22 ms, in a process by 1 ms.
"""

from __future__ import annotations

import gc
import math
import os
import pickle
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event
from typing import BinaryIO

import numpy as np

from taichi_msm.errors import FilesError, Pause
from taichi_msm.runs.media import PATIENCE, Job, Picture, PictureWriter, Report

# The most pictures that wait in memory: by number, and by bytes.
WAITING = 4
WAITING_BYTES = 256 << 20

# The child gets our path, so that it finds this package where we did. It must not run the caller's main module, as
# multiprocessing would: a script that calls us then needs no guard against its own import.
_CHILD = "import sys; sys.path[:] = {path!r}; from taichi_msm.runs.encoder import main; main()"


class Encoder:
    """A process that encodes pictures, and holds the file descriptors that it inherits open while it lives.

    An OSError, in any method and at the latest in `finish`, says that a file cannot be written or the process ended.
    """

    def __init__(self, job: Job, inherit: tuple[int, ...] = ()) -> None:
        with _hurry_held_back():
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CHILD.format(path=sys.path)],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=inherit,
                # Ctrl-C must reach only us: the child still finishes the pictures so far, as it does after a SIGTERM.
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        assert self._process.stdin
        assert self._process.stdout
        self._pictures = self._process.stdin
        self._answer = self._process.stdout
        self._answered = b""
        self._report: Report | None = None
        pickle.dump(job, self._pictures)
        if os.name != "nt":  # where pipes always block
            os.set_blocking(self._pictures.fileno(), False)

    def add(self, pictures: Picture, pause: Pause = lambda: None) -> None:
        """Hand over the pictures of the next frame, shape (cameras, height, width, 3); waits while too many wait.

        `pause` is called some times a second while it waits; if it raises, the picture is given up.
        """
        rest = np.ascontiguousarray(pictures).reshape(-1).data
        try:
            while rest:
                count = self._pictures.write(rest)
                # The process may have been stopped, so the waiting must be interruptible.
                if count is None and not select.select([], [self._pictures], [], PATIENCE)[1]:
                    pause()
                rest = rest[count or 0 :]
        except BrokenPipeError:
            self.finish()  # raises what ended the process
            raise

    def finish(self, pause: Pause = lambda: None, *, hurry: bool = False) -> Report:
        """Wait until all pictures are encoded; in a hurry those that are not being encoded yet are given up.

        `pause` is called some times a second while it waits; if it raises, this can be called again.
        """
        if self._report is None:
            if hurry:
                with suppress(ValueError, OSError, AttributeError):  # a system without them, or an ended process
                    self._process.send_signal(signal.SIGINT)
                    self._process.send_signal(signal.SIGCONT)
            with suppress(BrokenPipeError):
                self._pictures.close()
            while part := self._read_answer(pause):
                self._answered += part
            self._answer.close()
            code = self._process.wait()
            result = pickle.loads(self._answered) if self._answered else None
            if isinstance(result, Exception):
                raise result
            if not isinstance(result, Report):
                raise ChildProcessError(f"the encoder ended with exit code {code}")
            self._report = result
        return self._report

    def _read_answer(self, pause: Pause) -> bytes:
        """Wait for the next part of the answer; an empty part is the last."""
        if os.name != "nt":  # where pipes cannot be waited for
            while not select.select([self._answer], [], [], PATIENCE)[0]:
                pause()
        return self._answer.read(1 << 16)

    def abort(self) -> None:
        """End the process at once."""
        self._process.kill()
        with suppress(BrokenPipeError):
            self._pictures.close()
        self._answer.close()
        self._process.wait()


@contextmanager
def _hurry_held_back() -> Iterator[None]:
    """Block SIGINT while a process is started, so that it stays blocked there until the process is ready for it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def main() -> None:
    """Run as the child process: read a job and its pictures from stdin, report on stdout."""
    answer: Report | Exception
    hurry = Event()
    # A SIGTERM to all processes of a service reaches this one too; it is ignored, as our pictures end when the parent
    # process closes the stream.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, lambda number, frame: hurry.set())
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        answer = encode(pickle.load(sys.stdin.buffer), sys.stdin.buffer, hurry)
    except (OSError, FilesError) as error:
        answer = error
    except Exception as error:
        # Not every exception can be pickled.
        answer = RuntimeError(f"in the encoder: {type(error).__name__}: {error}")
    with suppress(BrokenPipeError):  # when the parent process was killed
        os.write(sys.stdout.fileno(), pickle.dumps(answer))
    gc.freeze()  # The parent waits for the end, which a search for cycles would delay.


def encode(job: Job, source: BinaryIO, hurry: Event) -> Report:
    """Encode the pictures of a stream of bytes until it ends; in a hurry those are given up that are not begun."""
    width, height = job.size
    shape = len(job.folders), height, width, 3
    parent = os.getppid()
    writer = PictureWriter(job, max(1, min(WAITING, WAITING_BYTES // math.prod(shape))), hurry)
    try:
        for pictures in _pictures(source, shape):
            writer.add(pictures)
            if hurry.is_set():
                break
            _leave_orphaned(parent)
        _leave_orphaned(parent)
        return writer.finish()
    finally:
        writer.abort()


def _leave_orphaned(parent: int) -> None:
    """End this process if its parent was killed, so that the directory is free for another run."""
    if os.getppid() != parent:
        os._exit(1)


def _pictures(source: BinaryIO, shape: tuple[int, ...]) -> Iterator[Picture]:
    """Read the pictures of frames until the stream ends; an incomplete frame, of an interrupted run, is dropped."""
    size = math.prod(shape)
    while True:
        data = source.read(size)
        if len(data) < size:
            return
        yield np.frombuffer(data, np.uint8).reshape(shape)
