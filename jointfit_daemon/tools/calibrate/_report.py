"""Text lines for calibration results and progress, from the payloads of MQTT topics."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

MOVED_M = 0.008
"""Displacement, m, above which a marker probably was pushed out of its place. Soft tissue moves
markers by about 5 mm."""


def report(quality: Mapping[str, Any]) -> list[str]:
    """Return one line for each result in `quality` of topic ``calibration``.

    Orientation and flexion errors are RMS differences from the optical reference over the last part
    of the trial. The fit does not use this part. Missing entries are omitted.
    """
    holdout: Mapping[str, Any] = quality.get("holdout") or {}
    method = str(holdout.get("method", ""))
    lines = [
        _error_line(f"{name}: orientation", by_method, method)
        for name, by_method in (holdout.get("segments_deg") or {}).items()
    ]
    lines += [
        _error_line(f"{name}: flexion", by_method, method)
        for name, by_method in (holdout.get("flexion_deg") or {}).items()
    ]

    # List the marker refinement by body part, and the markers with a large displacement.
    markers: Mapping[str, Any] = quality.get("markers") or {}
    for name, part in (markers.get("parts") or {}).items():
        before, after = (1000 * part[key] for key in ("before_m", "after_m"))
        kept = "" if part.get("refined") else ", positions of the static pose retained"
        lines.append(
            f"{name}: RMS marker error {before:.1f} mm, after refinement {after:.1f} mm{kept}"
        )

    moved: Mapping[str, float] = markers.get("moved_m") or {}
    lines += [
        f"{name}: {1000 * m:.0f} mm from its position in the static pose: check the marker"
        for name, m in sorted(moved.items(), key=lambda item: -item[1])
        if m >= MOVED_M
    ]

    lines += _chain_lines(quality.get("chain") or {})
    anatomy: Mapping[str, Any] = quality.get("anatomy") or {}
    for name, joint in (anatomy.get("joints") or {}).items():
        sd_m = joint.get("sd_m")
        spread = "" if sd_m is None else f", sd {1000 * sd_m:.0f} mm"
        center: Mapping[str, Any] = (anatomy.get("centers") or {}).get(name) or {}
        method = center.get("method", "sphere")
        by = "" if method == "sphere" else f" by {method}"
        axis = center.get("axis_sd_deg")
        hinge = "" if axis is None else f", axis ± {axis:.1f}°"
        lines.append(f"{name}: center from {joint.get('source')}{by}{spread}{hinge}")

    sources: Mapping[str, Any] = anatomy.get("length_sources") or {}
    for name, length_m in (anatomy.get("lengths_m") or {}).items():
        by = f", from {sources[name]}" if sources.get(name) else ""
        if length_m is not None:
            lines.append(f"{name}: {length_m:.3f} m long{by}")

    if "alignment" in quality and quality["alignment"] is None:
        lines.append("no align phase: sensor headings are estimated from the static pose")

    return lines


def movement_lines(data: Mapping[str, Any]) -> list[str]:
    """Return one line for each joint in ``data`` of topic ``calibration/progress``.

    The first number is the predicted error of the joint centre, including the effect of the
    soft-tissue artefact. The second number is the random part of this error, which decreases with
    more movement.
    """
    lines = []
    for name, joint in (data.get("joints") or {}).items():
        noise, total = joint.get("noise_error_mm"), joint.get("predicted_error_mm")
        bends, source = joint.get("bends"), joint.get("source")
        words = [
            "center unknown" if total is None else f"center ± {total:.1f} mm",
            *([] if noise is None else [f"random error {ceil(10 * noise) / 10:.1f} mm"]),
            *([] if joint.get("arc_deg") is None else [f"{joint['arc_deg']:.0f}° range"]),
            *([] if bends is None else [f"{bends} bend{'' if bends == 1 else 's'}"]),
            *([f"from {source}"] if source not in {None, "unknown", "markers"} else []),
        ]
        lines.append(f"{'✔' if joint.get('met') else '…'} {name}: {', '.join(words)}")

    return lines


@dataclass(slots=True)
class ProgressLines:
    """Progress lines at a limited rate, for logs and pipes."""

    interval_s: float = 5.0
    """Minimum time between two lines about the same phase, s."""
    _run_phase: str = ""
    _line: str = ""
    _next_s: float = 0.0

    def update(self, phase: str, share: float, text: str) -> None:
        """Store the newest progress, `share` from 0 to 1; a new phase is reported at once."""
        if phase != self._run_phase:
            self._run_phase, self._next_s = phase, float("-inf")
        self._line = f"{phase}: {100 * share:.0f} %" + (f", {text}" if text else "")

    def due(self, now_s: float, data: Mapping[str, Any]) -> list[str]:
        """Return the lines to print at `now_s`, or none before the interval has passed.

        `data` is the ``data`` of the newest message on topic ``calibration/progress``.
        """
        if now_s < self._next_s:
            return []
        self._next_s = now_s + self.interval_s
        return [self._line, *(f"  {line}" for line in movement_lines(data))]


def _chain_lines(chain: Mapping[str, Any]) -> list[str]:
    """Return lines about the refinement of the chain model, and about markers with large errors."""
    name = f"chain model {chain.get('model')!r}"
    if chain.get("refused"):
        return [f"{name}: markers not refined: {chain['refused']}"]
    if not chain:
        return []
    (rms, most), (new_rms, new_most) = (
        (1000 * chain[key]["rms_m"], 1000 * chain[key]["maximum_m"]) for key in ("before", "after")
    )
    limits = "within" if chain["after"]["accepted"] else "ABOVE"
    first = (
        f"{name}: marker error {rms:.1f} mm RMS, {most:.0f} mm at most; after refinement "
        f"{new_rms:.1f} and {new_most:.0f} mm, {limits} the accepted errors"
    )
    kept = [part for part, one in chain["parts"].items() if not one["refined"]]
    moved = {marker: 1000 * m for marker, m in chain["moved_m"].items() if m >= MOVED_M}
    return [
        first,
        *(f"{name}: {part}: not improved, positions of the model retained" for part in kept),
        *(
            f"{marker}: {mm:.0f} mm from its place in the chain model"
            for marker, mm in sorted(moved.items(), key=lambda item: -item[1])
        ),
    ]


def _error_line(quantity: str, by_method: Mapping[str, Any], method: str) -> str:
    error_deg, mean_deg = by_method.get(method), by_method.get("mean")
    error = "error unknown" if error_deg is None else f"error {error_deg:.1f}°"
    if mean_deg is None or method == "mean":
        return f"{quantity} {error}"
    return f"{quantity} {error}; error of the sensor mean {mean_deg:.1f}°"
