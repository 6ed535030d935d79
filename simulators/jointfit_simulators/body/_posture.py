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
    from numpy.typing import NDArray

PLATE_ON_TABLE = (0.55, 0.35, 0.90)
"""Where the plate lies when nobody holds it, m."""
FLEXION, ADDUCTION, ROTATION = 0, 1, 2
"""Columns of a joint."""
HEADING, TILT, LIST = 0, 1, 2
"""Columns of the pelvis' orientation."""


def column(part: slice, axis: int) -> int:
    """Return the coordinate column of one axis of one part."""
    return int(part.start) + axis


@dataclass(frozen=True, slots=True)
class MovementStyle:
    """How this person moves."""

    geometry: LegGeometry
    sway: RandomSignal
    """Slow sway of each joint angle in quiet stance, rad, 9 channels."""
    variability: RandomSignal
    """By how much each joint angle of a movement departs from its pattern, rad, 9 channels."""


def draw_style(geometry: LegGeometry, random: np.random.Generator) -> MovementStyle:
    """Return a person with habits drawn from `random`."""
    return MovementStyle(
        geometry,
        sway=RandomSignal(random, 9, low_hz=0.05, high_hz=0.3, rms=np.radians(0.08)),
        variability=RandomSignal(random, 9, low_hz=0.05, high_hz=0.7, rms=np.radians(1.5)),
    )


def upright(style: MovementStyle, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return upright stance over the origin, plate on its table."""
    coordinates = np.zeros((len(t), COORDINATES))
    coordinates[:, PELVIS_POSITION] = style.geometry.standing_pelvis
    coordinates[:, PLATE_POSITION] = PLATE_ON_TABLE
    return coordinates


def couple_knee(coordinates: NDArray[np.float64], rotation_rad: float = 0.0) -> None:
    """Give the knee what its flexion brings along: a little adduction and internal rotation.

    The tibia turns inward by some 8 degrees and tips by 2 as the knee bends to a right angle
    (the screw-home movement, reversed); `rotation_rad` adds what the person turns at will, which
    only a bent knee allows.
    """
    bend = np.sin(coordinates[:, column(KNEE, FLEXION)] / 2)
    coordinates[:, column(KNEE, ADDUCTION)] += np.radians(2.5) * bend
    coordinates[:, column(KNEE, ROTATION)] += np.radians(11.0) * bend + rotation_rad * bend


def vary(style: MovementStyle, t: NDArray[np.float64], coordinates: NDArray[np.float64]) -> None:
    """Let the movement depart from its pattern, as a person's does."""
    departure = style.variability.at(t)
    departure[:, 4:6] *= 0.3  # the knee hardly tips or twists at will
    coordinates[:, LEG_ANGLES] += departure


def ground(style: MovementStyle, coordinates: NDArray[np.float64]) -> None:
    """Move the pelvis so that the ankle stays where it stands."""
    ankle = leg_pose(style.geometry, coordinates).origins["foot"]
    coordinates[:, PELVIS_POSITION] += np.array(style.geometry.standing_ankle) - ankle


def smootherstep(x: NDArray[np.float64]) -> NDArray[np.float64]:
    r"""Return :math:`6x^5 - 15x^4 + 10x^3` clipped to [0, 1]: two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (x * (6 * x - 15) + 10)
