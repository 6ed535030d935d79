"""Forward kinematics of one frame: joint positions and angles with standard deviations.

Orientation errors are assumed to be isotropic and independent between segments.
`joint_angle_estimate` describes an exception for flexion. Only the trace of a position covariance
is propagated, because a LimbState contains only the standard deviation per axis.
"""

from __future__ import annotations

from math import hypot, isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.kinematics.rotation_scalar import rotate_one, rotate_z_one
from jointfit_daemon.limb_model import distal_joints, is_left, proximal_segment
from jointfit_daemon.model import AngleConvention

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.fusion._segment_fuser import FusedSegment
    from jointfit_daemon.model import Chain, JointAngles, Vector


class SegmentLength(NamedTuple):
    """Length of a segment and its standard deviation, m."""

    length: float | None
    sd: float


class JointPlace(NamedTuple):
    """Position of a joint on its proximal segment."""

    segment: int
    """Number of the proximal segment."""
    share: float = 0.0
    """Position of the joint on the segment. It is 0 at the distal end. Otherwise it is the distance
    to the right (+) or left (-) of the segment's origin, as a fraction of the segment's length.
    """


def joint_places(chain: Chain) -> list[JointPlace]:
    """Return the positions on their segments of all joints except the first joint.

    The two distal joints of a branched segment are half its length to the right and left of its
    origin.
    """
    places = []
    for joint in range(1, len(chain.joints)):
        segment = proximal_segment(chain, joint)
        if segment is None:
            raise ValueError(f"joint {chain.joints[joint]} has no proximal segment")
        branched = len(distal_joints(chain, segment)) > 1
        side = -0.5 if is_left(chain, joint) else 0.5
        places.append(JointPlace(segment, side if branched else 0.0))
    return places


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
    origin: Vector,
    fused: Sequence[FusedSegment],
    lengths: Sequence[SegmentLength],
    places: Sequence[JointPlace],
) -> list[tuple[Vector | None, float | None]]:
    r"""Return position (m) and variance per axis (m²) of every joint, from O1 to the distal end.

    Let joint i be the proximal end and joint j the distal end of a segment with the rotation matrix
    :math:`R_i` and the length L. The standard deviations are :math:`\sigma_i` per axis of the
    orientation, rad, and :math:`\sigma_L` of the length, m. Then

    .. math:: P_j = P_i - L\,R_i e_z, \qquad
              \mathrm{tr}\,\Sigma_j = \mathrm{tr}\,\Sigma_i + 2 L^2 \sigma_i^2 + \sigma_L^2

    For joints to the right or left of the origin of a segment, :math:`P_j = P_i \pm \frac{L}{2} R_i
    e_x`; their variance is computed from half the length and half the standard deviation of the
    length. O1 has the variance 0. The propagation is of first order, with isotropic orientation
    errors. Position and variance are None for all joints distal to a segment of unknown orientation
    or length.

    Parameters
    ----------
    origin : Vector
        Position of O1, m.
    fused : sequence of FusedSegment
        Orientation of each segment.
    lengths : sequence of SegmentLength
        Length of each segment.
    places : sequence of JointPlace
        Result of `joint_places`, for all joints except O1.
    """
    traces = [0.0]
    out: list[tuple[Vector | None, float | None]] = [(origin, 0.0)]
    for i, share in places:
        position, segment, (length, length_sd) = out[i][0], fused[i], lengths[i]
        if position is None or segment.q is None or segment.sd is None or length is None:
            traces.append(0.0)
            out.append((None, None))
            continue

        if share:
            length, length_sd = share * length, share * length_sd
            dx, dy, dz = rotate_one(segment.q, (length, 0.0, 0.0))
        else:
            dx, dy, dz = rotate_z_one(segment.q, -length)
        trace = traces[i] + (2.0 * (length * segment.sd) ** 2 + length_sd**2)
        traces.append(trace)
        out.append(((position[0] + dx, position[1] + dy, position[2] + dz), trace / 3.0))
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

    With isotropic errors, :math:`\Sigma_{angles} = (\sigma_1^2 + \sigma_2^2)(E^T E)^{-1}`, where
    :math:`\sigma_1` and :math:`\sigma_2` are the standard deviations per axis of the proximal and
    the distal segment, and E maps the rates of the angles to angular velocity. To first order, the
    standard deviation of the main angle is :math:`f \sqrt{\sigma_1^2 + \sigma_2^2}`. The factor f
    is :math:`1 / \cos\theta` for flexion with adduction (or bending) :math:`\theta`, 1 for
    elevation, and the factor of ``read_joint`` for a tilt.

    If the standard deviation of a segment about its x axis is known, it replaces the isotropic
    value in the conventions ``flexion`` and ``trunk``. In these conventions flexion hardly depends
    on the other axes. If the value is known for both segments, :math:`2 \rho \sigma_1 \sigma_2` is
    subtracted, where :math:`\rho` is the correlation of the model errors about x. Held segments,
    and segments without soft-tissue correction, do not have this value; their errors are treated as
    independent. So is the error `fault_sd` of inconsistent sensors.

    Parameters
    ----------
    proximal, distal : FusedSegment
        The segments above and below the joint.
    sign : float
        Sign of flexion about x, as defined in CONVENTIONS.md.
    left : bool
        Whether the joint is on the left side.
    correlation : float
        Correlation :math:`\rho`.
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
        # In these two conventions the main axis is not the x axis of a segment.
        first = second = None
    total = (proximal.sd if first is None else hypot(first, proximal.fault_sd)) ** 2
    total += (distal.sd if second is None else hypot(second, distal.fault_sd)) ** 2
    if first is not None and second is not None:
        total -= 2.0 * correlation * first * second
    sd = sqrt(total) * factor if isfinite(factor) else None
    return JointAngleEstimate(angles, inner, sd, gimbal)
