"""The figures of a calibration as lines for people. Law: pure; reads the published payload only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


def report(quality: Mapping[str, Any]) -> list[str]:
    """Return what `quality` of topic ``calibration`` says, one finding a line; what lacks is left.

    Errors are RMS distances from the cameras on the last part of the trial, which was not fitted.
    """
    holdout: Mapping[str, Any] = quality.get("holdout") or {}
    method = str(holdout.get("method", ""))
    lines = [
        _against_mean(f"{name}: orientation", by_method, method)
        for name, by_method in (holdout.get("segments_deg") or {}).items()
    ]
    lines += [
        _against_mean(f"{name}: flexion", by_method, method)
        for name, by_method in (holdout.get("flexion_deg") or {}).items()
    ]
    anatomy: Mapping[str, Any] = quality.get("anatomy") or {}
    for name, joint in (anatomy.get("joints") or {}).items():
        sd_m = joint.get("sd_m")
        spread = "" if sd_m is None else f", sd {1000 * sd_m:.0f} mm"
        lines.append(f"{name}: center by {joint.get('source')}{spread}")
    for name, length_m in (anatomy.get("lengths_m") or {}).items():
        if length_m is not None:
            lines.append(f"{name}: {length_m:.3f} m long")
    if "alignment" in quality and quality["alignment"] is None:
        lines.append("no align phase: headings come from the static pose")
    return lines


def _against_mean(what: str, by_method: Mapping[str, Any], method: str) -> str:
    error_deg, mean_deg = by_method.get(method), by_method.get("mean")
    told = "error unknown" if error_deg is None else f"error {error_deg:.1f}°"
    if mean_deg is None or method == "mean":
        return f"{what} {told}"
    return f"{what} {told}; the mean of the sensors has {mean_deg:.1f}°"
