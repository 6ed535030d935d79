"""Knee trials from skin markers of the recorded subject: both legs, including sit-to-stand.

The data set of the recorded knee contains the right leg without sit-to-stand. These trials are made
from the marker files of its subject in the same way. The orientation of a sensor is the Kabsch
rotation of three neighbouring skin markers relative to their mean in the static trial. The recorded
filter error of the same movement is added; for sit-to-stand, the filter error of the squats is
used. The reference is the subject's model, whose pose is from the inverse kinematics of this
project, without any marker of the thigh and shank clusters.

Invariant: no marker of a sensor contributes to its reference. All alignments are from the static
trial.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.subjects.recorded_knee import FOLDER, KneeTrial
from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.files.mocap import read_trc
from jointfit_daemon.files.models import read_osim
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.inverse_kinematics import solve_frames
from jointfit_daemon.limb_model import rigid_fit

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

SUBJECT = "opencap_subject4"
MODEL = "optimized_scale_and_markers.osim"
MOVEMENTS = {"squats1": 2, "walking1": 1, "DJ1": 1, "STS1": 2}
"""Step between used frames at 100 Hz, by movement, as in `bench.subjects.recorded_knee`."""
STATIC, STATIC_EVERY = "static1", 20
RATE_HZ = 100.0
CLUSTERS = ("thigh", "sh1", "sh2", "sh3", "sh4", "shank")
"""Substrings of the names of markers on thighs and shanks."""
SENSORS = {
    "r": (
        ("r_thigh1", "r_thigh2", "r_thigh4"),
        ("r_thigh3", "r_thigh4", "r_thigh2"),
        ("r_shank_antsup", "r_sh3", "r_sh4"),
        ("r_sh2", "r_sh4", "r_sh3"),
    ),
    "l": (
        ("L_thigh1", "L_thigh2", "L_thigh4"),
        ("L_thigh3", "L_thigh4", "L_thigh2"),
        ("L_shank_antsup", "L_sh2", "L_sh3"),
        ("L_shank_antsup", "L_sh2", "L_sh3"),
    ),
}
"""Three markers for each sensor. The left shank has only three markers, so its two sensors share
them."""
MEDIAL = ("r_mknee", "r_mankle", "L_mknee", "L_mankle")
"""Markers that only the static trial contains. They are not tracked: if they were, the bones of
the static trial would differ from the bones of the other trials.
"""


AS_RECORDED = (0, 1, 2, 3)
"""Index of the filter error of each sensor, as in `bench.subjects.recorded_knee`."""


class _Leg(NamedTuple):
    """Orientations of one leg, shape (n, 4) each, and their times, shape (n,).

    `skin_knee` aligns the sensors to the bones and adds the filter errors.
    """

    skin: tuple[Array, ...]
    """Rotation of each sensor's markers since the static trial."""
    thigh: Array
    shank: Array
    t_s: Array


@cache
def skin_knee(
    data: Path, movement: str, side: str, errors_of: tuple[int, ...] = AS_RECORDED
) -> KneeTrial:
    """Return one movement, or the static trial without filter errors, of leg ``r`` or ``l``.

    `errors_of` selects the filter errors of each sensor.
    """
    leg, static = (_legs(data, name)[side] for name in (movement, STATIC))
    mounts = [
        rotation.average(rotation.multiply(rotation.conjugate(q), bone))
        for q, bone in zip(static.skin, (static.thigh,) * 2 + (static.shank,) * 2, strict=True)
    ]
    errors = _filter_errors(data, movement, leg.t_s)
    columns = [
        rotation.multiply(rotation.multiply(errors[k], q), mount)
        for k, q, mount in zip(errors_of, leg.skin, mounts, strict=True)
    ]
    seen = np.all([np.isfinite(q).all(axis=1) for q in columns], axis=0)
    a, b, c, d = (q[seen] for q in columns)
    return KneeTrial((a, b, c, d), leg.thigh[seen], leg.shank[seen])


@cache
def _legs(data: Path, name: str) -> dict[str, _Leg]:
    """Return both legs of a trial, with one inverse-kinematics solution for all bones."""
    trial, static = (read_trc(data / SUBJECT / "trc" / f"{n}.trc") for n in (name, STATIC))
    every = MOVEMENTS.get(name, STATIC_EVERY)
    seen = to_z_up(trial.positions[::every])
    stood = np.nanmean(to_z_up(static.positions), axis=0)
    path = data / SUBJECT / "models" / MODEL
    tracked = {n for n in trial.names if n not in MEDIAL and not any(c in n for c in CLUSTERS)}
    chain = read_osim(path, markers=tracked & {m.name for m in read_osim(path).model.markers}).model
    found = solve_frames(chain, seen[:, [trial.names.index(n) for n in chain.marker_names]])
    bones = dict(zip(chain.segment_names, np.moveaxis(found.rotations, 1, 0), strict=True))
    return {
        side: _Leg(
            tuple(
                rigid_fit(
                    stood[[static.names.index(m) for m in markers]],
                    seen[:, [trial.names.index(m) for m in markers]],
                )[0]
                for markers in sensors
            ),
            rotation.from_matrix(bones[f"femur_{side}"]),
            rotation.from_matrix(bones[f"tibia_{side}"]),
            np.arange(len(seen)) * every / RATE_HZ,
        )
        for side, sensors in SENSORS.items()
    }


def _filter_errors(data: Path, movement: str, t_s: Array) -> list[Array]:
    """Return the filter error of each sensor, q_world_world, shape (n, 4).

    The static trial has no filter error.
    """
    if movement == STATIC:
        return [np.tile(rotation.IDENTITY, (len(t_s), 1))] * len(SENSORS["r"])
    known = movement if movement != "STS1" else "squats1"
    with np.load(data / FOLDER / f"{known}.npz", allow_pickle=False) as arrays:
        at, pairs = (
            arrays["t"],
            [(arrays[f"S{i}_quat"], arrays[f"S{i}_quat_noimuerr"]) for i in (1, 2, 3, 4)],
        )
    errors = []
    for said, true in pairs:
        q = rotation.multiply(
            rotation.normalize(said), rotation.conjugate(rotation.normalize(true))
        )
        turns = to_z_up(rotation.log(q))
        whole = np.isfinite(turns).all(axis=1)
        vectors = [np.interp(t_s, at[whole], turn) for turn in turns[whole].T]
        errors.append(rotation.exp(np.stack(vectors, axis=1)))
    return errors
