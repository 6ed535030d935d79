"""Description of a limb that the simulator can move.

A limb is a chain of at most four body parts, or two legs with the pelvis. Its posture has the
columns of ``_limb.py``: pose of the base, angles of the joints, and pose of the calibration plate.
The base is the pelvis, or the thorax for an arm. Each of the three joints (per leg) has
three angles.

The *base world* is the world in which the movement of the subject is described, with z up.

Invariant: in the static pose every segment frame is parallel to the base world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._limb import LegPose
    from jointfit_simulators.body._motion import StyledMotion


class Connection(NamedTuple):
    """One joint of a branched limb."""

    joint: str
    parent: str
    child: str
    side: str | None = None
    """Side of the branch, ``right`` or ``left``, if the joint begins a branch."""


class RigChain(NamedTuple):
    """Description of the limb in rig.toml, from proximal to distal."""

    joints: tuple[str, ...]
    """Joints from proximal to distal; empty for a branched limb."""
    segments: tuple[str, ...]
    proximal: str | None = None
    distal: str | None = None
    lengths_m: Mapping[str, float] = {}
    """Lengths of segments with a single joint centre, m. Markers do not determine these lengths."""
    connections: tuple[Connection, ...] = ()
    """Joints of a branched limb; empty for other limbs."""


class MainJoint(NamedTuple):
    """The joint whose angles are in the log of the ground truth."""

    name: str
    columns: slice
    """Columns of flexion, adduction (or bending) and rotation in a coordinate array."""
    proximal: str
    distal: str


@dataclass(frozen=True, slots=True)
class LimbKind:
    """Anatomy, sensors, markers and movements of one type of limb."""

    name: str
    pose: Callable[[Array], LegPose]
    """Function that returns the bones for coordinates of shape (n, COORDINATES)."""
    joints: Mapping[str, str]
    """Name of each joint, and the part whose origin is the joint centre."""
    main: MainJoint
    sensors: Mapping[str, str]
    """Segment of each default sensor, by sensor id."""
    clusters: Mapping[str, tuple[str, ...]]
    """Markers of each part and of the plate."""
    templates: Callable[[np.random.Generator], Mapping[str, Array]]
    """Function that returns marker positions in the frame of each part, with random placement
    errors, m."""
    adjacent: Mapping[str, tuple[slice, ...]]
    """Joints that move the soft tissue of each part, as columns of a coordinate array."""
    motions: Mapping[str, StyledMotion]
    reference: tuple[str, ...]
    """Motions in which the soft-tissue artefact has the RMS values of the settings."""
    facts: Mapping[str, object]
    """Lengths and joint centres for the log of the ground truth, m."""
    chain: RigChain
