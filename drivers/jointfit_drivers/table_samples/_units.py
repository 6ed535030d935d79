"""Units that a table permits for its quantities."""

from __future__ import annotations

from math import pi

from jointfit_daemon.units import STANDARD_GRAVITY

UNITS: dict[str, dict[str, float]] = {
    "rate": {"rad/s": 1.0, "deg/s": pi / 180, "mdeg/s": pi / 180_000, "mrad/s": 1e-3},
    "acceleration": {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000},
    "time": {"s": 1.0, "ms": 1e-3, "100us": 1e-4, "us": 1e-6, "ns": 1e-9},
}
"""SI value of each unit, by quantity. The first unit is the default. Quaternions and magnetic
fields have no unit, and time has no default."""
