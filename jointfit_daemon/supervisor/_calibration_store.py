"""Stored calibrations of the running rig: loading, and writing in the background.

Invariant: an unreadable calibration file does not stop the daemon. The core and a reload use the
same calibration, even while a write is pending or after it failed. A failed write of a calibration
is repeated.
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime
import time
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.calibration.record import CalibrationFileError, CalibrationStore
from jointfit_daemon.pipeline.events import CalibrationStored
from jointfit_daemon.supervisor.state_directory import (
    WRITE_REMEDY,
    describe_write_error,
    state_directory,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event

RETRY_S = 10.0
"""Interval between attempts to write a calibration after a failed attempt, s."""


class LoadedCalibration(NamedTuple):
    """Calibration of a rig, loaded from the store."""

    calibration: Calibration | None
    """Newest readable calibration; None if there is none, or if it does not fit the rig."""
    version: int | None
    """Number of the calibration in the store; None without a calibration."""
    warnings: tuple[str, ...]
    """Descriptions of faults in the stored files, for the log and ``bridge/event``."""


def store_of(rig: Rig) -> CalibrationStore:
    """Return the calibration store of the rig."""
    return CalibrationStore(state_directory() / "calibrations", rig.calibration_store)


def store_directory(rig: Rig) -> Path:
    """Return the folder of the calibration store of the rig."""
    return state_directory() / "calibrations" / rig.calibration_store


def load_latest(rig: Rig) -> LoadedCalibration:
    """Return the newest readable calibration if it fits the rig's chain and sensors, else none."""
    try:
        latest = store_of(rig).latest()
    except (CalibrationFileError, OSError) as error:
        text = f"no stored calibration can be read: {error}"
        return LoadedCalibration(None, None, (text,))

    if latest is None:
        return LoadedCalibration(None, None, ())
    if not latest.calibration.fits(rig.chain):
        text = (
            f"version {latest.version} in store {rig.calibration_store!r} belongs to another limb "
            "or other sensors than rig.toml: calibrate again, or set another [calibration] store"
        )
        return LoadedCalibration(None, None, (*latest.notes, text))
    return LoadedCalibration(latest.calibration, latest.version, latest.notes)


def calibration_age_s(calibration: Calibration, now: datetime.datetime | None = None) -> float:
    """Return the time since a calibration was stored, s; 0 for unknown and future dates."""
    try:
        then = datetime.datetime.fromisoformat(calibration.created_utc)
        elapsed = (now or datetime.datetime.now(datetime.UTC)) - then
    except (ValueError, TypeError):  # no date, or a date without time zone
        return 0.0
    return max(0.0, elapsed.total_seconds())


def save(rig: Rig, calibration: Calibration, *, keep_date: bool = False) -> int:
    """Write `calibration` as a new version and return the number of this version.

    The stored calibration gets the current date, unless `keep_date` is true.

    Raises
    ------
    OSError
        The storage medium is full, read-only or absent.
    """
    if keep_date:
        return store_of(rig).save(calibration)
    return store_of(rig).save(_with_present_date(calibration))


def _with_present_date(calibration: Calibration) -> Calibration:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return dataclasses.replace(calibration, created_utc=now)


class CalibrationWriter:
    """Writes calibrations one after another in a thread, and feeds `CalibrationStored` to the core.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        Task group that owns the task of every write.
    deliver : callable
        Function that feeds one event to the core.
    report : callable
        Function that reports a failed write. It is called once for each reason.
    """

    def __init__(
        self,
        tasks: asyncio.TaskGroup,
        deliver: Callable[[Event], None],
        report: Callable[[str], None],
    ) -> None:
        self._tasks, self._deliver, self._report = tasks, deliver, report
        self._lock = asyncio.Lock()
        self._writing: set[asyncio.Task[None]] = set()
        self._unwritten: tuple[Rig, Calibration, bool] | None = None
        self._next_try: asyncio.TimerHandle | None = None
        self._store = ""
        self.fault: str | None = None
        """Reason why the current calibration is not stored; None if it is stored."""

    def start(self, rig: Rig, calibration: Calibration, *, keep_date: bool = False) -> None:
        """Write a new version to the store of the rig; `keep_date` is described at `save`."""
        self._unwritten, self._store = (rig, calibration, keep_date), rig.calibration_store
        self._begin(*self._unwritten)

    def retry(self) -> None:
        """Repeat a failed write at once; do nothing if no write has failed."""
        if self._next_try is not None:
            self._next_try.cancel()
            self._next_try = None
        if self._unwritten is not None and not self._writing:
            self._begin(*self._unwritten)

    def _begin(self, rig: Rig, calibration: Calibration, keep_date: bool) -> None:
        writing = self._write(rig, calibration, keep_date=keep_date)
        task = self._tasks.create_task(writing, name="store")
        self._writing.add(task)
        task.add_done_callback(self._writing.discard)

    def stop(self) -> None:
        """Cancel further attempts. A write in progress is completed."""
        self._unwritten = None
        if self._next_try is not None:
            self._next_try.cancel()

    async def _write(self, rig: Rig, calibration: Calibration, *, keep_date: bool) -> None:
        async with self._lock:
            dated = calibration if keep_date else _with_present_date(calibration)
            try:
                version = await asyncio.to_thread(save, rig, dated, keep_date=True)
            except OSError as error:
                if (fault := describe_write_error(error, store_directory(rig))) != self.fault:
                    self.fault = fault
                    self._report(
                        f"in force but not stored: {fault}. It would be lost at a restart: "
                        f"{WRITE_REMEDY}; retrying every {RETRY_S:g} s"
                    )
                if self._next_try is None:
                    loop = asyncio.get_running_loop()
                    self._next_try = loop.call_later(RETRY_S, self.retry)
                return
            newest = self._unwritten is None or self._unwritten[1] is calibration
            if newest:
                self._unwritten = self.fault = None

        # `version` is not the version of the current calibration if a newer calibration is in
        # use, or if a reload selected another store.
        if newest and rig.calibration_store == self._store:
            self._deliver(CalibrationStored(time.monotonic_ns(), version, dated.created_utc))

    async def settle(self) -> None:
        """Wait until no write is in progress."""
        while self._writing:
            await asyncio.wait(set(self._writing))

    def load(self, rig: Rig) -> LoadedCalibration:
        """Return the calibration to use: the newest stored or a newer unwritten calibration."""
        self._store = rig.calibration_store
        if self._unwritten is not None:
            asked, calibration, _ = self._unwritten
            same_store = asked.calibration_store == rig.calibration_store
            if same_store and calibration.fits(rig.chain):
                text = (
                    "the calibration in force is still used, but it is not stored: a restart would "
                    "lose it"
                )
                return LoadedCalibration(calibration, None, (text,))
        return load_latest(rig)
