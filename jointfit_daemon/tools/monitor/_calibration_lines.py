"""The calibration view as text: phases, progress, predicted errors, results, and history."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.tools.calibrate import report
from jointfit_daemon.tools.monitor._text_lines import Column, Line, table, wrap
from jointfit_daemon.tools.monitor._words import (
    RUNNING,
    UNKNOWN,
    calibration_sentence,
    format_date,
    format_number,
    title_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.outputs.payload_models import (
        CalibrationState,
        Progress,
        StoredVersion,
    )
    from jointfit_daemon.tools.monitor._monitor_state import MonitorState
    from jointfit_daemon.tools.monitor._rig_view import RigView
    from jointfit_daemon.tools.monitor._text_lines import Style

_BAR = 30
"""Maximum number of cells of the progress bar."""
_WIDE = 66
"""Smallest width at which the joint centres are a table, cells."""
_STEPS = (
    ("align", "a", "Align the sensors", True,
     "Fix all sensors to the plate. Turn the plate about all three axes until the time is over."),
    ("static", "s", "Stand still", False,
     "Put on all sensors and markers. Stand upright and still, with straight joints."),
    ("functional", "f", "Move every joint", True,
     "Move every joint through its range in view of the cameras: walk, squat, sit down and stand"
     " up, circle the hip."),
)  # fmt: skip
"""The calibration phases: name, key, title, whether the phase needs cameras, and instruction."""
_NEXT = {"uncalibrated": "align", "aligned": "static", "posed": "functional"}


def calibration_lines(rig: RigView, width: int) -> list[Line]:
    """Return the calibration view."""
    calibration = rig.calibration
    if calibration is None:
        return wrap("Waiting for the calibration state of the daemon.", width, "muted")
    lines = _running(calibration, rig.progress, width) if calibration.phase in RUNNING else []
    if not lines:
        # List the phases with their keys, and mark the next phase.
        cameras = rig.info is not None and any(
            each.kind == "mocap" for each in rig.info.devices.values()
        )
        steps = [step for step in _STEPS if cameras or not step[3]]
        due = _NEXT.get(str(calibration.phase), "")
        if due and due not in [step[0] for step in steps]:
            due = steps[0][0]
        shown = []
        for number, (phase, key, title, _, text) in enumerate(steps, 1):
            style: Style = "strong" if phase == due else ""
            mark = "▶" if phase == due else " "
            shown.append(Line.of(f"{mark} {number} {title}", style).add(f"  key {key}", "muted"))
            shown += [Line.of("    ") + line for line in wrap(text, width - 4, "muted")]
        lines = [*_result(calibration, width), Line(), *shown]
    return lines


def _running(calibration: CalibrationState, progress: Progress | None, width: int) -> list[Line]:
    """Return progress, instruction, missing movement and predicted errors of the running phase."""
    share = None if progress is None else progress.progress
    title = Line.of(calibration_sentence(calibration), "strong")
    lines = [title.add("  " + format_number(None if share is None else 100 * share, 0, " %"))]
    if share is not None:
        cells = max(1, min(_BAR, width))
        done = round(share * cells)
        lines.append(Line.of("█" * done, "imu").add("░" * (cells - done), "muted"))

    instruction = next((text for phase, *_, text in _STEPS if phase == calibration.phase), "")
    lines += wrap(instruction, width)

    text = progress.text if progress is not None else calibration.text
    data: Mapping[str, Any] = {} if progress is None else progress.data
    found = data.get("missing")
    missing = [str(each) for each in found] if isinstance(found, list) else []
    if text and text not in missing:
        lines += wrap(text, width, "strong")
    for each in missing:
        lines += wrap(f"▲ {each}", width, "warning", indent=2)

    lines += _joint_lines(_table(data.get("joints")), width)
    seen = ", ".join(
        f"{name} {format_number(_number(_table(part).get('seen_pct')), 0, ' %')}"
        for name, part in _table(data.get("parts")).items()
    )
    return lines + (wrap(f"Seen by the cameras: {seen}", width, "muted") if seen else [])


def _joint_lines(joints: Mapping[str, Any], width: int) -> list[Line]:
    """Return the predicted error of every joint centre."""
    if not joints:
        return []

    wide = width >= _WIDE
    columns = [Column("joint centre"), Column("error", right=True)]
    if wide:
        columns += [Column("random error", right=True), Column("arc", right=True), Column("from")]

    rows = []
    for name, joint in joints.items():
        one = _table(joint)
        row: list[tuple[str, Style]] = [
            (title_of(name), "strong"),
            (_error_text(one.get("predicted_error_mm"), 0), ""),
        ]
        if wide:
            row += [
                (_error_text(one.get("noise_error_mm"), 1), ""),
                (format_number(_number(one.get("arc_deg")), 0, "°"), ""),
                (str(one.get("source", UNKNOWN)), ""),
            ]
        met = bool(one.get("met"))
        row.append(("✔ enough" if met else "○ more movement", "good" if met else "strong"))
        rows.append(row)
    return [Line(), *table([*columns, Column("state")], rows, width)]


def _result(calibration: CalibrationState, width: int) -> list[Line]:
    """Return outcome and quality of the last phase, and a remedy for a rejected result."""
    lines = [Line.of(calibration_sentence(calibration), "strong")]
    if calibration.phase == "aborted":
        lines = wrap(f"✖ {calibration_sentence(calibration)}", width, "error", indent=2)
    if calibration.kept:
        lines += wrap(f"✖ Rejected: {calibration.kept}", width, "error", indent=2)
        lines += wrap(
            "Key F repeats the movement and accepts its result, even if it is worse.",
            width,
            "muted",
        )
    quality = calibration.quality
    try:
        texts = report(quality)
    except (
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
    ):  # the quality has the format of another version
        texts = [
            "The quality of this calibration cannot be read: its format is of another version."
        ]
    for text in texts:
        lines += wrap(text, width, indent=2)
    still_s = _number(_table(quality.get("static")).get("still_s"))
    if still_s is not None:
        lines += wrap(f"static pose: still for {format_number(still_s, 1)} s", width)
    if calibration.phase == "calibrated" and not quality.get("holdout"):
        lines += wrap("Made without cameras: its error was not measured.", width, "muted")
    return lines


def history_lines(state: MonitorState, width: int) -> list[Line]:
    """Return the stored calibrations, newest first; a symbol marks the selected calibration."""
    if state.stored_fault:
        return wrap(f"✖ The list cannot be read: {state.stored_fault}", width, "error", indent=2)
    stored = state.stored
    if stored is None:
        return wrap("Reading the stored calibrations.", width, "muted")
    if not stored.versions:
        return wrap("No calibration is stored yet: key 2 shows how to make one.", width, "muted")

    wide = width >= _WIDE
    columns = [Column(""), Column("version", right=True), Column("made")]
    if wide:
        columns += [Column("method"), Column("held-out error")]

    chosen = state.chosen_version()
    rows = [
        _version_row(state, each, in_force=stored.in_force, chosen=each is chosen, wide=wide)
        for each in stored.versions
    ]

    lines = table([*columns, Column("state")], rows, width)
    if not wide and chosen is not None:
        lines += wrap(f"Version {chosen.version}: {_errors(chosen)}", width, "muted")
    if stored.omitted:
        lines += wrap(f"{stored.omitted} older versions: jointfit calibrate --list", width, "muted")
    return lines


def _version_row(
    state: MonitorState, one: StoredVersion, *, in_force: int | None, chosen: bool, wide: bool
) -> list[tuple[str, Style]]:
    style: Style = "chosen" if chosen else ""
    row: list[tuple[str, Style]] = [
        ("▶" if chosen else " ", style),
        (str(one.version), style),
        (format_date(one.created_utc, state.timezone), style),
    ]
    if wide:
        row += [(one.method or UNKNOWN, style), (_errors(one), style)]
    text, level = _version_state(one, in_force)
    return [*row, (text, style or level)]


def _version_state(one: StoredVersion, in_force: int | None) -> tuple[str, Style]:
    if one.fault:
        return f"✖ {one.fault}", "error"
    if one.version == in_force:
        return "✔ in force", "good"
    if not one.usable:
        return "○ of another limb", "muted"
    if one.restored_from is not None:
        return f"copy of {one.restored_from}", ""
    return ("stored" if one.online is None else f"learned, round {one.online.rounds}"), ""


def _errors(one: StoredVersion) -> str:
    errors = [
        f"{title_of(name)} flexion {format_number(error, 1, '°')}"
        for name, error in one.flexion_deg.items()
    ]
    return ", ".join(errors) or "not measured"


def _error_text(value: Any, decimals: int) -> str:
    number = _number(value)
    return UNKNOWN if number is None else f"± {format_number(number, decimals, ' mm')}"


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
