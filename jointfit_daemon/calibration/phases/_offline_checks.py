"""What is odd about trials of files before anything is fitted to them, in words.

Law: pure. Only clear cases, each with the thing and the remedy; what skin can do is not odd.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.phases._training_set import twins
from jointfit_daemon.calibration.registration import fit_sensor_alignment, robust_mean
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import joint_rotation

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.phases._offline import OfflineTrial
    from jointfit_daemon.model import Chain


MISALIGNED = np.deg2rad(25.0)
"""A heading that differs by more is no matter of skin."""
HEADING_SEPARABLE = 0.98
"""Above this ratio of singular values heading and mount cannot be told apart."""
FAR = np.deg2rad(45.0)
"""Median distance of a sensor on its mount from the reference that no skin explains."""
LEAST_TURN = np.deg2rad(5.0)
"""A joint that turns by less in 95 % of the frames teaches nothing."""


def unmoved(chain: Chain, trials: Sequence[OfflineTrial]) -> str | None:
    """Return which joint (of a lone segment: which segment) does not move; None: all do."""
    for name, q in _movements(chain, trials):
        known = q[np.isfinite(q).all(axis=1)]
        turned = rotation.angle_between(robust_mean(known).q, known)
        most = float(np.quantile(turned, 0.95))
        if most < LEAST_TURN:
            return (
                f"{name} turns by {np.rad2deg(most):.1f} deg only in all trials: there is nothing "
                "to learn from and nothing to judge; take trials that move it (squats, walking), "
                "or fit with --method mean"
            )
    return None


def doubts(
    chain: Chain, trials: Sequence[OfflineTrial], mounts: Mapping[str, Array] | None
) -> list[str]:
    """Return what people should look at before they believe figures of these trials."""
    worn = [name for group in chain.sensors for name in group]
    sensors = {name: np.concatenate([t.sensors[name] for t in trials]) for name in worn}
    return [
        *([] if mounts is None else _far_sensors(chain, trials, mounts)),
        *_turned_worlds(chain, trials),
        *twins(chain, sensors),
    ]


def _movements(chain: Chain, trials: Sequence[OfflineTrial]) -> Iterator[tuple[str, Array]]:
    reference = {s: np.concatenate([t.reference[s] for t in trials]) for s in chain.segments}
    inner = zip(chain.joints[1:-1], chain.segments, chain.segments[1:], strict=False)
    for joint, above, below in inner:
        yield joint, joint_rotation(reference[above], reference[below])
    if len(chain.segments) == 1:
        yield chain.segments[0], reference[chain.segments[0]]


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
                f"{segment}: are its quaternions scalar first (w, x, y, z), is --up right, and is "
                "its mount of this wearing?"
            )


def _turned_worlds(chain: Chain, trials: Sequence[OfflineTrial]) -> Iterator[str]:
    """Tell of worlds turned about the vertical, where the movement parts heading from mount."""
    for _, sensor, q, reference in _streams(chain, trials):
        alignment = fit_sensor_alignment("heading", q, reference)
        angle = float(rotation.heading_of(alignment.q_world))
        if alignment.kappa <= HEADING_SEPARABLE and abs(angle) > MISALIGNED:
            yield (
                f"{sensor}: its world seems turned by {np.rad2deg(angle):.0f}° about the vertical "
                "against the reference's: bring both into one world first, or check --up"
            )


def _streams(
    chain: Chain, trials: Sequence[OfflineTrial]
) -> Iterator[tuple[str, str, Array, Array]]:
    """Give segment, sensor, its orientations and the reference's, of all trials."""
    for i, segment in enumerate(chain.segments):
        reference = np.concatenate([trial.reference[segment] for trial in trials])
        for sensor in chain.sensors[i]:
            q = np.concatenate([trial.sensors[sensor] for trial in trials])
            yield segment, sensor, q, reference
