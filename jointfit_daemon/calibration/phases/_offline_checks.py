"""Checks of recorded trials before a fit.

The checks report joints without movement, and misaligned or identical sensors. Each message
contains the object and the remedy. Differences that soft-tissue artefact can cause are not
reported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.phases._training_set import MISALIGNED, identical_sensors
from jointfit_daemon.calibration.registration import fit_sensor_alignment, robust_mean
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import joint_rotation
from jointfit_daemon.limb_model import inner_joints

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.phases._offline import OfflineTrial
    from jointfit_daemon.model import Chain


HEADING_SEPARABLE = 0.98
"""Value of `SensorAlignment.kappa` above which the data do not distinguish the heading of the
sensor's world from the sensor-to-segment alignment.
"""
FAR = np.deg2rad(45.0)
"""Median angle between an aligned sensor and its reference above which soft tissue is not the
cause, rad.
"""
LEAST_TURN = np.deg2rad(5.0)
"""0.95 quantile of the rotation of a joint below which the trials do not constrain its model,
rad."""


def unmoved_joint(chain: Chain, trials: Sequence[OfflineTrial]) -> str | None:
    """Return a message on a joint (or single segment) without movement; None if all move."""
    reference = {s: np.concatenate([t.reference[s] for t in trials]) for s in chain.segments}
    movements = {
        joint.name: joint_rotation(
            reference[chain.segments[joint.proximal]], reference[chain.segments[joint.distal]]
        )
        for joint in inner_joints(chain)
    }
    for name, q in (movements or reference).items():  # a single segment has no inner joint
        known = q[np.isfinite(q).all(axis=1)]
        turned = rotation.angle_between(robust_mean(known).q, known)
        most = float(np.quantile(turned, 0.95))
        if most < LEAST_TURN:
            return (
                f"{name} rotates by only {np.rad2deg(most):.1f} deg in all trials, too little "
                "for a fit or an evaluation; use trials that move it (squats, walking), or fit "
                "with --method mean"
            )
    return None


def trial_warnings(
    chain: Chain, trials: Sequence[OfflineTrial], mounts: Mapping[str, Array] | None
) -> list[str]:
    """Return warnings about sensors that make the results from these trials doubtful."""
    worn = [name for group in chain.sensors for name in group]
    sensors = {name: np.concatenate([t.sensors[name] for t in trials]) for name in worn}
    return [
        *([] if mounts is None else _far_sensors(chain, trials, mounts)),
        *_turned_worlds(chain, trials),
        *identical_sensors(chain, sensors),
    ]


def _far_sensors(
    chain: Chain, trials: Sequence[OfflineTrial], mounts: Mapping[str, Array]
) -> Iterator[str]:
    for trial in trials:
        for segment, sensor, q, reference in _streams(chain, [trial]):
            off = rotation.angle_between(rotation.multiply(q, mounts[sensor]), reference)
            off = off[np.isfinite(off)]
            apart = float(np.median(off)) if off.size else 0.0
            if apart <= FAR:
                continue

            yield (
                f"{trial.name}: {sensor} is {np.rad2deg(apart):.0f}° from the reference of "
                f"{segment}; check that quaternions are scalar first (w, x, y, z), that --up is "
                "correct, and that the mount is of this session"
            )


def _turned_worlds(chain: Chain, trials: Sequence[OfflineTrial]) -> Iterator[str]:
    """Yield warnings on sensor worlds rotated about the vertical, if the angle is observable."""
    for _, sensor, q, reference in _streams(chain, trials):
        alignment = fit_sensor_alignment("heading", q, reference)
        angle = float(rotation.heading_of(alignment.q_world))
        if alignment.kappa <= HEADING_SEPARABLE and abs(angle) > MISALIGNED:
            yield (
                f"{sensor}: its world seems rotated by {np.rad2deg(angle):.0f}° about the vertical "
                "relative to the world of the reference; transform both to one world, or check "
                "--up"
            )


def _streams(
    chain: Chain, trials: Sequence[OfflineTrial]
) -> Iterator[tuple[str, str, Array, Array]]:
    """Yield segment, sensor, sensor orientations and reference orientations, over all trials."""
    for i, segment in enumerate(chain.segments):
        reference = np.concatenate([trial.reference[segment] for trial in trials])
        for sensor in chain.sensors[i]:
            q = np.concatenate([trial.sensors[sensor] for trial in trials])
            yield segment, sensor, q, reference
