"""Sections about the movement: angles, gait cycles, range of motion, and camera differences."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.session_analysis import (
    LEAST_CYCLES,
    QUANTILE_95,
    normalize_cycles,
)
from jointfit_daemon.tools.report._svg_plot import (
    PlotArea,
    band,
    degree_ticks,
    frame,
    image,
    line,
    nice_ticks,
    number,
    pad_limits,
    points,
    responsive,
    second_ticks,
)
from jointfit_daemon.tools.report._words import (
    count_text,
    decimal,
    degree,
    joint_angle,
    percent,
    title,
    with_sd,
)
from jointfit_daemon.tools.report.html_document import (
    Drawing,
    facts,
    figure,
    paragraph,
    section,
    table,
)
from jointfit_daemon.tools.report.session_results import side_of

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_analysis import (
        AngleDifference,
        CycleCurves,
        GaitCycles,
        MotionRange,
    )
    from jointfit_daemon.session_data import JointSeries
    from jointfit_daemon.tools.report.session_results import SessionResults

_DETAIL_S = 10.0
"""Duration of the section of a long session that is drawn in detail, s."""
_UNSHOWN = 0.1
"""Largest share of the session that may pass before the first known angle. If the share is larger,
for example because of a calibration, the curves begin at the first known angle. Otherwise, they
begin at the start of the session."""
_PANEL, _HALF = 320.0, 450.0
"""Widths of a panel, px, in a row of three and in a row of two panels."""
_MOST_POINTS = 800
"""Maximum number of points of a scatter plot."""
_IMU_LEGEND = [("imu", "from the sensors"), ("band", "95 % interval")]
_OPTICAL_LEGEND = ("optical", "from the cameras")


def angles_section(results: SessionResults) -> str:
    """Return the curves of every angle, with a detailed section if the session is long."""
    if not results.angles:
        text = "No joint angle is known: the session has no calibration or no limb states."
        return section("angles", "Joint angles", [paragraph(text)])

    parts = []
    known = (joint.t_s[np.isfinite(joint.angles[angle])] for joint, angle in results.angles)
    known_s = min((float(t_s[0]) for t_s in known if len(t_s)), default=results.start_s)
    end_s = results.end_s
    if known_s - results.start_s > _UNSHOWN * (end_s - results.start_s):
        after = decimal(known_s - results.start_s, 0)
        parts.append(paragraph(f"No angle is known before {after} s, so the curves begin there."))
        whole = known_s, end_s
    else:
        whole = results.start_s, end_s

    for joint in results.session.joints:
        names = [angle for owner, angle in results.angles if owner is joint]
        drawings = "".join(_angle_figure(results, joint, angle, whole) for angle in names)
        if drawings:
            parts.append(f'<div class="block"><h3>{escape(title(joint.name))}</h3>{drawings}</div>')

    start_s = _detail_start(results)
    if start_s is not None:
        detail = start_s, start_s + _DETAIL_S
        panels = "".join(
            _angle_figure(results, joint, angle, detail, panel=True)
            for joint, angle in results.angles
        )
        name = "during walking" if _first_cycle(results) is not None else "with the most movement"
        parts.append(
            f'<div class="block"><h3>Detail of {_DETAIL_S:.0f} s {name}</h3>'
            f'<div class="panels">{panels}</div></div>'
        )
    return section("angles", "Joint angles", parts)


def _detail_start(results: SessionResults) -> float | None:
    """Return the start of the detailed section, s: the first walking or the largest movement.

    If the session is too short for a detailed section, return None.
    """
    if results.end_s - results.start_s < 3.0 * _DETAIL_S:
        return None
    first = _first_cycle(results)
    if first is not None:
        return min(first, results.end_s - _DETAIL_S)

    joint, angle = results.angles[0]
    starts = np.arange(results.start_s, results.end_s - _DETAIL_S, _DETAIL_S / 2.0)
    edges = np.searchsorted(joint.t_s, np.column_stack([starts, starts + _DETAIL_S]))
    windows = [joint.angles[angle][a:b] for a, b in edges]
    known = [window[np.isfinite(window)] for window in windows]
    spreads = [float(np.std(window)) if len(window) else 0.0 for window in known]
    return float(starts[int(np.argmax(spreads))])


def _first_cycle(results: SessionResults) -> float | None:
    begun = [gait.cycles_s[0, 0] for gait in results.gait.values() if len(gait.cycles_s)]
    return float(min(begun)) if begun else None


def _angle_figure(
    results: SessionResults,
    joint: JointSeries,
    angle: str,
    span_s: tuple[float, float],
    *,
    panel: bool = False,
) -> str:
    inside = (joint.t_s >= span_s[0]) & (joint.t_s <= span_s[1])
    t_s, values = joint.t_s[inside], np.degrees(joint.angles[angle][inside])
    sd = np.degrees(joint.angle_sd[angle][inside]) if angle in joint.angle_sd else None
    if sd is not None and not np.isfinite(sd).any():
        sd = None
    optical = results.optical_joint(joint.name)
    seen = None
    if optical is not None and angle in optical.angles:
        shown = (optical.t_s >= span_s[0]) & (optical.t_s <= span_s[1])
        seen = optical.t_s[shown], np.degrees(optical.angles[angle][shown])

    reach = [values] if sd is None else [values - QUANTILE_95 * sd, values + QUANTILE_95 * sd]
    limits = _limits([*reach, *([] if seen is None else [seen[1]])])
    name = joint_angle(joint.name, angle)

    def draw(width: float, kind: str) -> str:
        area = PlotArea(width, 150.0 if panel else 168.0, span_s, limits)
        parts = [frame(area, second_ticks(area), degree_ticks(area, 4), "degrees")]
        if sd is not None:
            parts.append(
                band(area, t_s, values - QUANTILE_95 * sd, values + QUANTILE_95 * sd, "imu")
            )
        if seen is not None:
            parts.append(line(area, *seen, "optical"))
        parts.append(line(area, t_s, values, "imu"))
        label = f"{name} over time, {_range_text(values)}"
        return image(width, area.height, label, parts, kind)

    drawing = draw(_PANEL, "") if panel else responsive(draw)
    legend = [*(_IMU_LEGEND if sd is not None else _IMU_LEGEND[:1])]
    if seen is not None:
        legend.append(_OPTICAL_LEGEND)
    caption = f"{name}: {_range_text(values)}"
    return figure(drawing, caption, [] if panel else legend)


def _limits(curves: list[Array]) -> tuple[float, float]:
    known = [curve[np.isfinite(curve)] for curve in curves]
    known = [curve for curve in known if len(curve)]
    if not known:
        return 0.0, 1.0
    return pad_limits(
        min(float(curve.min()) for curve in known), max(float(curve.max()) for curve in known), 0.06
    )


def _range_text(values_deg: Array) -> str:
    if not np.isfinite(values_deg).any():
        return "unknown"
    return f"{decimal(np.nanmin(values_deg))}° to {decimal(np.nanmax(values_deg))}°"


def gait_section(results: SessionResults) -> str:
    """Return the section with the mean and standard deviation of the angles over a gait cycle."""
    if not results.gait:
        text = "Gait cycles need the orientation of a shank; the session has none."
        return section("gait", "Gait cycles", [paragraph(text)])

    parts = []
    for side, gait in results.gait.items():
        heading = f"<h3>{escape(title(side))} leg</h3>" if side else ""
        if gait.refused is not None:
            parts += [heading, paragraph(f"No gait cycles: {gait.refused}.")]
            continue
        parts += [heading, _stride_facts(gait)]
        panels = "".join(
            _cycle_figure(results, joint, angle, gait)
            for joint, angle in results.angles
            if side_of(joint.name) in ("", side)
        )
        legend = [("imu", "mean of the cycles"), ("band", "± 1 standard deviation between cycles"),
                  ("cycle", "single cycles")]  # fmt: skip
        if results.session.optical_joints:
            legend.append(("optical", "mean from the cameras"))
        panels = f'<div class="panels">{panels}</div>'
        parts.append(f'<div class="block">{figure(panels, _CYCLE_CAPTION, legend)}</div>')
    parts.append(paragraph(_GAIT_METHOD, "note"))
    return section("gait", "Gait cycles", parts)


_CYCLE_CAPTION = "Joint angles over the gait cycle, from one initial contact to the next."
_GAIT_METHOD = (
    "Method: mid-swing is the peak of the sagittal angular velocity of the shank (Aminian et al."
    " 2002, Salarian et al. 2004). Initial contact is the end of the forward rotation of the shank"
    " after mid-swing, when the foot is farthest in front of the body (principle of Zeni et al."
    " 2008)."
    f" At least {LEAST_CYCLES} successive cycles of similar duration count as walking. No foot"
    " switch was used: the instants can differ from the contact of the heel by some hundredths of a"
    " second."
)


def _stride_facts(gait: GaitCycles) -> str:
    durations = gait.durations_s
    cadence = 120.0 / durations
    sd, cadence_sd = (float(x.std(ddof=1)) for x in (durations, cadence))
    return facts(
        [
            ("Cycles", f"{len(durations)}"),
            ("Stride time", f"{decimal(durations.mean(), 2)} s ± {decimal(sd, 2)} s"),
            ("Variation of stride time", percent(sd / float(durations.mean()))),
            ("Cadence", f"{decimal(cadence.mean(), 0)} ± {decimal(cadence_sd, 0)} steps/min"),
        ]
    )


def _cycle_figure(results: SessionResults, joint: JointSeries, angle: str, gait: GaitCycles) -> str:
    curves = normalize_cycles(joint.t_s, joint.angles[angle], gait.cycles_s)
    name = joint_angle(joint.name, angle)
    if not len(curves.cycles):
        return figure("", f"{name}: unknown in every cycle")
    optical = results.optical_joint(joint.name)
    reference: CycleCurves | None = None
    if optical is not None and angle in optical.angles:
        reference = normalize_cycles(optical.t_s, optical.angles[angle], gait.cycles_s)

    mean, sd = np.degrees(curves.mean), np.degrees(curves.sd)
    single = np.degrees(curves.cycles)
    limits = _limits([single, mean - sd, mean + sd])
    area = PlotArea(_PANEL, 200.0, (0.0, 100.0), limits)
    x_ticks = [(float(v), f"{v}") for v in range(0, 100, 20)] + [(100.0, "100 %")]
    parts = [frame(area, x_ticks, degree_ticks(area), "degrees")]
    parts += [line(area, curves.percent, cycle, "cycle") for cycle in single[:40]]
    parts.append(band(area, curves.percent, mean - sd, mean + sd, "imu"))
    if reference is not None and len(reference.cycles):
        parts.append(line(area, reference.percent, np.degrees(reference.mean), "optical"))
    parts.append(line(area, curves.percent, mean, "imu"))

    spread = float(np.nanmean(sd))
    caption = (
        f"{name}: mean curve {_range_text(mean)}, sd between cycles {decimal(spread)}°,"
        f" {count_text(len(curves.cycles), 'cycle')}"
    )
    return figure(image(_PANEL, 200.0, caption, parts), caption)


def range_section(results: SessionResults) -> str:
    """Return the table of the range of motion."""
    if not results.ranges:
        return section("range", "Range of motion", [paragraph("No joint angle is known.")])
    low = min(found.minimum for found in results.ranges)
    high = max(found.maximum for found in results.ranges)
    limits = pad_limits(float(np.degrees(low)), float(np.degrees(high)), 0.03)
    rows = [
        (
            joint_angle(found.joint, found.angle),
            with_sd(found.minimum, found.minimum_sd),
            with_sd(found.maximum, found.maximum_sd),
            with_sd(found.extent, found.extent_sd),
            degree(found.median),
            f"{degree(found.low)} to {degree(found.high)}",
            percent(found.known_share),
            _range_bar(found, limits),
        )
        for found in results.ranges
    ]
    head = (
        "Angle", "Minimum", "Maximum", "Range", "Median", "95 % of the values", "Known",
        "Distribution",
    )  # fmt: skip
    return section(
        "range",
        "Range of motion",
        [
            table("Range of motion of every angle", head, rows),
            paragraph(
                "Whole session. ± is one standard deviation of the measurement, where it is known."
                " Known: share of the frames with a value. The bar covers 95 % of the values, and"
                " the thin line covers all values. The gap in the bar is the median.",
                "note",
            ),
        ],
    )


def _range_bar(found: MotionRange, limits: tuple[float, float]) -> Drawing:
    area = PlotArea(120.0, 18.0, limits, (0.0, 1.0), left=0.0, right=0.0, top=0.0, bottom=0.0)
    values = np.degrees([found.minimum, found.low, found.median, found.high, found.maximum])
    a, b, middle, c, d = (float(x) for x in area.x_px(values))
    zero = float(area.x_px(0.0))
    parts = [
        f'<line class="grid zero" x1="{zero:.1f}" x2="{zero:.1f}" y1="0" y2="18"/>',
        f'<line class="line imu" x1="{a:.1f}" x2="{d:.1f}" y1="9" y2="9"/>',
        f'<rect class="bar" x="{b:.1f}" y="4" width="{max(1.0, c - b):.1f}" height="10"/>',
        f'<rect class="median" x="{middle - 1.2:.1f}" y="3" width="2.4" height="12"/>',
    ]
    label = f"{degree(found.minimum)} to {degree(found.maximum)}"
    return Drawing(image(120.0, 18.0, label, parts, "inline"))


def comparison_section(results: SessionResults) -> str:
    """Return the section on the angle differences between sensors and cameras."""
    if not results.differences:
        text = "There is no reference: the cameras measured no joint angle in this session."
        return section("cameras", "Sensors against cameras", [paragraph(text)])
    rows = [
        (
            joint_angle(found.joint, found.angle),
            degree(found.rms),
            degree(found.bias),
            degree(found.sd),
            f"{degree(found.limits[0])} to {degree(found.limits[1])}",
            degree(found.worst),
            percent(found.coverage),
        )
        for found in results.differences
    ]
    head = ("Angle", "RMS", "Bias", "SD", "Limits of agreement", "Largest", "Inside interval")

    # Draw two figures for each joint, of its first angle (flexion or elevation): the difference
    # over time, and the difference over the mean (Bland-Altman plot).
    shown: dict[str, AngleDifference] = {}
    for found in results.differences:
        shown.setdefault(found.joint, found)
    panels = "".join(_difference_figure(one) + _agreement_figure(one) for one in shown.values())
    return section(
        "cameras",
        "Sensors against cameras",
        [
            table("Angles from the sensors minus angles from the cameras", head, rows),
            f'<div class="panels pairs">{panels}</div>',
            paragraph(
                "Bias: mean difference. Limits of agreement: bias ± 1.96 standard deviations (Bland"
                " and Altman 1986). Inside interval: share of the differences within the published"
                " 95 % interval of the sensor angles; 95 % is expected. The angles from the cameras"
                " have errors, too, mainly from soft tissue.",
                "note",
            ),
        ],
    )


def _difference_figure(found: AngleDifference) -> str:
    values = np.degrees(found.difference)
    name = joint_angle(found.joint, found.angle)
    limits = pad_limits(min(0.0, float(values.min())), max(0.0, float(values.max())))
    span = (float(found.t_s[0]), float(found.t_s[-1]))
    area = PlotArea(_HALF, 200.0, span, limits)

    # A NaN in each long gap of the cameras prevents a line across the gap.
    t_s = found.t_s
    if len(t_s) > 1:
        wide = np.flatnonzero(np.diff(t_s) > 5.0 * np.median(np.diff(t_s))) + 1
        t_s, values = np.insert(t_s, wide, t_s[wide]), np.insert(values, wide, np.nan)
    parts = [
        frame(area, second_ticks(area), degree_ticks(area), "degrees"),
        line(area, t_s, values, "imu"),
    ]
    caption = f"{name}: difference over time, RMS {degree(found.rms)}"
    return figure(image(_HALF, 200.0, caption, parts), caption)


def _agreement_figure(found: AngleDifference) -> str:
    every = max(1, -(-len(found.difference) // _MOST_POINTS))
    mean, values = np.degrees(found.mean[::every]), np.degrees(found.difference[::every])
    low, high = (float(np.degrees(limit)) for limit in found.limits)
    name = joint_angle(found.joint, found.angle)
    x_limits = pad_limits(float(mean.min()), float(mean.max()), 0.04)
    y_limits = pad_limits(min(low, float(values.min())), max(high, float(values.max())))
    area = PlotArea(_HALF, 200.0, x_limits, y_limits)
    x_ticks = [(v, number(v)) for v in nice_ticks(*x_limits, 5)]
    x_ticks = [(v, t + ("°" if v == x_ticks[-1][0] else "")) for v, t in x_ticks]
    ends = np.array(x_limits)
    parts = [
        frame(area, x_ticks, degree_ticks(area), "difference, degrees"),
        points(area, mean, values, "imu"),
        *(line(area, ends, np.full(2, v), "limit") for v in (low, high)),
        line(area, ends, np.full(2, float(np.degrees(found.bias))), "bias"),
    ]
    caption = (
        f"{name}: difference over the mean of sensors and cameras; bias {degree(found.bias)}"
        f" (line), limits of agreement {decimal(low)}° to {decimal(high)}° (dashed)"
    )
    return figure(image(_HALF, 200.0, caption, parts), caption)
