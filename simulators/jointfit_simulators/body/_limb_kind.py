"""Description of a limb that the simulator can move.

A limb is a chain of at most four body parts, or both legs with the pelvis. Its posture has the
columns of ``_limb.py``: position and orientation of the base (pelvis, or thorax of the arm), three
angles of each of three joints (of both legs), and the plate.

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
    """``right`` or ``left`` at the begin of a branch."""


class RigChain(NamedTuple):
    """The limb as rig.toml describes it, from proximal to distal."""

    joints: tuple[str, ...]
    """Joints from proximal to distal; empty for a branched limb."""
    segments: tuple[str, ...]
    proximal: str | None = None
    distal: str | None = None
    lengths_m: Mapping[str, float] = {}
    """Lengths of segments with one joint centre only, which markers do not determine."""
    connections: tuple[Connection, ...] = ()
    """Joints of a branched limb."""


class MainJoint(NamedTuple):
    """The joint whose angles the ground-truth log contains."""

    name: str
    columns: slice
    """Columns of flexion, adduction (or bending) and rotation in a coordinate array."""
    proximal: str
    distal: str


@dataclass(frozen=True, slots=True)
class LimbKind:
    """Anatomy, instruments and movements of one kind of limb."""

    name: str
    pose: Callable[[Array], LegPose]
    """Bones for coordinates of shape (n, COORDINATES)."""
    joints: Mapping[str, str]
    """Joints, and the part whose origin is the joint centre."""
    main: MainJoint
    sensors: Mapping[str, str]
    """Default sensor ids and their segments."""
    clusters: Mapping[str, tuple[str, ...]]
    """Markers of each part, and of the plate."""
    templates: Callable[[np.random.Generator], Mapping[str, Array]]
    """Marker positions in the frame of each part, drawn with errors of the operator, m."""
    adjacent: Mapping[str, tuple[slice, ...]]
    """Joints that move the soft tissue of each part, as columns of a coordinate array."""
    motions: Mapping[str, StyledMotion]
    reference: tuple[str, ...]
    """Motions over which soft-tissue artefact has the RMS values of the settings."""
    facts: Mapping[str, object]
    """Lengths and joint centres for the ground-truth log, m."""
    chain: RigChain
