"""From the quaternion a device sends to the canonical one, and the gate on the way.

Law: plain arithmetic on four floats; no device is named here. Canonical is Hamilton, scalar first,
unit, sensor to world, world ENU with z up. The axes of the sensor stay as printed on its housing:
only the world turns.

| native world | v_ENU from native (1, 2, 3) | q_enu_native  |
|--------------|-----------------------------|---------------|
| ENU          | (1, 2, 3)                   | (1, 0, 0, 0)  |
| NED          | (2, 1, -3)                  | (0, s, s, 0)  |
| NWU          | (-2, 1, 3)                  | (s, 0, 0, s)  |     s = sqrt(1/2)
"""

from __future__ import annotations

from math import isfinite, sqrt
from statistics import median
from typing import Literal

Quaternion = tuple[float, float, float, float]
World = Literal["ENU", "NED", "NWU"]

_S = sqrt(0.5)
_JUDGED = 100  # samples after which the share of refused ones means something
_REFUSED = 90  # of them: no noise does that, only a wrong byte order or scale


def canonical(
    native: Quaternion, world: World = "ENU", *, world_to_sensor: bool = False
) -> Quaternion:
    """Turn `native` (w, x, y, z, any norm) into sensor to ENU, same norm.

    Parameters
    ----------
    native
        As sent, scalar first.
    world
        World it refers to.
    world_to_sensor
        True where the device sends the inverse.
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
    """Return what a device with `world` sends for a canonical orientation: for simulators."""
    w, x, y, z = q_world_sensor
    if world == "ENU":
        return (w, x, y, z)
    if world == "NED":
        return (_S * (x + y), _S * (-w - z), _S * (z - w), _S * (x - y))
    return (_S * (w + z), _S * (x + y), _S * (y - x), _S * (z - w))


class OrientationGate:
    """Finite, norm near 1, then unit and with the sign nearest the previous one.

    Parameters
    ----------
    tolerance
        Largest deviation of the norm from 1 before normalising. 0.01 suits floats and fine
        integers, 0.05 integers in thousandths. A constant small error is normal.
    """

    def __init__(self, tolerance: float = 0.01) -> None:
        self._low = (1.0 - tolerance) ** 2
        self._high = (1.0 + tolerance) ** 2
        self._last: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._judged = self._refused = 0
        self._norms: list[float] = []

    def admit(self, q: Quaternion) -> Quaternion | None:
        """Return `q` as a unit quaternion, its sign nearest the last one; None if refused."""
        w, x, y, z = q
        square = w * w + x * x + y * y + z * z
        refused = not self._low <= square <= self._high  # NaN compares false: refused
        if self._judged < _JUDGED:
            self._judge(square, refused=refused)
        if refused:
            return None
        a, b, c, d = self._last
        scale = 1.0 / sqrt(square)
        if a * w + b * x + c * y + d * z < 0.0:
            scale = -scale
        self._last = (scale * w, scale * x, scale * y, scale * z)
        return self._last

    def _judge(self, square: float, *, refused: bool) -> None:
        self._judged += 1
        self._refused += refused
        if isfinite(square):
            self._norms.append(sqrt(square))

    @property
    def judged(self) -> bool:
        """Whether ``misconfigured_norm`` has become what it will stay."""
        return self._judged >= _JUDGED

    @property
    def misconfigured_norm(self) -> float | None:
        """Median norm, once more than 90 of the first 100 samples failed; else None.

        Byte order or scale are wrong then. NaN where no norm was finite.
        """
        if self._judged < _JUDGED or self._refused <= _REFUSED:
            return None
        return median(self._norms) if self._norms else float("nan")

    def forget(self) -> None:
        """Start sign continuity anew: the device restarted."""
        self._last = (1.0, 0.0, 0.0, 0.0)
