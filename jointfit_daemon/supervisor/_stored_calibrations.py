"""The calibration store as the daemon uses it. Law: a bad file costs a calibration, not the run."""

from __future__ import annotations

import dataclasses
import datetime
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.calibration.record import CalibrationFileError, CalibrationStore
from jointfit_daemon.supervisor.state_directory import state_directory

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration


class Found(NamedTuple):
    """What the store has for a rig."""

    calibration: Calibration | None
    version: int | None
    complaints: tuple[str, ...]


def store_of(rig: Rig) -> CalibrationStore:
    """Return the rig's store."""
    return CalibrationStore(state_directory() / "calibrations", rig.calibration_store)


def stored(rig: Rig) -> Found:
    """Return the newest calibration that belongs to the rig's limb; never raises for a bad file."""
    try:
        latest = store_of(rig).latest()
    except (CalibrationFileError, OSError) as error:
        return Found(None, None, (f"no stored calibration can be read: {error}",))
    if latest is None:
        return Found(None, None, ())
    if not latest.calibration.fits(rig.chain):
        text = (
            f"version {latest.version} in store {rig.calibration_store!r} is of another limb or "
            "other sensors than rig.toml: calibrate again, or name its own store"
        )
        return Found(None, None, (*latest.notes, text))
    return Found(latest.calibration, latest.version, latest.notes)


def age_of(calibration: Calibration, now: datetime.datetime | None = None) -> float:
    """Return how long ago a calibration was stored, s; 0 where that is not known or not past."""
    try:
        then = datetime.datetime.fromisoformat(calibration.created_utc)
        elapsed = (now or datetime.datetime.now(datetime.UTC)) - then
    except (ValueError, TypeError):  # no date, or one without its zone
        return 0.0
    return max(0.0, elapsed.total_seconds())


def save(rig: Rig, calibration: Calibration) -> int:
    """Write a new version, with the date, and return its number.

    Raises
    ------
    OSError
        The medium is full, read-only or gone.
    """
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return store_of(rig).save(dataclasses.replace(calibration, created_utc=now))
