"""Who does the tasks of a sweep: threads (batch engine), processes of this machine, or a dask.distributed cluster.

Results come in any order.  A worker that dies costs only the time of its task: the task is done again.  One at which workers
die again and again ends the sweep.
"""

import os
import signal
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for
from typing import Any, Final, Protocol

from echelon import __version__
from echelon.errors import PartRunError, UsageError
from echelon.sim.sweep.rows import Rows
from echelon.sim.sweep.work import EngineName, Task, work

DEATHS: Final = 3
"""So often a worker may die at the same task"""
AHEAD: Final = 2
"""Tasks that are handed out at once, for each worker"""
SCHEMES: Final = ("tcp://", "tls://", "ws://", "wss://", "inproc://")
"""How addresses of a dask scheduler begin"""


class WorkersLostError(PartRunError):
    """Workers died at a task again and again.  What was finished is kept."""


class Workers(Protocol):
    """Does tasks; results come in any order."""

    def perform(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Rows]]:
        """Yields each task with its rows when it is done."""

    def close(self) -> None:
        """Stops all work that still goes on."""


def cores() -> int:
    """Returns the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def parse_workers(text: str) -> int | str:
    """Returns a number of workers, or the address of a dask scheduler.  Raises ValueError."""
    if text.startswith(SCHEMES):
        return text
    if not text.isascii() or not text.isdecimal() or not 0 < int(text) < 10_000:
        raise ValueError(f"{text!r}: must be a number of workers, or the address of a dask scheduler, tcp://host:port")
    return int(text)


def make_workers(engine: EngineName, workers: int | str | None) -> Workers:
    """Returns workers for an engine: a number of them, or those of a dask scheduler; by default one for each processor, and
    one for runs as processes.  Raises UsageError if there is no such cluster."""
    if isinstance(workers, str):
        return DaskWorkers(workers)
    if workers is not None and workers < 1:
        raise UsageError(f"workers = {workers}: must be at least 1")
    count = workers or (1 if engine == "processes" else cores())
    if engine == "gpu":
        return ThreadWorkers(1)  # the runs of one task fill it
    return ThreadWorkers(count) if engine == "batch" else ProcessWorkers(count)


class ThreadWorkers:
    """Threads of this process.  The batch engine's compiled code lets them run at the same time."""

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count)
        self._window = AHEAD * count

    def perform(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Rows]]:
        """Yields each task with its rows when it is done."""
        waiting, running = iter(tasks), dict[Future[Rows], Task]()
        while True:
            _fill(self._pool, waiting, running, self._window)
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()

    def close(self) -> None:
        """Waits for the tasks that go on; those that wait are dropped."""
        self._pool.shutdown(cancel_futures=True)


class ProcessWorkers:
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: ProcessPoolExecutor | None = None

    def perform(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Rows]]:
        """Yields each task with its rows when it is done.  Raises WorkersLostError."""
        waiting, running = iter(tasks), dict[Future[Rows], Task]()
        deaths = Counter[str]()
        again: list[Task] = []
        while True:
            try:
                # What was going on when a worker died goes on alone, so that it is known at which task workers die.
                source, window = (iter(again), 1) if again else (waiting, AHEAD * self._count)
                _fill(self._executor(), source, running, window)
                again = [*source] if again else []
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    rows = future.result()
                    yield running.pop(future), rows
            except BrokenProcessPool:
                suspects = [task for future, task in running.items() if not _has_rows(future)]
                finished = [(task, future.result()) for future, task in running.items() if _has_rows(future)]
                if len(suspects) == 1:
                    deaths[suspects[0].name] += 1
                self._drop()
                running.clear()
                again = [*suspects, *again]
                for task in suspects:
                    if deaths[task.name] >= DEATHS:
                        seeds = f"{task.seeds[0]} to {task.seeds[-1]}" if len(task.seeds) > 1 else f"{task.seeds[0]}"
                        raise WorkersLostError(f"workers died {DEATHS} times at {task.name} (seed {seeds})") from None
                yield from finished

    def close(self) -> None:
        """Ends all processes."""
        self._drop()

    def _executor(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self._count, get_context("spawn"), _begin)
        return self._pool

    def _drop(self) -> None:
        if self._pool is not None:
            processes = [*(self._pool._processes or {}).values()]
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            self._pool = None


def _fill(pool: Executor, tasks: Iterator[Task], running: dict[Future[Rows], Task], window: int) -> None:
    """Hands out tasks until `window` of them are running."""
    while len(running) < window and (task := next(tasks, None)) is not None:
        try:
            running[pool.submit(work, task)] = task
        except BrokenProcessPool:
            running[Future()] = task  # so that it is not forgotten
            raise


def _has_rows(future: Future[Rows]) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None


def _begin() -> None:
    """Prepares a worker process: Ctrl-C is for the sweep, and a worker whose sweep was killed ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)


class DaskWorkers:
    """The workers of a dask.distributed cluster.  They must have the same version of echelon."""

    def __init__(self, address: str) -> None:
        try:
            self._dask = _distributed()
        except ImportError:
            raise UsageError(
                f"--workers {address}: needs dask.distributed, which is not installed: pip install 'echelon[dask]'"
            ) from None
        try:
            self._client = self._dask.Client(address, timeout=10)
        except (OSError, ValueError, TimeoutError) as error:
            why = str(error).partition("\n")[0]
            raise UsageError(f"--workers {address}: no dask scheduler answers there: {why}") from None
        if wrong := {name: told for name, told in self._client.run(_version).items() if told != __version__}:
            name, told = next(iter(wrong.items()))
            self.close()
            raise UsageError(f"--workers {address}: the worker {name} has echelon {told}, not {__version__}")

    def perform(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Rows]]:
        """Yields each task with its rows when it is done.  Raises WorkersLostError."""
        waiting, running = iter(tasks), dict[Any, Task]()
        completed = self._dask.as_completed()
        window = AHEAD * max(1, sum(self._client.nthreads().values()))
        while True:
            while len(running) < window and (task := next(waiting, None)) is not None:
                future = self._client.submit(work, task, pure=False)
                running[future] = task
                completed.add(future)
            if not running:
                return
            future = next(completed)
            task = running.pop(future)
            try:
                rows = future.result()
            except self._dask.KilledWorker:
                raise WorkersLostError(f"workers died again and again at {task.name}") from None
            yield task, rows

    def close(self) -> None:
        """Drops what still goes on, and leaves the cluster."""
        self._client.close()


def _distributed() -> Any:
    """Returns the module, which has no types.  Raises ImportError."""
    import distributed

    return distributed


def _version() -> str:
    return __version__
