"""Quality figures and notes on the lags and the anatomy of a functional calibration.

The *static world* is the optical world as it was during the static pose.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._quality import (
    AnatomyQuality,
    AxisQuality,
    CenterCoordinates,
    CenterQuality,
    JointQuality,
    LagQuality,
    MeasuredLag,
)
from jointfit_daemon.calibration.anatomy import SKIN_SD_M, artefact_covariance, posture_covariance
from jointfit_daemon.calibration.registration import NO_LAG
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    CalibratedCenter,
    JointCalibration,
    body_parts,
    joint_parts,
    vector,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy import Anatomy, ClusterTrack, JointCenter
    from jointfit_daemon.calibration.registration import SensorLag
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.model import Chain, Vector
    from jointfit_daemon.timing.lag import LagEstimate


def lag_quality(moving: LagEstimate | None, used: SensorLag) -> LagQuality:
    """Return the lag that one sensor uses and, if estimated, the lag from the movement alone."""
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
    """Return notes on the sensors without a lag from the movement, with the lag that is used."""
    return [
        f"{name}: no lag from this movement ({lag.refused}); "
        f"{used.get(name, NO_LAG).lag_ns / 1e6:.1f} ms used"
        for name, lag in moving.items()
        if lag.refused is not None
    ]


def joint_record(found: JointCenter | None) -> JointCalibration:
    """Return the stored form of a joint center."""
    if found is None:
        return JointCalibration(None, None, "unknown")
    sd = sqrt(float(np.trace(found.covariance)) / 3.0 + SKIN_SD_M**2)
    fit, center = found.fit, vector(found.center)
    if fit is None:
        return JointCalibration(center, sd, found.source, None, found.gap_rms)

    unseen = tuple(vector(direction) for direction in fit.unseen)
    reference = CalibratedCenter(vector(fit.center), _rows(posture_covariance(fit)), unseen)
    return JointCalibration(center, sd, found.source, fit.residual, found.gap_rms, reference)


def anatomy_quality(
    chain: Chain, anatomy: Anatomy, tracks: Mapping[str, ClusterTrack]
) -> AnatomyQuality:
    """Return the figures of joint centers, segment lengths and flexion axes."""
    joints = {}
    for name, found in anatomy.joints.items():
        fit, record = None if found is None else found.fit, joint_record(found)
        joints[name] = JointQuality(
            source="unknown" if found is None else found.source_text,
            sd_m=record.sd,
            residual_rms_m=record.residual_rms,
            gap_rms_m=record.gap_rms,
            arc_rad=None if fit is None else fit.arc,
            unseen_directions=0 if fit is None else len(fit.unseen),
        )

    return AnatomyQuality(
        joints,
        {name: length for name, (length, _) in anatomy.lengths.items()},
        {name: sd for name, (_, sd) in anatomy.lengths.items()},
        anatomy.length_sources,
        {name: AxisQuality(axis.rms, axis.off) for name, axis in anatomy.axes.items()},
        _center_quality(chain, anatomy, tracks),
    )


def _center_quality(
    chain: Chain, anatomy: Anatomy, tracks: Mapping[str, ClusterTrack]
) -> dict[str, CenterQuality]:
    """Return the center of every joint from the movement, in coordinates of both body parts."""
    parts, centers = body_parts(chain), {}
    for joint, adjacent in zip(chain.joints, joint_parts(chain), strict=True):
        found = anatomy.joints[joint]
        if found is None or found.fit is None:
            continue
        fit = found.fit
        covariance = artefact_covariance(fit)
        sides = {
            part: _coordinates(fit, covariance, tracks[part].origin, anatomy.q_static.get(part))
            for part in (parts[k] for k in adjacent)
            if part is not None
        }
        observed = 3 - len(fit.unseen)
        centers[joint] = CenterQuality(
            method=fit.method,
            frames=fit.frames,
            effective_frames=fit.effective_frames,
            predicted_error_m=sqrt(float(np.trace(covariance)) / observed),
            noise_error_m=sqrt(float(np.trace(fit.covariance)) / observed),
            bound_m=fit.bound if isfinite(fit.bound) else None,
            residual_rms_m=fit.residual,
            arc_rad=fit.arc,
            conditioning=fit.conditioning,
            flags=fit.flags,
            segments=sides,
            axis_sd_rad=fit.axis_sd,
        )
    return centers


def _coordinates(
    fit: CenterEstimate, covariance: Array, origin: Array, q_static: Array | None
) -> CenterCoordinates:
    """Transform a center from the static world to one body part."""
    R = np.eye(3) if q_static is None else rotation.to_matrix(q_static).T
    return CenterCoordinates(
        vector(R @ (fit.center - origin)),
        _rows(R @ covariance @ R.T),
        tuple(vector(R @ direction) for direction in fit.unseen),
        None if fit.axis is None else vector(R @ fit.axis),
    )


def _rows(matrix: Array) -> tuple[Vector, Vector, Vector]:
    a, b, c = matrix
    return vector(a), vector(b), vector(c)
