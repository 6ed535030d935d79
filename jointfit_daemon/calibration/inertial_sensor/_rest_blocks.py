"""Detection of rest from blocks of readings without movement.

The standard deviation of the angular rate does not contain the bias, so a sensor with a large bias
is still detected as being at rest. A slow rotation also has a small standard deviation. The
specific forces of successive blocks must therefore agree.
"""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Vector

BLOCK_NS = 250_000_000
"""Length of a block, ns."""
RATE_SD = radians(1.0)
"""Largest standard deviation of an angular rate at rest, rad/s."""
FORCE_SD = 0.15
"""Largest standard deviation of a specific force at rest, m/s^2."""
FORCE_STEP = 0.06
"""Largest difference of the mean specific force between blocks of a rest, m/s^2, equivalent to 0.35
degrees.
"""
LONGEST_PAUSE_NS = 200_000_000
"""Longest pause between two readings of a block, ns."""
_FEWEST = 3
"""Smallest number of readings in a block."""


class SensorReading(NamedTuple):
    """Measurements of one sensor at one instant, in sensor axes, as the device sent them."""

    t_ns: int
    rate: Vector
    """Angular rate, rad/s."""
    force: Vector
    """Specific force, m/s^2."""
    magnetic: Vector | None = None
    """Magnetic field, any unit."""


class RestBlock(NamedTuple):
    """Statistics of a block of readings."""

    rate: Array
    """Mean angular rate, rad/s, shape (3,)."""
    force: Array
    """Mean specific force, m/s^2, shape (3,)."""
    rate_sd: float
    """Largest standard deviation of an angular rate, rad/s."""
    force_sd: float
    """Largest standard deviation of a specific force, m/s^2."""
    constant: Array
    """Whether each component of the specific force was exactly constant, shape (3,)."""

    @property
    def is_calm(self) -> bool:
        """Whether the block contains no movement."""
        return self.rate_sd < RATE_SD and self.force_sd < FORCE_SD

    def agrees(self, other: RestBlock) -> bool:
        """Return whether the inclination is the same as in another block."""
        return float(np.linalg.norm(self.force - other.force)) < FORCE_STEP


class RestBlocks:
    """Divides readings into blocks, and collects the blocks of the current rest."""

    def __init__(self) -> None:
        self._readings: list[SensorReading] = []
        self.rest: list[RestBlock] = []
        """Blocks of the current rest; empty during a movement."""
        self.last: RestBlock | None = None
        """Most recent block, at rest or in motion."""

    def add(self, reading: SensorReading) -> bool:
        """Add a reading; return whether the reading completed a block."""
        readings = self._readings
        if readings and not 0 <= reading.t_ns - readings[-1].t_ns <= LONGEST_PAUSE_NS:
            readings.clear()
            self.rest.clear()
        readings.append(reading)
        if reading.t_ns - readings[0].t_ns < BLOCK_NS or len(readings) < _FEWEST:
            return False

        rates = np.array([each.rate for each in readings])
        forces = np.array([each.force for each in readings])
        block = RestBlock(
            rates.mean(axis=0),
            forces.mean(axis=0),
            float(rates.std(axis=0).max()),
            float(forces.std(axis=0).max()),
            np.ptp(forces, axis=0) == 0.0,
        )
        readings.clear()
        self.last = block
        if not block.is_calm or (self.rest and not block.agrees(self.rest[0])):
            self.rest.clear()
        if block.is_calm:
            self.rest.append(block)
        return True
