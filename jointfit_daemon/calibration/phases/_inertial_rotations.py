"""Rotations of the segments since the static pose, computed from IMUs alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import visible

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.phases._plate_alignment import PlateAlignment
    from jointfit_daemon.calibration.phases._static_pose import StaticPose
    from jointfit_daemon.model import Chain

_SAME_WORLD = (1.0, 0.0, 0.0, 0.0)


def inertial_rotations(
    chain: Chain, raw: Mapping[str, Array], pose: StaticPose, alignment: PlateAlignment | None
) -> dict[str, Array]:
    r"""Return the rotation of each segment since the static pose in the optical world.

    .. math:: q_{now,static} = w \otimes q(t) \otimes q_{static}^* \otimes w^*

    where w is the rotation from the world of the sensor to the optical world. Segment axes are not
    needed. If a segment has several sensors, their rotations are averaged.

    Parameters
    ----------
    raw : mapping of str to ndarray, shape (m, 4)
        q_world_sensor of every sensor at m common instants; NaN if missing.
    alignment : PlateAlignment or None
        Alignment of the sensor worlds. With None, all sensor worlds are assumed to equal the
        optical world.

    Returns
    -------
    dict of str to ndarray, shape (m, 4)
        Rotation of each segment since the static pose; NaN where one of its sensors has no data.
    """
    found = {}
    for segment, group in zip(chain.segments, chain.sensors, strict=True):
        turns = []
        for sensor in group:
            w = np.asarray(_SAME_WORLD if alignment is None else alignment.world(sensor))
            since = rotation.multiply(raw[sensor], rotation.conjugate(pose.sensors[sensor].q))
            turns.append(rotation.multiply(rotation.multiply(w, since), rotation.conjugate(w)))
        known = np.all([visible(q) for q in turns], axis=0)
        mean = np.full(turns[0].shape, np.nan)
        mean[known] = rotation.average(np.stack([q[known] for q in turns], axis=1))
        found[segment] = mean
    return found
