"""Joint positions and angles of one frame, with their standard deviations. Law: floats only.

Orientation errors are taken as isotropic and independent between segments, but for flexion, see
`read_angles`; what is kept of a position's covariance is its trace, which is all that a LimbState
carries.
"""

from __future__ import annotations

from math import cos, hypot, sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.kinematics.rotation_scalar import along_z_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.fusion._segment_fuser import Fused
    from jointfit_daemon.model import JointAngles, Vector


class Reach(NamedTuple):
    """Length of a segment and its standard deviation, m."""

    length: float | None
    sd: float


class AngleState(NamedTuple):
    """Angles of one joint."""

    angles: JointAngles
    inner: float
    """Between the two segments, rad: pi when straight."""
    flexion_sd: float | None
    """rad."""
    gimbal: bool


def joint_positions(
    origin: Vector, fused: Sequence[Fused], reaches: Sequence[Reach]
) -> list[tuple[Vector | None, float | None]]:
    r"""Run the chain from O1 down; return position (m) and variance per axis (m²) of every joint.

    .. math:: P_{i+1} = P_i - L\,R_i e_z, \qquad
              \mathrm{tr}\,\Sigma_{i+1} = \mathrm{tr}\,\Sigma_i + 2 L^2 \sigma_i^2 + \sigma_L^2

    First-order propagation with isotropic orientation errors. Below a segment whose orientation or
    length is unknown everything is None.
    """
    place: Vector | None = origin
    trace = 0.0
    out: list[tuple[Vector | None, float | None]] = [(origin, 0.0)]
    for one, reach in zip(fused, reaches, strict=True):
        if place is None or one.q is None or one.sd is None or reach.length is None:
            place = None
            out.append((None, None))
            continue
        length = reach.length
        dx, dy, dz = along_z_one(one.q, -length)
        place = (place[0] + dx, place[1] + dy, place[2] + dz)
        trace += 2.0 * (length * one.sd) ** 2 + reach.sd**2
        out.append((place, trace / 3.0))
    return out


def read_angles(
    above: Fused, below: Fused, *, sign: float, left: bool, alike: float = 0.0
) -> AngleState | None:
    r"""Return the angles of one joint, or None where a segment's orientation is unknown.

    With isotropic errors :math:`\Sigma_{angles} = (\sigma_1^2 + \sigma_2^2)(E^T E)^{-1}`, whose
    first entry is :math:`1 / \cos^2\theta` times the sum: the deviation of flexion, to first order
    (E: rates of Grood and Suntay's angles to angular velocity). It is None where the axes lock.
    Where a segment's deviation about its x is known apart, that stands for its sigma: flexion
    hardly feels the others. Where it is of both, `alike`, the correlation of what both models err
    about it, takes :math:`2 \rho \sigma_1 \sigma_2` from the sum. What is held, a plain mean
    or doubted errs by itself.
    """
    if above.q is None or below.q is None or above.sd is None or below.sd is None:
        return None
    angles, inner, gimbal = read_joint(above.q, below.q, flexion_sign=sign, left=left)
    first, second = above.flexion_sd, below.flexion_sd
    total = (above.sd if first is None else hypot(first, above.doubt)) ** 2
    total += (below.sd if second is None else hypot(second, below.doubt)) ** 2
    if first is not None and second is not None:
        total -= 2.0 * alike * first * second
    sd = None if gimbal else sqrt(total) / cos(angles.adduction)
    return AngleState(angles, inner, sd, gimbal)
