"""Runs fits in a worker process, so that acquisition does not stall while a calibration is fitted.

Law: one job at a time; a job that is cancelled, or outlives the daemon, is killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import pickle  # noqa: S403 - parent and child only
import sys
import time
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import JobFinished

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Event, FitJob

log = logging.getLogger(__name__)

PATIENCE_S = 300.0
"""A fit that takes longer than this is given up: the wearer will have taken the sensors off."""


class FitRunner:
    """Starts the worker for a job and delivers ``JobFinished``."""

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
        result, error = None, None
        try:
            async with asyncio.timeout(PATIENCE_S):
                result = await _in_worker(job)
        except TimeoutError:
            error = f"not done after {PATIENCE_S:g} s"
        except WorkerFailed as failed:
            error = str(failed)
            log.error("fit %s: %s", job.kind, failed)  # noqa: TRY400 - the traceback is the worker's
        self._deliver(JobFinished(time.monotonic_ns(), job.job, result, error))


class WorkerFailed(Exception):  # noqa: N818 - named for what happened
    """The worker ended without a result; the text is the end of what it said."""


async def _in_worker(job: FitJob) -> dict[str, object]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "jointfit_daemon.supervisor.worker",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        # Pickling minutes of samples takes tens of milliseconds: not in the loop's way.
        words = await asyncio.to_thread(pickle.dumps, (job.kind, dict(job.payload)))
        out, said = await process.communicate(words)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    if process.returncode != 0:
        lines = said.decode("utf-8", "replace").strip().splitlines()
        log.error("the worker's traceback:\n%s", "\n".join(lines))
        raise WorkerFailed(lines[-1] if lines else f"worker ended with {process.returncode}")
    result: dict[str, object] = pickle.loads(out)  # noqa: S301 - written by our child
    return result
