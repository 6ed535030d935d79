"""Writes calibrations to the store, one after another, without holding up the loop.

Law: what the core holds in force and what a reload finds are the same calibration, whether a
write is still under way or has failed.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import CalibrationStored
from jointfit_daemon.supervisor import calibrations
from jointfit_daemon.supervisor.calibrations import Found

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.calibration.result import Calibration
    from jointfit_daemon.config import Rig
    from jointfit_daemon.pipeline.events import Event


class StoreRunner:
    """Stores a calibration and delivers ``CalibrationStored``.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        Owns the task of every write.
    deliver : callable
        Feeds one event to the core.
    complain : callable
        Tells of a calibration that could not be written.
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
        self._unwritten: tuple[str, Calibration] | None = None

    def start(self, rig: Rig, calibration: Calibration) -> None:
        """Write a new version to the rig's store."""
        task = self._tasks.create_task(self._write(rig, calibration), name="store")
        self._writing.add(task)
        task.add_done_callback(self._writing.discard)

    async def _write(self, rig: Rig, calibration: Calibration) -> None:
        async with self._in_turn:
            try:
                version = await asyncio.to_thread(calibrations.save, rig, calibration)
            except OSError as fault:
                self._unwritten = (rig.calibration_store, calibration)
                self._complain(f"in force but not stored: {fault}")
                return
            self._unwritten = None
        self._deliver(CalibrationStored(time.monotonic_ns(), version))

    async def settle(self) -> None:
        """Wait until nothing is being written."""
        while self._writing:
            await asyncio.wait(set(self._writing))

    def found(self, rig: Rig) -> Found:
        """Return what is to be in force: the newest of the store, or the one it could not take."""
        if self._unwritten is not None:
            store, calibration = self._unwritten
            if store == rig.calibration_store and calibration.fits(rig.chain):
                text = (
                    "the calibration in force goes on, but it is not stored: a restart forgets it"
                )
                return Found(calibration, None, (text,))
        return calibrations.stored(rig)
