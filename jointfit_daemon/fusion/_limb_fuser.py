"""One aligned frame in, one LimbState out, whatever sensors are alive.

Law: pure, in order of time, plain floats. Unknown is None; every degradation is a flag.
"""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.fusion._angle_rates import AngleRates
from jointfit_daemon.fusion._forward_kinematics import Reach, joint_positions, read_angles
from jointfit_daemon.fusion._heading_uncertainty import widened_joints, widened_segments
from jointfit_daemon.fusion._segment_fuser import Fused, SegmentFuser
from jointfit_daemon.fusion.faults import LinkWatch, SensorWatch
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.limb_model import flexion_sign, neighbor
from jointfit_daemon.model import JointState, LimbState, SegmentState

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from jointfit_daemon.fusion._segment_fuser import Inputs
    from jointfit_daemon.fusion.faults import SensorNews
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, Quaternion, Vector

_NOBODY: frozenset[str] = frozenset()


class LimbFuser:
    """Turns aligned sensor orientations into the state of a limb.

    Parameters
    ----------
    chain : Chain
        Joints, segments and sensors of the rig.
    calibration : Calibration or None
        None, or one of another chain (flag ``other_chain``): every state is ``uncalibrated``.
    watch : SensorWatch, optional
        What is known of the sensors already: a calibration that changed is no change of sensors.
    drifting : collection of str
        Sensors that are known to have no north, see ``LinkWatch``.
    """

    def __init__(
        self,
        chain: Chain,
        calibration: Calibration | None,
        watch: SensorWatch | None = None,
        drifting: Collection[str] = (),
    ) -> None:
        self._chain, self._drifting = chain, drifting
        self.watch = watch or SensorWatch(chain)
        known = calibration is not None and calibration.fits(chain)
        self._calibration = calibration if known else None
        self._standing: tuple[str, ...] = ("uncalibrated",)
        if calibration is not None and not known:
            self._standing = ("uncalibrated", "other_chain")
        self._fusers: list[SegmentFuser] = []
        self._reaches: list[Reach] = []
        self._mounts: list[tuple[str, Quaternion, Quaternion]] = []
        self.links: LinkWatch | None = None
        self._rates = AngleRates()
        if self._calibration is not None:
            self._prepare(self._calibration)

    def _prepare(self, calibration: Calibration) -> None:
        chain = self._chain
        self._standing = calibration.flags
        self.links = LinkWatch(chain, calibration, self._drifting)
        self._mounts = [
            (name, item.q_optical_world, item.q_sensor_segment)
            for name, item in calibration.sensor.items()
        ]
        for i, segment in enumerate(chain.segments):
            stored = calibration.segment[segment]
            self._fusers.append(SegmentFuser(segment, chain.sensors[i], stored))
            length, sd = stored.length, stored.length_sd
            if i < len(chain.lengths) and chain.lengths[i] is not None:
                length = chain.lengths[i]
            self._reaches.append(Reach(length, sd or 0.0))
        self._neighbors = [neighbor(chain, i) for i in range(len(chain.segments))]
        self._signs = [flexion_sign(joint) for joint in chain.joints]
        self._take_correlations(calibration)

    def _take_correlations(self, calibration: Calibration) -> None:
        known = calibration.correlations
        self._alike = [known.get(joint, 0.0) for joint in self._chain.joints]

    def fuse(
        self,
        t_ns: int,
        completed_ns: int,
        seq: int,
        orientations: Mapping[str, Quaternion],
        *,
        extrapolated: frozenset[str] = _NOBODY,
        optical_origin: Vector | None = None,
        sync: str = "locked",
        mode: str = "imu",
    ) -> LimbState:
        """Return the state of the limb at `t_ns`.

        Parameters
        ----------
        t_ns, completed_ns, seq
            Instant, arrival of what completed the frame, running number; handed through.
        orientations : mapping of str to Quaternion
            q_world_sensor of every sensor that is alive, each in its own world; unknown ids are
            ignored. Not to be changed afterwards.
        extrapolated : frozenset of str
            Sensors whose value is extrapolated beyond their last sample.
        optical_origin : Vector, optional
            Where the cameras see O1 now, m; wins over the configured origin.
        sync, mode : str
            Handed through; without a calibration the mode is ``uncalibrated``.

        Notes
        -----
        Flags: ``uncalibrated``, ``other_chain``, those of the calibration, then ``extrapolating``
        (a sample was extrapolated in time), ``origin_fixed`` (cameras run but do not see O1, so
        that it is at the configured origin), ``stuck:`` per sensor, ``slipped:`` per sensor or
        ``pair_disagrees:`` per segment, ``heading_disagrees:`` per joint, ``heading_unseen``, per
        segment ``one_sensor:``, ``untrained:`` (outside the movements of the calibration),
        ``held:``, ``lost:``; ``gimbal`` last.
        """
        orientations, stuck = self.watch.look(t_ns, completed_ns, orientations)
        if self._calibration is None:
            return self._uncalibrated(t_ns, completed_ns, seq, sync)
        inputs = {
            name: multiply_one(multiply_one(q_world, orientations[name]), q_mount)
            for name, q_world, q_mount in self._mounts
            if name in orientations
        }
        fused, doubts = self._fused(t_ns, inputs)
        flags = [*self._standing]
        if extrapolated and not extrapolated.isdisjoint(inputs):
            flags.append("extrapolating")
        if optical_origin is None and mode == "imu+mocap":
            flags.append("origin_fixed")
        if stuck:
            flags += [f"stuck:{name}" for name in stuck]
        flags += doubts
        for one in fused:
            flags += one.flags
        joints = self._joints(t_ns, fused, optical_origin, flags)
        segments = tuple(
            [
                SegmentState(name, one.q, one.sd, one.used)
                for name, one in zip(self._chain.segments, fused, strict=True)
            ]
        )
        if self.links is not None and (unseen := self.links.common_sd) > 0.0:
            segments, joints = widened_segments(segments, unseen), widened_joints(joints, unseen)
        return LimbState(seq, t_ns, completed_ns, mode, sync, tuple(flags), segments, joints)

    def take_models(self, calibration: Calibration) -> None:
        """Go over to the models of a calibration that is the same otherwise, without a jump."""
        if self._calibration is None:
            return
        self._calibration = calibration
        self._take_correlations(calibration)
        for fuser, name in zip(self._fusers, self._chain.segments, strict=True):
            fuser.take(calibration.segment[name].models)

    def worn_since(self, t_ns: int) -> None:
        """Take it that the calibration is as old as that: headings have wandered since."""
        for fuser in self._fusers:
            fuser.worn_since(t_ns)

    def take_over(self, before: LimbFuser) -> None:
        """Go on where the fuser before a reload was, if the same sensors are worn as then.

        What drifted stays taken out, what is doubted stays doubted, and what fades goes on fading:
        a reload moves nobody's leg.
        """
        was, now = before._calibration, self._calibration
        if was is None or now is None or not _worn_alike(was, now):
            return
        if set(before._drifting) != set(self._drifting):
            return
        self.links, self._rates, self._fusers = before.links, before._rates, before._fusers
        for fuser, name in zip(self._fusers, self._chain.segments, strict=True):
            if was.segment[name].models != now.segment[name].models:
                fuser.take(now.segment[name].models)

    def news(self, now_ns: int) -> list[SensorNews]:
        """Return what is worth telling of the sensors at `now_ns`, each change once."""
        told = self.watch.news(now_ns)
        if self.links is not None:
            told += self.links.news()
        return told

    def _fused(self, t_ns: int, inputs: Inputs) -> tuple[list[Fused], tuple[str, ...]]:
        """Return the segments, and flags of sensors that contradict each other."""
        spread: tuple[float, ...] = ()
        flags: tuple[str, ...] = ()
        if self.links is not None:
            inputs = self.links.correct(inputs)
            spread, slipped, flags = self.links.look(t_ns, inputs)
            inputs = self.links.brought_together(inputs)
            if slipped:
                inputs = {name: q for name, q in inputs.items() if name not in slipped}
        fused = [
            fuser.fuse(t_ns, inputs, near)
            for fuser, near in zip(self._fusers, self._neighbors, strict=True)
        ]
        if any(spread):
            fused = [_widened(one, more) for one, more in zip(fused, spread, strict=True)]
        return fused, flags

    def _joints(
        self, t_ns: int, fused: list[Fused], optical_origin: Vector | None, flags: list[str]
    ) -> tuple[JointState, ...]:
        chain = self._chain
        origin = optical_origin or chain.origin or (0.0, 0.0, 0.0)
        places = joint_positions(origin, fused, self._reaches)
        joints = []
        for i, name in enumerate(chain.joints):
            position, variance = places[i]
            sd = None if variance is None else sqrt(variance)
            if not 0 < i < len(fused):
                joints.append(JointState(name, position, sd))
                continue
            above, below = fused[i - 1], fused[i]
            state = read_angles(
                above, below, sign=self._signs[i], left=chain.left_side, alike=self._alike[i]
            )
            if state is None:
                joints.append(JointState(name, position, sd))
                continue
            if state.gimbal and "gimbal" not in flags:
                flags.append("gimbal")
            angles, inner, flexion_sd, gimbal = state
            measured = angles if above.used and below.used else None  # held angles have no rate
            rates = self._rates.rates(t_ns, name, measured, gimbal=gimbal)
            joints.append(JointState(name, position, sd, angles, inner, flexion_sd, rates))
        return tuple(joints)

    def _uncalibrated(self, t_ns: int, completed_ns: int, seq: int, sync: str) -> LimbState:
        segments = tuple(SegmentState(name, None, None, ()) for name in self._chain.segments)
        joints = tuple(JointState(name, None, None) for name in self._chain.joints)
        mode = "uncalibrated"
        return LimbState(seq, t_ns, completed_ns, mode, sync, self._standing, segments, joints)


def _worn_alike(was: Calibration, now: Calibration) -> bool:
    """Tell whether two calibrations are of the same limb, wearing and links."""
    if (was.joints, was.segments, was.chain_sensors) != (
        now.joints,
        now.segments,
        now.chain_sensors,
    ):
        return False
    poses = all(was.segment[name].q_static == now.segment[name].q_static for name in now.segments)
    return poses and was.sensor == now.sensor and was.links == now.links


def _widened(one: Fused, more: float) -> Fused:
    """Return a segment with a standard deviation added, per axis, rad."""
    return one if one.sd is None else one._replace(sd=hypot(one.sd, more), doubt=more)
