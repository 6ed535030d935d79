"""Counters and states of the core: devices, clocks, lags, frames and online learning.

Times are in nanoseconds. `jointfit_daemon.outputs.payloads` converts them for the MQTT topic
``bridge/health``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import CalibrationPhase

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.fusion.faults import SensorState
    from jointfit_daemon.timing.clock import DelayPercentiles
    from jointfit_daemon.timing.lag import TrackedLag

MOST_LOST = 0.01
"""Largest share of lost samples without a warning. The self-test also counts runs of corrupt
bytes."""


@dataclass(slots=True)
class WireCounts:
    """Counts since the daemon started. They continue if a reconnect replaces the decoder."""

    received: int = 0
    """Number of decoded samples."""
    corrupt: int = 0
    """Number of runs of discarded bytes."""
    discarded_bytes: int = 0
    lost: int = 0
    """Number of missing samples, according to the sequence numbers of the device."""
    restarts: int = 0
    """Number of restarts of the device, reported by the device or detected from its clock. A
    reconnected device counts as restarted unless its clock continued."""
    opened: int = 0
    """Number of times the source was opened. All openings after the first are reconnects."""


@dataclass(frozen=True, slots=True)
class ClockHealth:
    """State of the clock of one device."""

    state: str
    epoch: int
    """Number of restarts and jumps of the clock."""
    offset_ns: int | None
    """Host time minus device time at the last sample, ns; None if unknown."""
    skew_ppm: float | None
    sigma_ns: float | None
    """Standard deviation of the last stamp, ns."""
    bound_ns: float | None
    """Limit of the constant error of the stamps, ns; None if the device sends no echoes."""
    latency_ns: int
    """Prior mean of the smallest delay from sampling to arrival, ns."""
    latency_sd_ns: int
    jitter_ns: float | None
    delays: DelayPercentiles | None
    """Quantiles of the delay from sampling to arrival in the last minute; None if unknown."""
    rate_hz: float | None
    """Sample rate in the last minute, Hz; None if unknown."""


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """Health of one device.

    Invariant: ``received = used + decimated + idle + late + duplicate + dropped + pending``.
    Pending samples get another outcome within a few sample periods.
    """

    online: bool
    wire: WireCounts
    silent_ns: int | None
    """Time since the last chunk, ns; None before the first chunk."""
    samples: Mapping[str, int]
    """Number of samples by outcome (CONVENTIONS.md), and ``pending``."""
    clock: ClockHealth
    orientation_filter: object = None
    """Report of the orientation filter on the gateway; None without such a filter."""
    sensor: SensorState | None = None
    """State of an IMU; None for mocap."""


class LagSource(StrEnum):
    """Origin of the lag in use."""

    NONE = "none"
    CALIBRATION = "calibration"
    CONFIGURED = "configured"


@dataclass(frozen=True, slots=True)
class LagHealth:
    """Lag of one sensor behind the mocap system."""

    source: LagSource
    used_ns: float | None
    sigma_ns: float | None
    """Standard deviation of the lag in use, ns; None if unknown."""
    found_by: str | None
    """Method by which the calibration estimated the lag; None without such an estimate."""
    tracked: TrackedLag | None
    """Lag estimated during operation; None before the first estimate."""
    refused: str | None
    """Reason why the last window yielded no estimate of the lag; None if it yielded one."""


class LearningState(StrEnum):
    """State of online learning."""

    OFF = "off"
    WAITING = "waiting"
    LEARNING = "learning"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class LearningHealth:
    """State and counts of online learning."""

    state: LearningState = LearningState.OFF
    reason: str | None = None
    stopped_ns: int | None = None
    """Time since the last usable frame, ns; None unless learning is stopped."""
    kept: int = 0
    """Number of frames that wait for a refit."""


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Counts of frames since the daemon started."""

    sent: int = 0
    empty: int = 0
    """Number of frames without data of any sensor."""
    skipped: int = 0
    """Number of frames omitted because the process was delayed."""


@dataclass(frozen=True, slots=True)
class CoreHealth:
    """Health of the core. The default values describe a core without configuration."""

    devices: Mapping[str, DeviceHealth] = field(default_factory=dict)
    phase: CalibrationPhase = CalibrationPhase.UNCALIBRATED
    version: int | None = None
    """Version of the current calibration."""
    fusion: Mapping[str, object] = field(default_factory=dict)
    """Report on the consistency of the sensors, as a JSON object."""
    lags: Mapping[str, LagHealth] = field(default_factory=dict)
    frames: FrameCounts = field(default_factory=FrameCounts)
    learning: LearningHealth = field(default_factory=LearningHealth)
