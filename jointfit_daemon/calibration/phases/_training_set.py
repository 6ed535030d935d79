"""Training frames of a limb: sensors and reference at common instants.

Only complete frames are used. A note or an error reports missing data with the remedy.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration.registration import sensor_at
from jointfit_daemon.calibration.soft_tissue import LimbTraining
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import visible

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import CalibrationTrial
    from jointfit_daemon.calibration.anatomy import Anatomy, ClusterTrack
    from jointfit_daemon.limb_model import SensorCalibration
    from jointfit_daemon.model import Chain


MAX_FRAMES = 2000
"""Largest number of frames of one movement that are used; longer movements are decimated."""
MIN_FRAMES = 300
"""Smallest number of complete frames."""
MISALIGNED = np.deg2rad(25.0)
"""Heading difference of a sensor and its reference above which soft tissue is not the cause, rad.
"""
SILENT = 0.1
"""Fraction of the movement without data of a sensor above which a note is published."""
TWINS = np.deg2rad(0.01)
"""Largest relative rotation of two sensors, rad, at which they count as one device."""


class TrainingSet(NamedTuple):
    """Training frames of a functional trial."""

    training: LimbTraining
    """Frames in segment axes, after correction of lags and with alignment of worlds and sensors."""
    raw: dict[str, Array]
    """q_world_sensor of every sensor at the same instants, shape (n, 4)."""
    notes: list[str]
    """Notes for the operator, as complete sentences."""


def limb_training(
    chain: Chain,
    functional: CalibrationTrial,
    tracks: Mapping[str, ClusterTrack],
    anatomy: Anatomy,
    sensors: Mapping[str, SensorCalibration],
) -> TrainingSet:
    """Return the training frames of a functional trial.

    Raises
    ------
    CalibrationError
        Sensors and segments have fewer than 300 common frames.
    """
    t_ns = next(iter(tracks.values())).t_ns
    raw = {s: sensor_at(functional.sensors[s], t_ns, item.lag_ns) for s, item in sensors.items()}
    reference = {
        name: rotation.multiply(tracks[name].q, anatomy.q_static[name]) for name in chain.segments
    }

    whole = np.all([visible(q) for q in (*raw.values(), *reference.values())], axis=0)
    rows = np.flatnonzero(whole)
    shares = {name: 1.0 - float(visible(q).mean()) for name, q in raw.items()}
    silent = [
        f"{name}: no data in {100 * share:.0f} % of the movement; this part was ignored for all "
        "sensors: check its connector or battery, and repeat"
        for name, share in shares.items()
        if share > SILENT
    ]
    if rows.size < MIN_FRAMES:
        counts = {name: int(visible(q).sum()) for name, q in (raw | reference).items()}
        raise CalibrationError(
            *silent,
            f"functional: {rows.size} frames with all sensors and segments, at least {MIN_FRAMES} "
            f"are needed; frames of each: {counts}",
        )
    rows = rows[:: -(-rows.size // MAX_FRAMES)]

    aligned = {
        s: rotation.multiply(
            rotation.multiply(item.q_optical_world, raw[s][rows]), item.q_sensor_segment
        )
        for s, item in sensors.items()
    }

    training = LimbTraining(aligned, {name: q[rows] for name, q in reference.items()})
    kept = {s: q[rows] for s, q in raw.items()}
    return TrainingSet(training, kept, [*silent, *identical_sensors(chain, kept)])


def identical_sensors(chain: Chain, sensors: Mapping[str, Array]) -> list[str]:
    """Return notes on sensors of a segment without relative motion, which may be one device.

    Parameters
    ----------
    sensors : mapping of str to ndarray, shape (n, 4)
        Orientations of each sensor; NaN if missing. World and sensor-to-segment alignment are
        arbitrary.
    """
    found = []
    for group in chain.sensors:
        for a, b in combinations(group, 2):
            between = rotation.multiply(rotation.conjugate(sensors[a]), sensors[b])
            between = between[visible(between)]
            if not len(between):
                continue
            if float(np.max(rotation.angle_between(between[0], between))) < TWINS:
                found.append(
                    f"{a} and {b} do not move relative to each other: check that they are not one "
                    "device or recording under two names; the second one then has no benefit"
                )
    return found
