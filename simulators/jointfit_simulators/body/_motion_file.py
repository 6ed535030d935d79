"""Motions from files with joint angles over time, as TOML keys, NPZ arrays or OpenSim tables.

A TOML file contains degrees with clinical signs, and one table for each key. A cubic spline
interpolates the keys::

    loop = true                     # otherwise the last posture is held
    [[key]]
    t_s = 0.0
    hip = [20, 0, 0]                # flexion, adduction, internal rotation; default 0
    knee = [5, 0, 0]
    ankle = [0, 0, 0]
    pelvis = [0, 0, 0]              # heading, tilt, list

An NPZ file contains ``t`` (n,), s, and some of the arrays ``hip``, ``knee``, ``ankle`` and
``pelvis`` (n, 3), rad. It may contain the position of the pelvis, ``position`` (n, 3), m.

A MOT or STO file contains coordinates of OpenSim's lower-limb models for the right leg. The axes of
these models (x forward, y up, z right) are the axes y, z and x of this project. Their pelvis
rotates by tilt, list and rotation, in this order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from jointfit_daemon.files.orientations import read_sto
from jointfit_daemon.files.text import read_toml
from jointfit_simulators.body._limb import ANKLE, HIP, KNEE, PELVIS_POSITION, PELVIS_TURN
from jointfit_simulators.body._orientation import Rotation
from jointfit_simulators.body._posture import MovementStyle, upright_pose

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._motion import Motion

_ANGLES = {"hip": HIP, "knee": KNEE, "ankle": ANKLE, "pelvis": PELVIS_TURN}
_PARTS = {**_ANGLES, "position": PELVIS_POSITION}


def _read_toml(path: Path) -> tuple[Array, dict[str, Array], bool]:
    table = read_toml(path)
    keys = table.get("key", [])
    t_s = np.array([key["t_s"] for key in keys], dtype=np.float64)
    angles = {
        part: np.radians([key.get(part, (0.0, 0.0, 0.0)) for key in keys]) for part in _ANGLES
    }
    return t_s, angles, bool(table.get("loop", False))


def _read_npz(path: Path) -> tuple[Array, dict[str, Array], bool]:
    with np.load(path, allow_pickle=False) as arrays:
        t_s = np.asarray(arrays["t"], dtype=np.float64)
        angles = {
            part: np.asarray(arrays[part], dtype=np.float64) for part in _PARTS if part in arrays
        }
    return t_s, angles, False


def _read_opensim(path: Path) -> tuple[Array, dict[str, Array], bool]:
    table = read_sto(path)
    unit = np.pi / 180 if table.in_degrees else 1.0

    def columns(*names: str) -> Array:
        return np.column_stack([table.column(name) for name in names])

    hip = unit * columns("hip_flexion_r", "hip_adduction_r", "hip_rotation_r")
    turn = Rotation.from_euler(
        "XYZ", unit * columns("pelvis_tilt", "pelvis_list", "pelvis_rotation")
    )
    angles = {
        "hip": hip,
        "knee": unit * columns("knee_angle_r") * [1, 0, 0],
        "ankle": unit * columns("ankle_angle_r") * [1, 0, 0],
        "pelvis": np.unwrap(turn.as_euler("ZXY"), axis=0),
        "position": columns("pelvis_tz", "pelvis_tx", "pelvis_ty"),
    }
    return table.t_s, angles, False


_READERS = {".toml": _read_toml, ".npz": _read_npz, ".mot": _read_opensim, ".sto": _read_opensim}


def motion_from_file(path: Path, style: MovementStyle) -> Motion:
    """Return the motion in a file; splines between its keys have two continuous derivatives.

    Raises
    ------
    ValueError
        The suffix is unknown, the file has fewer than two keys, the times do not increase, or the
        first and last postures of a loop differ.
    """
    if path.suffix.lower() not in _READERS:
        raise ValueError(f"{path}: unknown motion file; expected one of {', '.join(_READERS)}")
    t_s, angles, loop = _READERS[path.suffix.lower()](path)
    if not len(t_s) > 1 or np.any(np.diff(t_s) <= 0):
        raise ValueError(f"{path}: expected at least two keys with increasing t_s")
    ends: Literal["periodic", "clamped"] = "periodic" if loop else "clamped"
    curves = {part: CubicSpline(t_s, values, bc_type=ends) for part, values in angles.items()}
    length = float(t_s[-1] - t_s[0])

    def motion(t: Array) -> Array:
        place = t_s[0] + (t % length if loop else np.clip(t, 0.0, length))
        coordinates = upright_pose(style, t)
        for part, curve in curves.items():
            coordinates[:, _PARTS[part]] = curve(place)
        return coordinates

    return motion
