"""The figures of a calibration as lines for people. Law: pure; reads the published payload only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

MOVED_M = 0.008
"""Skin moves markers by 5 mm; what is farther away was touched."""


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
    lines += _marker_lines(quality.get("markers") or {})
    anatomy: Mapping[str, Any] = quality.get("anatomy") or {}
    for name, joint in (anatomy.get("joints") or {}).items():
        sd_m = joint.get("sd_m")
        spread = "" if sd_m is None else f", sd {1000 * sd_m:.0f} mm"
        lines.append(f"{name}: center by {joint.get('source')}{spread}")
    sources: Mapping[str, Any] = anatomy.get("length_sources") or {}
    for name, length_m in (anatomy.get("lengths_m") or {}).items():
        by = f", by {sources[name]}" if sources.get(name) else ""
        if length_m is not None:
            lines.append(f"{name}: {length_m:.3f} m long{by}")
    if "alignment" in quality and quality["alignment"] is None:
        lines.append("no align phase: headings come from the static pose")
    return lines


def _marker_lines(markers: Mapping[str, Any]) -> list[str]:
    """Return what refining the markers did, a body part a line, and who moved most."""
    lines = []
    for name, part in (markers.get("parts") or {}).items():
        before, after = (1000 * part[key] for key in ("before_m", "after_m"))
        kept = "" if part.get("refined") else ", kept as in the static pose"
        lines.append(f"{name}: markers {before:.1f} mm off, refined {after:.1f} mm{kept}")
    moved: Mapping[str, float] = markers.get("moved_m") or {}
    far = {name: m for name, m in moved.items() if m >= MOVED_M}
    lines += [
        f"{name}: {1000 * m:.0f} mm from where it was in the static pose: knocked off?"
        for name, m in sorted(far.items(), key=lambda item: -item[1])
    ]
    return lines


def movement_lines(data: Mapping[str, Any]) -> list[str]:
    """Return what ``data`` of topic ``calibration/progress`` says of a movement, a joint a line.

    The first figure is what more movement makes smaller; the second is what to expect on skin.
    """
    lines = []
    for name, joint in (data.get("joints") or {}).items():
        noise, total = joint.get("noise_error_mm"), joint.get("predicted_error_mm")
        words = [
            "center unknown" if total is None else f"center ± {_tenth(total)} mm with skin",
            *([] if noise is None else [f"{_tenth(noise)} mm by noise"]),
            *([] if joint.get("arc_deg") is None else [f"{joint['arc_deg']:.0f}° seen"]),
            *([] if joint.get("bends") is None else [f"bent {joint['bends']}×"]),
            *([] if joint.get("source") == "markers" else [f"by {joint.get('source')}"]),
        ]
        lines.append(f"{'✔' if joint.get('met') else '…'} {name}: {', '.join(words)}")
    return lines


@dataclass(slots=True)
class ProgressLines:
    """The progress of a phase as plain lines, for logs and pipes."""

    interval_s: float = 5.0
    """Least time from one report of a phase to the next, s."""
    _phase: str = ""
    _line: str = ""
    _next_s: float = 0.0

    def update(self, phase: str, share: float, text: str) -> None:
        """Take the newest progress; `share` is 0 to 1. A new phase is reported at once."""
        if phase != self._phase:
            self._phase, self._next_s = phase, float("-inf")
        self._line = f"{phase}: {100 * share:.0f} %" + (f", {text}" if text else "")

    def due(self, now_s: float, data: Mapping[str, Any]) -> list[str]:
        """Return the lines to print at `now_s`; none before the interval is over."""
        if now_s < self._next_s:
            return []
        self._next_s = now_s + self.interval_s
        return [self._line, *(f"  {line}" for line in movement_lines(data))]


def _tenth(value: float) -> str:
    return f"{value:.1f}"


def _against_mean(what: str, by_method: Mapping[str, Any], method: str) -> str:
    error_deg, mean_deg = by_method.get(method), by_method.get("mean")
    told = "error unknown" if error_deg is None else f"error {error_deg:.1f}°"
    if mean_deg is None or method == "mean":
        return f"{what} {told}"
    return f"{what} {told}; the mean of the sensors has {mean_deg:.1f}°"
