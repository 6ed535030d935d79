"""Errors of the gyroscope, accelerometer and magnetometer of a simulated sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import mul
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from random import Random

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class VectorErrors:
    """Errors of one vector: measured = `matrix` · true + `bias` + noise, limited to the range."""

    bias: Vector = (0.0, 0.0, 0.0)
    """Bias in the unit of the vector."""
    matrix: Matrix = IDENTITY
    """Scale factors, non-orthogonality and soft iron."""
    noise_sd: float = 0.0
    """Standard deviation of white noise, in the unit of the vector."""
    limit: float = float("inf")
    """Largest magnitude in the measuring range. A larger component is reduced to this magnitude."""

    def measure(self, true: Vector, random: Random) -> Vector:
        """Return the measurement of a vector in sensor axes."""
        x, y, z = (
            sum(map(mul, row, true)) + bias + self._noise(random)
            for row, bias in zip(self.matrix, self.bias, strict=True)
        )
        return (self._limit(x), self._limit(y), self._limit(z))

    def _noise(self, random: Random) -> float:
        return random.gauss(0.0, self.noise_sd) if self.noise_sd else 0.0

    def _limit(self, value: float) -> float:
        return min(max(value, -self.limit), self.limit)


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors of all three vectors of a sensor; the default is no errors."""

    gyroscope: VectorErrors = field(default_factory=VectorErrors)
    """Errors of the angular rate, rad/s."""
    accelerometer: VectorErrors = field(default_factory=VectorErrors)
    """Errors of the specific force, m/s^2."""
    magnetometer: VectorErrors = field(default_factory=VectorErrors)
    """Errors of the magnetic field, relative to the earth's field."""
    seed: int = 0
    """Random seed of the noise."""
