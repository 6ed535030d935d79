"""The report of a session as one HTML page without scripts and references to other files.

Invariant: equal sessions produce identical bytes.
"""

from __future__ import annotations

from datetime import UTC, datetime
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.tools.report._movement_sections import (
    angles_section,
    comparison_section,
    gait_section,
    range_section,
)
from jointfit_daemon.tools.report._recording_sections import (
    calibration_section,
    events_section,
    sources_section,
    timing_section,
)
from jointfit_daemon.tools.report._words import (
    UNKNOWN,
    count_text,
    decimal,
    degree,
    duration,
    joint_angle,
    percent,
    title,
)
from jointfit_daemon.tools.report.html_document import document, facts, footer
from jointfit_daemon.tools.report.session_results import analyze_session

if TYPE_CHECKING:
    from jointfit_daemon.session_data import SessionData
    from jointfit_daemon.tools.report.session_results import SessionResults

_SECTIONS = (
    angles_section,
    gait_section,
    range_section,
    comparison_section,
    sources_section,
    timing_section,
    calibration_section,
    events_section,
)
_DESCRIBED = (
    ("subject", "Subject"),
    ("limb", "Limb"),
    ("side", "Side"),
    ("calibration", "Calibration"),
    ("software", "Recorded with"),
    ("processed", "Processed with"),
    ("gateway", "Gateway"),
    ("recording", "File"),
    ("source", "Source"),
)
"""Keys of a session's description, and the names of the keys on the page."""
_MUCH_LOSS = 0.05
"""Share of lost samples above which the page highlights the value."""
_DISCLAIMER = (
    "jointfitd is not a medical device. Angles and their uncertainty were estimated by software"
    " from body-worn sensors; a diagnosis must not rest on them alone."
)


def render_report(session: SessionData) -> str:
    """Return the page of a session as HTML."""
    results = analyze_session(session)
    body = "".join(draw(results) for draw in _SECTIONS)
    main = f"{_header(results)}<main>{_summary(results)}{body}</main>{footer(_DISCLAIMER)}"
    return document(f"{_name(session)}: session report", main)


def _name(session: SessionData) -> str:
    return session.description.get("rig") or session.name or "session"


def _header(results: SessionResults) -> str:
    session, date = results.session, UNKNOWN
    if session.start_unix_ns is not None:
        start = datetime.fromtimestamp(session.start_unix_ns // 1_000_000_000, tz=UTC)
        date = f"{start.day} {start:%B %Y, %H:%M:%S} UTC"
    pairs = [("Date", date), ("Duration", duration(session.duration_s))]
    pairs += [
        (label, session.description[key])
        for key, label in _DESCRIBED
        if session.description.get(key)
    ]
    links = "".join(
        f'<a href="#{anchor}">{escape(text)}</a>'
        for anchor, text in (
            ("angles", "Angles"), ("gait", "Gait"), ("range", "Range"), ("cameras", "Cameras"),
            ("recorded", "Recording"), ("events", "Faults"),
        )
    )  # fmt: skip
    return (
        f'<header><p class="kicker">Session report</p><h1>{escape(_name(session))}</h1>'
        f'{facts(pairs, "facts head")}<nav aria-label="Sections">{links}</nav></header>'
    )


def _summary(results: SessionResults) -> str:
    """Return the boxes with the most important results."""
    count = results.faults
    faults = "see the list below" if count else "none reported"
    tiles = [
        _range_tile(results),
        _gait_tile(results),
        _camera_tile(results),
        _loss_tile(results),
        ("Faults", f"{count}", faults, count > 0),
    ]
    inner = "".join(
        f'<li class="tile{" alert" if alert else ""}"><span class="label">{escape(label)}</span>'
        f'<strong>{escape(value)}</strong><span class="remark">{escape(remark)}</span></li>'
        for label, value, remark, alert in tiles
    )
    return f'<section aria-label="Summary"><ul class="tiles">{inner}</ul></section>'


def _range_tile(results: SessionResults) -> tuple[str, str, str, bool]:
    if not results.ranges:
        return "Range of motion", UNKNOWN, "no joint angle is known", False
    found = max(results.ranges, key=lambda found: found.extent)
    remark = f"{degree(found.minimum, 0)} to {degree(found.maximum, 0)}"
    if np.isfinite(found.extent_sd):
        remark += f", ± {degree(found.extent_sd)}"
    return f"{joint_angle(found.joint, found.angle)}, range", degree(found.extent, 0), remark, False


def _gait_tile(results: SessionResults) -> tuple[str, str, str, bool]:
    walked = {side: gait for side, gait in results.gait.items() if len(gait.cycles_s)}
    if not walked:
        return "Gait cycles", "0", "no walking was recognized", False
    count = sum(len(gait.cycles_s) for gait in walked.values())
    stride = np.concatenate([gait.durations_s for gait in walked.values()])
    sides = f", {' and '.join(walked)} leg" if all(walked) else ""
    return (
        "Gait cycles",
        f"{count}",
        f"stride {decimal(stride.mean(), 2)} s ± {decimal(stride.std(ddof=1), 2)} s{sides}",
        False,
    )


def _camera_tile(results: SessionResults) -> tuple[str, str, str, bool]:
    if not results.differences:
        return "Against the cameras", UNKNOWN, "the cameras measured no reference", False
    found = results.differences[0]
    name = joint_angle(found.joint, found.angle)
    return "Against the cameras", degree(found.rms), f"RMS difference, {name.lower()}", False


def _loss_tile(results: SessionResults) -> tuple[str, str, str, bool]:
    shares = {n: q.lost_share for n, q in results.sources.items() if np.isfinite(q.lost_share)}
    if not shares:
        return "Samples lost", UNKNOWN, "the file contains no samples", False
    worst = max(shares, key=shares.__getitem__)
    gaps = sum(len(found.gaps_s) for found in results.sources.values())
    remark = f"worst source: {title(worst)}; {count_text(gaps, 'gap')}"
    return "Samples lost", percent(shares[worst]), remark, shares[worst] > _MUCH_LOSS
