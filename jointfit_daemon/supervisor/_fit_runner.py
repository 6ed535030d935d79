"""Runs calibration fits in a worker process, so that they do not delay acquisition.

Invariant: one job runs at a time. The worker process is killed when its job is cancelled or the
daemon ends. Results pass through JSON, so that a replay of a recording uses the same values.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import pickle
import sys
import time
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon.calibration import FitResult
from jointfit_daemon.pipeline.events import JobFinished, JobProgress
from jointfit_daemon.supervisor.worker import HEADER

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Event, FitJob

log = logging.getLogger(__name__)

FIT_TIMEOUT_S = 300.0
"""Longest duration of a fit, s. After this time the subject has probably removed the sensors."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Environment variables of the worker, which numpy reads on import. More threads would use the CPU
core that processes the sensors. More threads are also slower on small matrices: a fit can take 11 s
instead of 1 s."""
_LONGEST_LINE = 256 * 1024 * 1024
"""Size of the largest result, bytes. A calibration of four sensors has about 1 MB."""
_STDERR_TAIL = 4000
"""Number of bytes of the worker's standard error that are logged."""


class FitRunner:
    """Runs the worker process of a job and delivers `JobProgress` and `JobFinished`.

    Parameters
    ----------
    tasks
        Task group that owns the task of every job.
    deliver
        Function that feeds one event to the core.
    """

    def __init__(self, tasks: asyncio.TaskGroup, deliver: Callable[[Event], None]) -> None:
        self._tasks, self._deliver = tasks, deliver
        self._running: asyncio.Task[None] | None = None

    def start(self, job: FitJob) -> None:
        """Start a job, and cancel the running job if there is one."""
        self.cancel()
        self._running = self._tasks.create_task(self._run(job), name=f"fit {job.work.name}")

    def cancel(self) -> None:
        """Kill the running job without delivering a result; do nothing if no job is running."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    async def _run(self, job: FitJob) -> None:
        def report(line: dict[str, Any]) -> None:
            share, text = line["progress"], line["text"]
            self._deliver(JobProgress(time.monotonic_ns(), job.job, share, text))

        began = time.monotonic()
        try:
            async with asyncio.timeout(FIT_TIMEOUT_S):
                answer = await _in_worker(job, report)
        except TimeoutError:
            answer = {"error": f"the fit did not end within {FIT_TIMEOUT_S:g} s"}

        error = answer.get("error")
        result = None if error else FitResult.from_dict(answer["result"])
        took_s = time.monotonic() - began
        log.info("fit %s: %s, %.1f s", job.work.name, "failed" if error else "done", took_s)
        self._deliver(JobFinished(time.monotonic_ns(), job.job, result, error))


async def _in_worker(job: FitJob, report: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    # Pickling minutes of samples takes tens of milliseconds, so it is done in a thread.
    data = await asyncio.to_thread(pickle.dumps, job.work)
    command = [sys.executable, "-m", "jointfit_daemon.supervisor.worker"]
    pipe = asyncio.subprocess.PIPE
    worker = await asyncio.create_subprocess_exec(
        *command,
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        env=ONE_THREAD | os.environ,
        limit=_LONGEST_LINE,
    )
    try:
        async with asyncio.TaskGroup() as pipes:
            answer = pipes.create_task(_answer(worker.stdout, report), name="fit result")
            printed = pipes.create_task(_read(worker.stderr), name="fit output")
            # The pipe must stay open, because the worker exits when the pipe is closed. If the
            # worker ended early, the missing result is reported below.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                if worker.stdin is not None:
                    worker.stdin.write(HEADER.pack(len(data)) + data)
                    await worker.stdin.drain()
        code = await worker.wait()
    finally:
        with contextlib.suppress(ProcessLookupError):
            worker.kill()
        await worker.wait()
        if worker.stdin is not None:
            worker.stdin.close()
    if text := printed.result()[-_STDERR_TAIL:].decode("utf-8", "replace").strip():
        log.warning("fit %s: output of the worker:\n%s", job.work.name, text)
    without = f"the worker process ended with exit code {code} and without a result"
    return answer.result() or {"error": without}


async def _answer(
    pipe: asyncio.StreamReader | None, report: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Report the progress lines of the worker; return its result line, or {} if there is none."""
    found: dict[str, Any] = {}
    while pipe is not None and (line := await pipe.readline()):
        content = orjson.loads(line)
        if "progress" in content:
            report(content)
        else:
            found = content
    return found


async def _read(pipe: asyncio.StreamReader | None) -> bytes:
    return b"" if pipe is None else await pipe.read()
