"""Conversion of the quaternions that LPMS devices send to canonical orientations.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

Invariant: the output depends only on the quaternions fed.
"""

from __future__ import annotations

from math import isfinite, sqrt
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.model import DeviceEvent
from jointfit_protocols.lpms import COARSE, QuaternionScale
from jointfit_protocols.orientation import OrientationGate, canonical

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Decoded
    from jointfit_drivers.lpms._convention_settings import LpmsConventionSettings
    from jointfit_protocols.orientation import Quaternion, World

_CHECKED = 100
"""Number of quaternions whose norms are checked and reported once."""
_COARSE_TOLERANCE = 0.05
"""Largest deviation of the norm from 1 for quaternions whose components are integer thousandths."""


class LpmsConvention(NamedTuple):
    """Meaning of the quaternions that one sensor sends."""

    world: World = "NWU"
    world_to_sensor: bool = True
    unit: int | None = None
    """Number of counts for 1.0 in 16-bit data; None if it is determined from the norm."""

    @classmethod
    def of(cls, settings: LpmsConventionSettings) -> LpmsConvention:
        """Return the convention that the settings of a sensor define."""
        unit = None if settings.scale == "auto" else settings.scale
        return cls(settings.world, settings.direction == "world_to_sensor", unit)


class LpmsOrientation:
    """Converts the quaternions of one sensor and reports their unit and norm.

    Parameters
    ----------
    convention : LpmsConvention
        Meaning of the quaternions.
    remedy : str
        Settings to change if hardly any quaternion has norm 1, for the error message.
    """

    def __init__(self, convention: LpmsConvention, remedy: str) -> None:
        self._world, self._inverse, unit = convention
        self._scale = QuaternionScale(unit)
        self._unit: int | None = None
        self._gate = OrientationGate()
        self.remedy = remedy
        """Settings to change if hardly any quaternion has the norm 1."""
        self._norms: list[float] = []
        self.events: list[Decoded] = []
        """Events that were not returned yet."""

    def convert(
        self, values: Sequence[float], *, floats: bool
    ) -> tuple[Quaternion, Quaternion] | None:
        """Return the scaled and the canonical quaternion; None if the norm is not 1.

        `floats` states whether `values` are floats; otherwise they are 16-bit integers.
        """
        a, b, c, d = values
        if not floats:
            unit = self._scale.feed(values)
            if unit != self._unit:
                before, self._unit = self._unit, unit
                self._gate = OrientationGate(_COARSE_TOLERANCE if unit == COARSE else 0.01)
                if unit is not None:
                    text = f"16-bit quaternions in units of 1/{unit}"
                    text += "" if before is None else f", no longer 1/{before}"
                    self.events.append(DeviceEvent("info", text, {"scale": unit}))
            scale = 1.0 / unit if unit is not None else 1.0
            a, b, c, d = a * scale, b * scale, c * scale, d * scale

        native = (a, b, c, d)
        q = self._gate.admit(canonical(native, self._world, world_to_sensor=self._inverse))
        if len(self._norms) < _CHECKED:
            self._check_norm(a * a + b * b + c * c + d * d)
        return None if q is None else (native, q)

    def forget(self) -> None:
        """Forget the sign of the last quaternion, because the device restarted."""
        self._gate.forget()

    def _check_norm(self, square: float) -> None:
        """Report the norms of the first quaternions once."""
        self._norms.append(sqrt(square) if isfinite(square) else float("nan"))
        if len(self._norms) < _CHECKED:
            return

        norm = self._gate.misconfigured_norm
        if norm is not None:
            text = f"median quaternion norm is {norm:.4g}, expected 1: {self.remedy}"
            data = {"median_norm": norm} if isfinite(norm) else {}
            self.events.append(DeviceEvent("warning", text, data))
            return
        known = [norm for norm in self._norms if isfinite(norm)]
        low, middle, high = min(known), median(known), max(known)
        text = f"norm of the first {_CHECKED} quaternions: {low:.5f} to {high:.5f}"
        self.events.append(DeviceEvent("info", text, {"median_norm": round(middle, 6)}))
