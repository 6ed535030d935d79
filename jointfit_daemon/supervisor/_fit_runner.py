"""Runs fits in a worker process, so that acquisition does not stall while a calibration is fitted.

Law: one job at a time; a job that is cancelled, or outlives the daemon, is killed. Results pass
through JSON, so a replay, which reads them from the event log, sees the same values.
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

from jointfit_daemon.pipeline.events import JobFinished
from jointfit_daemon.supervisor.worker import HEADER

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Event, FitJob

log = logging.getLogger(__name__)

PATIENCE_S = 300.0
"""A fit that takes longer than this is given up: the wearer will have taken the sensors off."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Set before the worker starts, for numpy reads it when imported. Threads would take the core that
the sensors need, and on small matrices they only wait for each other: 11 s instead of 1."""
_LAST_WORDS = 4000  # characters of a worker's standard error worth logging


class FitRunner:
    """Starts the worker for a job and delivers ``JobFinished``.

    Parameters
    ----------
    tasks
        Owns the task of every job.
    deliver
        Feeds one event to the core.
    """

    def __init__(self, tasks: asyncio.TaskGroup, deliver: Callable[[Event], None]) -> None:
        self._tasks, self._deliver = tasks, deliver
        self._running: asyncio.Task[None] | None = None

    def start(self, job: FitJob) -> None:
        """Start a job; one that still runs is cancelled."""
        self.cancel()
        self._running = self._tasks.create_task(self._run(job), name=f"fit {job.kind}")

    def cancel(self) -> None:
        """Kill the running job, if there is one; nothing is delivered for it."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    async def _run(self, job: FitJob) -> None:
        began = time.monotonic()
        try:
            async with asyncio.timeout(PATIENCE_S):
                answer = await _in_worker(job)
        except TimeoutError:
            answer = {"error": f"not done after {PATIENCE_S:g} s"}
        error = answer.get("error")
        took_s = time.monotonic() - began
        log.info("fit %s: %s, %.1f s", job.kind, "failed" if error else "done", took_s)
        self._deliver(JobFinished(time.monotonic_ns(), job.job, answer.get("result"), error))


async def _in_worker(job: FitJob) -> dict[str, Any]:
    # Pickling minutes of samples takes tens of milliseconds: not in the loop's way.
    words = await asyncio.to_thread(pickle.dumps, (job.kind, dict(job.payload)))
    command = [sys.executable, "-m", "jointfit_daemon.supervisor.worker"]
    pipe = asyncio.subprocess.PIPE
    worker = await asyncio.create_subprocess_exec(
        *command, stdin=pipe, stdout=pipe, stderr=pipe, env=ONE_THREAD | os.environ
    )
    try:
        async with asyncio.TaskGroup() as pipes:
            answer = pipes.create_task(_read(worker.stdout), name="fit result")
            said = pipes.create_task(_read(worker.stderr), name="fit words")
            pipes.create_task(_write(worker.stdin, words), name="fit job")
        code = await worker.wait()
    finally:
        with contextlib.suppress(ProcessLookupError):
            worker.kill()
        await worker.wait()
        if worker.stdin is not None:
            worker.stdin.close()
    if text := said.result()[-_LAST_WORDS:].decode("utf-8", "replace").strip():
        log.warning("fit %s: the worker said:\n%s", job.kind, text)
    if not answer.result():
        return {"error": f"the worker ended with {code} and without a result"}
    found: dict[str, Any] = orjson.loads(answer.result())
    return found


async def _read(pipe: asyncio.StreamReader | None) -> bytes:
    return b"" if pipe is None else await pipe.read()


async def _write(pipe: asyncio.StreamWriter | None, words: bytes) -> None:
    """Send the job and leave the pipe open: the worker dies when it closes."""
    if pipe is not None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it ended: told by _read
            pipe.write(HEADER.pack(len(words)) + words)
            await pipe.drain()
