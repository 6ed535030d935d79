"""Fusion of one aligned frame of sensor orientations to the state of a limb.

Invariant: the same frames in the same order result in the same states. Unknown values are None, and
every degradation sets a flag.
"""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.fusion._angle_rates import AngleRates
from jointfit_daemon.fusion._forward_kinematics import (
    SegmentLength,
    joint_angle_estimate,
    joint_places,
    joint_positions,
)
from jointfit_daemon.fusion._heading_uncertainty import add_heading_sd
from jointfit_daemon.fusion._patent_segment_fuser import PatentSegmentFuser
from jointfit_daemon.fusion._segment_fuser import FusedSegment, SegmentFuser
from jointfit_daemon.fusion.faults import ConsistencyMonitor, SensorMonitor
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.limb_model import (
    angle_convention,
    configured_length,
    flexion_sign,
    inner_joints,
    is_left,
    neighbor,
)
from jointfit_daemon.model import (
    FrameFlag,
    FusionMode,
    JointState,
    LimbState,
    SegmentState,
    SyncState,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from jointfit_daemon.fusion._segment_fuser import Inputs
    from jointfit_daemon.fusion.faults import SensorReport
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, Quaternion, Vector

_NO_SENSORS: frozenset[str] = frozenset()


class LimbFuser:
    """Computes limb states from aligned sensor orientations.

    Parameters
    ----------
    chain : Chain
        Joints, segments and sensors of the rig.
    calibration : Calibration or None
        If it is None or belongs to another chain, every state is ``uncalibrated``.
    sensor_monitor : SensorMonitor, optional
        Existing monitor to use, so that a change of the calibration does not reset the sensor
        states.
    drifting : collection of str
        Sensors without heading reference, for ``ConsistencyMonitor``.
    """

    def __init__(
        self,
        chain: Chain,
        calibration: Calibration | None,
        sensor_monitor: SensorMonitor | None = None,
        drifting: Collection[str] = (),
    ) -> None:
        self._chain, self._drifting = chain, drifting
        self.sensor_monitor = sensor_monitor or SensorMonitor(chain)
        self.worn = True
        """Whether the sensors are on the body. On the calibration plate, the sensors of a segment
        are not compared.
        """
        usable = calibration is not None and calibration.fits(chain)
        self._uncorrected = calibration is not None and calibration.procedure == "patent"
        """Whether sensors are used without correction, even if they have faults."""
        self._calibration = calibration if usable else None
        self._base_flags: tuple[str, ...] = (FrameFlag.UNCALIBRATED,)
        self._fusers: list[SegmentFuser] = []
        self._lengths: list[SegmentLength] = []
        self._alignments: list[tuple[str, Quaternion, Quaternion]] = []
        """Sensor, q_optical_world and q_sensor_segment."""
        self.consistency: ConsistencyMonitor | None = None
        self._conventions = [angle_convention(chain, i) for i in range(len(chain.joints))]
        self._places, self._rates = joint_places(chain), AngleRates()
        self._inner = {joint.number: joint for joint in inner_joints(chain)}
        self._unknown_joints = tuple(
            JointState(name, None, None, convention=convention)
            for name, convention in zip(chain.joints, self._conventions, strict=True)
        )
        if calibration is None or not usable:
            return

        self._base_flags, fuser = calibration.flags, SegmentFuser
        if self._uncorrected:
            self._base_flags += (FrameFlag.UNCORRECTED,)
            fuser = PatentSegmentFuser
        self.consistency = ConsistencyMonitor(chain, calibration, drifting)
        self._alignments = [
            (name, item.q_optical_world, item.q_sensor_segment)
            for name, item in calibration.sensor.items()
        ]
        for i, segment in enumerate(chain.segments):
            stored = calibration.segment[segment]
            self._fusers.append(fuser(segment, chain.sensors[i], stored))
            known = configured_length(chain, i)  # replaces the calibrated length, without error
            estimated = SegmentLength(stored.length, stored.length_sd or 0.0)
            self._lengths.append(estimated if known is None else SegmentLength(known, 0.0))
        self._neighbors = [neighbor(chain, i) for i in range(len(chain.segments))]
        self._signs = [flexion_sign(joint) for joint in chain.joints]
        self._use_correlations(calibration)

    def _use_correlations(self, calibration: Calibration) -> None:
        known = calibration.correlations
        self._correlations = [known.get(joint, 0.0) for joint in self._chain.joints]

    def fuse(
        self,
        t_ns: int,
        completed_ns: int,
        seq: int,
        orientations: Mapping[str, Quaternion],
        *,
        extrapolated: frozenset[str] = _NO_SENSORS,
        optical_origin: Vector | None = None,
        sync: SyncState = SyncState.LOCKED,
        mode: FusionMode = FusionMode.IMU,
    ) -> LimbState:
        """Return the state of the limb at `t_ns`.

        Parameters
        ----------
        t_ns, completed_ns, seq
            Instant of the frame, arrival of its last sample, and frame number, which are copied to
            the state.
        orientations : mapping of str to Quaternion
            q_world_sensor of every sensor with data, each in its own world. Unknown sensors are
            ignored. The caller must not change the mapping afterwards.
        extrapolated : frozenset of str
            Sensors whose orientation is extrapolated beyond their last sample.
        optical_origin : Vector, optional
            Position of O1 in the current mocap frame, m; overrides the configured origin.
        sync, mode
            Values that are copied to the state; without a calibration the mode is ``uncalibrated``.

        Notes
        -----
        The flags have this order:

        1. ``uncalibrated``, or the flags of the calibration;
        2. ``uncorrected`` in the procedure of the patent, where the following fault flags only
           report the faults, and the sensors are used without correction;
        3. ``extrapolating`` if an orientation is extrapolated in time;
        4. ``origin_fixed`` if mocap runs, but O1 is not visible, so the configured origin is used;
        5. ``stuck:SENSOR``;
        6. ``slipped:SENSOR`` or ``pair_disagrees:SEGMENT``;
        7. ``heading_disagrees:JOINT``, then ``heading_unseen``;
        8. for each segment ``one_sensor:SEGMENT``, ``untrained:SEGMENT`` (outside the training
           range), ``held:SEGMENT`` or ``lost:SEGMENT``;
        9. ``gimbal``.
        """
        working, stuck = self.sensor_monitor.update(t_ns, completed_ns, orientations)
        orientations = orientations if self._uncorrected else working
        if self._calibration is None:
            return LimbState(
                seq,
                t_ns,
                completed_ns,
                FusionMode.UNCALIBRATED,
                sync,
                self._base_flags,
                tuple(SegmentState(name, None, None, ()) for name in self._chain.segments),
                self._unknown_joints,
            )

        # The product of three rotations is q_optical_segment.
        inputs = {
            name: multiply_one(multiply_one(q_world, orientations[name]), q_alignment)
            for name, q_world, q_alignment in self._alignments
            if name in orientations
        }
        fused, fault_flags = self._fuse_segments(t_ns, inputs)

        flags = [*self._base_flags]
        if extrapolated and not extrapolated.isdisjoint(inputs):
            flags.append(FrameFlag.EXTRAPOLATING)
        if optical_origin is None and mode == FusionMode.IMU_AND_MOCAP:
            flags.append(FrameFlag.ORIGIN_FIXED)
        flags += [FrameFlag.STUCK.of(name) for name in stuck]
        flags += fault_flags
        for segment in fused:
            flags += segment.flags

        joints = self._joints(t_ns, fused, optical_origin, flags)
        segments = tuple(
            [
                SegmentState(name, segment.q, segment.sd, segment.used)
                for name, segment in zip(self._chain.segments, fused, strict=True)
            ]
        )
        if self.consistency is not None and (sd := self.consistency.common_heading_sd) > 0.0:
            segments, joints = add_heading_sd(segments, joints, sd)
        return LimbState(seq, t_ns, completed_ns, mode, sync, tuple(flags), segments, joints)

    def replace_models(self, calibration: Calibration) -> None:
        """Use the models of an otherwise equal calibration from now on.

        The output moves gradually to the orientations of the new models.
        """
        if self._calibration is None:
            return
        self._calibration = calibration
        self._use_correlations(calibration)
        for fuser, name in zip(self._fusers, self._chain.segments, strict=True):
            fuser.replace_models(calibration.segment[name].models)

    def set_calibration_time(self, t_ns: int) -> None:
        """Set the instant of the static pose, from which heading uncertainty grows."""
        for fuser in self._fusers:
            fuser.set_calibration_time(t_ns)

    def resume(self, before: LimbFuser) -> None:
        """Take over the state of the previous fuser if sensors and alignments are unchanged.

        Drift corrections, faults and fading continue, so that a reload of the configuration does
        not change the output.
        """
        old, new = before._calibration, self._calibration
        if old is None or new is None or not old.fits(self._chain):
            return
        poses = [{n: s.q_static for n, s in one.segment.items()} for one in (old, new)]
        if (poses[0], old.sensor, old.links) != (poses[1], new.sensor, new.links):
            return
        if old.procedure != new.procedure:
            return
        if set(before._drifting) != set(self._drifting):
            return

        self.consistency, self._rates = before.consistency, before._rates
        self._fusers = before._fusers
        for fuser, name in zip(self._fusers, self._chain.segments, strict=True):
            if old.segment[name].models != new.segment[name].models:
                fuser.replace_models(new.segment[name].models)

    def pop_reports(self, now_ns: int) -> list[SensorReport]:
        """Return the reports on sensors that are due at `now_ns`, each once."""
        reports = self.sensor_monitor.pop_reports(now_ns)
        if self.consistency is not None:
            reports += self.consistency.pop_reports()
        return reports

    def _fuse_segments(
        self, t_ns: int, inputs: Inputs
    ) -> tuple[list[FusedSegment], tuple[str, ...]]:
        """Return the fused segments and the flags of inconsistent sensors."""
        spread: tuple[float, ...] = ()
        flags: tuple[str, ...] = ()
        measured = inputs
        if self.consistency is not None and self.worn:
            inputs = self.consistency.correct_headings(inputs)
            spread, slipped, flags = self.consistency.update(t_ns, inputs)
            inputs = self.consistency.correct_pairs(inputs)
            if slipped:
                inputs = {name: q for name, q in inputs.items() if name not in slipped}

        if self._uncorrected:
            inputs = measured
        fused = [
            fuser.fuse(t_ns, inputs, near)
            for fuser, near in zip(self._fusers, self._neighbors, strict=True)
        ]
        if any(spread):
            # Inconsistent sensors add an error that is independent of other errors. `sd` is the
            # standard deviation of this error per axis, rad.
            fused = [
                one if one.sd is None else one._replace(sd=hypot(one.sd, sd), fault_sd=sd)
                for one, sd in zip(fused, spread, strict=True)
            ]
        return fused, flags

    def _joints(
        self,
        t_ns: int,
        fused: list[FusedSegment],
        optical_origin: Vector | None,
        flags: list[str],
    ) -> tuple[JointState, ...]:
        chain = self._chain
        origin = optical_origin or chain.origin or (0.0, 0.0, 0.0)
        positions = joint_positions(origin, fused, self._lengths, self._places)
        joints = []
        for i, name in enumerate(chain.joints):
            position, variance = positions[i]
            sd = None if variance is None else sqrt(variance)
            inner = self._inner.get(i)
            if inner is None:  # the ends of the chain have no angles
                joints.append(JointState(name, position, sd))
                continue

            proximal, distal = fused[inner.proximal], fused[inner.distal]
            convention, carrier = self._conventions[i], inner.proximal if chain.parents else None
            estimate = joint_angle_estimate(
                proximal,
                distal,
                sign=self._signs[i],
                left=is_left(chain, i),
                correlation=self._correlations[i],
                convention=convention,
            )
            if estimate is None:
                joints.append(
                    JointState(name, position, sd, convention=convention, proximal=carrier)
                )
                continue
            if estimate.gimbal and FrameFlag.GIMBAL not in flags:
                flags.append(FrameFlag.GIMBAL)
            angles, included, main_sd, gimbal = estimate
            # The angles of a held segment have no rate.
            measured = angles if proximal.used and distal.used else None
            rates = self._rates.update(t_ns, name, measured, gimbal=gimbal)
            joints.append(
                JointState(
                    name, position, sd, angles, included, main_sd, rates, convention, carrier
                )
            )
        return tuple(joints)
