"""Virtual devices that send the bytes of a recording at the recorded times."""

from jointfit_simulators.recorded._recorded_devices import RecordedCameras
from jointfit_simulators.recorded._recorded_scene import RecordedScene
from jointfit_simulators.recorded._session_file import (
    RecordedSession,
    UnplayableRecordingError,
    read_session_chunks,
)

__all__ = [
    "RecordedCameras",
    "RecordedScene",
    "RecordedSession",
    "UnplayableRecordingError",
    "read_session_chunks",
]
