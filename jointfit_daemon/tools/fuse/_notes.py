"""Notes on sensor lags, which `jointfit fuse apply` ignores, and on the side of the limb.

A model file does not contain the side (left or right), which sets the signs of some angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.limb_model import Calibration

LARGEST_LAG_DIFFERENCE_NS = 1_000_000
"""Largest difference between lags that is not reported. At 360 deg/s, 1 ms corresponds to 0.4 deg.
"""


def calibration_notes(
    calibration: Calibration, sensors: Collection[str], *, left: bool
) -> tuple[str, ...]:
    """Return notes, each with its remedy, on lags and on the side of the limb.

    Parameters
    ----------
    calibration
        Model of `jointfit fuse fit`, or calibration stored by the daemon.
    sensors
        Names of the sensors to fuse.
    left
        Value of the option ``--left``: whether the limb is a left limb.
    """
    notes = []
    lags = {name: ns for name, ns in calibration.lag_ns.items() if name in sensors}
    difference = max(lags.values(), default=0) - min(lags.values(), default=0)
    if difference > LARGEST_LAG_DIFFERENCE_NS:
        listed = ", ".join(f"{name} {ns * 1e-6:.1f}" for name, ns in lags.items())
        notes.append(
            f"sensor lags of the calibration differ by {difference * 1e-6:.1f} ms and are not"
            f" applied ({listed} ms): if the file contains the time stamps of the sensors,"
            " interpolate each sensor at t + lag first"
        )

    # A model of `jointfit fuse fit` contains no side either, but the user of this command has
    # already selected the signs, so a note is not necessary.
    known = left or bool(calibration.left_joints) or "offline" in calibration.quality
    if not known:
        notes.append(
            "side assumed to be right, because a stored calibration does not contain it: add --left"
            " for a left limb"
        )
    return tuple(notes)
