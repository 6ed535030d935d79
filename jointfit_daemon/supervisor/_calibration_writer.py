"""Writes calibrations to the store, one after another, without holding up the loop.

Invariant: what the core holds in force and what a reload finds are the same calibration, whether a
write is still under way or has failed. A calibration that could not be written is written again.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import CalibrationStored
from jointfit_daemon.supervisor import _stored_calibrations
from jointfit_daemon.supervisor._stored_calibrations import Found

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event


RETRY_S = 10.0
"""Time between attempts to store a calibration that could not be stored."""


class CalibrationWriter:
    """Stores a calibration and delivers ``CalibrationStored``.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        Owns the task of every write.
    deliver : callable
        Feeds one event to the core.
    complain : callable
        Reports a calibration that could not be written; once for each reason.
    """

    def __init__(
        self,
        tasks: asyncio.TaskGroup,
        deliver: Callable[[Event], None],
        complain: Callable[[str], None],
    ) -> None:
        self._tasks, self._deliver, self._complain = tasks, deliver, complain
        self._in_turn = asyncio.Lock()
        self._writing: set[asyncio.Task[None]] = set()
        self._unwritten: tuple[Rig, Calibration] | None = None
        self._next_try: asyncio.TimerHandle | None = None
        self._store = ""
        self.fault: str | None = None
        """Why the calibration in force is not stored; None if it is, or none was made."""

    def start(self, rig: Rig, calibration: Calibration) -> None:
        """Write a new version to the rig's store."""
        self._unwritten, self._store = (rig, calibration), rig.calibration_store
        self._begin(rig, calibration)

    def retry(self) -> None:
        """Write now what could not be written before, if there is any."""
        if self._next_try is not None:
            self._next_try.cancel()
            self._next_try = None
        if self._unwritten is not None and not self._writing:
            self._begin(*self._unwritten)

    def _begin(self, rig: Rig, calibration: Calibration) -> None:
        task = self._tasks.create_task(self._write(rig, calibration), name="store")
        self._writing.add(task)
        task.add_done_callback(self._writing.discard)

    def stop(self) -> None:
        """Stop trying again; what is being written is finished."""
        self._unwritten = None
        if self._next_try is not None:
            self._next_try.cancel()

    async def _write(self, rig: Rig, calibration: Calibration) -> None:
        async with self._in_turn:
            try:
                version = await asyncio.to_thread(_stored_calibrations.save, rig, calibration)
            except OSError as error:
                self._failed(str(error))
                return
            if self._unwritten is None or self._unwritten[1] is calibration:
                self._unwritten = self.fault = None
        if rig.calibration_store == self._store:  # else a reload chose another store meanwhile
            self._deliver(CalibrationStored(time.monotonic_ns(), version))

    def _failed(self, fault: str) -> None:
        if fault != self.fault:
            self.fault = fault
            self._complain(f"in force but not stored: {fault}; tried again every {RETRY_S:g} s")
        if self._next_try is None:
            self._next_try = asyncio.get_running_loop().call_later(RETRY_S, self.retry)

    async def settle(self) -> None:
        """Wait until nothing is being written."""
        while self._writing:
            await asyncio.wait(set(self._writing))

    def found(self, rig: Rig) -> Found:
        """Return what is to be in force: the newest of the store, or the one it could not take."""
        self._store = rig.calibration_store
        if self._unwritten is not None:
            asked, calibration = self._unwritten
            same_store = asked.calibration_store == rig.calibration_store
            if same_store and calibration.fits(rig.chain):
                text = (
                    "the calibration in force goes on, but it is not stored: a restart forgets it"
                )
                return Found(calibration, None, (text,))
        return _stored_calibrations.stored(rig)
