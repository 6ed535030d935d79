"""Input events and outputs of the core, as frozen data.

Invariant: only input events change the core. If a log of the input events is fed to a new core, the
outputs are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_daemon.model import (
    ChainModelState,
    LimbState,
    OpticalState,
    RunningCenters,
    SensorStates,
    StickFigure,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration import CalibrationJob, FitResult
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chunk

# --- input events -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Configured:
    """A configuration was loaded. This is the first event, and it is repeated at every reload."""

    t_ns: int
    rig: Rig
    calibration: Calibration | None
    """Calibration to use: the newest stored one, or a newer one that is not written yet; None
    without a calibration."""
    calibration_version: int | None = None
    calibration_age_s: float = 0.0
    """Time since the calibration was stored, s. The heading uncertainty grows with this time."""


@dataclass(frozen=True, slots=True)
class SourceOpened:
    """A driver started. A new decoder processes its chunks."""

    t_ns: int
    source: str


@dataclass(frozen=True, slots=True)
class SourceClosed:
    """A driver ended because the device is lost, misconfigured, or removed by a reload.

    The driver of a lost device is started again soon, and the driver of a misconfigured device
    after a pause. The driver of a removed device is not started again.
    """

    t_ns: int
    source: str
    reason: Literal["lost", "misconfigured", "removed"]
    text: str


@dataclass(frozen=True, slots=True)
class ChunkArrived:
    """Bytes of one source arrived."""

    source: str
    chunk: Chunk


@dataclass(frozen=True, slots=True)
class Tick:
    """No other event arrived before a deadline of the core, or within 100 ms."""

    t_ns: int


class ReplyAddress(NamedTuple):
    """Topic and correlation data that a client requests for the reply to its request (MQTT 5)."""

    topic: str | None = None
    """Full name of the topic; None selects ``bridge/response/COMMAND``."""
    correlation: bytes | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """A request of a client, with validated arguments."""

    t_ns: int
    command: str
    """Name of the request. The core processes ``calibrate``, ``static`` and ``mark``."""
    transaction: str
    arguments: Mapping[str, object]
    reply_to: ReplyAddress = field(default_factory=ReplyAddress)
    """Destination of the reply. A recording does not contain the destination."""

    def refusal(self, key: str, message: str) -> Reply:
        """Return the reply that refuses this request because of a single fault."""
        return self.reply("error", {}, {"key": key, "message": message})

    def reply(
        self,
        status: Literal["ok", "accepted", "error"],
        data: Mapping[str, object],
        error: Mapping[str, object] | None = None,
    ) -> Reply:
        """Return the reply to this request."""
        return Reply(self.command, self.transaction, status, data, error, self.reply_to)


@dataclass(frozen=True, slots=True)
class CalibrationSelected:
    """A stored calibration was loaded for the request ``use-calibration``."""

    t_ns: int
    calibration: Calibration
    version: int
    """Version of the loaded calibration."""
    age_s: float
    """Time since the calibration was stored, s. The heading uncertainty grows with this
    time."""
    request: Request


@dataclass(frozen=True, slots=True)
class JobFinished:
    """The worker finished a job with a result or an error."""

    t_ns: int
    job: int
    result: FitResult | None
    error: str | None

    @property
    def failure(self) -> str | None:
        """Reason why there is no usable result; None if the result is usable."""
        if self.result is None:
            return self.error or "no result"
        return self.error or self.result.refused


@dataclass(frozen=True, slots=True)
class JobProgress:
    """The worker reported the progress of a job, at most five times a second."""

    t_ns: int
    job: int
    progress: float
    """Share of the job that is done, 0 to 1."""
    text: str


@dataclass(frozen=True, slots=True)
class CalibrationStored:
    """The calibration of the last ``CalibrationReady`` was stored."""

    t_ns: int
    version: int
    created_utc: str = ""
    """Date of the stored calibration, ISO 8601; empty if unknown."""


@dataclass(frozen=True, slots=True)
class UnixOffset:
    """Offset of UNIX time from CLOCK_MONOTONIC, at the start and whenever the offset changes.

    Both clocks have the same rate. A change means that UNIX time was set, or that the host was
    suspended.
    """

    t_ns: int
    offset_ns: int


Event = (
    Configured
    | SourceOpened
    | SourceClosed
    | ChunkArrived
    | Tick
    | Request
    | CalibrationSelected
    | JobFinished
    | JobProgress
    | CalibrationStored
    | UnixOffset
)

# --- outputs ----------------------------------------------------------------------------------


class NoticeKind(StrEnum):
    """Subject of a notice, published as the key ``kind`` on the MQTT topic ``bridge/event``."""

    DEVICE = "device"
    SENSOR = "sensor"
    MARKER = "marker"
    CLOCK = "clock"
    WIRE = "wire"
    CALIBRATION = "calibration"
    RELOAD = "reload"
    RECORDING = "recording"
    METRICS = "metrics"
    LSL = "lsl"
    """The streams of the Lab Streaming Layer."""
    STATE = "state"
    """The state directory."""
    MARK = "mark"
    """A label that a client set for an instant."""


class NoticeLevel(StrEnum):
    """Severity of a notice."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Notice:
    """A change that is logged and published on the MQTT topic ``bridge/event``."""

    t_ns: int
    kind: NoticeKind
    id: str
    """Name of the subject, such as a device, a rig, a marker or a calibration phase."""
    text: str
    level: NoticeLevel = NoticeLevel.INFO
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """Availability of one device; published as a retained message."""

    id: str
    online: bool


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Information that a device reported about itself; published as a retained message."""

    id: str
    data: Mapping[str, object]


class CalibrationPhase(StrEnum):
    """Phases of the calibration session."""

    UNCALIBRATED = "uncalibrated"
    ALIGN = "align"
    ALIGNED = "aligned"
    STATIC = "static"
    POSED = "posed"
    FUNCTIONAL = "functional"
    FITTING = "fitting"
    CALIBRATED = "calibrated"
    ABORTED = "aborted"


@dataclass(frozen=True, slots=True)
class CalibrationStatus:
    """Phase and quality of the calibration; published as a retained message."""

    t_ns: int
    phase: CalibrationPhase
    text: str
    version: int | None = None
    """Version of the current calibration; None if there is none, or if it is not stored."""
    quality: Mapping[str, object] = field(default_factory=dict)
    """Quality of the last phase's result, or of the current calibration if there is no result."""
    kept: str | None = None
    """Reason why a new result was rejected, so that the current calibration stays in use."""
    refused: Mapping[str, object] = field(default_factory=dict)
    """Quality of the rejected result."""
    done: tuple[CalibrationPhase, ...] = ()
    """Recorded phases whose results the functional phase uses."""
    created_utc: str | None = None
    """Date of the current version, ISO 8601; None if there is no version or its date is
    unknown."""

    @property
    def level(self) -> NoticeLevel:
        """Level of the event: warning for a rejected result or an aborted phase."""
        aborted = self.phase == CalibrationPhase.ABORTED
        return NoticeLevel.WARNING if aborted or self.kept is not None else NoticeLevel.INFO


@dataclass(frozen=True, slots=True)
class CalibrationProgress:
    """Progress of the running phase, at most five times a second."""

    t_ns: int
    phase: CalibrationPhase
    progress: float
    """Completed share of the phase, 0 to 1."""
    text: str
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FitJob:
    """A job for the worker process."""

    job: int
    """Number of the job. Numbers are never reused."""
    work: CalibrationJob


@dataclass(frozen=True, slots=True)
class CancelJob:
    """The result of this job is no longer needed, so the worker must be stopped."""

    job: int


@dataclass(frozen=True, slots=True)
class CalibrationReady:
    """A calibration that must be stored. The supervisor answers with `CalibrationStored`."""

    calibration: Calibration
    keep_date: bool = False
    """Whether ``created_utc`` is kept, because the calibration is a copy of a stored
    calibration."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to a request. Every request has exactly one reply."""

    command: str
    transaction: str
    status: Literal["ok", "accepted", "error"]
    data: Mapping[str, object] = field(default_factory=dict)
    error: Mapping[str, object] | None = None
    reply_to: ReplyAddress = field(default_factory=ReplyAddress)


Output = (
    LimbState
    | OpticalState
    | ChainModelState
    | SensorStates
    | RunningCenters
    | StickFigure
    | Notice
    | DeviceStatus
    | DeviceInfo
    | CalibrationStatus
    | CalibrationProgress
    | FitJob
    | CancelJob
    | CalibrationReady
    | Reply
)
