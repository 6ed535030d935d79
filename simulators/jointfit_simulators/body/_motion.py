"""Built-in motions, which are functions from time to leg coordinates.

All joint angles are zero in upright stance, which is the static pose of the calibration. Walking is
on a treadmill, so the subject remains in the capture volume.

Invariant: a motion has two continuous derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from jointfit_simulators.body._limb import (
    ANKLE,
    HIP,
    KNEE,
    LEG_ANGLES,
    PELVIS_TURN,
)
from jointfit_simulators.body._posture import (
    ADDUCTION,
    FLEXION,
    HEADING,
    LIST,
    ROTATION,
    TILT,
    MovementStyle,
    column,
    couple_knee,
    ground,
    in_turn,
    on_plate,
    upright_pose,
    vary,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array

Motion = Callable[["Array"], "Array"]
"""Function from time since the start, s, shape (n,), to coordinates, shape (n, COORDINATES)."""
StyledMotion = Callable[[MovementStyle, "Array"], "Array"]
"""Motion that depends on the movement style of a subject."""


def _cycle(*keys: tuple[float, float]) -> CubicSpline:
    """Return a periodic spline through points (share of the cycle, degrees), in radians."""
    share, degrees = np.array([*keys, (1.0, keys[0][1])]).T
    return CubicSpline(share, np.radians(degrees), bc_type="periodic")


# Sagittal angles of level walking over one stride from heel strike, from textbook curves.
_GAIT_HIP = _cycle((0, 30), (0.15, 24), (0.35, 0), (0.52, -10), (0.65, 5), (0.85, 33))
_GAIT_KNEE = _cycle((0, 4), (0.14, 17), (0.4, 4), (0.58, 30), (0.72, 62), (0.86, 28), (0.96, 4))
_GAIT_ANKLE = _cycle((0, 0), (0.07, -5), (0.3, 6), (0.46, 11), (0.62, -17), (0.78, 1), (0.9, 2))
_STRIDE_S = 1.1
"""Duration of a stride, s."""

# Angles of knee, thigh and pelvis: seated, leaning, upright, leaning, seated.
_CHAIR_KNEE = _cycle((0, 92), (0.15, 92), (0.28, 75), (0.45, 4), (0.55, 4), (0.75, 70), (0.9, 92))
_CHAIR_THIGH = _cycle((0, 86), (0.15, 86), (0.28, 66), (0.45, 2), (0.55, 2), (0.75, 60), (0.9, 86))
_CHAIR_LEAN = _cycle((0, 6), (0.12, 12), (0.24, 38), (0.45, 2), (0.55, 2), (0.72, 35), (0.9, 10))
_CHAIR_S = 5.0
"""Duration of one sit-to-stand cycle, s."""


def stand(style: MovementStyle, t: Array) -> Array:
    """Stand upright with a sway of tenths of a degree."""
    coordinates = upright_pose(style, t)
    coordinates[:, LEG_ANGLES] += style.sway.at(t)
    hip, knee = coordinates[:, HIP], coordinates[:, KNEE]
    coordinates[:, ANKLE] = np.array([1, -1, -1]) * knee - hip  # flat sole
    ground(style, coordinates)
    return coordinates


def walk(style: MovementStyle, t: Array) -> Array:
    """Walk on a treadmill with a constant mean heading."""
    coordinates = upright_pose(style, t)
    share = t / _STRIDE_S
    phase = 2 * np.pi * share

    # Sagittal angles
    coordinates[:, column(HIP, FLEXION)] = _GAIT_HIP(share % 1.0)
    coordinates[:, column(KNEE, FLEXION)] = _GAIT_KNEE(share % 1.0)
    coordinates[:, column(ANKLE, FLEXION)] = _GAIT_ANKLE(share % 1.0)

    # Frontal and transverse angles
    coordinates[:, column(HIP, ADDUCTION)] = np.radians(5) * np.sin(phase - 0.4)
    coordinates[:, column(HIP, ROTATION)] = np.radians(4) * np.cos(phase)
    coordinates[:, column(ANKLE, ADDUCTION)] = np.radians(3) * np.sin(phase + 1.0)

    # Pelvis
    coordinates[:, column(PELVIS_TURN, HEADING)] = np.radians(5) * np.sin(phase)
    coordinates[:, column(PELVIS_TURN, TILT)] = np.radians(1.5) * np.sin(2 * phase)
    coordinates[:, column(PELVIS_TURN, LIST)] = np.radians(3) * np.sin(phase + 0.5)
    coordinates[:, 0] += 0.02 * np.sin(phase)
    coordinates[:, 2] += 0.02 * np.cos(2 * phase) - 0.03

    couple_knee(coordinates)
    vary(style, t, coordinates)
    return coordinates


def _sagittal(style: MovementStyle, t: Array, *, knee: Array, thigh: Array, lean: Array) -> Array:
    """Flex hip, knee and ankle over a flat foot.

    All angles are in rad. `thigh` and `lean` are pitch angles in space.
    """
    coordinates = upright_pose(style, t)
    coordinates[:, column(PELVIS_TURN, TILT)] = -lean
    coordinates[:, column(HIP, FLEXION)] = thigh + lean
    coordinates[:, column(KNEE, FLEXION)] = knee
    coordinates[:, column(ANKLE, FLEXION)] = knee - thigh

    # Keep the knees over the toes.
    coordinates[:, column(HIP, ADDUCTION)] = -0.08 * thigh
    coordinates[:, column(ANKLE, ADDUCTION)] = 0.06 * thigh

    couple_knee(coordinates)
    vary(style, t, coordinates)
    ground(style, coordinates)
    return coordinates


def squat(style: MovementStyle, t: Array) -> Array:
    """Squat every 3 s with varying depth."""
    depth = (1 - np.cos(2 * np.pi * t / 3.0)) / 2 * (0.9 + 0.1 * np.cos(0.37 * t))
    return _sagittal(
        style,
        t,
        knee=np.radians(98) * depth,
        thigh=np.radians(70) * depth,
        lean=np.radians(24) * depth,
    )


def sit_to_stand(style: MovementStyle, t: Array) -> Array:
    """Sit down on a chair and stand up, every 5 s."""
    share = (t / _CHAIR_S + 0.5) % 1.0  # starts in upright stance
    return _sagittal(
        style, t, knee=_CHAIR_KNEE(share), thigh=_CHAIR_THIGH(share), lean=_CHAIR_LEAN(share)
    )


def hip_circles(style: MovementStyle, t: Array) -> Array:
    """Swing the almost straight leg in arcs of rotating direction (star-arc movement)."""
    coordinates = upright_pose(style, t)
    swing = np.sin(2 * np.pi * 0.5 * t)
    direction = 2 * np.pi * t / 13.0

    coordinates[:, column(HIP, FLEXION)] = np.radians(14 + 30 * swing * np.cos(direction))
    coordinates[:, column(HIP, ADDUCTION)] = np.radians(-12 + 22 * swing * np.sin(direction))
    coordinates[:, column(HIP, ROTATION)] = np.radians(15) * np.sin(2 * np.pi * 0.23 * t)
    coordinates[:, column(KNEE, FLEXION)] = np.radians(14 + 6 * np.sin(2 * np.pi * 0.31 * t))
    coordinates[:, column(ANKLE, FLEXION)] = np.radians(5) * np.sin(2 * np.pi * 0.4 * t)
    coordinates[:, column(PELVIS_TURN, LIST)] = np.radians(4) * swing * np.sin(direction)
    coordinates[:, 2] += 0.04

    couple_knee(coordinates)
    vary(style, t, coordinates)
    return coordinates


def knee_swings(style: MovementStyle, t: Array) -> Array:
    """Swing the shank with the thigh raised; internal rotation depends on knee flexion."""
    coordinates = upright_pose(style, t)
    bend = np.radians(55 + 43 * np.sin(2 * np.pi * 0.55 * t))
    coordinates[:, column(HIP, FLEXION)] = np.radians(42 + 8 * np.sin(2 * np.pi * 0.21 * t))
    coordinates[:, column(HIP, ADDUCTION)] = np.radians(5) * np.sin(2 * np.pi * 0.17 * t)
    coordinates[:, column(KNEE, FLEXION)] = bend
    coordinates[:, column(ANKLE, FLEXION)] = np.radians(8) * np.sin(2 * np.pi * 0.33 * t)
    coordinates[:, 2] += 0.04

    # Voluntary rotation requires a flexed knee.
    twist = np.radians(15) * np.sin(2 * np.pi * 0.29 * t)
    couple_knee(coordinates)
    coordinates[:, column(KNEE, ROTATION)] += twist * np.sin(bend / 2)
    vary(style, t, coordinates)
    return coordinates


def leg_swings(style: MovementStyle, t: Array) -> Array:
    """Flex and extend hip, knee and ankle of the raised leg widely, in the sagittal plane only."""
    coordinates = upright_pose(style, t)
    coordinates[:, column(HIP, FLEXION)] = np.radians(25 + 45 * np.sin(2 * np.pi * 0.31 * t))
    coordinates[:, column(KNEE, FLEXION)] = np.radians(55 + 50 * np.sin(2 * np.pi * 0.43 * t))
    coordinates[:, column(ANKLE, FLEXION)] = np.radians(-10 + 28 * np.sin(2 * np.pi * 0.67 * t))
    coordinates[:, 2] += 0.15
    return coordinates


def ankle_circles(style: MovementStyle, t: Array) -> Array:
    """Move the raised foot in circles."""
    coordinates = upright_pose(style, t)
    phase = 2 * np.pi * 0.7 * t

    coordinates[:, column(HIP, FLEXION)] = np.radians(25)
    coordinates[:, column(KNEE, FLEXION)] = np.radians(30 + 6 * np.sin(0.9 * t))
    coordinates[:, column(ANKLE, FLEXION)] = np.radians(-6 + 20 * np.sin(phase))
    coordinates[:, column(ANKLE, ADDUCTION)] = np.radians(13) * np.cos(phase)
    coordinates[:, column(ANKLE, ROTATION)] = np.radians(10) * np.sin(0.43 * phase)
    coordinates[:, 2] += 0.04

    couple_knee(coordinates)
    vary(style, t, coordinates)
    return coordinates


def turn(style: MovementStyle, t: Array) -> Array:
    """Walk with a heading that oscillates by 90 degrees to either side, with a period of 16 s."""
    coordinates = walk(style, t)
    coordinates[:, column(PELVIS_TURN, HEADING)] += np.radians(90) * np.sin(2 * np.pi * t / 16.0)
    return coordinates


def plate(style: MovementStyle, t: Array) -> Array:
    """Stand and rotate the plate with all sensors by hand, about every axis."""
    return on_plate(stand(style, t), t)


_MIX: tuple[StyledMotion, ...] = (walk, hip_circles, squat, knee_swings, ankle_circles)


def functional(style: MovementStyle, t: Array) -> Array:
    """Repeat walking, hip circles, squats, knee swings and ankle circles, 4 s each."""
    return in_turn(_MIX, style, t)


MOTIONS: Mapping[str, StyledMotion] = {
    motion.__name__: motion
    for motion in (
        stand, walk, squat, sit_to_stand, hip_circles, knee_swings, leg_swings, ankle_circles,
        functional, plate, turn,
    )
}  # fmt: skip
"""All built-in motions of the leg by name."""


def motions_of(
    style: MovementStyle, motions: Mapping[str, StyledMotion] = MOTIONS
) -> dict[str, Motion]:
    """Return the motions in the style of a subject; the default is the motions of the leg."""
    return {name: partial(motion, style) for name, motion in motions.items()}
