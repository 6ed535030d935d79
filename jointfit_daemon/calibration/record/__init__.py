"""Stored calibrations: the versioned store, the check of their content and the digest of trials."""

from jointfit_daemon.calibration.record._store import (
    MOST_BYTES,
    CalibrationFileError,
    CalibrationStore,
    calibration_of,
    calibration_text,
)
from jointfit_daemon.calibration.record._trial_digest import trials_digest

__all__ = [
    "MOST_BYTES",
    "CalibrationFileError",
    "CalibrationStore",
    "calibration_of",
    "calibration_text",
    "trials_digest",
]
