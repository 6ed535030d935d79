"""Comparison of the limb from the IMUs with the limb from the cameras, frame by frame.

Invariant: both sides of a comparison refer to the same instant. Limb states are interpolated to the
exposure of the mocap frame.
"""

from __future__ import annotations

from collections import deque
from math import dist, exp, pi, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.fusion import OpticalLimb
from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.kinematics.rotation_scalar import angle_between_one, interpolate_one
from jointfit_daemon.limb_model import (
    angle_convention,
    flexion_sign,
    is_left,
    proximal_segment,
)
from jointfit_daemon.model import (
    FrameFlag,
    FusionMode,
    JointAngles,
    OpticalJoint,
    OpticalSegment,
    OpticalState,
    SyncState,
)
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from jointfit_daemon.fusion import OpticalReading
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, LimbState, MocapFrame, Quaternion, Vector

RMS_TIME_S = 10.0
"""Time constant of the running RMS, s, equal to a few gait cycles."""
MAX_GAP_NS = 50_000_000
"""Longest time between two interpolated limb states, ns, equal to five frames at 100 Hz."""
_WAITING = 64
"""Largest number of mocap frames that wait for the next limb state, equal to 0.25 s at 240 Hz."""
_STATES = 64
"""Number of limb states stored for late mocap frames, equal to 0.6 s at 100 Hz."""


class RunningRms:
    r"""Running root mean square with exponentially decreasing weights and time constant T.

    .. math:: \mathrm{rms}^2 = \frac{\sum_k w_k x_k^2}{\sum_k w_k}, \qquad w_k = e^{-(t - t_k) / T}

    where x_k is the value that was added at t_k, and t is the time of the last value.

    Parameters
    ----------
    time_s : float
        Time constant T, s.
    """

    def __init__(self, time_s: float = RMS_TIME_S) -> None:
        self._time_ns = time_s * 1e9
        self._squares = self._weights = 0.0
        self._last_ns = 0

    def add(self, t_ns: int, value: float) -> float:
        """Add a value and return the RMS."""
        decay = exp(min(self._last_ns - t_ns, 0) / self._time_ns)
        self._squares = decay * self._squares + value * value
        self._weights = decay * self._weights + 1.0
        self._last_ns = t_ns
        return sqrt(self._squares / self._weights)


class OpticalComparison:
    """Pairs mocap frames with limb states, and computes their differences.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration or None
        The current calibration. Without a calibration, nothing is compared.
    rate_hz : float
        Largest number of compared mocap frames per second.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None, rate_hz: float) -> None:
        usable = calibration is not None and calibration.fits(chain) and rate_hz > 0.0
        self._chain = chain
        self._limb = OpticalLimb(chain, calibration) if usable and calibration else None
        self._signs = [flexion_sign(joint) for joint in chain.joints]
        self._conventions = [angle_convention(chain, i) for i in range(len(chain.joints))]
        self._rate = RateDivider(rate_hz if usable else 1.0)  # 1.0 is a valid rate that is not used
        self._waiting: deque[tuple[int, int, bool, OpticalReading]] = deque(maxlen=_WAITING)
        """Instant, frame number, whether the stamp is synchronized, and the limb in the frame."""
        self._states: deque[LimbState] = deque(maxlen=_STATES)
        self._rms: dict[tuple[str, ...], RunningRms] = {}

    def add_frame(self, t_ns: int, frame: MocapFrame, *, synced: bool) -> None:
        """Add one live mocap frame with its stamp."""
        if self._limb is None or not self._rate.is_due(t_ns):
            return
        self._waiting.append((t_ns, frame.number, synced, self._limb.read(frame)))

    def add_state(self, state: LimbState) -> list[OpticalState]:
        """Add one limb state; return the comparisons that this state makes possible."""
        if self._limb is None:
            return []
        self._states.append(state)
        if not self._waiting or self._waiting[0][0] > state.t_ns:
            return []
        done = []
        while self._waiting and self._waiting[0][0] <= state.t_ns:
            t_ns, number, synced, reading = self._waiting.popleft()
            pair = self._states_around(t_ns) if synced else None
            imu: list[Quaternion | None] = (
                [None] * len(self._chain.segments) if pair is None else _segments_at(t_ns, *pair)
            )
            segments = tuple(
                self._segment(t_ns, name, q, q_imu)
                for name, q, q_imu in zip(self._chain.segments, reading.segments, imu, strict=True)
            )
            joints = tuple(
                self._joint(t_ns, i, reading, imu, _position_at(t_ns, i, pair))
                for i in range(len(self._chain.joints))
            )
            done.append(OpticalState(number, t_ns, segments, joints))
        return done

    def _states_around(self, t_ns: int) -> tuple[LimbState, LimbState] | None:
        """Return the limb states before and after an instant.

        The result is None if no stored state precedes the instant, or if the two states are too far
        apart or not synchronized.
        """
        after = None
        for state in reversed(self._states):
            if state.t_ns <= t_ns:
                after = after or state
                near = after.t_ns - state.t_ns <= MAX_GAP_NS
                locked = state.sync is after.sync is SyncState.LOCKED
                return (state, after) if near and locked else None
            after = state
        return None

    def _segment(
        self, t_ns: int, name: str, q: Quaternion | None, q_imu: Quaternion | None
    ) -> OpticalSegment:
        if q is None or q_imu is None:
            return OpticalSegment(name, q, None, None)
        residual = angle_between_one(q, q_imu)
        return OpticalSegment(name, q, residual, self._add(t_ns, residual, "segment", name))

    def _joint(
        self,
        t_ns: int,
        number: int,
        reading: OpticalReading,
        imu: list[Quaternion | None],
        p_imu: Vector | None,
    ) -> OpticalJoint:
        name, position = self._chain.joints[number], reading.positions[number]
        distance = distance_rms = None
        if position is not None and p_imu is not None:
            distance = dist(position, p_imu)
            distance_rms = self._add(t_ns, distance, "position", name)

        convention = self._conventions[number]
        joint = OpticalJoint(
            name, position, reading.gaps[number], distance, distance_rms, convention=convention
        )
        optical = reading.joints[number]
        if optical is None:
            return joint
        joint = joint._replace(angles=optical.angles, inner=optical.inner)
        above = proximal_segment(self._chain, number)
        proximal, distal = None if above is None else imu[above], imu[number]
        if proximal is None or distal is None:
            return joint

        sign, left = self._signs[number], is_left(self._chain, number)
        measured = read_joint(proximal, distal, flexion_sign=sign, left=left, convention=convention)
        if optical.gimbal or measured.gimbal:  # in gimbal lock, single angles are not comparable
            return joint
        pairs = zip(measured.angles, optical.angles, strict=True)
        residual = JointAngles(*((a - b + pi) % (2.0 * pi) - pi for a, b in pairs))
        named = zip(JointAngles._fields, residual, strict=True)
        rms = JointAngles(*(self._add(t_ns, x, "angle", name, axis) for axis, x in named))
        return joint._replace(residual=residual, residual_rms=rms)

    def _add(self, t_ns: int, value: float, *key: str) -> float:
        return self._rms.setdefault(key, RunningRms()).add(t_ns, value)


def _segments_at(t_ns: int, before: LimbState, after: LimbState) -> list[Quaternion | None]:
    """Return the segments interpolated between two states.

    A segment is None if one of the states lacks data from its sensors.
    """
    share = _share(t_ns, before, after)
    return [
        interpolate_one(a.q_world_segment, b.q_world_segment, share)
        if a.used and b.used and a.q_world_segment is not None and b.q_world_segment is not None
        else None
        for a, b in zip(before.segments, after.segments, strict=True)
    ]


def _position_at(t_ns: int, joint: int, pair: tuple[LimbState, LimbState] | None) -> Vector | None:
    """Return a joint position interpolated between two states; None if it cannot be compared.

    The comparison needs the origin from the cameras in both states. The cameras define the position
    of the first joint, so this joint is not compared.
    """
    if pair is None or joint == 0:
        return None
    for state in pair:
        if state.mode is not FusionMode.IMU_AND_MOCAP or FrameFlag.ORIGIN_FIXED in state.flags:
            return None
    before, after = pair
    a, b = before.joints[joint].position, after.joints[joint].position
    if a is None or b is None:
        return None
    share = _share(t_ns, before, after)
    x, y, z = (p + share * (q - p) for p, q in zip(a, b, strict=True))
    return (x, y, z)


def _share(t_ns: int, before: LimbState, after: LimbState) -> float:
    width = after.t_ns - before.t_ns
    return (t_ns - before.t_ns) / width if width else 0.0
