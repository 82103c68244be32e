"""Processes of this machine that take calls, one at a time each, as an executor of `concurrent.futures`.

Those of the standard library import the caller's main module again, and all fail when one of them is killed. Here a
call whose process is killed raises `DiedError`, and the next call starts another process.
"""

from __future__ import annotations

import gc
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import Any

from taichi_msm.errors import MsmError

# How often a process looks whether its parent is there [s].
ORPHANED = 0.2

_CHILD = "import sys; sys.path[:] = {path!r}; from taichi_msm.sweeps.pool import serve; serve()"


class DiedError(MsmError):
    """The process of a call ended before it returned."""


class Pool(Executor):
    """So many processes, each started when it is first needed; what they are given and return must be picklable."""

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self._idle: SimpleQueue[_Process | None] = SimpleQueue()
        self._live: set[_Process] = set()
        self._closed = False
        for _ in range(workers):
            self._idle.put(None)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Call a function, which must be importable, in a process that is free."""
        return self._threads.submit(self._call, (function, arguments, named))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes: after all calls, or at once if those that wait are cancelled."""
        self._threads.shutdown(wait=False, cancel_futures=cancel_futures)
        if cancel_futures:
            self._closed = True
            for process in list(self._live):
                process.kill()
        self._threads.shutdown(wait)
        for process in list(self._live):
            process.close()

    def _call(self, call: tuple[Any, ...]) -> Any:
        process = self._idle.get()
        try:
            if process is None:
                if self._closed:
                    raise DiedError("the pool was shut down")
                process = _Process()
                self._live.add(process)
            success, value = process.call(call)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            code = process.close() if process else None
            self._live.discard(process)
            process = None
            raise DiedError(_in_words(code)) from error
        finally:
            self._idle.put(process)
        if not success:
            raise value
        return value


class _Process:
    """A process that takes calls."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CHILD.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # Ctrl-C must reach only us.
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )

    def call(self, call: tuple[Any, ...]) -> Any:
        """Give the answer to a call: whether it succeeded, and its value or what it raised."""
        assert self._process.stdin
        assert self._process.stdout
        pickle.dump(call, self._process.stdin)
        self._process.stdin.flush()
        return pickle.load(self._process.stdout)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def close(self) -> int:
        """End it when it has returned; gives its exit code."""
        assert self._process.stdin
        assert self._process.stdout
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        code = self._process.wait()
        self._process.stdout.close()
        return code


def _in_words(code: int | None) -> str:
    """Say how a process ended."""
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        hint = ", as the system does when memory runs out; take fewer --workers" if -code == signal.SIGKILL else ""
        return f"its process was ended by {name}{hint}"
    return f"its process ended with exit code {code}"


def serve() -> None:
    """Run as a process of the pool, until the other end closes the pipe or is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_leave_orphaned, args=[os.getppid()], daemon=True).start()
    answers = os.fdopen(os.dup(1), "wb")
    # Whatever is printed must not get among the answers.
    os.dup2(2, 1)
    while True:
        try:
            function, arguments, named = pickle.load(sys.stdin.buffer)
        except EOFError:
            break
        try:
            answer = True, function(*arguments, **named)
        except Exception as error:
            answer = False, error
        answers.write(pickle.dumps(answer))
        answers.flush()
    if runtime := sys.modules.get("taichi_msm.system.runtime"):
        runtime.stop()  # which writes the cache of kernels
    gc.freeze()  # The search for cycles at the end would take time.


def _leave_orphaned(parent: int) -> None:
    """End this process soon after its parent was killed, so that the run's folder is free for another one."""
    while os.getppid() == parent:
        time.sleep(ORPHANED)
    os._exit(1)
