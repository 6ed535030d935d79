"""Whether a new calibration may replace the one in force. Law: never silently, always a reason."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.limb_model import Calibration

SLACK = 1.15
"""Hold-out figures of two good trials differ by less than this factor."""
SLACK_RAD = np.deg2rad(0.3)
SLACK_M = 0.005


class Verdict(NamedTuple):
    """Whether the new one is at least as good, and why (or why not)."""

    better: bool
    reason: str


def better(new: Calibration, old: Calibration | None) -> Verdict:
    """Judge a new calibration against the one in force.

    Compared in this order, the first difference decides: the chain, whether cameras took part,
    whether worlds were aligned, the hold-out error of each segment and of each inner joint's
    flexion by the method in force (a factor of 1.15 and 0.3° are allowed), and how far apart the
    body parts carry each joint center (5 mm are allowed).
    """
    if old is None:
        return Verdict(True, "there was none")
    if (new.joints, new.segments, new.chain_sensors) != (
        old.joints,
        old.segments,
        old.chain_sensors,
    ):
        return Verdict(True, "the old one is of another chain or other sensors")
    had, has = "holdout" in old.quality, "holdout" in new.quality
    if had != has:
        return Verdict(has, "only the new one saw cameras" if has else "the old one saw cameras")
    assumed = "headings_from_static"
    if (assumed in old.flags) != (assumed in new.flags):
        aligned = assumed in old.flags
        return Verdict(
            aligned, "its worlds are aligned" if aligned else "the old one's worlds were aligned"
        )
    worse = [*_worse_angles(new, old), *_worse_joints(new, old)] if has else []
    return Verdict(False, "; ".join(worse)) if worse else Verdict(True, "no figure is worse")


def _worse_angles(new: Calibration, old: Calibration) -> list[str]:
    found = []
    for kind in ("segments", "flexion"):
        before = old.quality["holdout"].get(kind, {})
        after = new.quality["holdout"].get(kind, {})
        for name in before:
            was, now = _figure(before, name, old.method), _figure(after, name, new.method)
            if was is None or now is None:
                continue
            if now > SLACK * was + SLACK_RAD:
                what = "orientation" if kind == "segments" else "flexion"
                found.append(
                    f"{name}: {what} error {np.rad2deg(now):.1f} deg, was {np.rad2deg(was):.1f}"
                )
    return found


def _figure(figures: Mapping[str, Any], name: str, method: str) -> float | None:
    value = figures.get(name, {}).get(method)
    return float(value) if isinstance(value, int | float) else None


def _worse_joints(new: Calibration, old: Calibration) -> list[str]:
    found = []
    for name, was in old.joint.items():
        now = new.joint[name]
        if was.source == "fit" and now.source != "fit":
            found.append(f"{name}: its center was fitted, now it is {now.source}")
        elif (now.gap_rms or 0.0) > (was.gap_rms or np.inf) + SLACK_M:
            found.append(
                f"{name}: center moves by {1000 * (now.gap_rms or 0.0):.0f} mm, "
                f"was {1000 * (was.gap_rms or 0.0):.0f}"
            )
    return found
