"""JSON form of ``bridge/health``: rounding, and units in the keys."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jointfit_daemon.outputs.frame_latency import LatencyHealth
    from jointfit_daemon.outputs.mqtt import LinkHealth
    from jointfit_daemon.outputs.recording import RecordingHealth
    from jointfit_daemon.outputs.spool import SpoolHealth
    from jointfit_daemon.pipeline.health import (
        CoreHealth,
        DeviceHealth,
        LagHealth,
        LearningHealth,
    )

_NS_PER_US, _NS_PER_MS, _NS_PER_S = 1e3, 1e6, 1e9


@dataclass(frozen=True, slots=True)
class ProcessHealth:
    """Resource usage of the process since the last health message."""

    cpu_pct: float
    """CPU time divided by elapsed time, percent of one core."""
    rss_bytes: int | None
    """Resident memory; None if unknown."""
    loop_delay_p99_ms: float | None
    """0.99 quantile of the event loop's delay in the last minute, ms; None if unknown."""


@dataclass(frozen=True, slots=True)
class StateHealth:
    """Faults of persistent data. Each field is the reason of a fault, or None without a fault."""

    fault: str | None
    """Reason why the daemon cannot write to the state directory."""
    not_stored: str | None
    """Reason why the current calibration is not stored."""


@dataclass(frozen=True, slots=True)
class BridgeHealth:
    """Health of the daemon."""

    core: CoreHealth
    process: ProcessHealth
    link: LinkHealth
    state: StateHealth
    recording: RecordingHealth | None = None
    spool: SpoolHealth | None = None
    latency: LatencyHealth | None = None


def health_payload(health: BridgeHealth) -> dict[str, Any]:
    """Return the payload of ``bridge/health``."""
    parts = {
        "process": asdict(health.process),
        "link": asdict(health.link),
        "state": asdict(health.state),
    }
    if health.recording is not None:
        parts["recording"] = asdict(health.recording)
    if health.spool is not None:
        parts["spool"] = asdict(health.spool)
    if health.latency is not None:
        parts["latency"] = _latency(health.latency)
    return core_payload(health.core) | parts


def core_payload(core: CoreHealth) -> dict[str, Any]:
    """Return the part of the payload that describes the core."""
    return {
        "devices": {name: _device(device) for name, device in core.devices.items()},
        "calibration": {"phase": core.phase, "version": core.version},
        "fusion": core.fusion,
        "lags": {name: lag_payload(lag) for name, lag in core.lags.items()},
        "frames": asdict(core.frames),
        "learning": learning_payload(core.learning),
    }


def _latency(latency: LatencyHealth) -> dict[str, Any]:
    stages = {
        f"{name}_us": None
        if stage is None
        else {"p50": _us(stage.p50_ns), "p99": _us(stage.p99_ns), "max": _us(stage.max_ns)}
        for name, stage in latency.stages.items()
    }
    return {"frames": latency.frames, **stages}


def _device(device: DeviceHealth) -> dict[str, Any]:
    wire, silent_ns = asdict(device.wire), device.silent_ns
    opened = wire.pop("opened")
    clock, delays = device.clock, device.clock.delays
    payload = {
        "online": device.online,
        **wire,
        "reconnects": max(0, opened - 1),
        "last_age_ms": None if silent_ns is None else round(silent_ns / _NS_PER_MS, 1),
        **device.samples,
        "clock": clock.state,
        "epoch": clock.epoch,
        "offset_us": _us(clock.offset_ns),
        "skew_ppm": None if clock.skew_ppm is None else round(clock.skew_ppm, 2),
        "sigma_us": _us(clock.sigma_ns),
        "bound_us": _us(clock.bound_ns),
        "latency_prior_us": [_us(clock.latency_ns), _us(clock.latency_sd_ns)],
        "jitter_us": _us(clock.jitter_ns),
        "delay_us": None
        if delays is None
        else {"p50": _us(delays.p50_ns), "p99": _us(delays.p99_ns), "max": _us(delays.max_ns)},
        "rate_hz": None if clock.rate_hz is None else round(clock.rate_hz, 2),
    }
    if device.orientation_filter is not None:
        payload["orientation_filter"] = device.orientation_filter
    if device.sensor is not None:
        payload["sensor"] = device.sensor
    return payload


def lag_payload(lag: LagHealth) -> dict[str, Any]:
    """Return the lag of one sensor, in milliseconds."""
    tracked = lag.tracked
    return {
        "lag_ms": _ms(lag.used_ns),
        "lag_sigma_ms": _ms(lag.sigma_ns),
        "lag_source": lag.source,
        "lag_found_by": lag.found_by,
        "tracked_ms": None if tracked is None else _ms(tracked.lag_ns),
        "tracked_sigma_ms": None if tracked is None else _ms(tracked.sigma_ns),
        "tracked_drift_ppm": None if tracked is None else round(1e6 * tracked.drift, 3),
        "tracked_refused": lag.refused,
    }


def learning_payload(learning: LearningHealth) -> dict[str, Any]:
    """Return the state of online learning."""
    stopped_ns = learning.stopped_ns
    return {
        "state": learning.state,
        "reason": learning.reason,
        "stopped_s": None if stopped_ns is None else round(stopped_ns / _NS_PER_S, 1),
        "kept": learning.kept,
    }


def _us(value_ns: float | None) -> float | None:
    """Return a time in microseconds; None if it is unknown or infinite."""
    return None if value_ns is None or not isfinite(value_ns) else round(value_ns / _NS_PER_US, 1)


def _ms(value_ns: float | None) -> float | None:
    return None if value_ns is None else round(value_ns * 1e-6, 3)
