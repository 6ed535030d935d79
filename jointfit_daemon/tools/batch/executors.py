"""Execution of tasks in a pool of processes, or on an existing Dask cluster.

Invariant: every task yields exactly one result. If a task ends its process, only this task fails.
With one job there is no pool: a task that ends its process also ends the command.
"""

from __future__ import annotations

import multiprocessing
from collections import deque
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import TYPE_CHECKING, Any

from jointfit_daemon.tools.batch.recording_task import (
    RecordingResult,
    RecordingTask,
    process_recording,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence
    from concurrent.futures import Future

_AHEAD = 2
"""Number of submitted tasks per process. The second task prevents an idle time between tasks."""
_DIED = (
    "the process that read this recording was ended, probably by the system for lack of memory:"
    " process the recording on a computer with more memory"
)


class SchedulerUnavailableError(ImportError):
    """The package for Dask clusters is not installed."""

    def __init__(self) -> None:
        super().__init__("--scheduler needs distributed: pip install 'jointfitd[batch]'")


def run_in_pool(tasks: Sequence[RecordingTask], jobs: int) -> Iterator[RecordingResult]:
    """Yield the results in the order of completion; with one job, run in this process.

    If a process of the pool dies, the pool loses all tasks. The lost tasks then run one at a time,
    which identifies the task that ended its process.
    """
    if jobs == 1:
        yield from map(process_recording, tasks)
        return
    lost = yield from _run_pool(tasks, jobs)
    while lost:
        rest = yield from _run_pool(lost[:1], 1)
        if rest:
            yield RecordingResult(rest[0].name, "failed", error=_DIED)
        lost = lost[1:]


def _run_pool(
    tasks: Sequence[RecordingTask], jobs: int
) -> Generator[RecordingResult, None, list[RecordingTask]]:
    """Yield the results; return the tasks that have no result because a process died."""
    context = multiprocessing.get_context("spawn")  # a fork would copy the state of numpy's threads
    waiting = deque(tasks)
    running: dict[Future[RecordingResult], RecordingTask] = {}
    with ProcessPoolExecutor(jobs, context) as pool:
        try:
            while waiting or running:
                # Remove a task from `waiting` only after the submission, which fails if a process
                # died.
                while waiting and len(running) < _AHEAD * jobs:
                    future = pool.submit(process_recording, waiting[0])
                    running[future] = waiting.popleft()

                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    result = future.result()
                    del running[future]
                    yield result
        except BrokenProcessPool:
            return [*running.values(), *waiting]
        except GeneratorExit:
            pool.shutdown(cancel_futures=True)
            raise
    return []


def run_on_cluster(tasks: Sequence[RecordingTask], address: str) -> Iterator[RecordingResult]:
    """Yield the results from a Dask cluster in the order of completion.

    If a worker dies, another worker runs its tasks. The workers must have access to the recordings
    and the output folder under the same paths.

    Raises
    ------
    SchedulerUnavailableError
        The extra ``batch`` is not installed.
    OSError
        No scheduler answers at `address`.
    """
    try:
        dask: Any = import_module("distributed")  # some functions of Dask have no types
    except ModuleNotFoundError as missing:
        raise SchedulerUnavailableError from missing

    with dask.Client(address, timeout="10s") as client:
        names: dict[Any, str] = {}
        for task in tasks:
            future = client.submit(process_recording, task, pure=False)
            names[future] = task.name
        for future in dask.as_completed(list(names)):
            name = names.pop(future)
            error = future.exception()
            if error is None:
                yield future.result()
            else:
                yield RecordingResult(name, "failed", error=f"{type(error).__name__}: {error}")
            future.release()
