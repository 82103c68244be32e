"""A dask.distributed cluster as a `concurrent.futures` executor.

A worker plugin sends the scene and its files once to every worker, also to those that join later. A worker needs this
package, and access to the directory of the sweep.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from distributed import Client, Reschedule, Security, WorkerPlugin, get_worker
from distributed.cfexecutor import ClientExecutor
from distributed.client import ClosedClientError
from distributed.comm import connect
from distributed.utils import LoopRunner, silence_logging_cmgr

from taichi_msm.errors import ExecutorError, LostExecutorError, StageProgressCallback
from taichi_msm.images import use_copies
from taichi_msm.scene.outputs import SWEEP_RECORD
from taichi_msm.sweeps.runs import Outcome, RunTask, execute_run, missing_versions
from taichi_msm.sweeps.spec import Sweep
from taichi_msm.system.compiler import versions

# Time limit for the answer of a scheduler [s].
MAX_WAIT_S = 10


class Inputs(WorkerPlugin):  # type: ignore[misc]  # that package has no types
    """Worker plugin with the inputs that all runs of a sweep have in common; all workers must access the directory."""

    def __init__(self, sweep: Sweep, directory: Path) -> None:
        scene = sweep.scene
        # Absolute, as workers have other current directories.
        self.scene, self.directory = scene._replace(folder=scene.folder.absolute()), directory.absolute()
        self.home = Path.cwd()
        # Required versions of this package and its libraries, by name.
        self.versions = versions()
        self._digests = {str(Path(path).absolute()): digest for path, digest in sweep.files.items()}
        self._contents = {digest: Path(path).read_bytes() for path, digest in self._digests.items()}
        self.error = ""  # reason why the worker cannot execute runs
        self.copies: dict[str, Path] = {}  # local copies, by path of the file
        self._folder = Path()
        self._ended = False

    def setup(self, worker: Any) -> None:
        """Write the files to a temporary folder of the worker; raise an ExecutorError if it cannot execute runs."""
        self.error = self._check(worker)
        if self.error:
            raise ExecutorError(self.error)
        if not self.home.is_dir():
            self.home = Path.cwd()
        self._folder = Path(tempfile.mkdtemp(dir=worker.local_directory))
        for digest, content in self._contents.items():
            (self._folder / digest).write_bytes(content)
        self._contents.clear()
        self.copies = {path: self._folder / digest for path, digest in self._digests.items()}

    def teardown(self, worker: Any) -> None:  # noqa: ARG002
        """Stop the run of a worker when the worker closes or the sweep ends."""
        self._ended = True
        if self.copies:
            shutil.rmtree(self._folder, ignore_errors=True)

    def pause(self, _stage: str, _done: int, _total: int) -> None:
        """Interrupt the run after `teardown`; a progress callback."""
        if self._ended:
            raise KeyboardInterrupt

    def _check(self, worker: Any) -> str:
        """Return the reason why a worker cannot execute runs; empty if it can."""
        if (threads := worker.state.nthreads) != 1:
            return f"worker {worker.address} has {threads} threads; start it with one: dask worker --nthreads 1"
        # Results in a worker's own directory would be lost.
        if not (self.directory / SWEEP_RECORD).is_file():
            return f"worker {worker.address} cannot access {self.directory}; choose an --out that all machines share"
        if missing := missing_versions(self.versions):
            return f"worker {worker.address} needs other versions; install {', '.join(missing)}"
        return ""


class Cluster(ClientExecutor):  # type: ignore[misc]
    """Executor on the workers of a scheduler; sends only number, overrides and directory of a run.

    The name is that of the plugin `Inputs` on the scheduler.
    """

    def __init__(self, client: Any, name: str) -> None:
        super().__init__(client, pure=False)
        self._name = name

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Schedule a call of an importable function in an idle worker; raise a BrokenExecutor without connection.

        The arguments are picklable; `execute_run` gets the scene and its files from the plugin.
        """
        call: tuple[Any, ...] = (_call, self._name, function, *arguments)
        if function is execute_run:
            (task,) = arguments
            call = (_execute_run, self._name, task.run, task.overrides, task.directory.absolute())
        try:
            return super().submit(*call)
        except ClosedClientError as error:
            raise BrokenExecutor(str(error)) from error


def _call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function with the worker's local copies of the files."""
    with use_copies(_inputs(name).copies):
        return function(*arguments)


def _execute_run(name: str, run: int, overrides: tuple[str, ...], directory: Path) -> Outcome:
    inputs = _inputs(name)
    with suppress(KeyboardInterrupt):
        task = RunTask(run, inputs.scene, overrides, directory, inputs.home)
        outcome: Outcome = _call(name, execute_run, task, inputs.pause)
        inputs.pause("", 0, 0)
        return outcome
    # The worker closes; dask executes the run in another one.
    raise Reschedule


def _inputs(name: str) -> Inputs:
    """Return the plugin of this worker."""
    inputs: Inputs | None = get_worker().plugins.get(name)
    if inputs is None:
        raise ExecutorError("another command for the same folder has ended meanwhile")
    if inputs.error:
        raise ExecutorError(inputs.error)
    return inputs


@contextmanager
def cluster_connection(
    address: str, sweep: Sweep, directory: Path, progress: StageProgressCallback
) -> Iterator[Cluster]:
    """Connect to a scheduler, such as tcp://10.0.0.1:8786, and send the inputs of a sweep to its workers.

    The context manager yields an executor. Raise an ExecutorError when no scheduler answers, or a worker cannot execute
    runs, and a LostExecutorError in place of an error of the block, when the connection is lost.
    """
    with silence_logging_cmgr(logging.CRITICAL):
        client = _client(address)
        # A name per directory: a new command replaces the plugin of a killed one.
        name = f"taichi-msm {directory.absolute()}"
        cluster, lost = Cluster(client, name), False
        try:
            _register_inputs(Inputs(sweep, directory), name, client)
            _wait_for_worker(client, progress)
            yield cluster
        except ExecutorError as error:
            # Within the block, only a lost connection cancels runs.
            if lost := isinstance(error.__cause__, (BrokenExecutor, CancelledError, OSError)):
                raise LostExecutorError(f"lost the scheduler at {address}") from error
            raise
        finally:
            if not lost:
                # The connection may be lost, or another command for this directory may have removed the plugin.
                with suppress(OSError, ValueError):
                    cluster.shutdown(wait=False)
                    client.unregister_worker_plugin(name)
            client.close()


def _client(address: str) -> Any:
    remedy = "give the address that `dask scheduler` prints, such as tcp://10.0.0.1:8786"
    try:
        # With another service, such as the scheduler's web page, a client would wait for the handshake forever.
        LoopRunner(asynchronous=False).run_sync(_check_scheduler, address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `Inputs` compares versions.
            return Client(address, timeout=MAX_WAIT_S, set_as_default=False)
    except (OSError, asyncio.TimeoutError):
        raise ExecutorError(f"{address}: no dask scheduler answers; {remedy}") from None
    except TypeError:  # raised by a transport whose requirements are not installed
        needs = "tls needs certificates in dask's configuration, under distributed.comm.tls; ucx needs distributed-ucxx"
        raise ExecutorError(f"{address}: the transport is not set up; {needs}") from None
    except Exception as error:
        raise ExecutorError(f"{address}: {' '.join(str(error).split())}; {remedy}") from None


async def _check_scheduler(address: str) -> None:
    arguments = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=MAX_WAIT_S, **arguments), MAX_WAIT_S)
    await comm.close()


def _register_inputs(inputs: Inputs, name: str, client: Any) -> None:
    """Send the inputs to all workers, also to later ones."""
    try:
        client.register_plugin(inputs, name=name)
    except ExecutorError:
        raise
    except Exception as error:
        # Where a worker lacks a package, unpickling raises any error.
        raise ExecutorError(f"a worker cannot execute runs: {error}; install the same packages there") from None


def _wait_for_worker(client: Any, progress: StageProgressCallback) -> None:
    try:
        while not client.nthreads():
            progress("workers", 0, 0)
            time.sleep(0.2)
    except OSError as error:
        raise LostExecutorError("the scheduler does not answer") from error
