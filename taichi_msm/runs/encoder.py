"""Encoding of pictures: in threads of this process, or in a child process in parallel with the simulation.

Taichi holds the GIL while a kernel runs, so threads encode only between kernels. With kernels of 25 ms and PNGs of
512 x 512 pixels (18 ms each), encoding adds 22 ms to a frame in threads, 1 ms in a child process.
"""

from __future__ import annotations

import gc
import math
import os
import pickle
import subprocess
import sys
import time
import zlib
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from taichi_msm.errors import FilesError
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.media import GifWriter, Mp4Writer, Palette, Picture, predict_colours
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.system.process import ignore_signals


class EncodingJob(NamedTuple):
    """Formats, destinations and size of the pictures of a run."""

    folders: tuple[Path, ...]  # destination of each camera
    size: tuple[int, int]  # width and height [px]
    rate: float  # frames per second
    outputs: tuple[str, ...]  # names of outputs; others than png, gif and mp4 are ignored
    background: tuple[int, int, int]  # colour that the palette of the GIF contains exactly
    quality: int  # of the MP4 [%]

    def still_paths(self, number: int) -> list[Path]:
        """Return the paths of a frame's PNGs, one per camera; none if PNGs are not written."""
        return [folder / OUTPUTS["png"].path(number) for folder in self.folders if "png" in self.outputs]


# Number of completely encoded frames, and the processor time [s].
EncodingReport = tuple[int, float]


class PictureWriter:
    """Encoder of pictures in threads of this process. A KeyboardInterrupt does not reach the threads.

    With a queue of 0 frames, `add` returns when its frame is encoded. Any method, at the latest `finish`, raises the
    OSError of a file.
    """

    def __init__(self, job: EncodingJob, max_queued: int = 0) -> None:
        self._job, self._max_queued = job, max_queued
        self._frames = self._added_frames = 0
        self._seconds = 0.0
        self._videos: list[tuple[int, GifWriter | Mp4Writer]] = []  # with the index of the camera
        self._files = ExitStack()
        self._pending: deque[Future[None]] = deque()
        self._still_executor = ThreadPoolExecutor(max(1, min(max_queued * len(job.folders), os.cpu_count() or 1)))
        self._video_executor = ThreadPoolExecutor(1)

    def add(self, pictures: Picture) -> None:
        """Add the pictures of the next frame, shape (cameras, height, width, 3); wait while the queue is full.

        The caller must not change them afterwards.
        """
        paths = self._job.still_paths(self._added_frames)
        if self._added_frames == 0:
            for path in paths:
                path.parent.mkdir()
        self._added_frames += 1
        stills = [self._still_executor.submit(_write_still, *each) for each in zip(pictures, paths, strict=False)]
        self._pending.append(self._video_executor.submit(self._complete_frame, pictures, stills))
        while len(self._pending) > self._max_queued:
            self._pending[0].result()
            self._pending.popleft()

    def finish(self) -> EncodingReport:
        """Wait until all pictures are encoded; after an interruption, `finish` can be called again."""
        for frame in self._pending:
            frame.result()
        self._video_executor.submit(self._close_videos).result()
        # After an interruption of `add`, the last frame may have PNGs, and be missing in the videos.
        self._still_executor.shutdown()
        for number in range(self._frames, self._added_frames):
            for path in self._job.still_paths(number):
                path.unlink(missing_ok=True)
        return self._frames, self._seconds

    def abort(self) -> None:
        """End the threads and close incomplete files."""
        self._still_executor.shutdown()
        self._video_executor.shutdown()
        with suppress(OSError):
            self._files.close()

    def _complete_frame(self, pictures: Picture, stills: Sequence[Future[float]]) -> None:
        """Append a frame to the videos once its PNGs are written, so that every frame of a video has a PNG."""
        self._seconds += sum(still.result() for still in stills)
        start = time.thread_time()
        if self._frames == 0:
            self._open_videos(pictures)
        for camera, video in self._videos:
            video.add(pictures[camera])
        self._seconds += time.thread_time() - start
        self._frames += 1

    def _open_videos(self, pictures: Picture) -> None:
        """Open the videos of all cameras; their first pictures determine the palettes."""
        job = self._job
        for camera, folder in enumerate(job.folders):
            if "gif" in job.outputs:
                file = self._files.enter_context(create_file(folder / OUTPUTS["gif"].path()))
                palette = Palette(predict_colours(pictures[camera]), job.background)
                self._videos.append((camera, GifWriter(file, job.size, job.rate, palette)))
            if "mp4" in job.outputs:
                file = self._files.enter_context(create_file(folder / OUTPUTS["mp4"].path()))
                self._videos.append((camera, Mp4Writer(file, job.size, job.rate, job.quality)))

    def _close_videos(self) -> None:
        start = time.thread_time()
        while self._videos:
            self._videos.pop()[1].close()
        self._seconds += time.thread_time() - start


def _write_still(picture: Picture, path: Path) -> float:
    """Write a PNG; return the processor time [s], which excludes waiting for a core."""
    start = time.thread_time()
    with create_file(path) as file:
        # For 512 x 512 pixels of shaded tissue, Pillow's default takes 93 ms, and level 1 takes 17 ms and 348 kB.
        # Run-length encoding takes 16 ms and 314 kB, because only the background repeats.
        Image.fromarray(picture).save(file, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return time.thread_time() - start


class Encoder:
    """Encoder of pictures in a child process, which inherits descriptors, with the methods of `PictureWriter`.

    Any method, at the latest `finish`, raises the OSError of a file or of a process that has died.
    """

    def __init__(self, job: EncodingJob, inherit: tuple[int, ...] = ()) -> None:
        # With the parent's sys.path, the child imports the same package. Unlike a child of multiprocessing, it does not
        # import the caller's main module, so that scripts need no guard.
        script = f"import sys; sys.path[:] = {sys.path!r}; from taichi_msm.runs.encoder import main; main()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", script],
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
        self._pictures, self._report_pipe = self._process.stdin, self._process.stdout
        self._report_data = b""
        self._report: EncodingReport | None = None
        pickle.dump(job, self._pictures)

    def add(self, pictures: Picture) -> None:
        """Add the pictures of the next frame, shape (cameras, height, width, 3); wait while the queue is full."""
        remaining = np.ascontiguousarray(pictures).reshape(-1).data
        try:
            while remaining:
                remaining = remaining[self._pictures.write(remaining) :]
        except BrokenPipeError:
            self.finish()  # raises the error that ended the process
            raise

    def finish(self) -> EncodingReport:
        """Wait until all pictures are encoded; after an interruption, `finish` can be called again."""
        if self._report is None:
            self._pictures.close()
            while data := self._report_pipe.read(1 << 16):
                self._report_data += data
            exit_code = self._process.wait()
            result = pickle.loads(self._report_data) if self._report_data else None
            if isinstance(result, Exception):
                raise result
            if not isinstance(result, tuple):
                raise ChildProcessError(f"the encoder ended with exit code {exit_code}")
            self._report = result
        return self._report

    def abort(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._pictures.close()
        self._report_pipe.close()
        self._process.wait()


def main() -> None:
    """Run the child process: read a job and its pictures from stdin, write the report to stdout."""
    result: EncodingReport | Exception
    ignore_signals()  # ends when the parent closes its stdin
    try:
        result = _encode_stream()
    except (OSError, FilesError) as error:
        result = error
    except Exception as error:
        # Not all exceptions can be pickled.
        result = RuntimeError(f"in the encoder: {type(error).__name__}: {error}")
    with suppress(BrokenPipeError):  # when the parent was killed
        os.write(sys.stdout.fileno(), pickle.dumps(result))
    gc.freeze()  # A final garbage collection would delay the exit, for which the parent waits.


def _encode_stream() -> EncodingReport:
    """Encode the pictures from stdin until it ends; an incomplete last frame is dropped."""
    job: EncodingJob = pickle.load(sys.stdin.buffer)
    shape = len(job.folders), *reversed(job.size), 3
    size = math.prod(shape)
    # Queue at least one frame, at most 4 pictures and 256 MiB: an interrupted run waits for their encoding.
    writer = PictureWriter(job, max(1, min(4 // len(job.folders), (256 << 20) // size)))
    try:
        while len(data := sys.stdin.buffer.read(size)) == size:
            writer.add(np.frombuffer(data, np.uint8).reshape(shape))
        return writer.finish()
    finally:
        writer.abort()
