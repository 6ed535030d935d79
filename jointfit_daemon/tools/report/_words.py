"""Conversion of names and numbers to text for the report: degrees, percent, minutes."""

from __future__ import annotations

from math import degrees, isfinite

UNKNOWN = "–"
_PERCENT_OF_NONE = 0.0005
"""Smallest share that is displayed as a number. A smaller share is displayed as ``< 0.1 %``."""


def joint_angle(joint: str, angle: str) -> str:
    """Return the title of an angle, such as ``Right knee flexion``."""
    return f"{title(joint)} {angle.replace('_', ' ')}"


def title(name: str) -> str:
    """Return a configured name as a title: ``right_knee`` becomes ``Right knee``."""
    text = name.replace("_", " ")
    return text[:1].upper() + text[1:]


def decimal(value: float, places: int = 1) -> str:
    """Return a number with a typographic minus sign, or a dash if it is unknown."""
    if not isfinite(value):
        return UNKNOWN
    text = f"{value:.{places}f}"
    return (text.lstrip("-") if float(text) == 0.0 else text).replace("-", "−")


def degree(value_rad: float, places: int = 1) -> str:
    """Return an angle in degrees, or a dash if it is unknown."""
    return f"{decimal(degrees(value_rad), places)}°" if isfinite(value_rad) else UNKNOWN


def with_sd(value_rad: float, sd_rad: float) -> str:
    """Return an angle, followed by its standard deviation if `sd_rad` is known."""
    return degree(value_rad) + (f" ± {degree(sd_rad)}" if isfinite(sd_rad) else "")


def percent(share: float) -> str:
    """Return a share in percent; a very small share is displayed as a limit."""
    if not isfinite(share):
        return UNKNOWN
    if 0.0 < share < _PERCENT_OF_NONE:
        return "< 0.1 %"
    return f"{decimal(100.0 * share)} %"


def duration(seconds: float) -> str:
    """Return a duration, such as ``42.5 s``, ``12 min 5 s`` or ``1 h 20 min``."""
    if seconds < 60.0:  # noqa: PLR2004 - a minute
        return f"{decimal(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def count_text(count: int, one: str, many: str = "") -> str:
    """Return a count with its noun, such as ``1 gap`` or ``2 gaps``."""
    return f"{count} {one if count == 1 else many or one + 's'}"
