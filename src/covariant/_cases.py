"""Many cases by one function: in threads, in processes, or by the workers of a Dask cluster.

Whoever has cases cuts them into chunks and leaves out those that are in its store already; here they are computed, few
at a time, and come back as they are done. A process that dies takes nothing with it but the chunk that killed it.
"""

import concurrent.futures
import contextlib
import functools
import hashlib
import itertools
import json
import multiprocessing
import os
import pickle
import queue
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any, NamedTuple

from covariant._optional import load_optional
from scalargraph.errors import InputError
from scalargraph.files import read_sealed, write_sealed

optional = functools.partial(load_optional, use="many cases need", extra="scale")

IN_FLIGHT = 2048
"""Chunks submitted to a scheduler at a time: more than the processors that it can keep busy, so that none waits."""

Work = Callable[[], Callable[[Any], Any]]
"""Called once in each process; returns the function of a chunk, for instance after it has compiled it."""


class Crew(NamedTuple):
    """Who computes.

    Attributes:
        workers: Number of threads or processes; by default one for each processor.
        cluster: Address of the scheduler of a Dask cluster, or a `distributed.Client`, in place of these.
        processes: Whether workers are processes, for Python that holds the lock of its interpreter, and not threads.
    """

    workers: int | None = None
    cluster: Any = None
    processes: bool = False

    def check(self) -> "Crew":
        """Raise `ValueError` for workers that make no sense."""
        if self.cluster is not None and self.workers is not None:
            raise InputError("the scheduler has its own workers; give scheduler or workers, not both")
        if self.workers is not None and self.workers < 1:
            raise InputError(f"workers must be 1 or more; got {self.workers}")
        return self

    @property
    def size(self) -> int:
        """Number of chunks that may be computed at a time."""
        return IN_FLIGHT if self.cluster is not None else self.workers or os.cpu_count() or 1

    @contextlib.contextmanager
    def pool(self, work: Work) -> Iterator[tuple[Callable[[Any], Future], int]]:
        """Context of a function that submits a chunk, and the number of chunks that it shall have at a time."""
        if self.cluster is not None:
            named = isinstance(self.cluster, str)
            connect = optional("distributed").Client(self.cluster, set_as_default=False) if named else None
            with connect or contextlib.nullcontext(self.cluster) as client:
                # A task and not a scattered value: it can be computed again when the worker that holds it dies.
                shared = client.submit(bytes, optional("cloudpickle").dumps(work))
                # A chunk may be written, not returned: no result of an earlier call may replace a call.
                executor = client.get_executor(pure=False)
                yield lambda chunk: executor.submit(_compute, shared, chunk), IN_FLIGHT
            return
        workers = self.size
        if self.processes:
            # Not forked: JAX has threads.
            context = multiprocessing.get_context("spawn")
            executor = concurrent.futures.ProcessPoolExecutor(workers, context, initializer=_end_with_parent)
            function = functools.partial(_compute, pickle.dumps(work))
        else:
            executor, function = concurrent.futures.ThreadPoolExecutor(workers), work()
        try:
            # One chunk in work and one that waits for each worker, so that none is idle and few are pending.
            yield lambda chunk: executor.submit(function, chunk), 2 * workers
        finally:
            executor.shutdown(cancel_futures=True)


def run_chunks(
    work: Work, chunks: Iterable[Any], crew: Crew, split: Callable[[Any], list[Any]] = lambda chunk: [chunk]
) -> Generator[tuple[Any, Any], None, None]:
    """Compute chunks, and yield each with its result when it is done.

    What the function raises is raised here. Chunks that are lost with a process are split, and their parts computed one
    at a time; in place of the result of a part that kills its process, there is a `BrokenExecutor`.
    """
    todo = iter(chunks)
    while lost := (yield from _run_until_lost(work, todo, crew)):
        parts = itertools.chain.from_iterable(map(split, lost))
        while killer := (yield from _run_until_lost(work, parts, crew._replace(workers=1), alone=True)):
            yield killer[0], BrokenExecutor("its process died, as one does that runs out of memory")


def _run_until_lost(
    work: Work, todo: Iterator[Any], crew: Crew, alone: bool = False
) -> Generator[tuple[Any, Any], None, list[Any]]:
    """Compute chunks until there are none, or until a process dies; returns the chunks that were lost with it."""
    pending: dict[Future, Any] = {}
    lost: list[Any] = []
    done: queue.SimpleQueue[Future] = queue.SimpleQueue()  # `concurrent.futures.wait` would go over all each time
    death = () if crew.cluster is None else (optional("distributed").KilledWorker,)  # of a chunk that killed too many
    with crew.pool(work) as (submit, limit):
        while True:
            for chunk in itertools.islice(todo, 0 if lost else (1 if alone else limit) - len(pending)):
                try:
                    future = submit(chunk)
                except BrokenExecutor:
                    lost.append(chunk)
                    continue
                pending[future] = chunk
                future.add_done_callback(done.put)
            if not pending:
                return lost
            future = done.get()
            chunk = pending.pop(future)
            try:
                result = future.result()
            except (BrokenExecutor, *death):
                lost.append(chunk)
                continue
            yield chunk, result


def _end_with_parent() -> None:
    """Leave Ctrl-C to the parent, and end when it was killed, as its pool does not see to that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent: Any = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _compute(pickled: bytes, chunk: Any) -> Any:
    with _LOADING:
        function = _load(pickled)
    return function(chunk)


_LOADING = threading.Lock()
"""Lock by which the threads of one process wait for the function instead of each making it."""


@functools.lru_cache(maxsize=4)
def _load(pickled: bytes) -> Callable[[Any], Any]:
    return pickle.loads(pickled)()


def content_hash(value: object) -> str:
    """SHA-256 of plain data, as JSON writes it."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


class CaseTable(NamedTuple):
    """Rows of finished cases in a folder, each under the hash of its case.

    A file of them is sealed: one that was cut, emptied or edited counts as absent, and its cases are computed again.
    """

    folder: Path
    suffix: str = ".rows"

    def rows(self) -> dict[str, dict[str, Any]]:
        """Rows of all finished cases, by the hash of the case."""
        # The newest last, as a case may have been computed again.
        files = sorted(self.folder.glob(f"*{self.suffix}"), key=lambda part: part.lstat().st_mtime_ns)
        parts = (json.loads(read_sealed(part) or b"{}") for part in files)
        return {case: row for part in parts for case, row in part.items()}

    def write(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Write rows, all or none."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_sealed(self.folder / f"{content_hash(list(rows))[:32]}{self.suffix}", json.dumps(rows).encode())
