"""Functions for all motions: posture coordinates from joint angles, and sequences of motions.

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
    ON_PLATE,
    PELVIS_POSITION,
    PLATE_POSITION,
    PLATE_TURN,
    LegGeometry,
    leg_pose,
)
from jointfit_simulators.body._random_signal import RandomSignal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.arrays import Array

PLATE_ON_TABLE = (0.55, 0.35, 0.90)
"""Position of the plate on its table, m."""
_MIX_S = 4.0
"""Duration of each motion in a repeated sequence, s."""
_MIX_BLEND_S = 1.0
"""Duration of the blend between two motions of the sequence, s."""
FLEXION, ADDUCTION, ROTATION = 0, 1, 2
"""Indices of the angles of a joint."""
HEADING, TILT, LIST = 0, 1, 2
"""Indices of the orientation angles of the pelvis."""


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


def upright_pose(style: MovementStyle, t: Array) -> Array:
    """Return upright stance over the origin, with the plate on its table."""
    return rest(t, style.geometry.standing_pelvis)


def rest(t: Array, base: tuple[float, float, float]) -> Array:
    """Return zero angles, with the limb's base at `base` (m) and the plate on its table."""
    coordinates = np.zeros((len(t), COORDINATES))
    coordinates[:, PELVIS_POSITION] = base
    coordinates[:, PLATE_POSITION] = PLATE_ON_TABLE
    return coordinates


def on_plate(coordinates: Array, t: Array) -> Array:
    """Move the sensors to the plate, which turns about every axis; return `coordinates`."""
    coordinates[:, ON_PLATE] = 1.0
    rates_hz, phases = np.array([0.31, 0.23, 0.17]), np.array([0.0, 1.1, 2.3])
    turns = np.sin(2 * np.pi * t[:, None] * rates_hz + phases)
    coordinates[:, PLATE_TURN] = np.radians([62.0, 55.0, 58.0]) * turns
    coordinates[:, PLATE_POSITION] += np.array([0.06, 0.05, 0.08]) * turns + np.array([0, 0.1, 0.2])
    return coordinates


def in_turn(
    parts: Sequence[Callable[[MovementStyle, Array], Array]], style: MovementStyle, t: Array
) -> Array:
    """Repeat a sequence of motions of `_MIX_S` each, with smooth blends."""
    coordinates = np.zeros((len(t), COORDINATES))
    place = (t / _MIX_S) % len(parts)

    # The sum of the weights of all motions is always 1.
    for index, part in enumerate(parts):
        since = ((place - index) % len(parts)) * _MIX_S
        weight = smootherstep(since / _MIX_BLEND_S) * smootherstep(
            (_MIX_S + _MIX_BLEND_S - since) / _MIX_BLEND_S
        )
        active = weight > 0
        if np.any(active):
            coordinates[active] += weight[active, None] * part(style, t[active])
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
    coordinates[:, LEG_ANGLES] += deviation(style, t)


def deviation(style: MovementStyle, t: Array) -> Array:
    """Return the movement variability of a leg, rad, shape (n, 9)."""
    found = style.variability.at(t)
    found[:, 4:6] *= 0.3  # the knee has little voluntary adduction and rotation
    return found


def ground(style: MovementStyle, coordinates: Array) -> None:
    """Translate the pelvis so that the ankle is at its position in upright stance."""
    ankle = leg_pose(style.geometry, coordinates).origins["foot"]
    coordinates[:, PELVIS_POSITION] += np.array(style.geometry.standing_ankle) - ankle


def smootherstep(x: Array) -> Array:
    r"""Return :math:`6x^5 - 15x^4 + 10x^3` of `x` clipped to [0, 1].

    The function has two continuous derivatives.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (x * (6 * x - 15) + 10)
