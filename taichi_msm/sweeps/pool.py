"""A process pool as a `concurrent.futures` executor, whose processes may be killed one by one.

Unlike in the standard library's pool, processes do not import the caller's main module, and if one is killed, only its
call fails with a `DiedError`; the next call starts a new process.
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

# Interval at which a process checks that its parent is alive [s].
PARENT_POLL_S = 0.2


class DiedError(MsmError):
    """Raised when the process of a call ended before the call returned."""


class Pool(Executor):
    """Executor that starts processes on demand; functions, arguments and results must be picklable."""

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self._idle: SimpleQueue[_Process | None] = SimpleQueue()
        self._live: set[_Process] = set()
        self._closed = False
        for _ in range(workers):
            self._idle.put(None)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Schedule a call in an idle process.

        Args:
            function: an importable function.
            *arguments: its positional arguments.
            **named: its named arguments.
        """
        return self._threads.submit(self._call, (function, arguments, named))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes.

        Args:
            wait: whether to wait for the end of all calls.
            cancel_futures: whether to cancel pending calls and kill the processes at once.
        """
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
            raise DiedError(_exit_reason(code)) from error
        finally:
            self._idle.put(process)
        if not success:
            raise value
        return value


class _Process:
    """A process that executes calls, one at a time."""

    def __init__(self) -> None:
        code = f"import sys; sys.path[:] = {sys.path!r}; from taichi_msm.sweeps.pool import serve; serve()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # Ctrl-C must reach the parent process only.
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )

    def call(self, call: tuple[Any, ...]) -> Any:
        """Execute a call; return whether it succeeded, and its value or exception."""
        assert self._process.stdin
        assert self._process.stdout
        pickle.dump(call, self._process.stdin)
        self._process.stdin.flush()
        return pickle.load(self._process.stdout)

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()

    def close(self) -> int:
        """End the process after its call; return its exit code."""
        assert self._process.stdin
        assert self._process.stdout
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        code = self._process.wait()
        self._process.stdout.close()
        return code


def _exit_reason(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        hint = ", as the system does when memory runs out; take fewer --workers" if -code == signal.SIGKILL else ""
        return f"its process was ended by {name}{hint}"
    return f"its process ended with exit code {code}"


def serve() -> None:
    """Execute calls from stdin in a process of the pool, until the parent closes the pipe or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_exit_with_parent, args=[os.getppid()], daemon=True).start()
    answers = os.fdopen(os.dup(1), "wb")
    # Output of libraries must not mix with the answers.
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
        runtime.stop()  # writes the cache of kernels
    gc.freeze()  # avoids a slow garbage collection at exit


def _exit_with_parent(parent: int) -> None:
    """End this process after the death of its parent, which unlocks the directory of its run."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
