"""The processes that render, found or started through dask.distributed; imported only when they are asked for."""

from __future__ import annotations

import functools
import logging
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.errors import BackendError
from nlosrender.files.thread_pool import processors
from nlosrender.rendering.process_layout import ProcessLayout

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

CONNECT_SECONDS = 10.0  # timeout for a scheduler to answer
WORKER_SECONDS = 60.0  # timeout for workers to join it
ADVICE = "Start one with 'dask scheduler' and 'dask worker ADDRESS', or leave --scheduler out to use this machine."


@dataclass(frozen=True)
class Cluster:
    """A connection to a dask scheduler with workers, made when it is first used."""

    connect: Callable[[], Client]  # the same one at every call
    processes: ProcessLayout
    threads: int | None  # of Dr.Jit in each worker; None: as many as dask gave that worker

    @property
    def client(self) -> Client:
        """The connection.

        Raises
        ------
        BackendError
            The processes of this machine cannot be started.
        """
        return self.connect()


@contextmanager
def joined_cluster(scheduler: str | None = None, workers: int | None = None) -> Iterator[Cluster]:
    """Connect to a scheduler, or start one and workers on this machine; they end with the block.

    On this machine they start when the first work item is sent: the capture has been checked by then.

    Parameters
    ----------
    scheduler
        Address (``tcp://host:8786``) or scheduler file (JSON); None: processes on this machine.
    workers
        How many to start, or to wait for; None: one per core, or whichever there are.

    Raises
    ------
    BackendError
        dask.distributed is not installed, no scheduler answers, or too few workers join it.
    """
    try:
        import distributed
    except ImportError as error:
        message = f"--executor dask: {error}. Install it with: pip install 'nlosrender[dask]'"
        raise BackendError(message) from error
    _silence_tracebacks()
    if scheduler is not None:
        with _connected(scheduler) as client:
            yield Cluster(lambda: client, ProcessLayout(workers=_awaited(client, scheduler, workers)), threads=None)
        return
    cores = processors()
    count = workers or cores
    with ExitStack() as started:

        @functools.cache
        def connect() -> Client:
            try:
                local = started.enter_context(_local_workers(count))
                client: Client = started.enter_context(distributed.Client(local))
            except (OSError, RuntimeError, TimeoutError) as error:
                reason = f"{str(error) or type(error).__name__}. Try fewer --workers."
                raise BackendError(f"--executor dask: {count} workers cannot be started: {reason}") from error
            return client

        # the process that writes takes a share of the memory, too
        yield Cluster(connect, ProcessLayout(workers=count, memory_shares=count + 1), threads=max(1, cores // count))


def _silence_tracebacks() -> None:
    """Keep the tracebacks of dask's own threads out of the log: what a lost connection means is said by the error."""
    names = [name for name in logging.Logger.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    for name in (*names, "asyncio"):
        logger = logging.getLogger(name)
        if _has_no_traceback not in logger.filters:
            logger.addFilter(_has_no_traceback)


def _has_no_traceback(record: logging.LogRecord) -> bool:
    return not record.exc_info


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    from distributed import Client

    is_file = "://" not in scheduler and (scheduler.endswith(".json") or Path(scheduler).exists())
    if is_file and not Path(scheduler).exists():  # dask would wait forever
        raise BackendError(f"--scheduler {scheduler}: there is no such scheduler file. {ADVICE}")
    try:
        if is_file:
            client = Client(scheduler_file=scheduler, timeout=CONNECT_SECONDS)
        else:
            client = Client(scheduler, timeout=CONNECT_SECONDS)
    except (OSError, TimeoutError, ValueError, KeyError) as error:  # the last two: no address, no scheduler file
        reason = str(error) or type(error).__name__
        raise BackendError(f"--scheduler {scheduler}: no scheduler can be reached: {reason}. {ADVICE}") from error
    with client:
        yield client


def _awaited(client: Client, scheduler: str, wanted: int | None) -> int:
    """Wait for workers and return how many there are."""
    try:
        client.wait_for_workers(wanted or 1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        found = len(client.scheduler_info()["workers"])
        raise BackendError(
            f"--scheduler {scheduler}: has {found} workers after {WORKER_SECONDS:.0f} s, need {wanted or 1}. "
            "Start them with 'dask worker ADDRESS --nthreads CORES'."
        ) from error
    return len(client.scheduler_info()["workers"])


def _local_workers(count: int) -> LocalCluster:
    """Start processes that finish their work item when Ctrl-C reaches every process of the terminal."""
    from distributed import LocalCluster

    resource_tracker.ensure_running()  # started now: starting this process of Python's later would unblock the signal
    # the blocked signal is inherited by dask's thread and by every worker it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        # memory_limit 0: work items are planned to fit, and dask would kill workers for the machine's file cache
        return LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, memory_limit=0, dashboard_address=None
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
