"""Recorded knee: four virtual sensors of one leg, and the orientations of its bones in a model.

The module loads the data set `semireal_knee4imu`, converted to the conventions of the project. The
virtual sensors contain soft-tissue artefact of skin markers and recorded errors of orientation
filters. The module computes errors in the same way as the tables of the data set.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import functional_axis, joint_rotation, swing_twist

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

FOLDER = "semireal_knee4imu"
TRAINING_SHARE = 0.6


@dataclass(frozen=True, slots=True)
class KneeTrial:
    """Frames of one movement in which all orientations are known.

    `thigh` and `shank` are the reference, q_world_segment, shape (n, 4).
    """

    sensors: tuple[Array, Array, Array, Array]
    """Bone-aligned orientations q_world_segment of S1 and S2 (thigh) and S3 and S4 (shank), shape
    (n, 4) each."""
    thigh: Array
    shank: Array

    def part(self, frames: slice | NDArray[np.bool_]) -> KneeTrial:
        a, b, c, d = (q[frames] for q in self.sensors)
        return KneeTrial((a, b, c, d), self.thigh[frames], self.shank[frames])

    def turned(self, angle: float) -> KneeTrial:
        """Return the movement with the subject rotated about the vertical by `angle`, rad."""
        turn = rotation.heading(angle)
        a, b, c, d = (rotation.multiply(turn, q) for q in self.sensors)
        return KneeTrial(
            (a, b, c, d), rotation.multiply(turn, self.thigh), rotation.multiply(turn, self.shank)
        )

    def __len__(self) -> int:
        return len(self.thigh)


def load(data: Path, name: str) -> KneeTrial:
    """Return a trial: ``squats1``, ``walking1`` or ``DJ1``."""
    biases = json.loads((data / FOLDER / "static_bias.json").read_text())["q_bias"]
    with np.load(data / FOLDER / f"{name}.npz", allow_pickle=False) as arrays:
        columns = [
            rotation.multiply(_unit(arrays[f"S{i}_quat"]), _unit(np.array(biases[f"S{i}"])))
            for i in (1, 2, 3, 4)
        ]
        columns += [_unit(arrays["q_femur_r"]), _unit(arrays["q_tibia_r"])]
    seen = np.all([np.isfinite(q).all(axis=1) for q in columns], axis=0)
    # The file has y up. If world and segment axes are renamed, (w, x, y, z) becomes (w, z, x, y).
    a, b, c, d, thigh, shank = (q[seen][:, [0, 3, 1, 2]] for q in columns)
    return KneeTrial((a, b, c, d), thigh, shank)


def training_frames(trial: KneeTrial) -> int:
    """Return the number of frames in the first 60 % of a trial."""
    return int(TRAINING_SHARE * len(trial))


@dataclass(frozen=True, slots=True)
class Judge:
    """Computes RMS errors of thigh, shank and knee flexion about one functional axis, deg."""

    axis: Array

    @staticmethod
    def of(training: KneeTrial) -> Judge:
        return Judge(functional_axis(joint_rotation(training.thigh, training.shank)))

    def errors(self, said: tuple[Array, Array], truth: KneeTrial) -> tuple[float, float, float]:
        thigh, shank = said
        flexion = swing_twist(joint_rotation(thigh, shank), self.axis)[1]
        expected = swing_twist(joint_rotation(truth.thigh, truth.shank), self.axis)[1]
        off = np.pi - np.mod(np.pi - (flexion - expected), 2.0 * np.pi)
        return (
            _rms_degrees(rotation.angle_between(thigh, truth.thigh)),
            _rms_degrees(rotation.angle_between(shank, truth.shank)),
            _rms_degrees(off),
        )


def _unit(q: Array) -> Array:
    return rotation.normalize(np.asarray(q, dtype=np.float64))


def _rms_degrees(angles: Array | Sequence[float]) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))
