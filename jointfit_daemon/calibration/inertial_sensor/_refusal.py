"""Error of a sensor calibration whose result would be worse than no calibration."""

from __future__ import annotations


class SensorCalibrationError(Exception):
    """The readings do not determine the parameters; the text contains cause and remedy."""
