"""Lower limbs of one recorded adult as a chain with seven segments and 20 degrees of freedom.

The chain is built from the standing trial alone. A joint center is the midpoint of the markers on
both sides of the joint, except the hip center, which the recording contains. The axes of segments
follow from the centers, and the positions of markers on their segments are from the standing trial.
Virtual markers are not tracked.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.mocap import MarkerTrial, read_marker_trial
from jointfit_daemon.kinematics.chains import ChainModel, Joint, JointKind, Marker, Segment

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

FOLDER = "opencap_subject4"
TRIALS = ("static1", "walking1", "squats1", "DJ1", "STS1")
_PELVIS = ("L.ASIS", "L.PSIS", "r.ASIS", "r.PSIS")
_THIGH = ("thigh1", "thigh2", "thigh3", "thigh4", "knee")
_SHANK = ("sh2", "sh3", "shank_antsup", "ankle")
_FOOT = ("calc", "5meta", "toe")


@cache
def trial(data: Path, name: str) -> MarkerTrial:
    """Return a trial with z up."""
    return read_marker_trial(data / FOLDER / "trc" / f"{name}.trc")


def measured(data: Path, name: str, model: ChainModel) -> Array:
    """Return the positions of the model's markers in a trial, m, shape (T, M, 3)."""
    return trial(data, name).points(model.marker_names)


@cache
def oc4_lower(data: Path) -> ChainModel:
    """Return the chain model."""
    static = trial(data, "static1")
    names = static.trajectories.names
    means = np.nanmean(static.trajectories.positions, axis=0)
    at: dict[str, Array] = dict(zip(names, means, strict=True))
    frames = {"pelvis": _pelvis(at)}
    segments = [Segment("pelvis")]
    riders = [("pelvis", marker) for marker in _PELVIS]
    for side, sign in (("r", 1.0), ("L", -1.0)):
        for name, parent, frame, kind, markers in _leg(at, side, sign):
            above_r, above_t = frames[parent]
            center = above_r.T @ (frame[1] - above_t)
            segments.append(Segment(name, parent, Joint(kind, tuple(center.tolist()))))
            frames[name] = frame
            riders += [(name, f"{side}_{marker}") for marker in markers]
    return ChainModel(
        tuple(segments),
        tuple(
            Marker(marker, segment, tuple((R.T @ (at[marker] - t)).tolist()))
            for segment, marker in riders
            for R, t in [frames[segment]]
        ),
        "oc4-lower",
    )


def _frame(z: Array, x: Array) -> Array:
    z = z / np.linalg.norm(z)
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    return np.column_stack((np.cross(y, z), y, z))


def _pelvis(at: dict[str, Array]) -> tuple[Array, Array]:
    across = at["r.ASIS"] - at["L.ASIS"]
    origin = 0.5 * (at["r.ASIS"] + at["L.ASIS"])
    back = 0.5 * (at["r.PSIS"] + at["L.PSIS"])
    return _frame(np.cross(across, origin - back), across), origin


def _leg(
    at: dict[str, Array], side: str, sign: float
) -> list[tuple[str, str, tuple[Array, Array], JointKind, tuple[str, ...]]]:
    def middle(joint: str) -> Array:
        return 0.5 * (at[f"{side}_{joint}"] + at[f"{side}_m{joint}"])

    hip, knee, ankle = at[f"{side.upper()}_HJC"], middle("knee"), middle("ankle")
    x = sign * (at[f"{side}_knee"] - at[f"{side}_mknee"])
    up = np.array([0.0, 0.0, 1.0])
    forward = at[f"{side}_toe"] - at[f"{side}_calc"]
    femur, tibia, foot = (f"{bone}_{side}" for bone in ("femur", "tibia", "foot"))
    shank = (*_SHANK, "sh4") if side == "r" else _SHANK
    return [
        (femur, "pelvis", (_frame(hip - knee, x), hip), "ball", _THIGH),
        (tibia, femur, (_frame(knee - ankle, x), knee), "hinge", shank),
        (foot, tibia, (_frame(up, np.cross(forward, up)), ankle), "ball", _FOOT),
    ]
