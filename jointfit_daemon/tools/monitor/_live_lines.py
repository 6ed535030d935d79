"""The live view: the limb, the chosen angle with its curve, and the devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.tools.flag_words import flag_sentence, serious_flags
from jointfit_daemon.tools.monitor._angle_curve import curve_lines
from jointfit_daemon.tools.monitor._big_digits import big_digits
from jointfit_daemon.tools.monitor._device_lines import device_lines
from jointfit_daemon.tools.monitor._limb_figure import limb_lines
from jointfit_daemon.tools.monitor._monitor_state import chosen_angle
from jointfit_daemon.tools.monitor._text_lines import Line, beside, wrap
from jointfit_daemon.tools.monitor._words import (
    angle_name,
    format_number,
    title_of,
)

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payload_models import PoseJoint
    from jointfit_daemon.tools.monitor._monitor_state import MonitorState
    from jointfit_daemon.tools.monitor._rig_view import Moment, RigView

STALE_S = 1.5
"""Age of a pose, s, above which its angle disappears and its limb is drawn in the muted style."""
_OPTICAL_S = 0.6
"""Age of a pose from the cameras, s, above which this pose disappears from the screen."""
_WIDE = 72
"""Smallest width at which the limb is to the left of the curve, cells."""
_LEAST_CURVE, _MOST_CURVE = 3, 24
"""Smallest and largest number of rows of the curve."""
_WITH_SD = ("flexion_deg", "elevation_deg", "inner_deg")
"""Names of the angles to which the `sd_deg` of a joint applies."""


def pose_age_s(rig: RigView, now: Moment) -> float | None:
    """Return the time since the last pose, s; None before the first pose."""
    return None if rig.pose_s is None else now.monotonic_s - rig.pose_s


def live_lines(state: MonitorState, width: int, height: int, now: Moment) -> list[Line]:
    """Return the live view for `height` lines; many devices can need more lines."""
    rig, choice = state.rig, chosen_angle(state)
    devices = device_lines(rig, width, now)
    if rig.pose is None or rig.info is None or _is_uncalibrated(rig):
        return [*_no_pose(rig, width), Line(), *devices]

    figure_width = max(30, min(44, width // 3)) if width >= _WIDE else 0
    angle_width = width - figure_width - 2 if figure_width else width
    if choice is None:
        block = wrap("This rig has no joint between two segments, so it has no angle.", angle_width)
        block += [Line()] * max(0, height - len(devices) - 1 - len(block))
    else:
        # Show title, value with standard deviation, and the reason for a limitation.
        rig = state.rig
        joint = None if rig.pose is None else rig.pose.joints.get(choice[0])
        age_s = pose_age_s(rig, now) or 0.0
        value, sd = (None, None) if age_s > STALE_S else angle_of(joint, choice[1])
        title = Line.of(f"{title_of(choice[0])} {angle_name(choice[1])}", "strong")
        shown = format_number(value, 1, "°")
        spread = "" if value is None or sd is None else f" ± {format_number(sd, 1, '°')}"
        digits = big_digits(shown, unicode=state.unicode)
        big = [Line.of(row, "value") for row in digits]
        big[1] = big[1].add(f" {spread}", "strong")
        reason, warns = _reason(rig, value, sd, age_s)
        note = wrap(reason, angle_width, "warning" if warns else "muted")[:2]
        number = [title, *big, *note]
        free = height - len(number) - 1 - len(devices) - 1
        rows = max(_LEAST_CURVE, min(_MOST_CURVE, free))
        curve = curve_lines(rig, choice, angle_width, rows, unicode=state.unicode)
        block = [*number, *curve]
    if not figure_width:
        return [*block, *devices]
    return [*beside(_figure(state, figure_width, len(block), now), figure_width, block),
            Line(), *devices]  # fmt: skip


def _figure(state: MonitorState, width: int, rows: int, now: Moment) -> list[Line]:
    """Return the drawing of the limb; the style is muted if the pose is old."""
    rig = state.rig
    optical = rig.optical_s is not None and now.monotonic_s - rig.optical_s < _OPTICAL_S
    lines = limb_lines(rig, width, rows, state.turn_deg, optical=optical, unicode=state.unicode)
    if lines is None:
        return wrap("The positions of the joints are unknown.", width, "muted")
    if (pose_age_s(rig, now) or 0.0) <= STALE_S:
        return lines
    return [Line.of(line.text, "muted") for line in lines]


def _is_uncalibrated(rig: RigView) -> bool:
    return rig.calibration is not None and rig.calibration.phase == "uncalibrated"


def _no_pose(rig: RigView, width: int) -> list[Line]:
    """Return the reason for a missing angle, and the remedy."""
    if rig.info is None and rig.pose is not None:
        text = "The layout of the rig (bridge/info) is missing: the account cannot read it."
    elif _is_uncalibrated(rig):
        return [
            Line.of("Not calibrated yet", "strong"),
            *wrap(
                "The sensors send data, but their positions on the body are unknown. A calibration"
                " takes about two minutes: key 2 shows the steps.",
                width,
            ),
        ]
    else:
        text = (
            "Waiting for the first pose (pose/ui). If no pose arrives, the account cannot read"
            " this topic, or pose_ui_hz is low."
        )
    return wrap(text, width, "muted")


def angle_of(joint: PoseJoint | None, key: str) -> tuple[float | None, float | None]:
    """Return an angle of a joint and its standard deviation, degrees."""
    if joint is None:
        return None, None
    return getattr(joint, key, None), joint.sd_deg if key in _WITH_SD else None


def _reason(rig: RigView, value: float | None, sd: float | None, age_s: float) -> tuple[str, bool]:
    """Return the most important limitation of the angle, and whether it is a warning."""
    if age_s > STALE_S:
        return f"No pose for {age_s:.0f} s.", True

    # The most urgent flags precede the reasons for an unknown value or standard deviation.
    flags = serious_flags([] if rig.pose is None else rig.pose.flags)
    if flags:
        return "▲ " + " ".join(map(flag_sentence, flags[:2])), True
    if value is None:
        return "▲ Unknown: one of its two segments has no orientation.", True
    if sd is None:
        return "A standard deviation is published for flexion and elevation only.", False
    if rig.pose is not None and rig.pose.sync == "settling":
        return "The clocks of the devices are settling.", False
    return "", False
