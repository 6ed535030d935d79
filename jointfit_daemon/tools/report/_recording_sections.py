"""Sections about the recording: sources and gaps, timing, calibration, events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from jointfit_daemon.tools.report._svg_plot import (
    PlotArea,
    frame,
    image,
    responsive,
    second_ticks,
    svg_text,
    time_text,
)
from jointfit_daemon.tools.report._words import (
    UNKNOWN,
    count_text,
    decimal,
    degree,
    duration,
    percent,
    title,
)
from jointfit_daemon.tools.report.html_document import facts, figure, paragraph, section, table
from jointfit_daemon.tools.report.session_results import VALUE_KINDS, is_fault

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.session_analysis import SeriesQuality
    from jointfit_daemon.tools.report.session_results import SessionResults

_ROW = 22.0
"""Height of a row of the timeline, px."""
_MOST_EVENTS = 200
"""Maximum number of events in the list."""
_MOST_MARKS = 12
"""Maximum number of labelled marks in the timeline."""


def sources_section(results: SessionResults) -> str:
    """Return the timeline and the table of sensors and cameras."""
    if not results.sources:
        text = "The file contains no samples of sensors or cameras, only results."
        return section("recorded", "Recorded data", [paragraph(text)])

    segments = {sensor.id: sensor.segment for sensor in results.session.sensors}
    marker_count = len(results.session.markers.labels) if results.session.markers else 0
    segments["cameras"] = count_text(marker_count, "marker")
    configured = results.values("source")
    rows = [
        (
            title(name),
            segments[name] or UNKNOWN,
            f"{found.count}",
            decimal(found.rate_hz),
            percent(_loss(found, configured.get(name, {}))),
            _gap_text(found),
        )
        for name, found in results.sources.items()
    ]
    head = ("Source", "On", "Samples", "Rate, Hz", "Lost", "Gaps")
    drawing = responsive(lambda width, kind: _timeline(results, width, kind))
    legend = [("data", "data"), ("gap", "no data")]
    if any(len(gait.cycles_s) for gait in results.gait.values()):
        legend.append(("walking", "walking"))
    text = "Lost: missing samples as a share of the samples expected in the duration of the data."
    return section(
        "recorded",
        "Recorded data",
        [
            figure(drawing, "Data of every source over time; vertical lines are marks.", legend),
            table("Sensors and cameras", head, rows, text=2),
            paragraph(text, "note"),
        ],
    )


def _loss(found: SeriesQuality, counts: Mapping[str, Any]) -> float:
    """Return the share of lost samples, 0 to 1, relative to the configured rate if it is known."""
    rate_hz = counts.get("rate_hz")
    if not rate_hz or not np.isfinite(found.rate_hz):
        return found.lost_share
    return max(0.0, 1.0 - (1.0 - found.lost_share) * found.rate_hz / float(rate_hz))


def _gap_text(found: SeriesQuality) -> str:
    if not len(found.gaps_s):
        return "none"
    longest = float(np.diff(found.gaps_s).max())
    return f"{len(found.gaps_s)}, longest {duration(longest)}"


def _timeline(results: SessionResults, width: float, kind: str) -> str:
    walking = [cycle for gait in results.gait.values() for cycle in gait.cycles_s]
    rows = list(results.sources) + (["walking"] if walking else [])
    height = 18.0 + _ROW * len(rows) + 30.0
    area = PlotArea(
        width, height, (results.start_s, results.end_s), (0.0, 1.0), left=76.0, top=18.0
    )
    parts = [frame(area, second_ticks(area), ())]
    for number, name in enumerate(rows):
        y = 18.0 + _ROW * number
        parts.append(svg_text("tick row", 68.0, y + 15.0, title(name), "end"))
        if name == "walking":
            parts += [_bar(area, a, b, y, "walking") for a, b in walking]
            continue
        parts.append(_bar(area, *_extent(results, name), y, ""))
        parts += [_bar(area, a, b, y, "gap") for a, b in results.sources[name].gaps_s]

    marks = [event for event in results.session.events if event.kind in ("mark", "phase")]
    free_px = 0.0
    for event in marks[:_MOST_MARKS]:
        x = float(area.x_px(event.t_s))
        parts.append(
            f'<line class="event" x1="{x:.1f}" x2="{x:.1f}" y1="4" y2="{height - 26:.1f}"/>'
        )
        label = (event.text or event.id)[:24]
        if x + 3.0 >= free_px and x + 7.0 * len(label) < width:
            parts.append(svg_text("tick", x + 3.0, 12.0, label, "start"))
            free_px = x + 7.0 * len(label) + 10.0
    gaps = "; ".join(f"{title(name)}: {_gap_text(q)}" for name, q in results.sources.items())
    return image(width, height, f"Timeline. Gaps of the sources: {gaps}", parts, kind)


def _extent(results: SessionResults, name: str) -> tuple[float, float]:
    if name == "cameras" and results.session.markers is not None:
        t_s = results.session.markers.t_s
    else:
        t_s = next(sensor.t_s for sensor in results.session.sensors if sensor.id == name)
    return (float(t_s[0]), float(t_s[-1])) if len(t_s) else (results.start_s, results.start_s)


def _bar(area: PlotArea, start_s: float, end_s: float, y: float, kind: str) -> str:
    x0, x1 = area.x_px(start_s), area.x_px(end_s)
    return (
        f'<rect class="bar {kind}" x="{x0:.1f}" y="{y + 4:.1f}" width="{max(1.0, x1 - x0):.1f}"'
        f' height="{_ROW - 8:.1f}"/>'
    )


def timing_section(results: SessionResults) -> str:
    """Return the section on the quality of the clocks and on latency."""
    clocks, latency = results.values("clock"), results.values("latency").get("", {})
    parts = []
    if clocks:
        rows = [
            (
                title(name),
                _value(data, "sd_us", 1e-3, 2),
                _value(data, "jitter_us", 1e-3, 2),
                _value(data, "skew_ppm", 1.0, 1),
            )
            for name, data in clocks.items()
        ]
        head = ("Source", "Uncertainty, ms", "Jitter, ms", "Skew, ppm")
        parts.append(table("Clocks", head, rows))
        parts.append(
            paragraph(
                "Uncertainty: standard deviation of the instant of a sample. Jitter: mean delay of"
                " the samples beyond the smallest delay. Skew: rate error of the device clock,"
                " positive if it is slower than the clock of the gateway.",
                "note",
            )
        )
    if latency:
        parts.append(
            facts(
                [
                    ("Latency, median", f"{_value(latency, 'median_ms', 1.0, 1)} ms"),
                    ("Latency, 95th percentile", f"{_value(latency, 'p95_ms', 1.0, 1)} ms"),
                    ("Latency, largest", f"{_value(latency, 'max_ms', 1.0, 1)} ms"),
                ]
            )
        )
    if not parts:
        parts = [paragraph("The file contains no data about clocks and latency.")]
    return section("timing", "Timing", parts)


def calibration_section(results: SessionResults) -> str:
    """Return the section on the calibration, with its estimated errors."""
    tables = [
        event.data["quality"]
        for event in results.session.events
        if event.kind == "calibration" and event.data.get("quality")
    ]
    quality = cast("Mapping[str, Any]", tables[-1] if tables else {})
    holdout: Mapping[str, Any] = quality.get("holdout") or {}
    method = str(holdout.get("method", ""))
    rows = [
        (f"{title(name)}, {what}", degree(float(errors[method])))
        for key, what in (("segments", "orientation"), ("flexion", "flexion"))
        for name, errors in (holdout.get(key) or {}).items()
        if errors.get(method) is not None
    ]
    for name, joint in ((quality.get("anatomy") or {}).get("joints") or {}).items():
        if joint.get("sd_m") is not None:
            rows.append((f"{title(name)}, position", f"± {decimal(1e3 * joint['sd_m'], 0)} mm"))

    version = results.session.description.get("calibration", "")
    parts = [paragraph(f"Calibration in force: {version}.")] if version else []
    if rows:
        parts.append(table("Errors of the calibration", ("Quantity", "Error"), rows))
        parts.append(
            paragraph(
                "Errors of orientations and angles: RMS difference from the cameras on the part of"
                " the calibration movement that the fit did not use.",
                "note",
            )
        )
    elif not version:
        parts.append(paragraph("The session has no calibration: angles are not available."))
    else:
        parts.append(paragraph("The file contains no errors of the calibration."))
    return section("calibration", "Calibration", parts)


def events_section(results: SessionResults) -> str:
    """Return the list of faults and events."""
    events = [e for e in results.session.events if e.text or e.kind not in VALUE_KINDS]
    if not events:
        return section("events", "Faults and events", [paragraph("No faults and no events.")])
    order = sorted(events, key=lambda event: not is_fault(event))[:_MOST_EVENTS]
    span = results.end_s - results.start_s
    rows = [
        (
            time_text(round(event.t_s, 1), span) + ("" if ":" in time_text(0, span) else " s"),
            ("▲ " if is_fault(event) else "") + title(event.kind),
            event.id or "session",
            event.text or UNKNOWN,
        )
        for event in sorted(order, key=lambda event: event.t_s)
    ]
    parts = [table("Faults (▲) and events", ("Time", "Kind", "Object", "Text"), rows, text=4)]
    if len(events) > _MOST_EVENTS:
        rest = len(events) - _MOST_EVENTS
        parts.append(paragraph(f"{rest} further events are in the recording.", "note"))
    return section("events", "Faults and events", parts)


def _value(data: Mapping[str, Any], key: str, factor: float, places: int) -> str:
    value = data.get(key)
    return UNKNOWN if value is None else decimal(factor * float(value), places)
