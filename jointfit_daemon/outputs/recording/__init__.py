"""Recording of all inputs of the core, and their decoding for a replay."""

from jointfit_daemon.outputs.recording._event_log import (
    EventLogWriter,
    RecordingHealth,
    encode_state,
    read_events,
    read_states,
)

__all__ = ["EventLogWriter", "RecordingHealth", "encode_state", "read_events", "read_states"]
