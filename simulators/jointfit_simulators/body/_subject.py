"""Interface of a simulated or recorded subject.

Positions are in m, in the *base world*. This is the world in which the movement of the subject is
described, with z up. Each sensor has its own world, and so do the cameras.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._limb_kind import RigChain
    from jointfit_simulators.body._orientation import Rotation


class GroundTruth(NamedTuple):
    """Bones at n times."""

    orientations: Mapping[str, Rotation]
    """Rotation from segment coordinates to the base world, by segment."""
    joints: Mapping[str, Array]
    """Centre of each joint, m, shape (n, 3); NaN if unknown."""
    angles: Array
    """Flexion, adduction (or bending) and rotation of the main joint, rad, shape (n, 3)."""
    included: Array
    """Inner angle of the main joint, rad, shape (n,); pi when straight."""
    joint: str = "knee"
    """Name of the main joint."""


class Observation(NamedTuple):
    """Error-free measurements of one block of time. Each stream has its own sampling times."""

    sensors: Sequence[Array]
    """Orientation q_base_sensor of each sensor, with alignment and soft-tissue artefact, shape (n,
    4)."""
    markers: Array
    """Marker positions on the skin, m, shape (camera times, markers, 3); NaN if not recorded."""
    bones: Mapping[str, tuple[Rotation, Array]]
    """Orientation and origin (m) of each bone that the cameras stream as a rigid body."""
    truth: GroundTruth


class InstrumentedSubject(Protocol):
    """Subject with sensors and markers."""

    @property
    def sensors(self) -> Mapping[str, str]:
        """Segment of each sensor, by sensor id."""

    @property
    def clusters(self) -> Mapping[str, tuple[str, ...]]:
        """Markers of each body part, in the order of `Observation.markers`."""

    @property
    def templates(self) -> Mapping[str, Array]:
        """Markers of each rigid body in the frame of the body, m, shape (markers, 3)."""

    @property
    def visible_bones(self) -> tuple[str, ...]:
        """Segments whose bones the cameras stream as rigid bodies (the reference of a trial)."""

    @property
    def chain(self) -> RigChain:
        """Description of the limb in rig.toml."""

    @property
    def facts(self) -> Mapping[str, object]:
        """Constant properties for the log of the ground truth, as JSON values."""

    def play(self, name: str, t_s: float, *, at_once: bool = False) -> None:
        """Start another motion, without a blend if `at_once`.

        Raises
        ------
        UnknownMotionError
            There is no motion with this name.
        """

    def motion_at(self, t_s: float) -> str:
        """Return the name of the motion at the time `t_s`."""

    def discard_before(self, t_s: float) -> None:
        """Discard the state for times before `t_s`, which will not be requested again."""

    def observe(self, sensors: Sequence[Array], cameras: Array, truth: Array) -> Observation:
        """Return the observation at the given times (s) of each sensor, the cameras and the log."""
