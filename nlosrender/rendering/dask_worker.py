"""What a worker process does: set up a capture once, then render and pack work item after work item.

Nothing that is sent here may import Dr.Jit by being unpickled: the backend has to choose LLVM before that.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from nlosrender.capture.part import Selection
from nlosrender.capture.plan import WorkItem, replicas_for
from nlosrender.config.canonical import tree_hash
from nlosrender.config.document import Config
from nlosrender.config.load import config_to_dict
from nlosrender.engine.backend.start import Backend, BackendName, limit_threads, start_backend
from nlosrender.errors import BackendError, ConfigError, NlosError, ValidationIssue
from nlosrender.files.chunking import Chunker
from nlosrender.files.identity import capture_identity, differences
from nlosrender.rendering.process_layout import ProcessLayout
from nlosrender.rendering.render_report import Stopwatch
from nlosrender.rendering.stages import set_up_engine
from nlosrender.rendering.work_items import FinishedItem, render_timed

if TYPE_CHECKING:
    from nlosrender.engine.interface import Engine


@dataclass(frozen=True)
class Job:
    """Description of a capture for workers."""

    config: Config
    selection: Selection
    identity: Mapping[str, Any]  # has to equal the worker's own identity of the capture
    backend: BackendName
    processes: ProcessLayout


@dataclass(frozen=True)
class RemoteError:
    """An explained error as it travels: a value, so that dask neither retries nor pickles an exception."""

    kind: type[NlosError]
    content: str | tuple[ValidationIssue, ...]

    def error(self) -> NlosError:
        """Return the error to raise."""
        return self.kind(self.content)


@dataclass
class _WorkerState:
    """The capture this process is set up for; it renders one work item at a time while the one before is packed."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    key: str = ""
    engine: Engine | None = None
    chunker: Chunker | None = None

    def prepared(self, job: Job) -> tuple[Engine, Chunker]:
        """Return what renders and what cuts; the backend is started."""
        # in every thread: Mitsuba's variant is thread-local
        backend = start_backend(job.backend, colored=job.config.is_colored, polarized=job.config.render.polarized)
        key = tree_hash(dict(job.identity))
        if key != self.key or self.engine is None or self.chunker is None:
            self.key, self.engine, self.chunker = "", None, None  # dropped first: memory holds one engine
            _refuse_other_capture(job, backend)
            _, self.engine, header = set_up_engine(job.config, backend, job.selection, job.processes)
            self.chunker = Chunker(header, job.config.output.compression, job.config.output.variance)
            self.key = key
        return self.engine, self.chunker


_WORKER = _WorkerState()


def render_remotely(
    job: Job, item: WorkItem, budget: Mapping[str, Any], threads: int | None
) -> FinishedItem | RemoteError:
    """Render a work item in a worker process.

    Parameters
    ----------
    job, item
        What to render.
    budget
        The fields of a calibrated ``Budget``: the class itself would import Dr.Jit.
    threads
        Of Dr.Jit; None: as many as the dask worker has.
    """
    stopwatch = Stopwatch()
    try:
        with _WORKER.lock:
            with stopwatch.stage("scene"):
                engine, chunker = _WORKER.prepared(job)
                limit_threads(threads or _threads_of_worker())
            from nlosrender.engine.interface import Budget

            finished = render_timed(engine, item, Budget(**budget), chunker, stopwatch)
        begun = time.perf_counter()
        packed = tuple(finished.chunks)
        stopwatch.seconds["compress"] += time.perf_counter() - begun
    except ConfigError as error:
        return RemoteError(ConfigError, error.issues)
    except NlosError as error:
        return RemoteError(type(error), f"{error} (on worker {_worker_name()})")
    return replace(finished, chunks=packed, seconds=stopwatch.seconds)


def _refuse_other_capture(job: Job, backend: Backend) -> None:
    """Refuse to render what would be another capture here: other versions, another mesh under the same name."""
    replicas = replicas_for(backend.lanes, job.config.capture.n_sensors)
    mine = capture_identity(config_to_dict(job.config), str(job.selection), backend.variant, replicas)
    found = [f"{key}: {there} there, {here} here" for key, there, here in differences(job.identity, mine)]
    if found:
        raise BackendError(
            f"a worker would render another capture ({'; '.join(found)}). Install the same versions everywhere, and "
            "let every machine read the same files under the same names."
        )


def _threads_of_worker() -> int:
    from distributed import get_worker

    return get_worker().state.nthreads


def _worker_name() -> str:
    from distributed import get_worker

    return str(get_worker().address)
