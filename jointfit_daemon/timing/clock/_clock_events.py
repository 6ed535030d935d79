"""Events of a device clock: restarts, jumps and implausible rates, with their texts.

Each text names the finding and its likely cause.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from typing import Literal, NamedTuple

SKEW_LIMIT_PPM = 500.0
"""Largest plausible skew of a crystal, ppm."""
SERVER_SKEW_LIMIT_PPM = 100.0
"""Largest plausible skew of a server PC's clock, ppm."""

_MS, _S = 1e6, 1e9
_BOOT_NS = 2_000_000_000
"""Tolerance, ns. The clock of a device that restarted since the last sample shows at most the time
elapsed since then plus this tolerance.
"""


class ClockEvent(NamedTuple):
    """An event to be published."""

    kind: Literal["restart", "clock", "warning"]
    """``restart``: the device restarted; ``clock``: only the time of the device changed;
    ``warning``: the setup must be checked.
    """
    text: str
    data: Mapping[str, object]


def clock_restart_event(before_ns: int, now_ns: int, elapsed_ns: int) -> ClockEvent:
    """Return the event for a device time that does not continue the previous device times.

    Parameters
    ----------
    before_ns, now_ns : int
        Device time of the last sample and of this sample, ns.
    elapsed_ns : int
        Host time between the arrivals of the two samples, ns.
    """
    jump = now_ns - before_ns - elapsed_ns
    data = {"jump_ms": round(jump / _MS, 3)}
    if 0 <= now_ns <= elapsed_ns + _BOOT_NS and now_ns < before_ns:
        change = f"from {before_ns / _S:.2f} s to {now_ns / _S:.2f} s"
        return ClockEvent("restart", f"device rebooted: its clock went back {change}", data)

    direction = "back" if jump < 0 else "ahead"
    text = f"device clock jumped {direction} by {abs(jump) / _MS:.1f} ms"
    return ClockEvent("clock", text, data)


def early_arrival_event(early_ns: float) -> ClockEvent:
    """Return the event for samples that arrive before their sampling instant."""
    text = (
        f"device clock jumped ahead by {early_ns / _MS:.1f} ms, or this host's clock stopped "
        "(suspend)"
    )
    return ClockEvent("clock", text, {"jump_ms": round(early_ns / _MS, 3)})


def late_arrival_event(late_ns: float, seconds: float) -> ClockEvent:
    """Return the event for samples that have been late by `late_ns` for `seconds`."""
    text = (
        f"samples have arrived {late_ns / _MS:.1f} ms late for {seconds:g} s: the device clock "
        "stopped for the duration of this delay"
    )
    return ClockEvent("clock", text, {"jump_ms": round(-late_ns / _MS, 3)})


def as_restart_event(news: ClockEvent) -> ClockEvent:
    """Return `news` as a restart event, because a disconnected device may have been restarted."""
    return ClockEvent("restart", f"after reconnecting, {news.text}", news.data)


UNKNOWN_AFTER_RECONNECT = ClockEvent(
    "restart",
    "device reconnected; its data do not show whether it kept running: treated as a restart",
    {},
)


def clock_reset_event(step_ns: int, elapsed_ns: int) -> ClockEvent:
    """Return the event for a device that restarted while its port was closed."""
    text = (
        f"device time advanced by {step_ns / _S:.2f} s in {elapsed_ns / _S:.2f} s: the device "
        "restarted"
    )
    return ClockEvent("restart", text, {"jump_ms": round((step_ns - elapsed_ns) / _MS, 3)})


def echo_jump_event(off_ns: int) -> ClockEvent:
    """Return the event for an echo that contradicts the previous echoes."""
    text = (
        f"device clock jumped by {off_ns / _MS:.1f} ms relative to its echoes: the device "
        "restarted or its clock was set"
    )
    return ClockEvent("clock", text, {"jump_ms": round(off_ns / _MS, 3)})


def estimate_step_event(step_ns: int) -> ClockEvent:
    """Return the event for a clock estimate that moved too far to be slewed."""
    text = f"clock estimate stepped by {step_ns / _MS:.1f} ms"
    return ClockEvent("clock", text, {"step_ms": round(step_ns / _MS, 3)})


def clock_event(text: str) -> ClockEvent:
    """Return a clock event without data."""
    return ClockEvent("clock", text, {})


CLOCK_SOURCE_CHANGED = clock_event("clock source changed")


def sync_disagreement_event(direct_ns: int, estimate_ns: int) -> ClockEvent:
    """Return the warning for sync times that arrival times contradict."""
    off = (direct_ns - estimate_ns) / _MS
    text = (
        f"sync time differs from arrival times by {off:.1f} ms and is discarded: check the "
        "configured line, edge and clock"
    )
    return ClockEvent("warning", text, {"off_ms": round(off, 3)})


def skew_warning(kind: str, skew_ppm: float, sigma_ppm: float) -> ClockEvent | None:
    """Return a warning if the skew exceeds the limit by more than three standard deviations.

    Parameters
    ----------
    kind : {"ticks", "samples", "echo"}
        Source of the clock estimate: device ticks, sample numbers, or echoes (see `EchoFit`).
    skew_ppm, sigma_ppm : float
        Skew and its standard deviation, ppm.
    """
    limit = SERVER_SKEW_LIMIT_PPM if kind == "echo" else SKEW_LIMIT_PPM
    if abs(skew_ppm) - 3.0 * sigma_ppm <= limit:
        return None

    cause = {
        "ticks": "check the tick rate that the driver declares",
        "samples": "check that rate_hz is the rate the device sends at",
        "echo": "check whether the server's operating system steps or slews its clock",
    }[kind]
    text = (
        f"device clock skew is {skew_ppm:+.0f} ppm, too large for a crystal (limit {limit:g} ppm): "
        f"{cause}"
    )
    return ClockEvent("warning", text, {"skew_ppm": round(skew_ppm, 1)})
