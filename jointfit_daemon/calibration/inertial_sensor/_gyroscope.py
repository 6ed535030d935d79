r"""Bias of a gyroscope from readings at rest.

The readings are divided into blocks. With the block means m of n blocks,

.. math:: b = \bar m, \qquad \operatorname{cov}(b) = \frac{1}{n (n-1)} \sum (m-b)(m-b)^T

The block means contain the slow part of the noise, which the noise of single readings does not show
(method of batch means: Schmeiser 1982, Operations Research 30, 556-568).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.calibration.inertial_sensor._rest_blocks import (
    BLOCK_NS,
    RATE_SD,
    RestBlocks,
)
from jointfit_daemon.calibration.inertial_sensor._step_progress import StepProgress

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor._rest_blocks import SensorReading

REST_BLOCKS = 24
"""Number of blocks at rest, 6 s. With more blocks the drift of the bias exceeds the gain in
precision.
"""
LARGEST_BIAS = radians(15.0)
"""Largest plausible bias of an angular rate, rad/s."""


@dataclass(frozen=True, slots=True)
class GyroscopeEstimate:
    """Bias of a gyroscope."""

    bias: Array
    """Bias, rad/s, shape (3,)."""
    covariance: Array
    """Covariance of the bias, rad^2/s^2, shape (3, 3)."""
    degrees_of_freedom: int
    """Degrees of freedom of the covariance."""
    rest_s: float
    """Duration of the rest, s."""

    @property
    def bias_sd(self) -> Array:
        """Standard deviations of the bias, rad/s, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))


class GyroscopeStep:
    """Collects readings at rest, and estimates the bias."""

    def __init__(self) -> None:
        self._blocks = RestBlocks()
        self._interruptions = 0

    @property
    def is_complete(self) -> bool:
        """Whether the rest is long enough."""
        # the first block may contain the end of a movement
        return len(self._blocks.rest) > REST_BLOCKS

    @property
    def progress(self) -> StepProgress:
        """Fraction of the rest that has passed, and whether a movement interrupted it."""
        count = len(self._blocks.rest)
        note = "moved: the rest begins again" if self._interruptions and count < 2 else ""
        left_s = max(REST_BLOCKS + 1 - count, 0) * BLOCK_NS * 1e-9
        missing = (f"{left_s:.0f} s at rest",) if left_s else ()
        return StepProgress(min(count / (REST_BLOCKS + 1), 1.0), missing, note)

    def add(self, reading: SensorReading) -> None:
        """Add a reading."""
        before = len(self._blocks.rest)
        self._blocks.add(reading)
        self._interruptions += len(self._blocks.rest) < before

    def finish(self) -> GyroscopeEstimate:
        """Return the bias.

        Raises
        ------
        SensorCalibrationError
            The sensor was not at rest, or the rate at rest is too large for a bias.
        """
        last = self._blocks.last
        if last is None:
            raise SensorCalibrationError(
                "no readings arrived during the rest: check the sensor with `jointfit probe`"
            )
        if not self.is_complete:
            rest_s = (REST_BLOCKS + 1) * BLOCK_NS * 1e-9
            raise SensorCalibrationError(
                f"the sensor moved during the rest: expected {rest_s:.0f} s at rest, found "
                f"{len(self._blocks.rest) * BLOCK_NS * 1e-9:.1f} s at the end, where the angular "
                f"rate varied by {degrees(last.rate_sd):.2f} deg/s (limit {degrees(RATE_SD):g}). "
                "Lay the sensor on a table without vibration, let go, and repeat"
            )

        means = np.array([block.rate for block in self._blocks.rest[1:]])
        bias = means.mean(axis=0)
        if np.abs(bias).max() > LARGEST_BIAS:
            raise SensorCalibrationError(
                f"the angular rate at rest is {degrees(np.abs(bias).max()):.1f} deg/s, expected "
                f"less than {degrees(LARGEST_BIAS):.0f}: check the unit of the rate in rig.toml, "
                "or replace the sensor"
            )

        count = len(means)
        covariance = np.cov(means.T) / count
        return GyroscopeEstimate(bias, covariance, count - 1, count * BLOCK_NS * 1e-9)
