"""Picture encoding in a separate process, in parallel with the simulation.

Pillow releases the GIL while it encodes, but Taichi holds it while a kernel runs. With kernel launches of 25 ms, and
PNGs of 512 x 512 pixels that take 18 ms to encode, threads lengthen a frame by 22 ms, a process by 1 ms.
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
from taichi_msm.runs.media import PAUSE_INTERVAL_S, EncodingJob, EncodingReport, Picture, PictureWriter

# With the parent's sys.path, the child imports the same package. Unlike a child of multiprocessing, it does not import
# the caller's main module, so that scripts need no guard.
_CHILD_CODE = "import sys; sys.path[:] = {path!r}; from taichi_msm.runs.encoder import main; main()"


class Encoder:
    """Child process that encodes pictures.

    Args:
        job: formats, destinations and size of the pictures.
        inherit: file descriptors that the child inherits, such as locks.

    Raises:
        OSError: from any method, at the latest from `finish`, when a file cannot be written or the process has died.
    """

    def __init__(self, job: EncodingJob, inherit: tuple[int, ...] = ()) -> None:
        with _sigint_blocked():  # the child unblocks it once its handler is set
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CHILD_CODE.format(path=sys.path)],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=inherit,
                # Ctrl-C must not reach the child, which still finishes the queued pictures.
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        assert self._process.stdin
        assert self._process.stdout
        self._pictures = self._process.stdin
        self._report_pipe = self._process.stdout
        self._report_data = b""
        self._report: EncodingReport | None = None
        pickle.dump(job, self._pictures)
        if os.name != "nt":  # where pipes always block
            os.set_blocking(self._pictures.fileno(), False)

    def add(self, pictures: Picture, pause: Pause = lambda: None) -> None:
        """Add the pictures of the next frame; wait while the queue is full.

        Args:
            pictures: colours, shape (cameras, height, width, 3).
            pause: called several times a second while waiting; if it raises, the frame is discarded.
        """
        remaining = np.ascontiguousarray(pictures).reshape(-1).data
        try:
            while remaining:
                count = self._pictures.write(remaining)
                # Waiting must be interruptible, because the child may be suspended.
                if count is None and not select.select([], [self._pictures], [], PAUSE_INTERVAL_S)[1]:
                    pause()
                remaining = remaining[count or 0 :]
        except BrokenPipeError:
            self.finish()  # raises the error that ended the process
            raise

    def finish(self, pause: Pause = lambda: None, *, discard_queued: bool = False) -> EncodingReport:
        """Wait until all pictures are encoded.

        Args:
            pause: called several times a second while waiting; if it raises, `finish` can be called again.
            discard_queued: whether to discard frames whose encoding has not begun, except for the first one.

        Returns:
            The number of encoded frames and the processor time.
        """
        if self._report is None:
            if discard_queued:
                with suppress(ValueError, OSError, AttributeError):  # unsupported signals, or a dead process
                    self._process.send_signal(signal.SIGINT)
                    self._process.send_signal(signal.SIGCONT)
            with suppress(BrokenPipeError):
                self._pictures.close()
            while data := self._read_report(pause):
                self._report_data += data
            self._report_pipe.close()
            code = self._process.wait()
            result = pickle.loads(self._report_data) if self._report_data else None
            if isinstance(result, Exception):
                raise result
            if not isinstance(result, EncodingReport):
                raise ChildProcessError(f"the encoder ended with exit code {code}")
            self._report = result
        return self._report

    def _read_report(self, pause: Pause) -> bytes:
        """Wait for further bytes of the report; return empty bytes at its end."""
        if os.name != "nt":  # where select does not support pipes
            while not select.select([self._report_pipe], [], [], PAUSE_INTERVAL_S)[0]:
                pause()
        return self._report_pipe.read(1 << 16)

    def abort(self) -> None:
        """Kill the process."""
        self._process.kill()
        with suppress(BrokenPipeError):
            self._pictures.close()
        self._report_pipe.close()
        self._process.wait()


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT in this process and in the children started in the block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def main() -> None:
    """Run the child process: read a job and its pictures from stdin, write the report to stdout."""
    report: EncodingReport | Exception
    discard_queued = Event()
    # A SIGTERM to all processes of a service is ignored here: the parent closes the stream when it ends.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, lambda number, frame: discard_queued.set())
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        report = encode_stream(pickle.load(sys.stdin.buffer), sys.stdin.buffer, discard_queued)
    except (OSError, FilesError) as error:
        report = error
    except Exception as error:
        # Not all exceptions can be pickled.
        report = RuntimeError(f"in the encoder: {type(error).__name__}: {error}")
    with suppress(BrokenPipeError):  # when the parent was killed
        os.write(sys.stdout.fileno(), pickle.dumps(report))
    gc.freeze()  # A final garbage collection would delay the exit, for which the parent waits.


def encode_stream(job: EncodingJob, source: BinaryIO, discard_queued: Event) -> EncodingReport:
    """Encode the pictures of a byte stream until it ends.

    Args:
        job: formats, destinations and size of the pictures.
        source: concatenated frames, each of shape (cameras, height, width, 3), uint8.
        discard_queued: when set, frames whose encoding has not begun are discarded, except for the first one.

    Returns:
        The number of encoded frames and the processor time.
    """
    width, height = job.size
    shape = len(job.folders), height, width, 3
    parent = os.getppid()
    # At most 4 frames and 256 MiB are queued.
    writer = PictureWriter(job, max(1, min(4, (256 << 20) // math.prod(shape))), discard_queued)
    try:
        for pictures in _read_pictures(source, shape):
            writer.add(pictures)
            if discard_queued.is_set():
                break
            _exit_if_orphaned(parent)
        _exit_if_orphaned(parent)
        return writer.finish()
    finally:
        writer.abort()


def _exit_if_orphaned(parent: int) -> None:
    """End this process if its parent was killed, so that the lock on the directory is released."""
    if os.getppid() != parent:
        os._exit(1)


def _read_pictures(source: BinaryIO, shape: tuple[int, ...]) -> Iterator[Picture]:
    """Read frames until the stream ends; drop an incomplete last frame."""
    size = math.prod(shape)
    while True:
        data = source.read(size)
        if len(data) < size:
            return
        yield np.frombuffer(data, np.uint8).reshape(shape)
