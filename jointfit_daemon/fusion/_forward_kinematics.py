"""Forward kinematics of one frame: joint positions and angles with standard deviations.

Orientation errors are taken as isotropic and independent between segments, except for flexion (see
`joint_angle_estimate`). Only the trace of a position covariance is propagated, since a LimbState
contains no more.
"""

from __future__ import annotations

from math import hypot, isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.kinematics.rotation_scalar import rotate_z_one
from jointfit_daemon.model import AngleConvention

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.fusion._segment_fuser import FusedSegment
    from jointfit_daemon.model import JointAngles, Vector


class SegmentLength(NamedTuple):
    """Length of a segment and its standard deviation, m."""

    length: float | None
    sd: float


class JointAngleEstimate(NamedTuple):
    """Angles of one joint."""

    angles: JointAngles
    inner: float
    """Angle between the two segments, rad; pi if straight."""
    main_sd: float | None
    """Standard deviation of the main angle (flexion or elevation), rad; None where the angle is not
    defined."""
    gimbal: bool
    """Whether the joint is at gimbal lock."""


def joint_positions(
    origin: Vector, fused: Sequence[FusedSegment], lengths: Sequence[SegmentLength]
) -> list[tuple[Vector | None, float | None]]:
    r"""Return position (m) and variance per axis (m²) of every joint, from O1 downwards.

    .. math:: P_{i+1} = P_i - L\,R_i e_z, \qquad
              \mathrm{tr}\,\Sigma_{i+1} = \mathrm{tr}\,\Sigma_i + 2 L^2 \sigma_i^2 + \sigma_L^2

    First-order propagation with isotropic orientation errors. Both values are None below a segment
    of unknown orientation or length.
    """
    position: Vector | None = origin
    trace = 0.0
    out: list[tuple[Vector | None, float | None]] = [(origin, 0.0)]
    for segment, stored in zip(fused, lengths, strict=True):
        if position is None or segment.q is None or segment.sd is None or stored.length is None:
            position = None
            out.append((None, None))
            continue

        length = stored.length
        dx, dy, dz = rotate_z_one(segment.q, -length)
        position = (position[0] + dx, position[1] + dy, position[2] + dz)
        trace += 2.0 * (length * segment.sd) ** 2 + stored.sd**2
        out.append((position, trace / 3.0))
    return out


def joint_angle_estimate(
    proximal: FusedSegment,
    distal: FusedSegment,
    *,
    sign: float,
    left: bool,
    correlation: float = 0.0,
    convention: AngleConvention = AngleConvention.FLEXION,
) -> JointAngleEstimate | None:
    r"""Return the angles of one joint, or None if an orientation is unknown.

    With isotropic errors, :math:`\Sigma_{angles} = (\sigma_1^2 + \sigma_2^2)(E^T E)^{-1}`, where E
    maps the rates of the angles to angular velocity. Its entry of the main angle gives the standard
    deviation :math:`f \sqrt{\sigma_1^2 + \sigma_2^2}`, to first order. The factor f is
    :math:`1 / \cos\theta` for flexion with adduction (or bending) :math:`\theta`, 1 for elevation,
    and that of ``read_joint`` for a tilt.

    If the standard deviation of a segment about its x axis is known, it replaces the isotropic one
    in the conventions ``flexion`` and ``trunk``, whose flexion hardly depends on the other axes. If
    it is known for both segments,
    :math:`2 \rho \sigma_1 \sigma_2` is subtracted, where :math:`\rho` is the correlation of the
    model errors about x. Errors of held, uncorrected or inconsistent segments are treated as
    independent.

    Parameters
    ----------
    proximal, distal : FusedSegment
        The segments above and below the joint.
    sign : float
        Sign of flexion about x, see CONVENTIONS.md.
    left : bool
        Whether the limb is on the left side.
    correlation : float
        :math:`\rho`.
    convention : AngleConvention
        Definition of the angles.
    """
    if proximal.q is None or distal.q is None or proximal.sd is None or distal.sd is None:
        return None
    angles, inner, gimbal, factor = read_joint(
        proximal.q, distal.q, flexion_sign=sign, left=left, convention=convention
    )

    first, second = proximal.flexion_sd, distal.flexion_sd
    if convention in {AngleConvention.ELEVATION, AngleConvention.TILT_TORSION}:
        first = second = None  # their main axis is not the x axis of a segment
    total = (proximal.sd if first is None else hypot(first, proximal.fault_sd)) ** 2
    total += (distal.sd if second is None else hypot(second, distal.fault_sd)) ** 2
    if first is not None and second is not None:
        total -= 2.0 * correlation * first * second
    sd = sqrt(total) * factor if isfinite(factor) else None
    return JointAngleEstimate(angles, inner, sd, gimbal)
