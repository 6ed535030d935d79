"""Conversion of a device's quaternion to the canonical orientation, and a check of its norm.

A canonical orientation is a Hamilton unit quaternion, scalar first, from sensor to an ENU world
with z up. The conversion changes only the world. The sensor axes remain as printed on the housing.

| native world | v_ENU from native (1, 2, 3) | q_enu_native  |
|--------------|-----------------------------|---------------|
| ENU          | (1, 2, 3)                   | (1, 0, 0, 0)  |
| NED          | (2, 1, -3)                  | (0, s, s, 0)  |
| NWU          | (-2, 1, 3)                  | (s, 0, 0, s)  |     s = sqrt(1/2)
"""

from __future__ import annotations

from math import cos, isfinite, sin, sqrt
from statistics import median
from typing import Literal

Quaternion = tuple[float, float, float, float]
World = Literal["ENU", "NED", "NWU"]

_S = sqrt(0.5)
_CHECKED = 100
"""Number of samples after which the share of rejected samples is checked."""
_MOST_REJECTED = 90
"""Largest number of rejected samples out of `_CHECKED` that is possible with a correct byte order
and scale."""


def canonical(
    native: Quaternion, world: World = "ENU", *, world_to_sensor: bool = False
) -> Quaternion:
    """Return `native` as an orientation from sensor to ENU, with the same norm.

    Parameters
    ----------
    native : Quaternion
        Quaternion as sent, scalar first.
    world : World
        World to which the quaternion of the device refers.
    world_to_sensor : bool
        Whether the device sends the inverse rotation.
    """
    w, x, y, z = native
    if world_to_sensor:
        x, y, z = -x, -y, -z
    if world == "ENU":
        return (w, x, y, z)
    if world == "NED":
        return (_S * (-x - y), _S * (w + z), _S * (w - z), _S * (y - x))
    return (_S * (w - z), _S * (x - y), _S * (x + y), _S * (w + z))


def native_of(q_world_sensor: Quaternion, world: World = "ENU") -> Quaternion:
    """Return the quaternion that a device with this world sends for a canonical orientation."""
    w, x, y, z = q_world_sensor
    if world == "ENU":
        return (w, x, y, z)
    if world == "NED":
        return (_S * (x + y), _S * (-w - z), _S * (z - w), _S * (x - y))
    return (_S * (w + z), _S * (x + y), _S * (y - x), _S * (z - w))


def angles_quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of R = Rz(yaw) Ry(pitch) Rx(roll), rad."""
    cr, sr = cos(0.5 * roll), sin(0.5 * roll)
    cp, sp = cos(0.5 * pitch), sin(0.5 * pitch)
    cy, sy = cos(0.5 * yaw), sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


class OrientationGate:
    """Rejects quaternions that are not finite or whose norm is not 1, and normalises the others.

    Parameters
    ----------
    tolerance : float
        Largest deviation of the norm from 1. Use 0.01 for floats and fine integers, and 0.05 for
        integers in thousandths. A small constant deviation of the norm is normal.
    """

    def __init__(self, tolerance: float = 0.01) -> None:
        self._low = (1.0 - tolerance) ** 2
        self._high = (1.0 + tolerance) ** 2
        self._last: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._checked = self._rejected = 0
        self._norms: list[float] = []

    def admit(self, q: Quaternion) -> Quaternion | None:
        """Return `q` as a unit quaternion, with the sign that is nearer to the last result.

        The result is None if `q` is rejected.
        """
        w, x, y, z = q
        square = w * w + x * x + y * y + z * z
        refused = not self._low <= square <= self._high  # NaN compares false: refused

        if self._checked < _CHECKED:
            self._checked += 1
            self._rejected += refused
            if isfinite(square):
                self._norms.append(sqrt(square))
        if refused:
            return None

        a, b, c, d = self._last
        scale = 1.0 / sqrt(square)
        if a * w + b * x + c * y + d * z < 0.0:
            scale = -scale
        self._last = (scale * w, scale * x, scale * y, scale * z)
        return self._last

    @property
    def is_decided(self) -> bool:
        """Whether enough samples were checked, so that `misconfigured_norm` is final."""
        return self._checked >= _CHECKED

    @property
    def misconfigured_norm(self) -> float | None:
        """Median norm if more than 90 of the first 100 samples were rejected; None otherwise.

        If more than 90 were rejected, byte order or scale is wrong. The value is NaN if no norm was
        finite.
        """
        if self._checked < _CHECKED or self._rejected <= _MOST_REJECTED:
            return None
        return median(self._norms) if self._norms else float("nan")

    def forget(self) -> None:
        """Forget the sign of the last result, because the device restarted."""
        self._last = (1.0, 0.0, 0.0, 0.0)
