"""The quantities that move between rooms: frozen, SI, without behaviour.

Law: nothing here imports anything of ours; nothing here reads a clock or a file. Quaternions are
Hamilton, scalar first, and ``q_a_b`` takes b-coordinates to a-coordinates. The world is ENU with
z up. ``t_ns`` is host CLOCK_MONOTONIC in nanoseconds. Unknown is ``None`` (or NaN inside arrays),
never 0. See CONVENTIONS.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]
"""Hamilton unit quaternion (w, x, y, z)."""

Vector = tuple[float, float, float]
"""Three components, SI."""


# --- what arrives -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as they arrived at the host.

    ``t_ns`` is the arrival stamp. A stream chunk is any cut of the byte stream; a datagram chunk
    is one datagram; a CAN chunk is a run of records (``jointfit_protocols.can._frame``).
    """

    t_ns: int
    data: bytes


class TickClock(NamedTuple):
    """How a device counts time."""

    tick_ns: int
    """Nanoseconds a tick (100 000 for 100 us ticks); ignored when ``ticks_per_s`` is set."""
    modulus: int | None
    """Ticks after which the count starts again at 0; None if it never does."""
    ticks_per_s: int | None = None
    """Exact tick frequency where it is no whole number of nanoseconds (NatNet)."""
    scale: Literal["own", "monotonic", "unix"] = "own"
    """What 0 means: nothing (a clock of its own), or, declared by whoever configured the device,
    this host's CLOCK_MONOTONIC, or UNIX time that PTP keeps on device and host alike."""


class ImuSample(NamedTuple):
    """One orientation of one IMU."""

    arrival_ns: int
    """Host time of the first byte of the message (arrival, back-dated by bytes and baud)."""
    q_world_sensor: Quaternion
    """Canonical: unit, ENU, sensor to the sensor's own world (heading may be arbitrary)."""
    q_native: Quaternion
    """As sent, scaled but neither turned nor normalised."""
    ticks: int | None
    """Device time as sent, in ticks of the decoder's ``tick_clock``; None if it has none."""
    counter: int | None
    """Sequence number as sent; None if the device has none."""
    status: int | None = None
    """The device's own status word, if it sent one."""
    rate: Vector | None = None
    """Angular rate at the instant of the orientation, in the same sensor frame, rad/s; None where
    none came. A mean since the sample before is no such rate: leave it out."""
    acceleration: Vector | None = None
    """Specific force, sensor axes, m/s^2 (+9.81 upwards at rest); None where none came."""
    magnetic: Vector | None = None
    """Magnetic field, sensor axes, in the device's own unit; None where none came."""


@dataclass(frozen=True, slots=True)
class MocapLayout:
    """Which column of a ``MocapFrame`` is which marker or body. Shared by many frames."""

    markers: tuple[str, ...]
    bodies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """One camera frame, world already Z up, metres. NaN is "not seen"."""

    arrival_ns: int
    number: int
    ticks: int | None
    """Instant of exposure in device ticks; None where the server has no clock."""
    layout: MocapLayout
    markers: NDArray[np.float64]
    """Marker positions in the optical world, m, shape (len(layout.markers), 3)."""
    body_positions: NDArray[np.float64]
    """Rigid-body positions, m, shape (len(layout.bodies), 3)."""
    body_orientations: NDArray[np.float64]
    """q_world_body, shape (len(layout.bodies), 4)."""
    live: bool = True
    """False when the server plays back a recording."""


@dataclass(frozen=True, slots=True)
class ClockEcho:
    """One answered echo: host send and receive stamps, device ticks in between."""

    sent_ns: int
    received_ns: int
    ticks: int


class SyncPulse(NamedTuple):
    """One edge on a hardware sync line, as the device that saw (or made) it stamped it.

    Lines are electrical: one edge is the same instant on every device wired to the line, to well
    below a microsecond, whatever each calls it. That instant is its rising (configured) edge. A
    decoder yields pulses in wire order among its samples and never invents one that was not seen.
    """

    arrival_ns: int
    """Host time of the first byte of the message that tells of it; ms late does not matter."""
    ticks: int
    """Device time of the edge itself, in ticks of the decoder's ``tick_clock``."""
    line: int = 0
    """Which wire of the rig, as configured; devices on the same wire say the same number."""
    number: int | None = None
    """The device's own count of edges on that line; None if it does not count."""


@dataclass(frozen=True, slots=True)
class Corrupt:
    """Bytes that made no message. An event, never an exception."""

    discarded: int
    reason: str


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """Something a device said or did that is not a measurement.

    Kinds: ``info`` (data: model, serial, firmware, settings read back), ``restart`` (the device
    began anew), ``clock`` (its time did), ``gap`` (data: lost), ``counter`` (it jumped
    and nothing was lost), ``setting`` (changed while running), ``warning``, ``error``.
    """

    kind: str
    text: str
    data: Mapping[str, object] = field(default_factory=dict)


Decoded = ImuSample | MocapFrame | ClockEcho | SyncPulse | Corrupt | DeviceEvent
"""What a driver's decoder yields."""


# --- the body ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Chain:
    """Joints O1..On+1 from proximal to distal and the n segments between them."""

    joints: tuple[str, ...]
    segments: tuple[str, ...]
    sensors: tuple[tuple[str, ...], ...]
    """Sensor ids per segment, in the order of ``segments``; at least one each."""
    left_side: bool = False
    """A left limb: adduction and rotation change sign (CONVENTIONS.md)."""
    origin: Vector | None = None
    """Fixed position of O1 in the world, m; None: O1 is the origin, or optical where seen."""
    lengths: tuple[float | None, ...] = ()
    """Configured segment lengths, m; None where calibration must find them."""
    proximal: str | None = None
    """Body part before O1 (pelvis), seen by markers only; None if the rig has none."""
    distal: str | None = None
    """Body part after the last joint (foot), seen by markers only; None if the rig has none."""
    static_axes: bool = False
    """Segment axes are the world's in the static pose; else they come from centers and flexion."""


class JointAngles(NamedTuple):
    """Anatomical joint angles, rad; signs in CONVENTIONS.md."""

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
    """Sensors that took part."""


class JointState(NamedTuple):
    """One joint at one instant. End joints of the chain have a position but no angles."""

    name: str
    position: Vector | None
    position_sd: float | None
    """Standard deviation of the position, m (root of the mean variance per axis)."""
    angles: JointAngles | None = None
    inner: float | None = None
    """Included angle between the two segments, rad: pi when straight."""
    angle_sd: float | None = None
    """Standard deviation of the flexion angle, rad."""
    rates: JointAngles | None = None
    """How fast the angles change, over the last 50 ms, rad/s."""


class LimbState(NamedTuple):
    """The limb at instant ``t_ns``: one of these a frame, whatever sensors are alive."""

    seq: int
    t_ns: int
    completed_ns: int
    """Host arrival of the sample (or the deadline) that completed this frame."""
    mode: str
    """``uncalibrated`` | ``imu`` | ``imu+mocap``."""
    sync: str
    """``settling`` | ``locked`` | ``stale``: state of the clocks behind this frame."""
    flags: tuple[str, ...]
    segments: tuple[SegmentState, ...]
    joints: tuple[JointState, ...]
