"""Figures and notes on the lags and the anatomy of a functional calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration._quality import (
    AnatomyQuality,
    AxisQuality,
    JointQuality,
    LagQuality,
    MeasuredLag,
)
from jointfit_daemon.calibration.registration import NO_LAG

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration.anatomy import Anatomy
    from jointfit_daemon.calibration.registration import SensorLag
    from jointfit_daemon.limb_model import JointCalibration
    from jointfit_daemon.timing.lag import LagEstimate


def lag_quality(moving: LagEstimate | None, used: SensorLag) -> LagQuality:
    """Return the lag in use of one sensor and the lag of the movement alone, if estimated."""
    refused = None if moving is None else moving.refused
    measured = None
    if moving is not None and refused is None:
        measured = MeasuredLag(round(moving.lag_ns), round(moving.sigma_ns), moving.r2)
    return LagQuality(
        used.source,
        None if used.source == "none" else used.lag_ns,
        None if used.sigma_ns is None else round(used.sigma_ns),
        refused,
        measured,
    )


def lag_notes(moving: Mapping[str, LagEstimate], used: Mapping[str, SensorLag]) -> list[str]:
    """Return the sensors without a lag from the movement, with the lag in use."""
    return [
        f"{name}: no lag from this movement ({lag.refused}); "
        f"{used.get(name, NO_LAG).lag_ns / 1e6:.1f} ms used"
        for name, lag in moving.items()
        if lag.refused is not None
    ]


def anatomy_quality(anatomy: Anatomy, joints: Mapping[str, JointCalibration]) -> AnatomyQuality:
    """Return the figures of joint centers, segment lengths and flexion axes."""
    centers = {}
    for name, found in anatomy.joints.items():
        fit = None if found is None else found.fit
        centers[name] = JointQuality(
            source="unknown" if found is None else found.source_text,
            sd_m=joints[name].sd,
            residual_rms_m=joints[name].residual_rms,
            gap_rms_m=joints[name].gap_rms,
            arc_rad=None if fit is None else fit.arc,
            unseen_directions=0 if fit is None else len(fit.unseen),
        )

    return AnatomyQuality(
        centers,
        {name: length for name, (length, _) in anatomy.lengths.items()},
        {name: sd for name, (_, sd) in anatomy.lengths.items()},
        anatomy.length_sources,
        {name: AxisQuality(axis.rms, axis.off) for name, axis in anatomy.axes.items()},
    )
