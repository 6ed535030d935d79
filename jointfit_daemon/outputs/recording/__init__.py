"""Recordings: all inputs and outputs of the core in MCAP files, with writer and reader."""

from jointfit_daemon.outputs.recording._blocks import RecordingError
from jointfit_daemon.outputs.recording._channels import (
    DAEMON_HEALTH,
    DAEMON_NOTICE,
    STATE,
    encode_output,
)
from jointfit_daemon.outputs.recording._description import RecordingGap, RecordingInfo
from jointfit_daemon.outputs.recording._event_json import decode_event, encode_event, encode_state
from jointfit_daemon.outputs.recording._reader import (
    RecordedMessage,
    RecordedPart,
    Recording,
    open_recording,
    read_events,
)
from jointfit_daemon.outputs.recording._recorder import Recorder, RecordingHealth
from jointfit_daemon.outputs.recording._repair import RepairResult, repair_recording
from jointfit_daemon.outputs.recording._session_writer import (
    PROGRAM,
    RecordingLimits,
    RecordingReport,
)

__all__ = [
    "DAEMON_HEALTH",
    "DAEMON_NOTICE",
    "PROGRAM",
    "STATE",
    "RecordedMessage",
    "RecordedPart",
    "Recorder",
    "Recording",
    "RecordingError",
    "RecordingGap",
    "RecordingHealth",
    "RecordingInfo",
    "RecordingLimits",
    "RecordingReport",
    "RepairResult",
    "decode_event",
    "encode_event",
    "encode_output",
    "encode_state",
    "open_recording",
    "read_events",
    "repair_recording",
]
