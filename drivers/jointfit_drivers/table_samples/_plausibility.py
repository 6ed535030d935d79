"""Checks of a table against the first data: scale, byte order, type and units.

A finding contains the remedy.

Invariant: the result depends only on the records fed. Every check reports at most once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.table_samples._fitting_settings import fitting_keys
from jointfit_drivers.table_samples._rate_unit import RateUnitCheck
from jointfit_drivers.table_samples._records import SampleForm, TableRecord, duration_ns

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from jointfit_daemon.model import Vector
    from jointfit_protocols.table import Quantity

_CHECKED = 100
"""Number of records after which scale and byte order are checked."""
_ROUND = 0.05
"""Largest deviation of the norm of a quaternion from 1."""
_LIGHT, _HEAVY = 6.0, 14.0
"""Plausible range of the norm of a specific force, m/s^2."""
_GOOD, _CALM = 0.75, 0.5
"""Smallest shares of quaternions and of specific forces whose norm is in range. With smaller
shares, the table is wrong."""
_TIMED = 200
"""Number of records after which the unit of device time is checked."""
_TIMED_NS = 2_000_000_000
"""Shortest time between arrivals over which the unit of device time is checked, ns."""
_FASTEST = 1.5
"""Largest factor between elapsed device time and elapsed host time, in either direction, with a
correct unit."""

_Sample = tuple[tuple[bytes, ...], tuple[float, ...], tuple[float, ...]]


class PlausibilityChecks:
    """Plausibility checks of one device.

    Parameters
    ----------
    form : SampleForm
        Meaning of the numbers.
    places : mapping
        Indices of the components of each quantity among the measured components.
    """

    def __init__(self, form: SampleForm, places: Mapping[Quantity, slice]) -> None:
        self._form, self._places = form, places
        self._samples: list[_Sample] | None = []
        self._first: tuple[int, int] | None = None  # ticks and arrival
        self._timed = 0
        self._time_done = form.tick_clock is None
        both = "rate" in places and "acceleration" in places
        self._rates = RateUnitCheck() if both else None

    @property
    def done(self) -> bool:
        """Whether all checks have ended."""
        return self._samples is None and self._time_done and self._rates is None

    def take(
        self, record: TableRecord, si: tuple[float, ...], ticks: int | None
    ) -> list[DeviceEvent]:
        """Return the findings after the next record, whose components in SI units are `si`."""
        out: list[DeviceEvent] = []
        if self._samples is not None:
            # Measured components are known, because codecs drop a sample that lacks one of them.
            values = cast("tuple[float, ...]", record.values)
            self._samples.append((record.data, values, si))
            if len(self._samples) >= _CHECKED:
                out += self._check_norms(self._samples)
                self._samples = None
        if not self._time_done and ticks is not None:
            out += self._check_time(ticks, record.arrival_ns)
        if self._rates is not None:
            out += self._check_rates(self._rates, record.arrival_ns, si, ticks)
        return out

    def forget(self) -> None:
        """Start the check of device time again, because the device restarted."""
        self._first, self._timed = None, 0

    def _check_norms(self, samples: Sequence[_Sample]) -> list[DeviceEvent]:
        """Return warnings about the quantities whose norm is wrong."""
        checks: dict[Quantity, tuple[Callable[[float], bool], float]] = {
            "quaternion": (lambda norm: abs(norm - 1) <= _ROUND, _GOOD),
            "acceleration": (lambda norm: _LIGHT <= norm <= _HEAVY, _CALM),
        }
        out = []
        for quantity, (fits, share) in checks.items():
            place = self._places.get(quantity)
            if place is None:
                continue
            norms = sorted(_norm(si[place]) for _, _, si in samples)
            if sum(map(fits, norms)) < share * len(norms):
                middle = norms[len(norms) // 2]
                counts = [(data, values[place]) for data, values, _ in samples]
                out.append(self._misfit(quantity, middle, counts))
        return out

    def _misfit(
        self,
        quantity: Quantity,
        norm: float,
        samples: Sequence[tuple[tuple[bytes, ...], tuple[float, ...]]],
    ) -> DeviceEvent:
        """Return the warning about a quantity whose norm is wrong."""
        expected = "1" if quantity == "quaternion" else "9.81 m/s2"
        text = f"median norm of the {quantity} is {norm:.4g}, expected {expected}"
        keys = fitting_keys(quantity, self._form.fields, samples)
        data: dict[str, Any] = {"quantity": quantity, "median_norm": norm}
        if keys is None:
            remedy = f"check offset, type, byte order and scale of `fields.{quantity}`"
        else:
            data["fitting"] = keys
            remedy = f"the data fit fields.{quantity} with {keys}"
        return DeviceEvent("warning", f"{text}: {remedy}", data)

    def _check_time(self, ticks: int, arrival_ns: int) -> list[DeviceEvent]:
        """Compare device time with the arrivals; the result is reported only once."""
        if self._first is None:
            self._first = (ticks, arrival_ns)
            return []
        self._timed += 1
        elapsed_ns = arrival_ns - self._first[1]
        clock = self._form.tick_clock
        if self._timed < _TIMED or elapsed_ns < _TIMED_NS or clock is None:
            return []

        self._time_done = True
        step = ticks - self._first[0]
        passed = step if clock.modulus is None else step % clock.modulus
        ratio = passed * duration_ns(clock) / elapsed_ns
        if 1 / _FASTEST <= ratio <= _FASTEST:
            return []
        text = f"device time advances {ratio:.4g} times as fast as the host's clock"
        return [DeviceEvent("warning", f"{text}: correct `fields.time.unit`", {"ratio": ratio})]

    def _check_rates(
        self, check: RateUnitCheck, arrival_ns: int, si: tuple[float, ...], ticks: int | None
    ) -> list[DeviceEvent]:
        """Compare the angular rates with the motion of gravity in sensor axes."""
        timed = ticks is not None and self._form.tick_clock is not None
        t_ns = round((ticks or 0) * duration_ns(self._form.tick_clock)) if timed else arrival_ns
        rate = cast("Vector", si[self._places["rate"]])
        check.take(t_ns, rate, cast("Vector", si[self._places["acceleration"]]))
        if not check.done:
            return []
        self._rates = None
        if check.slope is None:
            return []

        text = f"gravity rotates {check.slope:.3g} times as fast as the rates predict, expected 1"
        unit = check.fitting_unit(self._form.rate_unit)
        remedy = "check unit, scale and axes of `fields.rate`"
        if unit is not None:
            remedy = f'the data fit fields.rate with unit = "{unit}"'
        return [DeviceEvent("warning", f"{text}: {remedy}", {"slope": check.slope})]


def _norm(vector: Sequence[float]) -> float:
    square: float = sum(part * part for part in vector)
    return float("inf") if square != square else square**0.5  # noqa: PLR0124 - NaN
