"""What a clock has to tell beside stamps: why it began anew, and what cannot be true.

Law: pure; words and figures only. Texts say what was found and what is the likely cause.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

SKEW_LIMIT_PPM = 500.0
"""No crystal is as wrong as this."""
SERVER_SKEW_LIMIT_PPM = 100.0
"""Nor the clock of a server PC as this."""

_MS, _S = 1e6, 1e9
_BOOT_NS = 2_000_000_000


class ClockNews(NamedTuple):
    """Something to be published."""

    kind: Literal["restart", "clock", "warning"]
    """``restart``: the device itself began anew; ``clock``: only its time did; ``warning``."""
    text: str
    data: Mapping[str, object]


def began_anew(before_ns: int, now_ns: int, elapsed_ns: int) -> ClockNews:
    """Explain device time that does not go on: `elapsed_ns` passed between two arrivals."""
    jump = now_ns - before_ns - elapsed_ns
    data = {"jump_ms": round(jump / _MS, 3)}
    if 0 <= now_ns <= elapsed_ns + _BOOT_NS and now_ns < before_ns:
        up = f"its clock shows {now_ns / _S:.2f} s"
        return ClockNews("restart", f"the device rebooted: {up} after {before_ns / _S:.2f} s", data)
    back = f"its clock jumped {'back' if jump < 0 else 'ahead'} by {abs(jump) / _MS:.1f} ms"
    return ClockNews("clock", back, data)


def too_early(early_ns: float) -> ClockNews:
    """Explain samples that arrive before they were taken."""
    text = (
        f"its clock jumped ahead by {early_ns / _MS:.1f} ms, or the clock of this host stood still "
        "(suspend)"
    )
    return ClockNews("clock", text, {"jump_ms": round(early_ns / _MS, 3)})


def too_late(late_ns: float, seconds: float) -> ClockNews:
    """Explain samples that stay late."""
    text = f"samples have been {late_ns / _MS:.1f} ms late for {seconds:g} s: its clock stood still"
    return ClockNews("clock", text, {"jump_ms": round(-late_ns / _MS, 3)})


def after_reopening(news: ClockNews) -> ClockNews:
    """Return `news` as a restart: of a device that was away, a new time is a new start."""
    return ClockNews("restart", f"after reconnecting, {news.text}", news.data)


UNKNOWN_WHILE_AWAY = ClockNews(
    "restart",
    "it reconnected, and nothing in its data shows whether it ran on: taken for a restart",
    {},
)


def did_not_run_on(step_ns: int, elapsed_ns: int) -> ClockNews:
    """Explain device time that is not where the time on this host says it must be."""
    text = f"its time moved by {step_ns / _S:.2f} s in {elapsed_ns / _S:.2f} s: it restarted"
    return ClockNews("restart", text, {"jump_ms": round((step_ns - elapsed_ns) / _MS, 3)})


def off_echoes(off_ns: int) -> ClockNews:
    """Explain an echo that no clock could give that was where it was."""
    text = f"its clock jumped by {off_ns / _MS:.1f} ms against its own echoes: restarted, or set"
    return ClockNews("clock", text, {"jump_ms": round(off_ns / _MS, 3)})


def moved(step_ns: int) -> ClockNews:
    """Explain an estimate that moved too far to be followed slowly."""
    text = f"the estimate of its clock moved by {step_ns / _MS:.1f} ms at once"
    return ClockNews("clock", text, {"step_ms": round(step_ns / _MS, 3)})


def said(text: str) -> ClockNews:
    """Return news without figures."""
    return ClockNews("clock", text, {})


ANOTHER_WAY = said("it tells time in another way now")


def contradicted(direct_ns: int, estimate_ns: int) -> ClockNews:
    """Explain why a direct time is not used."""
    off = (direct_ns - estimate_ns) / _MS
    text = (
        f"its sync time differs from what arrivals tell by {off:.1f} ms and is not used: wrong "
        "line, edge or clock declared?"
    )
    return ClockNews("warning", text, {"off_ms": round(off, 3)})


def skew_warning(kind: str, skew_ppm: float, sigma_ppm: float) -> ClockNews | None:
    """Return a warning if no clock can be so wrong; `kind` is ``ticks``, ``samples``, ``echo``."""
    limit = SERVER_SKEW_LIMIT_PPM if kind == "echo" else SKEW_LIMIT_PPM
    if abs(skew_ppm) - 3.0 * sigma_ppm <= limit:
        return None
    cause = {
        "ticks": "is its tick rate what the driver takes it for?",
        "samples": "is rate_hz the rate it really sends at?",
        "echo": "is the server's clock stepped or slewed by its operating system?",
    }[kind]
    text = f"its clock is {skew_ppm:+.0f} ppm off, more than any crystal (limit {limit:g}): {cause}"
    return ClockNews("warning", text, {"skew_ppm": round(skew_ppm, 1)})
