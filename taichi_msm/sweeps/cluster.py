"""Workers of dask.distributed, on any machines, as an executor of `concurrent.futures`.

A plugin brings the scene and the files that it names to every worker once, also to those that come later. Besides, a
worker needs only this package and the folder of the sweep.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker, Reschedule, Security, WorkerPlugin, get_worker
from distributed.client import ClosedClientError
from distributed.comm import connect
from distributed.utils import LoopRunner, silence_logging_cmgr

from taichi_msm.errors import ExecutorError, LostExecutorError, MsmError, StageProgressCallback
from taichi_msm.images import use_copies
from taichi_msm.scene.outputs import SWEEP_RECORD
from taichi_msm.sweeps.runs import Outcome, Task, take
from taichi_msm.sweeps.spec import Sweep
from taichi_msm.system.compiler import versions, what_decides_bits

# How long a scheduler may take to answer [s].
PATIENCE = 10

# What transports need besides dask.
_CERTIFICATES = "certificates; name them in dask's configuration, under distributed.comm.tls"
REQUIREMENTS = {
    "tls": _CERTIFICATES,
    "wss": _CERTIFICATES,
    "ucx": "UCX, which is not installed; pip install distributed-ucxx, or use tcp://",
}

# How often we look whether a worker has come [s].
LOOK = 0.2


class Inputs(WorkerPlugin):  # type: ignore[misc]  # that package has no types
    """What the runs of a sweep have in common, on its way to a worker and there."""

    def __init__(self, described: Sweep, directory: Path) -> None:
        scene = described.scene
        # Absolute, as there may be no such current directory where a worker is.
        self.scene, self.directory = scene._replace(folder=scene.folder.absolute()), directory.absolute()
        self.home = Path.cwd()
        self.versions = what_decides_bits(versions(), "cpu")
        self._digests = {str(Path(path).absolute()): digest for path, digest in described.files.items()}
        self._contents = {digest: Path(path).read_bytes() for path, digest in self._digests.items()}
        self.fault = ""
        self.copies: dict[str, Path] = {}  # of the files, by their paths where the sweep was started
        self._folder = Path()  # of these copies
        self._ended = False

    def setup(self, worker: Any) -> None:
        """Write the files into a temporary folder of the worker; ExecutorError: it cannot take runs."""
        self.fault = self._fault(worker)
        if self.fault:
            raise ExecutorError(self.fault)
        if not self.home.is_dir():
            self.home = Path.cwd()
        self._folder = Path(tempfile.mkdtemp(dir=worker.local_directory))
        for digest, content in self._contents.items():
            (self._folder / digest).write_bytes(content)
        self._contents.clear()
        self.copies = {path: self._folder / digest for path, digest in self._digests.items()}

    def teardown(self, worker: Any) -> None:  # noqa: ARG002
        """Stop the run of the worker, which is ending or whose sweep is."""
        self._ended = True
        if self.copies:
            shutil.rmtree(self._folder, ignore_errors=True)

    def pause(self, _stage: str, _done: int, _total: int) -> None:
        """Interrupt a run if it should be stopped."""
        if self._ended:
            raise KeyboardInterrupt

    def _fault(self, worker: Any) -> str:
        """Say why a worker cannot take runs, if so."""
        if (threads := worker.state.nthreads) != 1:
            return f"worker {worker.address} has {threads} threads; start it with one: dask worker --nthreads 1"
        # What a worker wrote into a folder of its own would be lost.
        if not (self.directory / SWEEP_RECORD).is_file():
            return f"worker {worker.address} does not see {self.directory}; choose an --out that all machines share"
        here = versions()
        if others := [f"{name} {version}" for name, version in self.versions.items() if here.get(name) != version]:
            return f"worker {worker.address} has other versions; install there {', '.join(others)}"
        return ""


class Cluster(Executor):
    """The workers of a scheduler; of the tasks of a sweep they are sent only what differs."""

    def __init__(self, client: Any, name: str) -> None:
        self._executor, self._name = client.get_executor(pure=False), name

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        """Call a function, which must be importable, in a worker that is free."""
        answer: Future[Any] = Future()
        try:
            if function is take:
                (task,) = arguments
                given = self._executor.submit(_take, self._name, task.run, task.overrides)
            else:
                given = self._executor.submit(_call, self._name, function, *arguments)
        except ClosedClientError:
            _cancel(answer)
        else:
            given.add_done_callback(partial(_pass_on, answer))
        return answer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for all calls, or cancel those that have not begun."""
        self._executor.shutdown(wait and not cancel_futures)


def _pass_on(answer: Future[Any], given: Future[Any]) -> None:
    """Pass on the end of a call; what dask says of workers that died would differ from time to time."""
    if given.cancelled():
        _cancel(answer)
    elif isinstance(error := given.exception(), KilledWorker):
        answer.set_exception(MsmError(f"its workers died, {error.allowed_failures + 1} one after another"))
    elif error is not None:
        answer.set_exception(error)
    else:
        answer.set_result(given.result())


def _cancel(answer: Future[Any]) -> None:
    answer.cancel()
    answer.set_running_or_notify_cancel()


def _call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a worker, where the files are those that it was sent."""
    with use_copies(_inputs(name).copies):
        return function(*arguments)


def _take(name: str, run: int, overrides: tuple[str, ...]) -> Outcome:
    """Take a run in a worker."""
    inputs = _inputs(name)
    with suppress(KeyboardInterrupt):
        task = Task(run, inputs.scene, overrides, inputs.directory, inputs.home)
        outcome: Outcome = _call(name, take, task, inputs.pause)
        inputs.pause("", 0, 0)
        return outcome
    # Where the sweep has not ended, the worker is about to.
    raise Reschedule


def _inputs(name: str) -> Inputs:
    """Find in a worker what it was sent."""
    inputs: Inputs | None = get_worker().plugins.get(name)
    if inputs is None:
        raise ExecutorError("another command for the same folder has ended meanwhile")
    if inputs.fault:
        raise ExecutorError(inputs.fault)
    return inputs


@contextmanager
def connected(address: str, described: Sweep, directory: Path, progress: StageProgressCallback) -> Iterator[Cluster]:
    """Use the workers of a scheduler for a sweep, once there is one; at the end they forget it.

    Raises:
        ExecutorError: when no scheduler answers, or a worker cannot take runs.
        LostExecutorError: instead of the error of a block in which the connection is lost.
    """
    with silence_logging_cmgr(logging.CRITICAL):
        client = _client(address)
        # Another command for this folder replaces what one that was killed has left there.
        name = f"taichi-msm {directory.absolute()}"
        cluster, lost = Cluster(client, name), False
        try:
            _bring(Inputs(described, directory), name, client)
            _wait(client, progress)
            yield cluster
        except ExecutorError as error:
            # While we wait for runs, only the loss of the connection cancels any.
            if lost := isinstance(error.__cause__, (CancelledError, OSError)):
                raise LostExecutorError(f"lost the scheduler at {address}") from error
            raise
        finally:
            if not lost:
                with suppress(OSError, ValueError):  # lost just now; forgotten by another command for this folder
                    cluster.shutdown(cancel_futures=True)
                    client.unregister_worker_plugin(name)
            client.close()


def _client(address: str) -> Any:
    """Connect to a scheduler."""
    remedy = "give the address that `dask scheduler` prints, such as tcp://10.0.0.1:8786"
    try:
        # A client would wait for ever for the greeting of another program, such as the scheduler's own web page.
        LoopRunner(asynchronous=False).run_sync(_greet, address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Workers compare versions.
            return Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, asyncio.TimeoutError):
        raise ExecutorError(f"{address}: no dask scheduler answers; {remedy}") from None
    except TypeError as error:  # by a transport whose requirements are missing
        needs = REQUIREMENTS.get(address.partition("://")[0], " ".join(str(error).split()))
        raise ExecutorError(f"{address}: needs {needs}") from None
    except Exception as error:
        raise ExecutorError(f"{address}: {' '.join(str(error).split())}; {remedy}") from None


async def _greet(address: str) -> None:
    how = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=PATIENCE, **how), PATIENCE)
    await comm.close()


def _bring(inputs: Inputs, name: str, client: Any) -> None:
    """Bring the inputs to the workers that are there, and to those that will come."""
    try:
        client.register_plugin(inputs, name=name)
    except ExecutorError:
        raise
    except Exception as error:
        # Unpickling what is sent raises whatever a worker lacks.
        raise ExecutorError(f"a worker cannot take runs: {error}; install there what is here") from None


def _wait(client: Any, progress: StageProgressCallback) -> None:
    """Wait for the first worker."""
    try:
        while not client.nthreads():
            progress("workers", 0, 0)
            time.sleep(LOOK)
    except OSError as error:
        raise LostExecutorError("the scheduler does not answer") from error
