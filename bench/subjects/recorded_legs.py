"""Both legs of a recorded adult, with eight assignments of filter errors and two references.

The module loads the data set `semireal_knee4imu_v2`, which contains soft-tissue artefact. Both
references are inverse kinematics of the same model: one with fitted marker positions, one with the
marker positions of the static trial. The references differ by up to 20 deg about the long axis of
the thigh. If only one reference shows an improvement, the method may only fit the error of that
reference.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.subjects.recorded_knee import KneeTrial
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

FOLDER = "semireal_knee4imu_v2"
MOVEMENTS = ("squats1", "STS1", "walking1", "DJ1")
STATIC = "static1"
LEGS = {"right": "r", "left": "l"}
DEALS = range(8)
REFERENCES = {"fitted": "", "placed": "_placed"}


class LegCase(NamedTuple):
    """One leg with one set of filter errors and one reference."""

    leg: str
    """Leg, a key of `LEGS`."""
    deal: int
    """Number of the assignment of recorded filter errors to the sensors."""
    reference: str
    """Reference, a key of `REFERENCES`."""


def all_cases(reference: str) -> list[LegCase]:
    """Return the cases of both legs with every assignment of filter errors."""
    return [LegCase(leg, deal, reference) for leg in LEGS for deal in DEALS]


@cache
def recorded_leg(data: Path, movement: str, case: LegCase) -> KneeTrial:
    """Return a movement of a leg; the alignments are from its static trial in the same case."""
    sensors, bones = _orientations(data, movement, case)
    mounts = [
        rotation.average(rotation.multiply(rotation.conjugate(q), bone))
        for q, bone in zip(*_orientations(data, STATIC, case), strict=True)
    ]
    columns = [rotation.multiply(q, mount) for q, mount in zip(sensors, mounts, strict=True)]
    seen = np.all([np.isfinite(q).all(axis=1) for q in columns], axis=0)
    a, b, c, d = (q[seen] for q in columns)
    return KneeTrial((a, b, c, d), bones[0][seen], bones[3][seen])


def _orientations(data: Path, movement: str, case: LegCase) -> tuple[list[Array], list[Array]]:
    """Return q_world_sensor of each of the four sensors, and q_world_bone of its bone."""
    letter, suffix = LEGS[case.leg], REFERENCES[case.reference]
    with np.load(data / FOLDER / f"{movement}.npz", allow_pickle=False) as arrays:
        skin = rotation.normalize(arrays[f"q_skin_{letter}"].astype(float))
        error = rotation.normalize(arrays[f"q_error_{letter}"][case.deal].astype(float))
        thigh, shank = (
            rotation.normalize(arrays[f"q_{bone}_{letter}{suffix}"].astype(float))
            for bone in ("femur", "tibia")
        )
    return list(rotation.multiply(error, skin)), [thigh, thigh, shank, shank]
