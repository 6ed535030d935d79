"""Motions from files: joint angles over time, as TOML keys or NPZ arrays.

TOML, degrees, clinical signs, one table a key; a smooth curve is laid through them::

    loop = true                     # else the last posture is held
    [[key]]
    t_s = 0.0
    hip = [20, 0, 0]                # flexion, adduction, internal rotation; left out: 0
    knee = [5, 0, 0]
    ankle = [0, 0, 0]
    pelvis = [0, 0, 0]              # heading, tilt, list

NPZ, radians: ``t`` (n,) seconds and any of ``hip knee ankle pelvis`` (n, 3).
"""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from jointfit_simulators.limb import ANKLE, HIP, KNEE, PELVIS_TURN
from jointfit_simulators.posture import Style, upright

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_simulators.motion import Motion

_PARTS = {"hip": HIP, "knee": KNEE, "ankle": ANKLE, "pelvis": PELVIS_TURN}


def _read_toml(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]], bool]:
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    keys = table.get("key", [])
    t_s = np.array([key["t_s"] for key in keys], dtype=np.float64)
    angles = {part: np.radians([key.get(part, (0.0, 0.0, 0.0)) for key in keys]) for part in _PARTS}
    return t_s, angles, bool(table.get("loop", False))


def _read_npz(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]], bool]:
    with np.load(path, allow_pickle=False) as arrays:
        t_s = np.asarray(arrays["t"], dtype=np.float64)
        angles = {
            part: np.asarray(arrays[part], dtype=np.float64) for part in _PARTS if part in arrays
        }
    return t_s, angles, False


def motion_from_file(path: Path, style: Style) -> Motion:
    """Return the motion a file describes; curves between its keys have two continuous derivatives.

    Raises
    ------
    ValueError
        Fewer than two keys, times that do not increase, or a loop whose ends differ.
    """
    t_s, angles, loop = (_read_toml if path.suffix == ".toml" else _read_npz)(path)
    if not len(t_s) > 1 or np.any(np.diff(t_s) <= 0):
        raise ValueError(f"{path}: needs at least two keys with increasing t_s")
    ends: Literal["periodic", "clamped"] = "periodic" if loop else "clamped"
    curves = {part: CubicSpline(t_s, values, bc_type=ends) for part, values in angles.items()}
    length = float(t_s[-1] - t_s[0])

    def motion(t: NDArray[np.float64]) -> NDArray[np.float64]:
        place = t_s[0] + (t % length if loop else np.clip(t, 0.0, length))
        coordinates = upright(style, t)
        for part, curve in curves.items():
            coordinates[:, _PARTS[part]] = curve(place)
        return coordinates

    return motion
