"""Data types that packages exchange: frozen, in SI units, without behaviour.

Invariant: this module imports no other module of the project, and reads no clock or file.
Quaternions are Hamilton, scalar first; ``q_a_b`` converts b-coordinates to a-coordinates. The world
is ENU with z up. ``t_ns`` is CLOCK_MONOTONIC of the host, ns. Unknown values are ``None`` (NaN in
arrays), never 0. See CONVENTIONS.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]
"""Hamilton unit quaternion (w, x, y, z)."""

Vector = tuple[float, float, float]
"""Three components, SI."""


# --- inputs -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as received by the host.

    A stream chunk is any part of the byte stream, a datagram chunk is one datagram, and a CAN chunk
    is a sequence of records (``jointfit_protocols.can._frame``).
    """

    t_ns: int
    """Arrival stamp, CLOCK_MONOTONIC ns."""
    data: bytes


class TickClock(NamedTuple):
    """Time base of a device."""

    tick_ns: int
    """Duration of a tick, ns (100 000 for 100 µs); ignored if ``ticks_per_s`` is set."""
    modulus: int | None
    """Number of ticks after which the counter wraps to 0; None if it never wraps."""
    ticks_per_s: int | None = None
    """Exact tick rate, 1/s, if the period is not a whole number of nanoseconds (NatNet)."""
    scale: Literal["own", "monotonic", "unix"] = "own"
    """Origin of the time base: arbitrary (``own``), CLOCK_MONOTONIC of this host, or UNIX time that
    PTP synchronizes between device and host. ``monotonic`` and ``unix`` come from rig.toml."""


class ImuSample(NamedTuple):
    """One sample of one IMU."""

    arrival_ns: int
    """Arrival of the first byte, CLOCK_MONOTONIC ns. On a UART it is computed from the number of
    bytes and the baud rate."""
    q_world_sensor: Quaternion
    """Unit quaternion, sensor to ENU world of this sensor (heading may be arbitrary)."""
    q_native: Quaternion
    """Quaternion as sent, converted to real numbers, but neither rotated nor normalised."""
    ticks: int | None
    """Device time as sent, in ticks of the decoder's ``tick_clock``; None without device time."""
    counter: int | None
    """Sequence number as sent; None if the device sends none."""
    status: int | None = None
    """Status word of the device; None if the device sends none."""
    rate: Vector | None = None
    """Angular rate at the instant of the orientation, sensor axes, rad/s; None if not sent. A mean
    over the interval since the last sample is not permitted."""
    acceleration: Vector | None = None
    """Specific force, sensor axes, m/s² (+9.81 upwards at rest); None if not sent."""
    magnetic: Vector | None = None
    """Magnetic field, sensor axes, in the unit of the device; None if not sent."""


@dataclass(frozen=True, slots=True)
class MocapLayout:
    """Names of the markers and rigid bodies of a `MocapFrame`, in the order of its arrays."""

    markers: tuple[str, ...]
    bodies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """One frame of the optical system, z up, metres. NaN means occluded."""

    arrival_ns: int
    number: int
    ticks: int | None
    """Instant of exposure in device ticks; None if the server has no clock."""
    layout: MocapLayout
    markers: NDArray[np.float64]
    """Marker positions in the optical world, m, shape (len(layout.markers), 3)."""
    body_positions: NDArray[np.float64]
    """Rigid-body positions, m, shape (len(layout.bodies), 3)."""
    body_orientations: NDArray[np.float64]
    """Rigid-body orientations q_world_body, shape (len(layout.bodies), 4)."""
    live: bool = True
    """Whether the frame is a live measurement; False if the server plays back a recording."""
    counted: bool = True
    """Whether the server numbers its frames. Without frame numbers, lost frames are not
    detected."""
    residuals: NDArray[np.float64] | None = None
    """Residual of the cameras for each marker, m, shape (len(layout.markers),); NaN where the
    server sent none. None if the protocol has no residuals."""


@dataclass(frozen=True, slots=True)
class ClockEcho:
    """One echo: the host requests the time of a device, and the device replies with its ticks.

    The clock offset is estimated from the ticks and the host times of request and reply.
    """

    sent_ns: int
    received_ns: int
    ticks: int


class SyncPulse(NamedTuple):
    """One edge on a hardware sync line, with the stamp of the device that detected or generated it.

    An edge (rising, unless configured otherwise) occurs at the same instant on all devices
    connected to the line, within one microsecond. A decoder returns pulses in wire order among its
    samples. It returns only pulses that the device reported.
    """

    arrival_ns: int
    """Arrival of the first byte of the message, ns; an error of milliseconds does not matter."""
    ticks: int
    """Device time of the edge, in ticks of the decoder's ``tick_clock``."""
    line: int = 0
    """Configured number of the line; equal for all devices connected to it."""
    number: int | None = None
    """Edge counter of the device; None if the device sends none."""


@dataclass(frozen=True, slots=True)
class Corrupt:
    """Bytes that belong to no valid message."""

    discarded: int
    reason: str
    rejected: int = 0
    """Number of well-formed messages among these bytes whose content cannot be used."""


DeviceEventKind = Literal[
    "info", "restart", "clock", "gap", "counter", "setting", "warning", "error"
]  # fmt: skip
"""Kinds of device events; `DeviceEvent` explains them."""


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """A message or state change of a device that is not a measurement.

    Kinds: ``info`` (data: model, serial number, firmware, settings read back), ``restart`` (the
    device restarted), ``clock`` (the device time restarted), ``gap`` (data: number of lost
    samples), ``counter`` (the sequence number jumped without loss), ``setting`` (a setting changed
    during operation), ``warning``, ``error``.
    """

    kind: DeviceEventKind
    text: str
    data: Mapping[str, object] = field(default_factory=dict)


Decoded = ImuSample | MocapFrame | ClockEcho | SyncPulse | Corrupt | DeviceEvent
"""Items that a decoder returns."""


# --- the body ---------------------------------------------------------------------------------


class AngleConvention(StrEnum):
    """Definition of the three angles of a joint; see docs/kinematics.md."""

    FLEXION = "flexion"
    """Flexion, adduction, axial rotation: hip, knee, ankle, elbow, wrist."""
    ELEVATION = "elevation"
    """Plane of elevation, elevation, axial rotation: shoulder."""
    TILT_TORSION = "tilt_torsion"
    """Flexion and adduction, which are the components of the tilt of the distal long axis, and
    torsion about this axis."""
    TRUNK = "trunk"
    """Flexion, lateral bending and axial rotation of the upper segment relative to the lower
    one."""


ANGLE_NAMES = {
    AngleConvention.FLEXION: ("flexion", "adduction", "rotation"),
    AngleConvention.ELEVATION: ("plane", "elevation", "rotation"),
    AngleConvention.TILT_TORSION: ("flexion", "adduction", "rotation"),
    AngleConvention.TRUNK: ("flexion", "bending", "rotation"),
}
"""Names of the three angles in outputs, in the order of `JointAngles`."""


@dataclass(frozen=True, slots=True)
class Chain:
    """A limb: joints O1 to On+1 from proximal to distal, and the n segments between them.

    In a branched limb, joint i is the proximal joint of segment i. The joints after the last
    segment are the distal ends of the branches. In `segments`, a segment always comes after its
    proximal segment. The first segment has two distal joints, and O1 is the midpoint between them.
    """

    joints: tuple[str, ...]
    segments: tuple[str, ...]
    sensors: tuple[tuple[str, ...], ...]
    """Sensor ids of each segment, in the order of ``segments``; at least one per segment, unless
    the limb is planar."""
    left_side: bool = False
    """Whether the limb is on the left side, where adduction and rotation have the opposite sign
    (CONVENTIONS.md)."""
    origin: Vector | None = None
    """Fixed position of O1 in the world, m. If None, O1 is at the origin of the world, or at the
    position that the cameras measure."""
    lengths: tuple[float | None, ...] = ()
    """Configured segment lengths, m; None if calibration estimates them."""
    proximal: str | None = None
    """Body part proximal of O1, such as the pelvis, that has markers but no sensors; None without
    such a part."""
    distal: str | None = None
    """Body part distal of the last joint, such as the foot, that has markers but no sensors; None
    without such a part."""
    static_axes: bool = False
    """Whether the segment axes equal the world axes in the static pose. If False, joint centres
    define the segment axes."""
    planar: bool = False
    """Whether the cameras alone measure a movement in a plane, without sensors and calibration."""
    conventions: tuple[AngleConvention | None, ...] = ()
    """Configured angle convention of each joint; None if the name of the joint selects it."""
    parents: tuple[int | None, ...] = ()
    """Index of the proximal segment of each joint, None for O1. The tuple is empty for a limb
    without branches."""
    left_joints: tuple[bool, ...] = ()
    """Whether each joint is on the left side; empty if ``left_side`` holds for all joints."""
    distals: tuple[str | None, ...] = ()
    """Body parts distal of the ends of a branched limb, used instead of ``distal``; None for an end
    without such a part."""


class JointAngles(NamedTuple):
    """Three angles of a joint, rad, in the order of its `AngleConvention`.

    The fields are named for the convention ``flexion``. CONVENTIONS.md defines the signs.
    """

    flexion: float
    adduction: float
    rotation: float


class SegmentState(NamedTuple):
    """One segment at one instant."""

    name: str
    q_world_segment: Quaternion | None
    sd: float | None
    """Standard deviation of the orientation, rad (root of the mean variance per axis)."""
    used: tuple[str, ...]
    """Ids of the sensors that contributed."""


class JointState(NamedTuple):
    """One joint at one instant. End joints of the chain have a position but no angles."""

    name: str
    position: Vector | None
    position_sd: float | None
    """Standard deviation of the position, m (root of the mean variance per axis)."""
    angles: JointAngles | None = None
    inner: float | None = None
    """Included angle between the two segments, rad; π when straight."""
    angle_sd: float | None = None
    """Standard deviation of flexion, or of elevation in the convention ``elevation``, rad."""
    rates: JointAngles | None = None
    """Rates of change of the angles over the last 50 ms, rad/s."""
    convention: AngleConvention = AngleConvention.FLEXION
    """Definition of `angles` and `rates`."""
    proximal: int | None = None
    """Index of the joint's proximal segment in a branched limb. None means the segment before the
    joint."""


class FusionMode(StrEnum):
    """Measurements on which a limb state is based."""

    UNCALIBRATED = "uncalibrated"
    IMU = "imu"
    IMU_AND_MOCAP = "imu+mocap"


class SyncState(StrEnum):
    """State of the clock estimates of a frame."""

    SETTLING = "settling"
    LOCKED = "locked"


class FrameFlag(StrEnum):
    """A limitation of a limb state; docs/mqtt.md explains each."""

    UNCALIBRATED = "uncalibrated"
    HEADINGS_FROM_STATIC = "headings_from_static"
    SAME_POSE_ASSUMED = "same_pose_assumed"
    FACING_UNKNOWN = "facing_unknown"
    EXTRAPOLATING = "extrapolating"
    ORIGIN_FIXED = "origin_fixed"
    HEADING_UNSEEN = "heading_unseen"
    GIMBAL = "gimbal"
    UNCORRECTED = "uncorrected"

    # Flags of one sensor, segment or joint.
    STUCK = "stuck"
    SLIPPED = "slipped"
    PAIR_DISAGREES = "pair_disagrees"
    HEADING_DISAGREES = "heading_disagrees"
    ONE_SENSOR = "one_sensor"
    HELD = "held"
    LOST = "lost"
    UNTRAINED = "untrained"
    AXIS_VERTICAL = "axis_vertical"
    AXIS_FROM_SHOULDER = "axis_from_shoulder"

    def of(self, name: str) -> str:
        """Return the flag of one sensor, segment or joint, as ``held:thigh``."""
        return f"{self.value}:{name}"


class LimbState(NamedTuple):
    """State of the limb at ``t_ns``. Every frame has a limb state, even if no sensor has data."""

    seq: int
    t_ns: int
    completed_ns: int
    """Arrival of the sample, or the deadline, that completed this frame, ns."""
    mode: FusionMode
    sync: SyncState
    flags: tuple[str, ...]
    """Flags of the frame. A flag that concerns one sensor, segment or joint ends in the name of
    this object."""
    segments: tuple[SegmentState, ...]
    joints: tuple[JointState, ...]


class SensorOrientation(NamedTuple):
    """One sensor in one frame, before any correction."""

    name: str
    q_world_sensor: Quaternion | None
    """Orientation in the sensor's own world, at the instant of the frame; None without data."""
    q_world_segment: Quaternion | None
    """Orientation of the sensor's segment from this sensor alone; None without data or
    calibration."""


class SensorStates(NamedTuple):
    """All sensors in one frame, and the rotations of the joints."""

    seq: int
    """Frame number of the limb state."""
    t_ns: int
    sensors: tuple[SensorOrientation, ...]
    joints: tuple[tuple[str, Quaternion | None], ...]
    """q_proximal_distal of every joint between two segments, computed from the fused segments."""


class OpticalSegment(NamedTuple):
    """Orientation of one segment as measured by the cameras."""

    name: str
    q_world_segment: Quaternion | None
    """Orientation measured by the cameras; None while fewer than three markers of the segment, or
    not its rigid body, are visible."""
    residual: float | None
    """Angle between the orientations from the IMUs and from the cameras, rad."""
    residual_rms: float | None
    """RMS of `residual` over the last seconds, rad."""


class OpticalJoint(NamedTuple):
    """One joint as measured by the cameras. Residuals are IMU minus cameras."""

    name: str
    position: Vector | None
    """Mean of the joint centers fixed in the two adjacent body parts, m."""
    gap: float | None
    """Distance between the two joint centers whose mean is `position`, m; None unless both body
    parts are visible."""
    distance: float | None
    """Distance between the positions from the IMUs and from the cameras, m."""
    distance_rms: float | None
    """RMS of `distance` over the last seconds, m."""
    angles: JointAngles | None = None
    inner: float | None = None
    """Included angle between the two segments, rad."""
    residual: JointAngles | None = None
    """Differences between the angles from the IMUs and from the cameras, rad, at most half a
    turn."""
    residual_rms: JointAngles | None = None
    """RMS of `residual` over the last seconds, rad."""
    convention: AngleConvention = AngleConvention.FLEXION
    """Definition of `angles` and `residual`."""


class RunningCenter(NamedTuple):
    """Center of rotation of one joint, estimated from the most recent camera frames.

    The coordinate frame moves with the proximal body part. Its origin is the mean of the part's
    markers. Its axes are the axes of the segment, or of the static pose for a part without sensors.
    """

    joint: str
    segment: str
    """Proximal body part."""
    arc: float
    """Range of the marker directions about the center, rad."""
    refused: str | None
    """Reason why there is no center; None if `center` is given."""
    center: Vector | None = None
    """Position of the center, m."""
    covariance: tuple[Vector, Vector, Vector] | None = None
    """Covariance of the center, m², which is 0 along `unseen`. Residuals from soft-tissue artefact
    repeat with posture, so all frames together count as one observation of these residuals."""
    unseen: tuple[Vector, ...] = ()
    """Unit directions along which the center was not observed. Their largest component is positive.
    """
    axis: Vector | None = None
    """Unit axis of a hinge joint, which is the only unobserved direction; None unless exactly one
    direction was not observed."""
    effective_frames: float | None = None
    """Number of independent frames."""
    position: Vector | None = None
    """Current position in the optical world, m; None while the body part is not visible."""
    shift: Vector | None = None
    """Displacement from the calibrated center, m, along the directions that were observed for both
    centers."""
    p_value: float | None = None
    """Probability of a shift of this size or larger by chance."""
    moved: bool | None = None
    """Whether `p_value` is so small that the center counts as displaced; None if unknown."""


class RunningCenters(NamedTuple):
    """Running centers of rotation of all joints with markers on both adjacent body parts."""

    t_ns: int
    memory_s: float
    """Time constant with which the weights of older camera frames decrease, s."""
    joints: tuple[RunningCenter, ...]


class OpticalState(NamedTuple):
    """The limb as measured by the cameras in one frame, and the errors of the IMUs."""

    number: int
    """Frame number of the camera server."""
    t_ns: int
    segments: tuple[OpticalSegment, ...]
    joints: tuple[OpticalJoint, ...]


class ModelCoordinate(NamedTuple):
    """One joint coordinate of a chain model, from inverse kinematics of the markers."""

    name: str
    is_angle: bool
    """Whether the coordinate is an angle (rad) or a translation (m)."""
    value: float | None
    """Value of the coordinate; None if the visible markers do not determine it."""
    sd: float | None


class MarkerFitErrors(NamedTuple):
    """Distances between measured markers and the marker positions of a chain model, m."""

    rms: float
    maximum: float
    accepted: bool
    """Whether RMS and maximum are within the limits that are common in biomechanics."""


class ChainModelState(NamedTuple):
    """A chain model fitted to the markers of one frame."""

    number: int
    """Frame number of the camera server."""
    t_ns: int
    model: str
    """Name of the chain model."""
    refined: bool
    """Whether the model's marker positions come from the current calibration."""
    coordinates: tuple[ModelCoordinate, ...]
    errors: Mapping[str, float | None]
    """Distance of each marker from its position in the model, m; None if the marker is not
    visible."""
    fit: MarkerFitErrors | None
    """Errors of the markers in use; None if fewer than three are visible."""
    recent: MarkerFitErrors | None
    """Errors of the markers over the last seconds."""
    flags: tuple[str, ...]
    """Values of `MarkerFlag`, each with the names of the markers concerned."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """Rows of the covariance matrix of the coordinates that have a value, rad and m, in the order
    of `coordinates`; None unless rig.toml requests it."""


class PlanarJoint(NamedTuple):
    """One joint of a planar chain in one frame."""

    name: str
    position: Vector | None
    """Position in the optical world, m. Its component normal to the plane is the mean of the
    markers."""
    error: float | None
    """Predicted RMS error of the position in the plane, m."""
    arc: float | None
    """Arc that the markers cover about the joint, rad. It is computed in the axes of each adjacent
    segment, and the larger value is given."""
    refused: str | None
    """Reason why there is no position, with the remedy; None if `position` is given."""


class Stick(NamedTuple):
    """One segment of a stick figure."""

    segment: str
    ends: tuple[Vector | None, ...]
    """Ends of the segment from proximal to distal, m. The ends are two joints, or a marker and a
    joint; None if unknown."""


class StickFigure(NamedTuple):
    """A planar chain in one frame."""

    number: int
    """Frame number of the camera server."""
    t_ns: int
    normal: Vector | None
    """Unit normal of the plane of movement; None while it is unknown."""
    off_plane: float | None
    """RMS distance of the markers from their planes of movement, m. The plane of each marker is
    parallel to the plane of movement of the limb."""
    refused: str | None
    """Reason why there is no plane of movement; None if `normal` is given."""
    joints: tuple[PlanarJoint, ...]
    sticks: tuple[Stick, ...]


class MarkerFlag(StrEnum):
    """A fault of markers, or a limitation of a chain model state; docs/mqtt.md explains each."""

    LOST = "lost"
    EXCHANGED = "exchanged"
    MISPLACED = "misplaced"
    MISFIT = "misfit"
    UNDETERMINED = "undetermined"
