"""Processing of recordings: replay, arrays of a session, verification and offline calibration."""

from jointfit_daemon.reprocessing._errors import ReprocessingError
from jointfit_daemon.reprocessing._processing import Changes, process_events
from jointfit_daemon.reprocessing._session import load_session

__all__ = ["Changes", "ReprocessingError", "load_session", "process_events"]
