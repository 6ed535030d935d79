"""State of the core's inputs, from which a replay starts at the beginning or after a gap."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import orjson

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording._event_json import encode_json
from jointfit_daemon.outputs.recording._part_file import RecordedAttachment
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationSelected,
    CalibrationStored,
    ChunkArrived,
    Configured,
    SourceClosed,
    SourceOpened,
    UnixOffset,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.outputs.recording._event_json import UnchunkedEvent
    from jointfit_daemon.pipeline.events import Event, Output


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Configuration, calibration, open sources and UNIX time offset at one instant.

    The chunks that describe the data of the sources, such as lists of marker names, are included.
    """

    configured: Configured | None = None
    """The configuration and the current calibration."""
    calibrated_t_ns: int = 0
    """Instant to which `Configured.calibration_age_s` refers, CLOCK_MONOTONIC ns."""
    unix_offset_ns: int | None = None
    opened: Mapping[str, SourceOpened] = field(default_factory=lambda: MappingProxyType({}))
    """Open sources by their id."""
    descriptions: Mapping[str, tuple[bytes, ...]] = field(
        default_factory=lambda: MappingProxyType({})
    )
    """For each open source, the chunks that a new decoder needs before all others."""

    def after_event(self, event: Event) -> Snapshot:
        """Return the state after an input event."""
        found = self
        match event:
            case Configured():
                found = replace(self, configured=event, calibrated_t_ns=event.t_ns)
            case UnixOffset():
                found = replace(self, unix_offset_ns=event.offset_ns)
            case SourceOpened():
                found = replace(self, opened=MappingProxyType({**self.opened, event.source: event}))
            case SourceClosed():
                rest = {key: one for key, one in self.opened.items() if key != event.source}
                found = replace(self, opened=MappingProxyType(rest))
            case CalibrationSelected() if self.configured is not None:
                configured = replace(
                    self.configured,
                    calibration=event.calibration,
                    calibration_version=event.version,
                    calibration_age_s=event.age_s,
                )
                found = replace(self, configured=configured, calibrated_t_ns=event.t_ns)
            case CalibrationStored() if self.configured is not None:
                configured = replace(self.configured, calibration_version=event.version)
                found = replace(self, configured=configured)
        return found

    def after_output(self, output: Output, t_ns: int) -> Snapshot:
        """Return the state after an output; `t_ns` is the stamp of the event before the output."""
        if not isinstance(output, CalibrationReady) or self.configured is None:
            return self
        configured = replace(self.configured, calibration=output.calibration, calibration_age_s=0.0)
        return replace(self, configured=configured, calibrated_t_ns=t_ns)

    def events(self, t_ns: int) -> list[UnchunkedEvent | ChunkArrived]:
        """Return the events that restore this state at `t_ns`."""
        found: list[UnchunkedEvent | ChunkArrived] = []
        if self.configured is not None:
            age_s = self.configured.calibration_age_s
            if self.configured.calibration is not None:
                age_s += max(0, t_ns - self.calibrated_t_ns) * 1e-9
            found.append(replace(self.configured, t_ns=t_ns, calibration_age_s=age_s))
        if self.unix_offset_ns is not None:
            found.append(UnixOffset(t_ns, self.unix_offset_ns))
        found += [replace(event, t_ns=t_ns) for event in self.opened.values()]
        found += [
            ChunkArrived(source, Chunk(t_ns, data))
            for source in self.opened
            for data in self.descriptions.get(source, ())
        ]
        return found

    def attachments(self) -> list[RecordedAttachment]:
        """Return the configuration and the calibration as documents."""
        if self.configured is None:
            return []
        rig, calibration = self.configured.rig, self.configured.calibration
        found = [("rig.json", orjson.dumps(rig.table, option=orjson.OPT_INDENT_2))]
        if calibration is not None:
            found.append(("calibration.json", encode_json(calibration)))
        return [RecordedAttachment(name, "application/json", data) for name, data in found]


SNAPSHOT_TYPES = (
    Configured,
    UnixOffset,
    SourceOpened,
    SourceClosed,
    CalibrationSelected,
    CalibrationStored,
)
"""Types of the events that change a snapshot."""
