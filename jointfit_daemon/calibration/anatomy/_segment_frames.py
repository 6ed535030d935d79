"""Joint centers, segment lengths and segment axes from markers in the static pose and in motion.

All coordinates are in the *static world*, which is the optical world as it was during the static
pose. All body parts therefore have the same coordinate system. The z axis of a segment points from
its distal to its proximal joint center. The x axis points to the right of the subject along the
flexion axis, and y = z × x. The origin is the proximal joint center. A segment with two distal
joints, such as the pelvis of both legs, is an exception. Its x axis passes through both joints,
from left to right, and its origin is between them. If ``Chain.static_axes`` is set, all segments
have the axes of the world in the static pose. Quantities that could not be determined are None, and
`notes` contains the reasons.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration.anatomy._chosen_center import CenterChoice, chosen_center
from jointfit_daemon.calibration.anatomy._joint_center import (
    UNSEEN_SD_M,
    align_vertically,
    carried_center_gap,
    joint_center,
)
from jointfit_daemon.calibration.anatomy._standing_prior import apply_standing_prior
from jointfit_daemon.center_of_rotation import hinge_axis_sd
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    angle_convention,
    body_parts,
    branch_runs,
    configured_length,
    distal_joints,
    flexion_sign,
    inner_joints,
    is_left,
    joint_parts,
    visible,
)
from jointfit_daemon.model import AngleConvention, FrameFlag

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.model import Chain


MIN_FLEXION_RAD = radians(8.0)
"""RMS rotation about the flexion axis below which the axis is undefined, rad."""
MAX_AXIS_TILT = 0.7
"""Largest accepted cosine of the angle between flexion axis and long axis of a segment."""
CONFIGURED_SD_M = 0.01
"""Standard deviation of a configured length, m."""
SKIN_SD_M = 0.005
"""Systematic error of every center from skin markers, m. The residuals do not contain this error.
"""
RADIAL_ARTEFACT_SD_M = 0.003
"""Radial, posture-dependent part of the 5 mm soft-tissue artefact of a marker, m. The resulting
error of the center is inversely proportional to the arc of the movement.
"""

_UP = np.array([0.0, 0.0, 1.0])
_STANDING = rotation.IDENTITY
"""Orientation of every segment in the static pose with static axes (q_O = 1 in the patent CN
114533039 B).
"""


@dataclass(frozen=True, slots=True)
class JointCenter:
    """Joint center in the static world, estimated together with the other centers of the chain."""

    center: Array
    """Position in the static world, m, shape (3,)."""
    covariance: Array
    """Covariance of the position, m², shape (3, 3)."""
    source: str
    """Source of the center. ``fit`` is an estimate from the movement. ``length`` is computed from
    the other end of a segment and its configured length. ``midpoint`` is the middle between the two
    distal joints of a branched segment.
    """
    fit: CenterEstimate | None
    """Center of rotation from the movement; None if `source` is not ``fit``."""
    gap_rms: float | None
    """RMS distance during the movement between the center fixed in the proximal body part and the
    center fixed in the distal body part, m."""

    @property
    def source_text(self) -> str:
        """Description of the source of the joint center.

        ``markers`` is a center from the movement. ``markers, static pose`` is a center with a
        direction that the movement did not determine. ``configured`` is a center from another joint
        and a configured length. ``midpoint`` is the middle between two joints.
        """
        if self.fit is None:
            return "midpoint" if self.source == "midpoint" else "configured"
        return "markers, static pose" if len(self.fit.unseen) > 0 else "markers"


@dataclass(frozen=True, slots=True)
class FlexionAxis:
    """Flexion axis of one joint during the movement."""

    axis: Array
    """Unit vector in the static world, to the right of the subject, shape (3,)."""
    rms: float
    """RMS rotation about the axis, rad."""
    off: float
    """RMS angle between the long axis of the distal part and the plane of the rotation, rad."""
    bend: float
    """Mean of angle times absolute angle, rad^2. It is small if the joint moves equally to both
    sides.
    """


@dataclass(frozen=True, slots=True)
class Anatomy:
    """Anatomy of a limb from the static pose and a movement."""

    joints: Mapping[str, JointCenter | None]
    q_static: Mapping[str, Array]
    """Orientation of each segment in the static world, q_world_segment, shape (4,)."""
    lengths: Mapping[str, tuple[float | None, float | None]]
    """Length and its standard deviation for each segment, m."""
    length_sources: Mapping[str, str]
    """Source of the length of each segment: ``configured``, ``markers`` (distance of its joint
    centers) or ``unknown``.
    """
    axes: Mapping[str, FlexionAxis]
    flags: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())


def find_anatomy(
    chain: Chain, tracks: Mapping[str, ClusterTrack], choice: CenterChoice | None = None
) -> Anatomy:
    """Determine joint centers, lengths and axes.

    Parameters
    ----------
    chain : Chain
        Joints, segments, configured lengths and adjacent body parts.
    tracks : mapping of str to ClusterTrack
        The functional trial; body parts without markers are absent.
    choice : CenterChoice, optional
        Estimators of the centers; the sphere fit if None.

    Raises
    ------
    CalibrationError
        No joint flexed enough for a flexion axis, the axis is along a segment, or a configured
        estimator rejected the movement of its joint.
    """
    fits, notes = _fit_centers(chain, tracks, choice or CenterChoice())

    joints = _with_lengths(chain, fits)
    if unknown := [name for name, found in joints.items() if found is None]:
        notes.append(f"joint centers unknown: {', '.join(unknown)}; configure lengths in rig.toml")

    ends = [_segment_ends(chain, i, joints) for i in range(len(chain.segments))]
    branched = [len(distal_joints(chain, i)) > 1 for i in range(len(chain.segments))]
    long_axes = [
        None if wide else _direction(*pair) for wide, pair in zip(branched, ends, strict=True)
    ]
    z = [_UP if axis is None else axis for axis in long_axes]
    axes = _flexion_axes(chain, tracks, z)

    flags = [
        FrameFlag.AXIS_VERTICAL.of(segment)
        for segment, end in zip(chain.segments, ends, strict=True)
        if None in end
    ]

    q_static, lengths, sources = {}, {}, {}
    shoulders = _shoulders(chain)
    for i, segment in enumerate(chain.segments):
        x = _direction(*ends[i]) if branched[i] else None
        if x is None:
            used = _axis_joints(chain, i, axes)
            x = _mean_axis([axes[joint] for joint in used])
            if not chain.static_axes and shoulders.intersection(used):
                flags.append(FrameFlag.AXIS_FROM_SHOULDER.of(segment))
        if x is None and _joint_tracks(chain, tracks):
            raise CalibrationError(
                f"{segment}: no adjacent joint flexed enough to determine its flexion axis; "
                "flex and extend it (squats)"
            )
        if x is None:  # the heading of a single segment is not observable
            flags.append(FrameFlag.FACING_UNKNOWN)
            x = np.array([1.0, 0.0, 0.0])
        q_static[segment] = _STANDING.copy() if chain.static_axes else _frame(segment, x, z[i])
        lengths[segment], sources[segment] = _length(chain, i, *ends[i])
    notes += _shoulder_note(chain, flags)
    flags = list(dict.fromkeys(flags))
    return Anatomy(joints, q_static, lengths, sources, axes, tuple(flags), tuple(notes))


def _joint_tracks(
    chain: Chain, tracks: Mapping[str, ClusterTrack]
) -> dict[str, tuple[ClusterTrack, ClusterTrack]]:
    """Return the two body parts of every joint with visible markers on both sides."""
    parts = [tracks.get(part) if part is not None else None for part in body_parts(chain)]
    found = {}
    for joint, (proximal, distal) in zip(chain.joints, joint_parts(chain), strict=True):
        above, below = parts[proximal], parts[distal]
        if above is not None and below is not None:
            found[joint] = (above, below)
    return found


def _segment_ends(
    chain: Chain, i: int, joints: Mapping[str, JointCenter | None]
) -> tuple[JointCenter | None, JointCenter | None]:
    """Return the proximal and distal joint of a segment, or right and left joint if branched."""
    distal = distal_joints(chain, i)
    if len(distal) == 1:
        return joints[chain.joints[i]], joints[chain.joints[distal[0]]]
    right, left = sorted(distal, key=lambda joint: is_left(chain, joint))
    return joints[chain.joints[right]], joints[chain.joints[left]]


def _fit_centers(
    chain: Chain, tracks: Mapping[str, ClusterTrack], choice: CenterChoice
) -> tuple[dict[str, JointCenter | None], list[str]]:
    found: dict[str, CenterEstimate] = {}
    notes, faults, jointed = [], [], _joint_tracks(chain, tracks)
    turned = [choice.turned.get(part) if part else None for part in body_parts(chain)]
    for joint, (above, below) in jointed.items():
        start = (above.origin + below.origin) / 2
        method = choice.methods.get(joint, "sphere")
        if method == "sphere":
            fit = joint_center(above, below, start)
        else:
            a, b = joint_parts(chain)[chain.joints.index(joint)]
            fit = chosen_center(method, above, below, start, (turned[a], turned[b]))

        if fit.refused is None:
            points = above.to_static(below.points)
            found[joint] = replace(fit, axis_sd=hinge_axis_sd(points, fit.axis))
        elif method == "sphere":
            notes.append(f"{joint}: no center: {fit.refused}")
        else:  # a configured estimator is not replaced by another estimator
            faults.append(f"{joint}: center_method {method}: {fit.refused}")
    if faults:
        raise CalibrationError(*faults)

    settled = place_unobserved(chain, found)

    out: dict[str, JointCenter | None] = dict.fromkeys(chain.joints)
    for joint, fit in settled.items():
        gap = carried_center_gap(*jointed[joint], fit.center)
        out[joint] = JointCenter(fit.center, on_skin(fit), "fit", fit, gap)

    # Combine the centers with the prior that the subject stood upright in the static pose.
    for run in branch_runs(chain):
        names = [chain.joints[i] for i in run]
        centers = [out[name] for name in names]
        straight = apply_standing_prior(
            [None if joint is None else joint.center for joint in centers],
            [None if joint is None else joint.covariance for joint in centers],
        )
        for name, center, pair in zip(names, centers, straight, strict=True):
            if center is not None and pair is not None:
                out[name] = replace(center, center=pair[0], covariance=pair[1])
    return out, notes


def place_unobserved(
    chain: Chain, found: Mapping[str, CenterEstimate]
) -> dict[str, CenterEstimate]:
    """Move centers along unobserved directions until they are above or below their neighbors.

    The limb is straight in the static pose, so neighboring joints are vertically above each other.
    Centers next to fully observed centers are moved first.
    """
    whole = [joint for joint, fit in found.items() if len(fit.unseen) == 0]
    settled = {joint: found[joint] for joint in whole}
    place = {  # number of the run of joints, and position in the run
        chain.joints[i]: (k, at)
        for k, run in enumerate(branch_runs(chain))
        for at, i in enumerate(run)
    }

    def apart(joint: str, other: str) -> int:
        (k, at), (n, there) = place[joint], place[other]
        return abs(at - there) if k == n else len(place)

    def distance(joint: str) -> int:
        return min((apart(joint, other) for other in whole), default=0)

    hinges = [joint for joint in chain.joints if joint in found and joint not in settled]
    for joint in sorted(hinges, key=distance):
        # Mean horizontal position of the neighbors, (x, y), m.
        near = [other for other in chain.joints if apart(joint, other) == 1]
        beside = [settled[other].center for other in near if other in settled]
        above = np.mean(beside, axis=0)[:2] if beside else None
        settled[joint] = align_vertically(found[joint], above)
    return settled


def on_skin(fit: CenterEstimate) -> Array:
    r"""Return the covariance of a joint center from skin markers, m², shape (3, 3).

    .. math:: C + \sigma_u^2\, U^T U + \sigma_r^2 L

    where C is ``fit.covariance``, the rows of U are the unobserved directions, and L =
    ``fit.leverage`` is the covariance per m² of radial soft-tissue artefact. The standard
    deviations are σ_u = `UNSEEN_SD_M` and σ_r = `RADIAL_ARTEFACT_SD_M`.
    """
    return artefact_covariance(fit) + UNSEEN_SD_M**2 * np.asarray(fit.unseen.T @ fit.unseen)


def artefact_covariance(fit: CenterEstimate) -> Array:
    r"""Return :math:`C + \sigma_r^2 L`, which is 0 along unobserved directions, m², (3, 3)."""
    if fit.leverage is None:
        return fit.covariance
    return fit.covariance + RADIAL_ARTEFACT_SD_M**2 * fit.leverage


def posture_covariance(fit: CenterEstimate) -> Array:
    r"""Return the covariance of a center with its persistent residuals counted once, m², (3, 3).

    .. math:: C + s^2 L

    where C is ``fit.covariance``, s = ``fit.noise`` and L = ``fit.leverage``. Residuals from
    soft-tissue artefact persist from frame to frame and repeat with posture. All frames together
    then count as one observation of these residuals. Without persistent residuals, the result is C.
    It is 0 along unobserved directions.
    """
    if fit.leverage is None or "residuals_persist" not in fit.flags:
        return fit.covariance
    return fit.covariance + fit.noise**2 * fit.leverage


def _with_lengths(
    chain: Chain, fits: dict[str, JointCenter | None]
) -> dict[str, JointCenter | None]:
    """Place missing joint centers a configured length above or below known centers.

    The origin of a branched segment is the midpoint of its distal joints.
    """
    joints = dict(fits)
    order = [*range(len(chain.segments)), *reversed(range(len(chain.segments)))]
    for i in order:
        length, distal = configured_length(chain, i), distal_joints(chain, i)
        if length is None or len(distal) != 1:
            continue
        top, bottom = chain.joints[i], chain.joints[distal[0]]
        if (known := joints[top]) is not None and joints[bottom] is None:
            joints[bottom] = _place_vertically(known, -length)
        elif (known := joints[bottom]) is not None and joints[top] is None:
            joints[top] = _place_vertically(known, length)

    for i in range(len(chain.segments)):
        if len(distal_joints(chain, i)) > 1:
            one, other = _segment_ends(chain, i, joints)
            if one is not None and other is not None:
                center, covariance = one.center + other.center, one.covariance + other.covariance
                middle = JointCenter(center / 2, covariance / 4, "midpoint", None, None)
                joints[chain.joints[i]] = middle
    return joints


def _place_vertically(known: JointCenter, up: float) -> JointCenter:
    wide = known.covariance + CONFIGURED_SD_M**2 * np.eye(3)
    return JointCenter(known.center + up * _UP, wide, "length", None, None)


def flexion_axis(
    parent: ClusterTrack, child: ClusterTrack, z_child: Array, sign: float
) -> FlexionAxis | None:
    r"""Return the axis about which a joint rotates the long axis of the distal body part.

    .. math:: x = \arg\min_{|x|=1} \sum_t (x \cdot R_{rel}(t)\, z)^2

    where R_rel is the rotation of the distal part relative to the proximal part. The result is the
    axis of least adduction: the normal of the great circle closest to the path of z. Unlike the
    principal axis of the rotation vectors, it is insensitive to rotation about the long axis. Such
    a rotation accompanies knee flexion.

    Parameters
    ----------
    parent, child : ClusterTrack
        Proximal and distal body part.
    z_child : ndarray, shape (3,)
        Long axis of the distal part in the static world, unit vector.
    sign : float
        Sign of flexion about the axis to the right, from `flexion_sign`.

    Returns
    -------
    FlexionAxis or None
        Axis; None if the RMS rotation is below `MIN_FLEXION_RAD`.
    """
    q = rotation.multiply(rotation.conjugate(parent.q), child.q)
    swung = rotation.rotate(q[visible(q)], z_child)
    if len(swung) < 3:
        return None

    _, s, Vt = np.linalg.svd(swung, full_matrices=False)
    x, y = Vt[2], np.cross(z_child, Vt[2])
    angle = np.arctan2(-(swung @ y), swung @ z_child)
    rms = float(np.sqrt((angle**2).mean()))
    if rms < MIN_FLEXION_RAD:
        return None
    # Large rotations have a large weight, because small rotations do not determine the sign.
    bend = float((angle * np.abs(angle)).mean())
    flip = sign * (1.0 if bend > 0 else -1.0)
    return FlexionAxis(x * flip, rms, float(s[2] / np.sqrt(len(swung))), abs(bend))


def _flexion_axes(
    chain: Chain, tracks: Mapping[str, ClusterTrack], z: Sequence[Array]
) -> dict[str, FlexionAxis]:
    found = {}
    for joint, (above, below) in _joint_tracks(chain, tracks).items():
        i = chain.joints.index(joint)
        distal = z[i] if i < len(z) else _UP  # the distal body part has no long axis
        found[joint] = flexion_axis(above, below, distal, flexion_sign(joint))
    axes = {joint: axis for joint, axis in found.items() if axis is not None}

    # In the static pose all axes point to the right. A joint that moved equally to both sides, such
    # as a wrist or an ankle, does not determine the sign of its axis. Its axis gets the sign of the
    # axis of the joint that was bent most.
    hinges = [axis for joint, axis in axes.items() if joint not in _shoulders(chain)]
    if not hinges:
        return axes
    right = max(hinges, key=lambda axis: axis.bend).axis
    return {
        joint: replace(axis, axis=-axis.axis) if axis.axis @ right < 0.0 else axis
        for joint, axis in axes.items()
    }


def _shoulders(chain: Chain) -> set[str]:
    """Return the shoulder joints, whose axis is not defined by one plane of movement."""
    return {
        chain.joints[joint.number]
        for joint in inner_joints(chain)
        if angle_convention(chain, joint.number) is AngleConvention.ELEVATION
    }


def _axis_joints(chain: Chain, i: int, axes: Mapping[str, FlexionAxis]) -> list[str]:
    """Return the joints that determine the flexion axis of a segment, inner joints if possible.

    In a chain with a shoulder, the axes of elbow and wrist are preferred, even for the thorax.
    """
    inner, shoulders = {joint.name for joint in inner_joints(chain)}, _shoulders(chain)
    ends = [chain.joints[k] for k in (i, *distal_joints(chain, i))]
    hinges = inner - shoulders
    beside = [j for j in ends if j in hinges]
    first = sorted(hinges) if shoulders.intersection(ends) else []

    adjacent = [j for j in ends if j in inner]
    for wanted in (beside, first, adjacent, ends, sorted(hinges), sorted(inner)):
        if usable := [j for j in wanted if j in axes]:
            return usable
    return []


def _mean_axis(axes: Sequence[FlexionAxis]) -> Array | None:
    """Return the mean of axes, weighted by their rotations; None without an axis."""
    if not axes:
        return None
    mean = np.sum([axis.axis * axis.rms for axis in axes], axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _shoulder_note(chain: Chain, flags: Sequence[str]) -> list[str]:
    """Return a note on segments whose axis was determined by a shoulder, with the remedy."""
    prefix = FrameFlag.AXIS_FROM_SHOULDER.of("")
    segments = [flag.removeprefix(prefix) for flag in flags if flag.startswith(prefix)]
    if not segments:
        return []
    hinges = sorted({joint.name for joint in inner_joints(chain)} - _shoulders(chain))
    remedy = (
        f"bend {' or '.join(hinges)} in the functional phase"
        if hinges
        else "raise the arm mainly forward and back in the functional phase"
    )
    return [
        f"{', '.join(segments)}: the flexion axis is the axis of the main movement"
        " of the shoulder. It differs from the anatomical axis if the arm was not raised straight"
        f" forward; {remedy}"
    ]


def _direction(end: JointCenter | None, begin: JointCenter | None) -> Array | None:
    """Return the unit vector from `begin` to `end`; None if either joint center is unknown."""
    if end is None or begin is None:
        return None
    between = end.center - begin.center
    return np.asarray(between / np.linalg.norm(between))


def _frame(segment: str, x: Array, z: Array) -> Array:
    if abs(x @ z) > MAX_AXIS_TILT:
        raise CalibrationError(
            f"{segment}: the main rotation of its joint was about the long axis of the segment; "
            "flex and extend the joint (squats), and check that marker names are not swapped"
        )
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return rotation.from_matrix(np.stack((x, np.cross(z, x), z), axis=1))


def _length(
    chain: Chain, i: int, top: JointCenter | None, bottom: JointCenter | None
) -> tuple[tuple[float | None, float | None], str]:
    configured = configured_length(chain, i)
    if configured is not None:
        return (configured, CONFIGURED_SD_M), "configured"
    if top is None or bottom is None:
        return (None, None), "unknown"
    z = top.center - bottom.center
    length = float(np.linalg.norm(z))
    u = z / length
    variance = u @ (top.covariance + bottom.covariance) @ u + SKIN_SD_M**2
    return (length, float(np.sqrt(variance))), "markers"
