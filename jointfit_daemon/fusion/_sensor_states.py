"""Orientations of the individual sensors of a frame, which are the inputs of the fusion.

Invariant: the orientations contain no fault correction, so that subscribers can repeat the fusion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import between_one, multiply_one
from jointfit_daemon.limb_model import inner_joints
from jointfit_daemon.model import SensorOrientation, SensorStates

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, LimbState, Quaternion


def sensor_states(
    chain: Chain,
    calibration: Calibration | None,
    orientations: Mapping[str, Quaternion],
    state: LimbState,
) -> SensorStates:
    r"""Return the sensors of a frame, and the joint rotations of its limb state.

    .. math:: q_{so} = q_W \otimes q_s \otimes q_\mathrm{bias}, \qquad
              q_j = q_\mathrm{proximal}^* \otimes q_\mathrm{distal}

    where q_so is the orientation of the segment from one sensor, q_s the orientation of this
    sensor, q_W the rotation from the world of the sensor to the optical world, q_bias the
    sensor-to-segment alignment, and q_j the rotation of a joint. Source: patent CN 114533039 B,
    steps S3 and S7.

    Parameters
    ----------
    chain : Chain
        Sensors and joints of the rig.
    calibration : Calibration or None
        Current calibration of this chain.
    orientations : mapping of str to Quaternion
        q_world_sensor of every sensor with data, each in its own world.
    state : LimbState
        The limb state of the same frame.
    """
    sensors = []
    for name in (name for group in chain.sensors for name in group):
        q = orientations.get(name)
        q_segment = None
        if q is not None and calibration is not None:
            used = calibration.sensor[name]
            q_segment = multiply_one(multiply_one(used.q_optical_world, q), used.q_sensor_segment)
        sensors.append(SensorOrientation(name, q, q_segment))

    joints = []
    for _, name, proximal, distal in inner_joints(chain):
        above, below = (state.segments[k].q_world_segment for k in (proximal, distal))
        q_joint = None if above is None or below is None else between_one(above, below)
        joints.append((name, q_joint))
    return SensorStates(state.seq, state.t_ns, tuple(sensors), tuple(joints))
