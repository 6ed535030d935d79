"""Comparison of a new calibration with the current calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.model import FrameFlag

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration

SLACK = 1.15
"""Largest ratio of the hold-out errors of two calibrations that count as equally good."""
SLACK_RAD = np.deg2rad(0.3)
"""Increase of a hold-out error that is accepted in addition to `SLACK`, rad."""
SLACK_M = 0.005
"""Difference of joint-center gaps that is accepted, m."""


class CalibrationComparison(NamedTuple):
    """Whether the new calibration is at least as good as the old calibration, with the reason."""

    better: bool
    reason: str


def compare_calibrations(new: Calibration, old: Calibration | None) -> CalibrationComparison:
    """Compare a new calibration with the current calibration.

    The first criterion in which the calibrations differ determines the result. The criteria are, in
    this order, the chain, the use of cameras, the alignment of the worlds, and all errors together.
    An error is the hold-out error of a segment, the hold-out error of the flexion of an inner
    joint, or the gap of a joint. The gap is the distance between the two centers that are fixed in
    the two body parts of the joint. A hold-out error may be 1.15 times the old error plus 0.3°, and
    a gap may be 5 mm larger than the old gap. A center that was estimated from the movement must
    not be replaced by a center from another source.
    """
    if old is None:
        return CalibrationComparison(True, "no calibration was in force")
    chains = [(one.joints, one.segments, one.chain_sensors) for one in (new, old)]
    if chains[0] != chains[1]:
        return CalibrationComparison(
            True, "the stored calibration belongs to another chain or other sensors"
        )

    had, has = "holdout" in old.quality, "holdout" in new.quality
    if had != has:
        which = "new" if has else "stored"
        return CalibrationComparison(has, f"only the {which} calibration used cameras")

    assumed = FrameFlag.HEADINGS_FROM_STATIC
    if (assumed in old.flags) != (assumed in new.flags):
        aligned = assumed in old.flags
        return CalibrationComparison(
            aligned, f"only the {'new' if aligned else 'stored'} calibration has an align phase"
        )

    worse = [*_worse_angles(new, old), *_worse_joints(new, old)] if has else []
    return CalibrationComparison(not worse, "; ".join(worse) or "no figure is worse")


def _worse_angles(new: Calibration, old: Calibration) -> list[str]:
    found = []
    for kind in ("segments", "flexion"):
        before = old.quality["holdout"].get(kind, {})
        after = new.quality["holdout"].get(kind, {})
        for name in before:
            was, now = before[name].get(old.method), after.get(name, {}).get(new.method)
            if not (isinstance(was, int | float) and isinstance(now, int | float)):
                continue

            if now > SLACK * was + SLACK_RAD:
                quantity = "orientation" if kind == "segments" else "flexion"
                found.append(
                    f"{name}: {quantity} error {np.rad2deg(now):.1f} deg, was {np.rad2deg(was):.1f}"
                )
    return found


def _worse_joints(new: Calibration, old: Calibration) -> list[str]:
    found = []
    for name, was in old.joint.items():
        now = new.joint[name]
        if was.source == "fit" and now.source != "fit":
            found.append(
                f"{name}: the stored center was estimated from the movement, the new center has "
                f"the source {now.source!r}"
            )
        elif (now.gap_rms or 0.0) > (was.gap_rms or np.inf) + SLACK_M:
            found.append(
                f"{name}: center gap {1000 * (now.gap_rms or 0.0):.0f} mm, "
                f"was {1000 * (was.gap_rms or 0.0):.0f}"
            )
    return found
