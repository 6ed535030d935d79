"""Models of states, events, and answers."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field

from jointfit_daemon.outputs.mqtt import LinkHealth  # noqa: TC001 - pydantic reads it
from jointfit_daemon.outputs.payload_models._streams import Number, Payload, Table, Time
from jointfit_daemon.outputs.spool import SpoolHealth  # noqa: TC001 - pydantic reads it
from jointfit_daemon.pipeline.events import (  # noqa: TC001 - pydantic reads them
    CalibrationPhase,
    NoticeKind,
    NoticeLevel,
)


class State(Payload):
    """``bridge/state`` and ``device/ID/availability``."""

    state: Literal["online", "offline"]


class InfoDevice(Table):
    """One device of the rig."""

    kind: Literal["imu", "mocap"]
    driver: str
    segment: str | None


class InfoConnection(Table):
    """One joint of a branched limb."""

    parent: str
    child: str | None
    side: Literal["left", "right"]


class Info(Payload):
    """``bridge/info``."""

    software: str
    rig: str
    config_sha256: str
    output_rate_hz: float
    side: Literal["left", "right", "both"]
    connections: dict[str, InfoConnection] | None = Field(
        None, description="joints of a branched limb, whose side is `both`"
    )
    joints: list[str]
    angles: dict[str, str] = Field(description="angle convention by joint")
    segments: list[str]
    sensors: dict[str, list[str]] = Field(description="sensors by segment")
    devices: dict[str, InfoDevice]
    quaternions: str
    world: str
    pose_bin: None


class Delays(Table):
    """Quantiles of a delay, µs."""

    p50: Number
    p99: Number
    max: Number


class DeviceCounts(Table):
    """Counters and clock of one device."""

    online: bool
    received: int
    used: int
    decimated: int
    idle: int
    late: int
    duplicate: int
    dropped: int
    pending: int
    corrupt: int
    discarded_bytes: int
    lost: int
    restarts: int
    reconnects: int
    last_age_ms: Number
    clock: Literal["settling", "direct", "echo", "passive", "arrival", "stale"]
    epoch: int
    offset_us: Number
    skew_ppm: Number
    sigma_us: Number
    bound_us: Number
    latency_prior_us: list[Number]
    jitter_us: Number
    delay_us: Delays | None
    rate_hz: Number
    sensor: Literal["absent", "ok", "lost", "stuck"] | None = Field(
        None, description="state of an IMU in fusion"
    )
    orientation_filter: dict[str, Any] | None = None


class Lag(Table):
    """Lag of one sensor behind the cameras."""

    lag_ms: Number
    lag_sigma_ms: Number
    lag_source: Literal["none", "calibration", "configured"]
    lag_found_by: str | None
    tracked_ms: Number
    tracked_sigma_ms: Number
    tracked_drift_ppm: Number
    tracked_refused: str | None


class Learning(Table):
    """State of online learning."""

    state: Literal["off", "waiting", "learning", "stopped"]
    reason: str | None
    stopped_s: Number
    kept: int


class Frames(Table):
    """Numbers of frames since the start of the daemon."""

    sent: int
    empty: int
    skipped: int


class CalibrationInForce(Table):
    """Phase of calibration, and version of the calibration in force."""

    phase: CalibrationPhase
    version: int | None


class Process(Table):
    """Load and memory of the daemon's process."""

    cpu_pct: float
    rss_bytes: int | None
    loop_delay_p99_ms: Number


class Latency(Table):
    """Latency of the frames since the last health message, by stage."""

    frames: int
    decoded_us: Delays | None
    aligned_us: Delays | None
    fused_us: Delays | None
    encoded_us: Delays | None
    written_us: Delays | None
    total_us: Delays | None = Field(description="all stages together")


class StateFaults(Table):
    """Reasons why the daemon cannot store data; null without a fault."""

    fault: str | None
    not_stored: str | None


class RecordingState(Table):
    """State of the present recording, or of the last recording if none is active."""

    file: str
    duration_s: float
    written_bytes: int
    backlog_bytes: int
    lost: int
    failure: str | None
    free_bytes: int | None
    active: bool


class Health(Payload):
    """``bridge/health``."""

    t_us: Time
    devices: dict[str, DeviceCounts]
    calibration: CalibrationInForce
    fusion: dict[str, Any]
    lags: dict[str, Lag]
    frames: Frames
    learning: Learning
    process: Process
    link: LinkHealth
    state: StateFaults
    recording: RecordingState | None = None
    spool: SpoolHealth | None = None
    latency: Latency | None = None


class EventMessage(Payload):
    """``bridge/event``."""

    t_us: Time
    kind: NoticeKind
    id: str
    level: NoticeLevel
    text: str
    data: dict[str, Any]


class LogLine(Payload):
    """``bridge/log``."""

    t_us: Time
    level: str
    logger: str
    text: str
    suppressed: int


class CalibrationState(Payload):
    """``calibration``."""

    t_us: Time
    phase: CalibrationPhase
    text: str
    version: int | None
    created_utc: str | None = Field(description="date of the version, ISO 8601")
    kept: str | None
    done: list[CalibrationPhase] = Field(
        description="recorded phases whose results the functional phase uses"
    )
    quality: dict[str, Any]


class Progress(Payload):
    """``calibration/progress``."""

    t_us: Time
    phase: CalibrationPhase
    progress: float = Field(ge=0, le=1)
    text: str
    data: dict[str, Any]


class DeviceFacts(Payload):
    """``device/ID/info``: keys that the device reports; they depend on the driver."""

    model_config = ConfigDict(extra="allow")


class RequestFault(Table):
    """One fault of a request."""

    key: str
    message: str


class Error(Table):
    """Error of a request."""

    key: str
    message: str
    faults: list[RequestFault]
    more: int = Field(description="number of faults beyond those listed")


class Response(Payload):
    """``bridge/response/COMMAND``."""

    transaction: str
    status: Literal["ok", "accepted", "error"]
    data: dict[str, Any]
    error: Error | None
