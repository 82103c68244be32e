"""A process pool as a `concurrent.futures` executor that survives the death of a process.

A killed process fails only its own call, with a `DiedError`; the next call starts a new one. Unlike those of the
standard library's pool, the processes do not import the caller's main module.
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
from threading import Lock, Thread, get_ident
from typing import Any

from taichi_msm.errors import MsmError
from taichi_msm.system.process import ignore_signals

# Interval at which a process checks that its parent is alive [s].
PARENT_POLL_S = 0.2


class DiedError(MsmError):
    """The process of a call ended before the call."""


class Pool(Executor):
    """Executor that starts processes on demand, at most `workers`."""

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        self._processes: dict[int, subprocess.Popen[bytes]] = {}  # by thread
        self._lock, self._closed = Lock(), False

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Schedule a call of an importable function in an idle process; arguments and result are picklable.

        The future raises a `DiedError` if the process ends before the call.
        """
        return self._threads.submit(self._call, function, arguments, named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End every process after its call; `cancel_futures` also cancels pending calls, and kills the processes."""
        self._threads.shutdown(wait=False, cancel_futures=cancel_futures)
        if cancel_futures:
            with self._lock:
                self._closed = True
                for process in self._processes.values():
                    process.kill()
        self._threads.shutdown(wait)
        for process in list(self._processes.values()):
            _close(process)

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=error is not None)

    def _call(self, *call: Any) -> Any:
        thread = get_ident()
        with self._lock:
            if self._closed:
                raise DiedError("the pool was shut down")
            if thread not in self._processes:
                self._processes[thread] = _start_process()
            process = self._processes[thread]
        assert process.stdin
        assert process.stdout
        try:
            pickle.dump(call, process.stdin)
            process.stdin.flush()
            success, value = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            with self._lock:
                del self._processes[thread]
            raise DiedError(_exit_reason(_close(process))) from error
        if not success:
            raise value
        return value


def _start_process() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        # Ctrl-C must reach the parent process only.
        start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    )


def _close(process: subprocess.Popen[bytes]) -> int:
    """End a process that has no call; return its exit code."""
    assert process.stdin
    assert process.stdout
    with suppress(BrokenPipeError):
        process.stdin.close()
    code = process.wait()
    process.stdout.close()
    return code


def _exit_reason(code: int) -> str:
    if code >= 0:
        return f"its process ended with exit code {code}"
    hint = ", as the system does when memory runs out; take fewer --workers" if -code == signal.SIGKILL else ""
    return f"its process was ended by {signal.Signals(-code).name}{hint}"


def serve() -> None:
    """Execute the calls from stdin until the parent closes the pipe or dies; the main function of a process."""
    ignore_signals()
    Thread(target=_exit_with_parent, args=[os.getppid()], daemon=True).start()
    answers = os.fdopen(os.dup(1), "wb")
    # What libraries print on stdout must not mix with the answers.
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
    """Exit after the death of the parent, which unlocks the directory of the run."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
