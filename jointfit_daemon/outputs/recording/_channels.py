"""Channels of a recording: names, schemas, and the encoding of events and outputs.

channel         content                                              encoding
source/ID       one chunk of a source, as it arrived                 bytes
event/KIND      every other input event of the core                  JSON
output/KIND     outputs of the core: `OUTPUT_KINDS`                  JSON
daemon/KIND     health and notices of the daemon outside the core    JSON
snapshot/KIND   events that restore the state at the start of a file or after a gap; KIND can be
                source/ID, for the chunks that describe the data of a source
recording/gap   messages that could not be written to the disk
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple

import orjson

from jointfit_daemon.model import ChainModelState, LimbState, OpticalState
from jointfit_daemon.outputs.recording._event_json import (
    EVENT_KINDS,
    encode_json,
    encode_state,
)
from jointfit_daemon.pipeline.events import (
    CalibrationStatus,
    DeviceInfo,
    DeviceStatus,
    Notice,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Output

PROFILE = "jointfit"
"""Profile in the header of the file."""
FORMAT = 1
"""Version of the channels and metadata. A reader rejects later versions."""
RECORDING_METADATA = "jointfit.recording"
"""Name of the metadata record that describes the file."""
CHANNEL_METADATA = "jointfit.channel"
"""Name of the metadata records that repeat the definition of a channel outside of chunks."""
END_METADATA = "jointfit.end"
"""Name of the metadata record that is written when a file is closed."""

SOURCE, EVENT, SNAPSHOT = "source/", "event/", "snapshot/"
GAP = "recording/gap"
DAEMON_NOTICE, DAEMON_HEALTH = "daemon/notice", "daemon/health"
OUTPUT_KINDS: dict[type, str] = {
    LimbState: "output/state",
    OpticalState: "output/optical",
    ChainModelState: "output/coordinates",
    Notice: "output/notice",
    CalibrationStatus: "output/calibration",
    DeviceStatus: "output/device",
    DeviceInfo: "output/device-info",
}
"""Channel of each recorded output."""
STATE = OUTPUT_KINDS[LimbState]
EVENT_CHANNELS = {event: EVENT + kind for event, kind in EVENT_KINDS.items()}


def encode_output(output: Output) -> tuple[str, bytes] | None:
    """Return channel and content of an output; None if the output is not recorded."""
    channel = OUTPUT_KINDS.get(type(output))
    if channel is None:
        return None
    return channel, _ENCODERS.get(channel, encode_json)(output)


_ENCODERS: dict[str, Callable[[Any], bytes]] = {STATE: encode_state}


_FILE_NAME = re.compile(r"(?P<rig>.+)-\d{8}T\d{6}-\d{4,}\.mcap(\.part)?")


def recorded_rig_name(file_name: str) -> str | None:
    """Return the name of the rig from the name of a recording; None for other files."""
    match = _FILE_NAME.fullmatch(file_name)
    return None if match is None else match["rig"]


class ChannelForm(NamedTuple):
    """Description of one channel in the MCAP file."""

    encoding: str
    """Message encoding."""
    schema: str
    """Name of the schema; empty if there is none."""
    metadata: dict[str, str]
    """Metadata of the channel, such as ``clock`` and ``stamp_means``."""


def channel_form(channel: str) -> ChannelForm:
    """Return the description of the channel with this name."""
    if channel.removeprefix(SNAPSHOT).startswith(SOURCE):
        return ChannelForm("application/octet-stream", "", {**_CLOCK, "stamp_means": _CHUNK_STAMP})
    kind = channel.removeprefix(SNAPSHOT).removeprefix(EVENT)
    stamp = _STAMPS.get(channel, _PROCESSED)
    return ChannelForm("json", f"jointfit.{kind}", {**_CLOCK, "stamp_means": stamp})


_CLOCK = {"clock": "CLOCK_MONOTONIC of the host plus unix_offset_ns of the file"}
_CHUNK_STAMP = (
    "log_time: arrival at the host; for a serial line, arrival of the first byte; "
    "publish_time: equal to log_time, because only the decoder knows the instants of the samples"
)
_PROCESSED = "log_time: arrival of the event that was being processed; publish_time: its own stamp"
_STAMPS = {
    STATE: "log_time: arrival of the sample, or the deadline, that completed the frame; "
    "publish_time: instant of the frame",
    "output/optical": _PROCESSED.replace("its own stamp", "instant of the camera frame"),
}


def schema_of(name: str) -> bytes:
    """Return the JSON Schema of a channel; `name` is the attribute `ChannelForm.schema`."""
    kind = name.removeprefix("jointfit.")
    fields = {key: _TYPES[letter] for key, letter in _FIELDS.get(kind, {}).items()}
    required = [key for key, letter in _FIELDS.get(kind, {}).items() if letter.islower()]
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": name,
        "type": "object",
        "properties": fields,
        "required": required,
    }
    return orjson.dumps(schema)


_TYPES: dict[str, dict[str, Any]] = {
    "i": {"type": "integer"}, "I": {"type": ["integer", "null"]}, "n": {"type": "number"},
    "s": {"type": "string"}, "S": {"type": ["string", "null"]}, "b": {"type": "boolean"},
    "o": {"type": "object"}, "O": {"type": ["object", "null"]}, "a": {"type": "array"},
}  # fmt: skip
"""Types of fields. A lower-case letter means that the value is never null."""
_FIELDS: dict[str, dict[str, str]] = {
    "tick": {"t_ns": "i"},
    "configured": {
        "t_ns": "i",
        "table": "o",
        "output_rate_hz": "n",
        "calibration": "O",
        "calibration_version": "I",
        "calibration_age_s": "n",
    },
    "opened": {"t_ns": "i", "source": "s"},
    "closed": {"t_ns": "i", "source": "s", "reason": "s", "text": "s"},
    "request": {"t_ns": "i", "command": "s", "transaction": "s", "arguments": "o"},
    "selected": {"t_ns": "i", "calibration": "o", "version": "i", "age_s": "n", "request": "o"},
    "job": {"t_ns": "i", "job": "i", "result": "O", "error": "S"},
    "progress": {"t_ns": "i", "job": "i", "progress": "n", "text": "s"},
    "stored": {"t_ns": "i", "version": "i"},
    "unix": {"t_ns": "i", "offset_ns": "i"},
    "output/state": {
        "seq": "i",
        "t_ns": "i",
        "completed_ns": "i",
        "mode": "s",
        "sync": "s",
        "flags": "a",
        "segments": "a",
        "joints": "a",
    },
    "output/optical": {"number": "i", "t_ns": "i", "segments": "a", "joints": "a"},
    "output/notice": {
        "t_ns": "i",
        "kind": "s",
        "id": "s",
        "text": "s",
        "level": "s",
        "data": "o",
    },
    "output/calibration": {"t_ns": "i", "phase": "s", "text": "s", "version": "I", "quality": "o"},
    "output/device": {"id": "s", "online": "b"},
    "output/device-info": {"id": "s", "data": "o"},
    "recording/gap": {
        "first_sequence": "i",
        "count": "i",
        "from_t_ns": "i",
        "to_t_ns": "i",
        "reason": "s",
    },
}
"""Fields of the JSON channels, by the name of the schema. Any other schema permits every object."""
