"""Processing of recordings: replay, arrays of a session, verification and offline calibration."""

from jointfit_daemon.reprocessing._errors import ReprocessingError
from jointfit_daemon.reprocessing._offline_calibration import (
    OfflineCalibration,
    calibrate_recording,
)
from jointfit_daemon.reprocessing._processing import Changes, process_events
from jointfit_daemon.reprocessing._session import load_calibration, load_session, recorded_rig
from jointfit_daemon.reprocessing._verification import (
    Difference,
    TolerantComparison,
    Verification,
    verify_recording,
)

__all__ = [
    "Changes",
    "Difference",
    "OfflineCalibration",
    "ReprocessingError",
    "TolerantComparison",
    "Verification",
    "calibrate_recording",
    "load_calibration",
    "load_session",
    "process_events",
    "recorded_rig",
    "verify_recording",
]
