"""A limb with soft-tissue artefact that depends on posture, calibrated on small knee flexion."""

from __future__ import annotations

from functools import cache

import numpy as np

from jointfit_daemon.calibration import OnlineFrames
from jointfit_daemon.calibration.soft_tissue import LimbTraining, fit_models, pack
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
    StoredCluster,
)
from jointfit_daemon.model import Chain

CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1", "S2"), ("S3",)))
TWO_AND_TWO = Chain(CHAIN.joints, CHAIN.segments, (("S1", "S2"), ("S3", "S4")))
BODIES = {"thigh": "Thigh", "shank": "Shank"}
ONE = (1.0, 0.0, 0.0, 0.0)
TEMPLATE = ((0.05, 0.0, 0.1), (-0.05, 0.02, 0.0), (0.0, -0.06, -0.08), (0.03, 0.05, -0.05))
SKIN = {
    "S1": (0.20, 0.05, 0.0),
    "S2": (0.05, -0.02, 0.1),
    "S3": (-0.15, 0.0, 0.05),
    "S4": (-0.1, 0.0, 0.0),
}
"""Rotation of each sensor by soft tissue at a knee flexion of 1 rad, rad. The rotation is
proportional to the square of the flexion."""


def moving(
    frames: int, bend: float, seed: int = 0, chain: Chain = CHAIN, rate_hz: float = 10.0
) -> LimbTraining:
    """Return a movement with knee flexion up to `bend`, rad, and soft-tissue artefact."""
    t = np.arange(frames) / rate_hz
    dice = np.random.default_rng(seed)
    knee = -0.5 * bend * (1.0 - np.cos(1.3 * t + seed))
    hip = 0.3 * bend * np.sin(1.3 * t + 0.5)
    zero = np.zeros(frames)
    thigh = rotation.exp(np.stack([hip, 0.1 * np.sin(0.7 * t), zero], axis=1))
    shank = rotation.multiply(thigh, rotation.exp(np.stack([knee, zero, zero], axis=1)))
    bones = {"thigh": thigh, "shank": shank}
    sensors = {}
    for name, segment in _owners(chain).items():
        bone = bones[segment]
        skin = knee[:, None] * np.abs(knee[:, None]) * np.array(SKIN[name])
        skin = skin + dice.normal(0.0, 0.005, (frames, 3))
        sensors[name] = rotation.multiply(bone, rotation.exp(skin))
    return LimbTraining(sensors, bones)


def _owners(chain: Chain) -> dict[str, str]:
    return {
        sensor: segment
        for segment, group in zip(chain.segments, chain.sensors, strict=True)
        for sensor in group
    }


def fresh(training: LimbTraining) -> OnlineFrames:
    """Return a movement as frames of sensors and of the markers of each segment."""
    markers = {
        name: rotation.rotate(q[:, None], np.array(TEMPLATE)) + np.array([0.1, 0.2, 1.0])
        for name, q in training.reference.items()
    }
    return OnlineFrames(training.sensors, markers, {})


@cache
def calibration(chain: Chain = CHAIN, *, bodies: bool = False) -> Calibration:
    """Return a calibration whose training movement has a knee flexion of at most 0.5 rad."""
    taught = moving(400, 0.5, chain=chain)
    models = fit_models(chain, taught, "anchored")
    cluster = StoredCluster(("A", "B", "C", "D"), None, TEMPLATE, (0.0, 0.0, 0.0), ONE)
    clusters = {
        name: StoredCluster((), body, (), (0.0, 0.0, 0.0), ONE) if bodies else cluster
        for name, body in BODIES.items()
    }
    return Calibration(
        method="anchored",
        joints=chain.joints,
        segments=chain.segments,
        chain_sensors=chain.sensors,
        sensor={name: SensorCalibration(ONE, ONE) for name in _owners(chain)},
        segment={n: SegmentCalibration(ONE, 0.4, 0.01, models[n]) for n in chain.segments},
        joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
        clusters=clusters,
        digest="d",
        memory=pack(chain, taught),
    )
