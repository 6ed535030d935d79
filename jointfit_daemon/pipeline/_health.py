"""Health of devices, calibration and fusion: the part of ``bridge/health`` that the core knows."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.fusion import LimbFuser
    from jointfit_daemon.pipeline.calibration_session import CalibrationSession
    from jointfit_daemon.pipeline.sources import SourceState

_NS_PER_MS = 1e6
_NS_PER_US = 1e3


def core_health(
    sources: Mapping[str, SourceState],
    counts: Mapping[str, Mapping[str, int]],
    session: CalibrationSession,
    fuser: LimbFuser,
    now_ns: int,
) -> dict[str, object]:
    """Return the health of all devices, the calibration and fusion, as JSON values.

    Invariant for each device:
    ``received = used + decimated + idle + late + duplicate + dropped + pending``. Pending samples
    are counted elsewhere within a few sample periods.
    """
    devices = {}
    for name, state in sources.items():
        # Mocap frames are counted by the decoder and the router, samples by the frame grid.
        samples = counts[name]
        if state.source.kind == "mocap":
            samples = _mocap_counts(state, samples)
        devices[name] = {**_wire_health(state, now_ns), **samples, **_clock_health(state)}
        if (orientation_filter := state.info.get("orientation_filter")) is not None:
            devices[name]["orientation_filter"] = orientation_filter
        if state.source.kind == "imu":
            devices[name]["sensor"] = fuser.sensor_monitor.state(name)

    return {
        "devices": devices,
        "calibration": {"phase": session.phase, "version": session.version},
        "fusion": {} if fuser.consistency is None else fuser.consistency.health(),
    }


def _mocap_counts(state: SourceState, counts: Mapping[str, int]) -> dict[str, int]:
    """Return the counts of a mocap source, with the frames that its decoder withheld."""
    withheld = state.withheld()
    return {
        **counts,
        "received": state.counts.received + sum(withheld.values()),
        "decimated": 0,
        "late": withheld["late"],
        "duplicate": withheld["duplicates"],
        "dropped": withheld["unpublished"],
        "pending": 0,
    }


def _wire_health(state: SourceState, now_ns: int) -> dict[str, object]:
    counts, last = state.counts, state.last_arrival_ns
    return {
        "online": state.online,
        "received": counts.received,
        "corrupt": counts.corrupt,
        "discarded_bytes": counts.discarded_bytes,
        "lost": counts.lost,
        "restarts": counts.restarts,
        "reconnects": max(0, counts.opened - 1),
        "last_age_ms": None if last is None else round((now_ns - last) / _NS_PER_MS, 1),
    }


def _clock_health(state: SourceState) -> dict[str, object]:
    clock = state.clock
    delays, rate = clock.minute.delays, clock.minute.rate_hz
    return {
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
        "rate_hz": None if rate is None else round(rate, 2),
    }


def _us(value_ns: float | None) -> float | None:
    """Return a time in microseconds; None if it is unknown or infinite."""
    return None if value_ns is None or not isfinite(value_ns) else round(value_ns / _NS_PER_US, 1)
