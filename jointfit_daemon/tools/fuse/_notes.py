"""Notes on the parts of a calibration that `jointfit fuse apply` ignores: lags and the side."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from jointfit_daemon.limb_model import Calibration

LARGEST_LAG_DIFFERENCE_NS = 1_000_000
"""Largest lag difference without a note: at 360 deg/s, 1 ms amounts to 0.4 deg."""


def calibration_notes(
    calibration: Calibration, sensors: Collection[str], *, left: bool
) -> tuple[str, ...]:
    """Return notes on quantities that are not applied or not stored, with remedies.

    Parameters
    ----------
    calibration
        Model of `jointfit fuse fit`, or calibration stored by the daemon.
    sensors
        Fused sensors.
    left
        Whether the limb is a left limb, from the option ``--left``.
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

    # A model of `jointfit fuse fit` has no side either, but the user of this command chose the
    # signs.
    known = left or bool(calibration.left_joints) or "offline" in calibration.quality
    if not known:
        notes.append(
            "side assumed to be right, because a stored calibration does not contain it: add --left"
            " for a left limb"
        )
    return tuple(notes)
