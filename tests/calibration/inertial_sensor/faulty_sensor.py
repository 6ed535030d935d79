"""A simulated sensor with known errors: readings at rest, in static poses, in free rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.inertial_sensor import DIRECTIONS, SensorReading
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.arrays import Array

RATE_HZ = 50
STEP_NS = 1_000_000_000 // RATE_HZ
GRAVITY = 9.80665
MOVE_S = 0.5
"""Duration of a turn between two poses, s."""
FIELD = 48.0
"""Magnitude of the magnetic field, uT."""


@dataclass(frozen=True)
class FaultySensor:
    """A sensor that measures matrix · truth + bias + noise.

    The matrices of accelerometer and magnetometer are symmetric.
    """

    gyroscope_bias: Array
    accelerometer_bias: Array
    accelerometer_matrix: Array
    magnetometer_bias: Array
    magnetometer_matrix: Array
    gyroscope_matrix: Array
    noise: tuple[float, float, float] = (0.003, 0.02, 0.3)
    """Standard deviations of rate, rad/s, force, m/s^2, and field, uT."""

    @classmethod
    def draw(cls, seed: int) -> FaultySensor:
        """Return a sensor with errors of the size of low-cost parts."""
        rng = np.random.default_rng(seed)
        return cls(
            rng.normal(0.0, 0.01, 3),
            rng.normal(0.0, 0.3, 3),
            symmetric(rng, 0.02, 0.004),
            rng.normal(0.0, 25.0, 3),
            symmetric(rng, 0.08, 0.03),
            symmetric(rng, 0.02, 0.0) + rng.normal(0.0, 0.005, (3, 3)),
        )

    def readings(
        self, up: Array, north: Array, rates: Array, seed: int | np.random.Generator = 0
    ) -> list[SensorReading]:
        """Return readings at `RATE_HZ` for the true vertical, field direction and angular rates.

        `up` and `north` are unit vectors along the vertical and the field, in sensor axes. `rates`
        are in rad/s.
        """
        rng = np.random.default_rng(seed)
        gyr, acc, mag = (rng.normal(0.0, sd, rates.shape) for sd in self.noise)
        rate = rates @ self.gyroscope_matrix.T + self.gyroscope_bias + gyr
        force = GRAVITY * up @ self.accelerometer_matrix + self.accelerometer_bias + acc
        field = FIELD * north @ self.magnetometer_matrix + self.magnetometer_bias + mag
        rows = np.concatenate((rate, force, field), axis=1).tolist()
        return [
            SensorReading(k * STEP_NS, tuple(row[:3]), tuple(row[3:6]), tuple(row[6:]))
            for k, row in enumerate(rows)
        ]

    def at_rest(self, seconds: float, seed: int = 0) -> list[SensorReading]:
        """Return readings of a sensor that lies still."""
        count = round(seconds * RATE_HZ)
        up, north = np.tile((0.0, 0.0, 1.0), (count, 1)), np.tile((0.0, 0.4, -0.917), (count, 1))
        return self.readings(up, north, np.zeros((count, 3)), seed)

    def posed(self, directions: Array, seed: int = 0, rest_s: float = 2.0) -> list[SensorReading]:
        """Return readings of static poses and turns.

        In each pose one of `directions` points up. A turn precedes every pose.
        """
        rng = np.random.default_rng(seed)
        q, rates = posed_rotation(directions, rng, rest_s)
        up = rotation.rotate(rotation.conjugate(q), np.tile((0.0, 0.0, 1.0), (len(q), 1)))
        return self.readings(up, up, rates, rng)

    def turned(self, directions: Array, seed: int = 0, count: int = 400) -> list[SensorReading]:
        """Return `count` readings in which the field is close to randomly drawn `directions`."""
        rng = np.random.default_rng(seed)
        chosen = directions[rng.integers(0, len(directions), count)]
        north = unit(chosen + rng.normal(0.0, 0.25, (count, 3)))
        return self.readings(north, north, rng.normal(0.0, 1.0, (count, 3)), rng)


def posed_rotation(
    directions: Array, rng: np.random.Generator, rest_s: float, rate_hz: int = RATE_HZ
) -> tuple[Array, Array]:
    """Return orientations, shape (n, 4), and angular rates, rad/s, of static poses and turns.

    In each pose one of `directions` points up. A turn precedes every pose.
    """
    moving, still = round(MOVE_S * rate_hz), round(rest_s * rate_hz)
    # the speed is proportional to 1 - cos(phase), so a turn begins and ends at rest
    phase = 2.0 * np.pi * np.arange(moving) / moving
    share, speed = (phase - np.sin(phase)) / (2.0 * np.pi), (1.0 - np.cos(phase)) / MOVE_S
    q, rates, pose = [], [], rotation.exp(rng.normal(size=3))
    for direction in directions:
        up = unit(direction + rng.normal(0.0, 0.05, 3))
        axis = np.cross(up, (0.0, 0.0, 1.0))
        sine = float(np.linalg.norm(axis))
        tilt = axis * np.arctan2(sine, up[2]) / max(sine, 1e-9)
        target = rotation.multiply(rotation.heading(rng.uniform(-np.pi, np.pi)), rotation.exp(tilt))
        turn = rotation.log(rotation.multiply(rotation.conjugate(pose), target))
        q += [rotation.multiply(pose, rotation.exp(np.outer(share, turn)))]
        q += [np.tile(target, (still, 1))]
        rates += [np.outer(speed, turn), np.zeros((still, 3))]
        pose = target
    return np.concatenate(q), np.concatenate(rates)


def unit(vectors: Array) -> Array:
    """Return the vectors, scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def symmetric(rng: np.random.Generator, scale_sd: float, skew_sd: float) -> Array:
    """Return a random symmetric matrix near the identity."""
    skew = np.triu(rng.normal(0.0, skew_sd, (3, 3)), 1)
    return np.diag(1.0 + rng.normal(0.0, scale_sd, 3)) + skew + skew.T


def poses() -> Array:
    """Return the directions that the guide requests: six faces and six edges."""
    return DIRECTIONS[[0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 14, 15]]


def draws(count: int) -> Iterator[tuple[int, FaultySensor]]:
    """Yield `count` sensors with different errors, each with its seed."""
    for seed in range(count):
        yield seed, FaultySensor.draw(seed)
