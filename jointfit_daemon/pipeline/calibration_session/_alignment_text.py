"""Text of the status after the align phase."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING, Any

from jointfit_daemon.name_lists import list_names
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def alignment_text(quality: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the text with the deviations of the sensors from the plate, and the lags.

    Parameters
    ----------
    quality
        JSON form of the quality of every sensor, as in `FitResult.quality`.
    """
    rms_deg = [degrees(found["rms_rad"]) for found in quality.values() if "rms_rad" in found]
    if not rms_deg:
        return "worlds aligned"
    lags_ms = [
        found["lag_ns"] / NS_PER_MS for found in quality.values() if found.get("lag_ns") is not None
    ]
    parts = [f"worlds aligned: sensors follow the plate within {_range(rms_deg)} deg RMS"]
    if lags_ms:
        parts.append(f"lags {_range(lags_ms)} ms")
    if unknown := [name for name, found in quality.items() if found.get("lag_ns") is None]:
        parts.append(f"lag of {list_names(unknown)} unknown")
    return "; ".join(parts)


def _range(values: Sequence[float]) -> str:
    low, high = (f"{value:.1f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
