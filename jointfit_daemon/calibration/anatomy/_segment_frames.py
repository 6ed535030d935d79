"""Joint centers and segment axes of a limb from its markers, standing and moving.

Law: everything is in the static world, the optical world while the wearer stood still, where all
body parts share coordinates. A segment's z goes from its distal to its proximal joint center, x to
the wearer's right along the flexion axis found while moving, y = z cross x (or, with static axes,
all are the world's while standing); its origin is the proximal joint center. What could not be
found is None and said in `notes`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationRefused
from jointfit_daemon.calibration.anatomy._joint_center import (
    CenterOfRotation,
    carried_gap,
    joint_center,
    slide_under,
)
from jointfit_daemon.calibration.anatomy._standing_prior import stand_straight
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import body_parts, flexion_sign, visible

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
    from jointfit_daemon.model import Chain


MIN_FLEXION_RAD = radians(8.0)
"""RMS rotation about the flexion axis below which it is not taken."""
MAX_AXIS_TILT = 0.7
"""Largest cosine between flexion axis and long axis of a segment."""
CONFIGURED_SD_M = 0.01
"""Standard deviation given to a configured length."""
SKIN_SD_M = 0.005
"""Systematic part of any center found through skin; no residual shows it."""
SKIN_RADIAL_M = 0.003
"""Part of a marker's 5 mm of skin motion that lies along its radius and repeats with posture; over
a short arc it moves the center by the inverse of that arc."""

_UP = np.array([0.0, 0.0, 1.0])
_STANDING = rotation.IDENTITY
"""With static axes every segment stands unrotated, as the patent has it (q_O = 1)."""


@dataclass(frozen=True, slots=True)
class JointFound:
    """One joint center in the static world."""

    center: Array
    """m, shape (3,)."""
    covariance: Array
    """m², shape (3, 3)."""
    source: str
    """``fit`` | ``length``: from the other end of a segment and its configured length."""
    fit: CenterOfRotation | None
    gap_rms: float | None
    """How far apart the two body parts carry the center, RMS, m."""

    @property
    def told(self) -> str:
        """Return in words where the center comes from.

        ``markers``; ``markers, static pose`` where the movement did not show a direction; or
        ``configured``: a length from another joint.
        """
        if self.fit is None:
            return "configured"
        return "markers, static pose" if len(self.fit.unseen) > 0 else "markers"


@dataclass(frozen=True, slots=True)
class FlexionAxis:
    """The axis that one joint flexed about while moving."""

    axis: Array
    """Unit, static world, to the wearer's right, shape (3,)."""
    rms: float
    """RMS swing about it, rad."""
    off: float
    """RMS angle of the long axis off the plane of the swing, rad."""


@dataclass(frozen=True, slots=True)
class Anatomy:
    """What standing and moving told about the limb."""

    joints: Mapping[str, JointFound | None]
    q_static: Mapping[str, Array]
    """q_static-world_segment per segment, shape (4,)."""
    lengths: Mapping[str, tuple[float | None, float | None]]
    """Length and its standard deviation per segment, m."""
    length_sources: Mapping[str, str]
    """``configured``, ``markers`` (the distance of its joint centers) or ``unknown``."""
    axes: Mapping[str, FlexionAxis]
    flags: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())


def find_anatomy(chain: Chain, tracks: Mapping[str, ClusterTrack]) -> Anatomy:
    """Find joint centers, lengths and axes.

    Parameters
    ----------
    chain : Chain
        Joints, segments, configured lengths, neighbouring body parts.
    tracks : mapping of str to ClusterTrack
        The functional trial; body parts without markers are absent.

    Raises
    ------
    CalibrationRefused
        No joint bent enough to show a flexion axis, or the axis lies along a segment.
    """
    fits, notes = _fit_centers(chain, tracks)
    joints = _with_lengths(chain, fits)
    if unknown := [name for name, found in joints.items() if found is None]:
        notes.append(f"unknown joint centers: {', '.join(unknown)}; give lengths in rig.toml")
    ends = [(joints[a], joints[b]) for a, b in pairwise(chain.joints)]
    z = [_long_axis(top, bottom) for top, bottom in ends]
    axes = _flexion_axes(chain, tracks, z)
    flags = [
        f"axis_vertical:{segment}"
        for segment, end in zip(chain.segments, ends, strict=True)
        if None in end
    ]
    q_static, lengths, sources = {}, {}, {}
    for i, segment in enumerate(chain.segments):
        x = _right_axis(chain, i, axes)
        if x is None and _jointed(chain, tracks):
            raise CalibrationRefused(
                f"{segment}: no joint next to it bent enough to show its flexion axis; bend and "
                "stretch it (squats)"
            )
        if x is None:  # a lone segment: nothing can tell which way it faces
            flags.append("facing_unknown")
            x = np.array([1.0, 0.0, 0.0])
        q_static[segment] = _STANDING.copy() if chain.static_axes else _frame(segment, x, z[i])
        lengths[segment], sources[segment] = _length(chain, i, *ends[i])
    flags = list(dict.fromkeys(flags))
    return Anatomy(joints, q_static, lengths, sources, axes, tuple(flags), tuple(notes))


def _jointed(
    chain: Chain, tracks: Mapping[str, ClusterTrack]
) -> dict[str, tuple[ClusterTrack, ClusterTrack]]:
    """Return the two body parts of every joint whose both sides were seen."""
    parts = [tracks.get(part) if part is not None else None for part in body_parts(chain)]
    return {
        joint: (above, below)
        for joint, above, below in zip(chain.joints, parts, parts[1:], strict=False)
        if above is not None and below is not None
    }


def _fit_centers(
    chain: Chain, tracks: Mapping[str, ClusterTrack]
) -> tuple[dict[str, JointFound | None], list[str]]:
    found: dict[str, CenterOfRotation] = {}
    notes, jointed = [], _jointed(chain, tracks)
    for joint, (above, below) in jointed.items():
        fit = joint_center(above, below, (above.origin + below.origin) / 2)
        if fit.refused is None:
            found[joint] = fit
        else:
            notes.append(f"{joint}: no center: {fit.refused}")
    settled = settle_unseen(chain, found)
    out: dict[str, JointFound | None] = dict.fromkeys(chain.joints)
    for joint, fit in settled.items():
        gap = carried_gap(*jointed[joint], fit.center)
        out[joint] = JointFound(fit.center, on_skin(fit), "fit", fit, gap)
    return _plumbed(out), notes


def settle_unseen(
    chain: Chain, found: Mapping[str, CenterOfRotation]
) -> dict[str, CenterOfRotation]:
    """Move centers along the directions that no movement showed to where the static pose has them.

    Beginning next to those of which everything was seen, each comes under or over its neighbours.
    """
    whole = [joint for joint, fit in found.items() if len(fit.unseen) == 0]
    settled = {joint: found[joint] for joint in whole}
    hinges = [joint for joint in chain.joints if joint in found and joint not in settled]
    for joint in sorted(hinges, key=lambda j: _distance(chain, j, whole)):
        settled[joint] = slide_under(found[joint], _beside(chain, joint, settled))
    return settled


def on_skin(fit: CenterOfRotation) -> Array:
    """Return the covariance of a center, m², with the skin motion that goes with posture."""
    return fit.covariance + SKIN_RADIAL_M**2 * fit.leverage


def _plumbed(found: dict[str, JointFound | None]) -> dict[str, JointFound | None]:
    """Let the static pose, in which the wearer stood straight, say what the movement did not."""
    straight = stand_straight(
        [None if joint is None else joint.center for joint in found.values()],
        [None if joint is None else joint.covariance for joint in found.values()],
    )
    return {
        name: joint
        if joint is None or pair is None
        else replace(joint, center=pair[0], covariance=pair[1])
        for (name, joint), pair in zip(found.items(), straight, strict=True)
    }


def _distance(chain: Chain, joint: str, others: list[str]) -> int:
    """Return how many joints away the nearest of `others` is."""
    i = chain.joints.index(joint)
    return min((abs(i - chain.joints.index(other)) for other in others), default=0)


def _beside(chain: Chain, joint: str, settled: Mapping[str, CenterOfRotation]) -> Array | None:
    """Return where over or under a joint its neighbours are, (x, y), m: legs stand straight."""
    i = chain.joints.index(joint)
    near = [chain.joints[k] for k in (i - 1, i + 1) if 0 <= k < len(chain.joints)]
    beside = [settled[k].center for k in near if k in settled]
    return np.mean(beside, axis=0)[:2] if beside else None


def _with_lengths(chain: Chain, fits: dict[str, JointFound | None]) -> dict[str, JointFound | None]:
    """Place missing ends straight over or under known ones where a length is configured."""
    joints = dict(fits)
    order = [*range(len(chain.segments)), *reversed(range(len(chain.segments)))]
    for i in order:
        length = chain.lengths[i] if i < len(chain.lengths) else None
        top, bottom = chain.joints[i], chain.joints[i + 1]
        if length is None:
            continue
        if (known := joints[top]) is not None and joints[bottom] is None:
            joints[bottom] = _hung(known, -length)
        elif (known := joints[bottom]) is not None and joints[top] is None:
            joints[top] = _hung(known, length)
    return joints


def _hung(known: JointFound, up: float) -> JointFound:
    wide = known.covariance + CONFIGURED_SD_M**2 * np.eye(3)
    return JointFound(known.center + up * _UP, wide, "length", None, None)


def flexion_axis(
    parent: ClusterTrack, child: ClusterTrack, z_child: Array, sign: float
) -> FlexionAxis | None:
    r"""Return the axis about which a joint swings the long axis of its distal part.

    .. math:: x = \arg\min_{|x|=1} \sum_t (x \cdot R_{rel}(t)\, z)^2

    the normal of the great circle nearest to the paths of z: the axis of least adduction. Rotation
    about the long axis, which knees add to flexion, does not turn it, as it would turn the
    principal axis of the rotation vectors.

    Parameters
    ----------
    parent, child : ClusterTrack
        The two body parts.
    z_child : ndarray, shape (3,)
        Long axis of the distal part in the static world, unit.
    sign : float
        Of the flexion about the wearer's right, see `flexion_sign`; the larger swings decide.

    Returns
    -------
    FlexionAxis or None
        None if the swing is below `MIN_FLEXION_RAD` (RMS), where no circle is defined.
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
    # the large swings decide the sign, not the small ones around standing still
    flip = sign * (1.0 if (angle * np.abs(angle)).sum() > 0 else -1.0)
    return FlexionAxis(x * flip, rms, float(s[2] / np.sqrt(len(swung))))


def _flexion_axes(
    chain: Chain, tracks: Mapping[str, ClusterTrack], z: Sequence[Array]
) -> dict[str, FlexionAxis]:
    found = {}
    for joint, (above, below) in _jointed(chain, tracks).items():
        i = chain.joints.index(joint)
        distal = z[i] if i < len(z) else _UP  # the part after the last joint has no long axis
        found[joint] = flexion_axis(above, below, distal, flexion_sign(joint))
    return {joint: axis for joint, axis in found.items() if axis is not None}


def _right_axis(chain: Chain, i: int, axes: Mapping[str, FlexionAxis]) -> Array | None:
    """Return the flexion axis for a segment: of its inner joints, else of its outer ones."""
    inner = set(chain.joints[1:-1])
    ends = (chain.joints[i], chain.joints[i + 1])
    for wanted in ([j for j in ends if j in inner], list(ends), sorted(inner)):
        if usable := [axes[j].axis * axes[j].rms for j in wanted if j in axes]:
            mean = np.sum(usable, axis=0)
            return np.asarray(mean / np.linalg.norm(mean))
    return None


def _long_axis(top: JointFound | None, bottom: JointFound | None) -> Array:
    if top is None or bottom is None:
        return _UP
    z = top.center - bottom.center
    return np.asarray(z / np.linalg.norm(z))


def _frame(segment: str, x: Array, z: Array) -> Array:
    if abs(x @ z) > MAX_AXIS_TILT:
        raise CalibrationRefused(
            f"{segment}: the main rotation of its joint was about the segment's own length; bend "
            "and stretch the joint (squats), and check that the marker names are not mixed up"
        )
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return rotation.from_matrix(np.stack((x, np.cross(z, x), z), axis=1))


def _length(
    chain: Chain, i: int, top: JointFound | None, bottom: JointFound | None
) -> tuple[tuple[float | None, float | None], str]:
    configured = chain.lengths[i] if i < len(chain.lengths) else None
    if configured is not None:
        return (configured, CONFIGURED_SD_M), "configured"
    if top is None or bottom is None:
        return (None, None), "unknown"
    z = top.center - bottom.center
    length = float(np.linalg.norm(z))
    u = z / length
    variance = u @ (top.covariance + bottom.covariance) @ u + SKIN_SD_M**2
    return (length, float(np.sqrt(variance))), "markers"
