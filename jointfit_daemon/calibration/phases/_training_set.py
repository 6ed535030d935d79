"""What the models of a limb are fitted to: sensors and reference at common instants.

Law: pure. Only frames in which everything is known; what lacks is named, with the remedy, and
whether the fit goes on without it or is refused.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationRefused
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
"""More frames than this of one movement repeat themselves; the fit takes every n-th."""
MIN_FRAMES = 300
SILENT = 0.1
"""Share of the movement for which a sensor may be silent and nobody need know."""
TWINS = np.deg2rad(0.01)
"""Two real sensors never keep to each other so closely."""


class Taught(NamedTuple):
    """What the movement gave."""

    training: LimbTraining
    """Through lag, worlds and mounts."""
    raw: dict[str, Array]
    """q_world_sensor of every sensor at the same instants, shape (n, 4)."""
    notes: list[str]
    """What people should know of it."""


def limb_training(
    chain: Chain,
    functional: CalibrationTrial,
    tracks: Mapping[str, ClusterTrack],
    anatomy: Anatomy,
    sensors: Mapping[str, SensorCalibration],
) -> Taught:
    """Return what models are fitted to.

    Raises
    ------
    CalibrationRefused
        Sensors and segments are known together in fewer than 300 frames.
    """
    t_ns = next(iter(tracks.values())).t_ns
    raw = {s: sensor_at(functional.sensors[s], t_ns, item.lag_ns) for s, item in sensors.items()}
    reference = {
        name: rotation.multiply(tracks[name].q, anatomy.q_static[name]) for name in chain.segments
    }
    whole = np.all([visible(q) for q in (*raw.values(), *reference.values())], axis=0)
    rows = np.flatnonzero(whole)
    silent = _silent(raw)
    if rows.size < MIN_FRAMES:
        raise CalibrationRefused(*silent, _too_few(rows.size, raw | reference))
    rows = rows[:: -(-rows.size // MAX_FRAMES)]
    said = {
        s: rotation.multiply(
            rotation.multiply(item.q_optical_world, raw[s][rows]), item.q_sensor_segment
        )
        for s, item in sensors.items()
    }
    training = LimbTraining(said, {name: q[rows] for name, q in reference.items()})
    kept = {s: q[rows] for s, q in raw.items()}
    return Taught(training, kept, [*silent, *twins(chain, kept)])


def twins(chain: Chain, sensors: Mapping[str, Array]) -> list[str]:
    """Return which sensors of a segment never move against each other: they are one.

    Parameters
    ----------
    sensors : mapping of str to ndarray, shape (n, 4)
        Orientations of each, in any world, on any mount; NaN where missing.
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
                    f"{a} and {b} say the same in every frame: one device or recording under two "
                    "names? What a second sensor wins is not there"
                )
    return found


def _silent(raw: Mapping[str, Array]) -> list[str]:
    """Return which sensors were silent for a part of the movement, and how long."""
    shares = {name: 1.0 - float(visible(q).mean()) for name, q in raw.items()}
    return [
        f"{name}: no data in {100 * share:.0f} % of the movement, of which nothing was learned for "
        "any sensor: see to its plug or battery, and repeat"
        for name, share in shares.items()
        if share > SILENT
    ]


def _too_few(count: int, known: Mapping[str, Array]) -> str:
    counts = {name: int(visible(q).sum()) for name, q in known.items()}
    return (
        f"functional: all sensors and segments together in {count} frames, at least {MIN_FRAMES} "
        f"are needed; seen of each: {counts}"
    )
