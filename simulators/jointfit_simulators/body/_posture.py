"""Functions common to all motions: posture coordinates from joint angles.

Invariant: all functions have two continuous derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import (
    COORDINATES,
    KNEE,
    LEG_ANGLES,
    PELVIS_POSITION,
    PLATE_POSITION,
    LegGeometry,
    leg_pose,
)
from jointfit_simulators.body._random_signal import RandomSignal

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

PLATE_ON_TABLE = (0.55, 0.35, 0.90)
"""Position of the plate on its table, m."""
FLEXION, ADDUCTION, ROTATION = 0, 1, 2
"""Columns of a joint."""
HEADING, TILT, LIST = 0, 1, 2
"""Columns of the orientation of the pelvis."""


def column(part: slice, axis: int) -> int:
    """Return the coordinate column of one axis of one part."""
    return int(part.start) + axis


@dataclass(frozen=True, slots=True)
class MovementStyle:
    """Geometry and movement variability of a subject."""

    geometry: LegGeometry
    sway: RandomSignal
    """Slow sway of each joint angle in quiet stance, rad, 9 channels."""
    variability: RandomSignal
    """Deviation of each joint angle from the pattern of a motion, rad, 9 channels."""


def draw_style(geometry: LegGeometry, random: np.random.Generator) -> MovementStyle:
    """Return a movement style drawn from `random`."""
    return MovementStyle(
        geometry,
        sway=RandomSignal(random, 9, low_hz=0.05, high_hz=0.3, rms=np.radians(0.08)),
        variability=RandomSignal(random, 9, low_hz=0.05, high_hz=0.7, rms=np.radians(1.5)),
    )


def upright(style: MovementStyle, t: Array) -> Array:
    """Return upright stance over the origin, with the plate on its table."""
    coordinates = np.zeros((len(t), COORDINATES))
    coordinates[:, PELVIS_POSITION] = style.geometry.standing_pelvis
    coordinates[:, PLATE_POSITION] = PLATE_ON_TABLE
    return coordinates


def couple_knee(coordinates: Array) -> None:
    """Add the adduction and internal rotation that accompany knee flexion.

    Over 90 degrees of flexion the tibia rotates internally by about 8 degrees and adducts by about
    2 degrees (the screw-home movement, reversed).
    """
    bend = np.sin(coordinates[:, column(KNEE, FLEXION)] / 2)
    coordinates[:, column(KNEE, ADDUCTION)] += np.radians(2.5) * bend
    coordinates[:, column(KNEE, ROTATION)] += np.radians(11.0) * bend


def vary(style: MovementStyle, t: Array, coordinates: Array) -> None:
    """Add the movement variability of the subject."""
    deviation = style.variability.at(t)
    deviation[:, 4:6] *= 0.3  # the knee has little voluntary adduction and rotation
    coordinates[:, LEG_ANGLES] += deviation


def ground(style: MovementStyle, coordinates: Array) -> None:
    """Translate the pelvis so that the ankle has its position in upright stance."""
    ankle = leg_pose(style.geometry, coordinates).origins["foot"]
    coordinates[:, PELVIS_POSITION] += np.array(style.geometry.standing_ankle) - ankle


def smootherstep(x: Array) -> Array:
    r"""Return :math:`6x^5 - 15x^4 + 10x^3` of `x` clipped to [0, 1]: two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (x * (6 * x - 15) + 10)
