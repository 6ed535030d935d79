"""Conversion of numbers, ages, states and flags to text.

An unknown value is ``–``, never 0 and never an old value. The web page of the dashboard has
similar texts (``page/js/words.js``).
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from datetime import tzinfo

    from jointfit_daemon.outputs.payload_models import CalibrationState, DeviceCounts

UNKNOWN = "–"
Level = Literal["good", "warning", "error", "muted"]
SYMBOLS: dict[Level, str] = {"good": "✔", "warning": "▲", "error": "✖", "muted": "○"}
"""Symbol of each level. Because of the symbols, no meaning depends on colour."""
RUNNING = frozenset({"align", "static", "functional", "fitting"})
"""Calibration phases in which the daemon records or fits."""
LARGE_SIGMA_US = 2000.0
"""Standard deviation of a device clock, µs, above which a warning is shown."""
_MINUTE_S = 60.0
_PHASES = {
    "uncalibrated": "Not calibrated",
    "align": "Align phase runs",
    "aligned": "Sensors aligned; the static pose is next",
    "static": "Static phase runs",
    "posed": "Static pose recorded; the functional phase is next",
    "functional": "Functional phase runs",
    "fitting": "Fitting the calibration",
}
_CLOCKS: dict[str, tuple[Level, str]] = {
    "settling": ("muted", "settling"),
    "direct": ("good", "sync line"),
    "echo": ("good", "synchronised"),
    "passive": ("good", "fitted"),
    "arrival": ("warning", "no device time"),
    "stale": ("warning", "stale"),
}


def format_number(value: float | None, decimals: int = 1, unit: str = "") -> str:
    """Return a number with fixed decimals and its unit."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    text = f"{value:.{decimals}f}"
    if text.startswith("-"):
        text = text[1:] if not text.strip("-0.") else f"−{text[1:]}"
    return f"{text}{unit}"


def format_duration(seconds: float) -> str:
    """Return a duration in the largest fitting unit."""
    for limit, size, unit in ((90, 1, "s"), (5400, 60, "min"), (129_600, 3600, "h")):
        if seconds < limit:
            return f"{max(0, round(seconds / size))} {unit}"
    return f"{round(seconds / 86_400)} days"


def format_clock(microseconds: float | None, timezone: tzinfo | None = None) -> str:
    """Return the time of day of a UNIX time, µs; the default of `timezone` is the local zone."""
    if microseconds is None:
        return UNKNOWN
    try:
        moment = datetime.fromtimestamp(microseconds / 1e6, tz=UTC).astimezone(timezone)
    except (ValueError, OverflowError, OSError):
        return UNKNOWN
    return moment.strftime("%H:%M:%S")


def format_date(text: str | None, timezone: tzinfo | None = None) -> str:
    """Return date and time of an ISO 8601 text, or the unchanged text if it is invalid."""
    if text is None:
        return UNKNOWN
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return text
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return moment.astimezone(timezone).strftime("%Y-%m-%d %H:%M")


def title_of(name: str) -> str:
    """Return a name as a heading: ``left_knee`` becomes ``Left knee``."""
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:]


def angle_name(key: str) -> str:
    """Return the name of an angle from its key: ``flexion_deg`` becomes ``flexion``."""
    return "inner angle" if key == "inner_deg" else key.removesuffix("_deg").replace("_", " ")


def calibration_sentence(calibration: CalibrationState | None, now_us: float | None = None) -> str:
    """Return the state of the calibration as text, with its age at the gateway time `now_us`."""
    if calibration is None:
        return "Waiting for the calibration state"
    phase = str(calibration.phase)
    if phase == "calibrated":
        version = calibration.version
        age = _age_words(calibration.created_utc, now_us)
        stored = "not stored yet" if version is None else f"version {version}{age}"
        rejected = "; the last result was rejected" if calibration.kept else ""
        return f"Calibrated, {stored}{rejected}"
    if phase == "aborted":
        return f"Calibration aborted: {calibration.text}"
    return _PHASES.get(phase, phase)


def _age_words(created_utc: str | None, now_us: float | None) -> str:
    """Return the time since a date as text, or an empty text if it is unknown."""
    if created_utc is None or now_us is None:
        return ""
    try:
        created_us = datetime.fromisoformat(created_utc).timestamp() * 1e6
    except (ValueError, OverflowError):
        return ""
    age_s = (now_us - created_us) / 1e6
    if age_s < _MINUTE_S:
        return ", just now"
    # The age is rounded to minutes, so the text does not change every second.
    return f", {format_duration(age_s) if age_s >= 1.5 * _MINUTE_S else '1 min'} ago"


def clock_quality(device: DeviceCounts | None) -> tuple[Level, str]:
    """Return level and text about the clock of a device."""
    if device is None:
        return "muted", UNKNOWN
    level, words = _CLOCKS[device.clock]
    sigma = device.sigma_us
    if level != "good" or sigma is None:
        return level, words
    if sigma > LARGE_SIGMA_US:
        return "warning", f"{words} ±{format_number(sigma / 1000, 1, ' ms')}"
    return level, f"{words} ±{format_number(sigma, 0, ' µs')}"
