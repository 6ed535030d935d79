"""The part of ``bridge/health`` that the core knows: counters and clocks of every device.

Law: a snapshot, computed when asked for; nothing here changes anything.
"""

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


def health_of(
    sources: Mapping[str, SourceState],
    counted: Mapping[str, Mapping[str, int]],
    session: CalibrationSession,
    fuser: LimbFuser,
    now_ns: int,
) -> dict[str, object]:
    """Return the health of every device and of the calibration, as JSON-able values.

    For every device ``received = used + decimated + idle + late + duplicate + dropped + pending``;
    what is pending gets its verdict within a few sample periods.
    """
    devices = {}
    for name, state in sources.items():
        verdicts = counted[name]
        if state.source.kind == "mocap":
            verdicts = _mocap(state, verdicts)
        devices[name] = {**_wire(state, now_ns), **verdicts, **_clock(state), **_filter(state)}
        if state.source.kind == "imu":
            devices[name]["sensor"] = fuser.sensor_monitor.state(name)
    return {
        "devices": devices,
        "calibration": {"phase": session.phase, "version": session.version},
        "fusion": {} if fuser.consistency is None else fuser.consistency.health(),
    }


def _mocap(state: SourceState, counted: Mapping[str, int]) -> dict[str, int]:
    """Camera frames are used or idle as they come; the decoder withheld the others."""
    withheld = state.withheld()
    return {
        **counted,
        "received": state.counts.received + sum(withheld.values()),
        "decimated": 0,
        "late": withheld["late"],
        "duplicate": withheld["duplicates"],
        "dropped": withheld["unpublished"],
        "pending": 0,
    }


def _wire(state: SourceState, now_ns: int) -> dict[str, object]:
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


def _clock(state: SourceState) -> dict[str, object]:
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


def _filter(state: SourceState) -> dict[str, object]:
    """Return rest and bias of an orientation filter on the gateway, as its decoder told them."""
    told = state.info.get("orientation_filter")
    return {} if told is None else {"orientation_filter": told}


def _us(value_ns: float | None) -> float | None:
    """Return microseconds; unknown where there is no figure yet, infinity included."""
    return None if value_ns is None or not isfinite(value_ns) else round(value_ns / _NS_PER_US, 1)
