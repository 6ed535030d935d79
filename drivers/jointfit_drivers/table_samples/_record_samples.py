"""Conversion of records to samples in SI units, for a device that a table describes.

Invariant: the output depends only on the records. The module reads no clock and no port. A record
with an orientation becomes one sample, or is rejected with a reason. For raw measurements, the
orientation filter returns no sample while it settles.
"""

from __future__ import annotations

from operator import add, mul
from typing import TYPE_CHECKING, cast

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation import (
    RawReading,
    RawSamples,
    RawStamp,
    is_plausible,
)
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.table_samples._continuity import RecordContinuity
from jointfit_drivers.table_samples._plausibility import PlausibilityChecks
from jointfit_drivers.table_samples._records import SampleForm, TableRecord, duration_ns
from jointfit_protocols.orientation import OrientationGate, canonical
from jointfit_protocols.table import MEASURED, SLOTS, Quantity, slot_quantities

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_protocols.orientation import Quaternion

_COARSE = 1e-4
"""Smallest value of one count at which rounding changes the norm of a quaternion noticeably."""
_TOLERANCE, _COARSE_TOLERANCE = 0.01, 0.05
_RECHECK = 100
"""Number of rejected records after which the settings are checked again. After each check the
number is multiplied by ten."""


class RecordSamples(Refusals):
    """Converts the records of one device to samples.

    Parameters
    ----------
    form : SampleForm
        Meaning of the numbers in the records.
    """

    def __init__(self, form: SampleForm) -> None:
        super().__init__()
        self._form = form
        self.tick_clock = form.tick_clock
        present = {slot: at for at, slot in enumerate(form.slots)}
        self._time = present.get(SLOTS["time"].start)
        self._counter = present.get(SLOTS["counter"].start)
        self._valid = present.get(SLOTS["valid"].start)
        measured = [slot for slot in form.slots if slot < MEASURED]
        self._places: dict[Quantity, slice] = {
            name: slice(present[SLOTS[name].start], present[SLOTS[name].stop - 1] + 1)
            for name in slot_quantities(measured)
        }
        self._rate = self._places.get("rate")
        self._acceleration = self._places.get("acceleration")
        self._magnetic = self._places.get("magnetic")
        self._raw = self._new_filter()
        self._raw_ns, self._raw_at = 0, -1  # last reading: time without wraps, and ticks
        self._limits = [_limits(form, slot) for slot in measured]
        self._scales = form.scales
        self._zeros = form.zeros if any(form.zeros) else None

        clock = form.tick_clock
        coarse = "quaternion" in self._places and abs(form.scales[0]) >= _COARSE
        self._gate = OrientationGate(_COARSE_TOLERANCE if coarse else _TOLERANCE)
        self._continuity = RecordContinuity(
            form.rate_hz, duration_ns(clock), None if clock is None else clock.modulus, form.counts
        )
        self._held: TableRecord | None = None
        self._checks: PlausibilityChecks | None = PlausibilityChecks(form, self._places)
        self._recheck, self._is_reported = _RECHECK, False

    def take(self, record: TableRecord) -> list[Decoded]:
        """Return the samples and events of the next record."""
        values = record.values
        ticks, counter = self._ticks(values), self._count(values)
        out: list[Decoded] = []
        if self._checks is not None:
            findings = self._checks.take(record, self._si(values), ticks)
            out += findings
            self._is_reported = self._is_reported or bool(findings)
            self._checks = None if self._checks.done else self._checks
        if self._valid is not None and not self._is_valid(values[self._valid]):
            return [*out, self.refuse(record.size, "the device marks the sample as invalid")]

        if ticks is None and counter is None:
            return out + self._sample(record, ticks, counter)

        step = self._continuity.take(ticks, counter, record.arrival_ns)
        held = self._held
        if held is None and not step.held:  # the usual case
            if step.lost:
                out.append(_gap(step.lost))
            return out + self._sample(record, ticks, counter)

        if held is not None and not step.confirmed:
            out += self.flush()
        self._held = record if step.held else None
        if step.held:
            return out
        if held is not None and step.confirmed:
            out += self._confirm(held, restarted=step.restarted)
        lost = step.lost_since if step.confirmed else step.lost
        if lost:
            out.append(_gap(lost))
        return out + self._sample(record, ticks, counter)

    def _confirm(self, held: TableRecord, *, restarted: bool) -> list[Decoded]:
        """Return the sample of the held record, after the next record confirmed it."""
        ticks = self._ticks(held.values)
        out: list[Decoded] = []
        if restarted:
            self._gate.forget()
            self._raw = self._new_filter()
            self._raw_ns, self._raw_at = 0, -1
            if self._checks is not None:
                self._checks.forget()
            clock = ": its counter began again" if ticks is None else f" at device time {ticks}"
            out.append(DeviceEvent("restart", f"device restarted{clock}"))
        return out + self._sample(held, ticks, self._count(held.values))

    @override
    def flush(self) -> list[Decoded]:
        """Reject a record that waits for the next record."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self.refuse(held.size, "time and counter disagree with the other samples")]

    def _sample(self, record: TableRecord, ticks: int | None, counter: int | None) -> list[Decoded]:
        """Return the sample of an accepted record."""
        form = self._form
        si = self._si(record.values)
        status = None if self._valid is None else int(record.values[self._valid] or 0)
        if self._raw is not None:
            return self._orient(
                self._raw,
                record,
                si,
                RawStamp(record.arrival_ns, ticks, counter, status),
            )

        native = cast("Quaternion", si[:4])
        if form.world == "ENU" and not form.world_to_sensor:
            q = self._gate.admit(native)
        else:
            turned = canonical(native, form.world, world_to_sensor=form.world_to_sensor)
            q = self._gate.admit(turned)
        if q is None:
            if (
                self.refused >= self._recheck and not self._is_reported
            ):  # the first checks may have passed by chance
                self._recheck *= 10
                self._checks = PlausibilityChecks(form, self._places)
            return [self.refuse(record.size, "quaternion norm is not 1")]
        vectors = (
            _vector(si, self._rate),
            _vector(si, self._acceleration),
            _vector(si, self._magnetic),
        )
        return [ImuSample(record.arrival_ns, q, native, ticks, counter, status, *vectors)]

    def _orient(
        self, raw: RawSamples, record: TableRecord, si: tuple[float, ...], stamp: RawStamp
    ) -> list[Decoded]:
        """Return samples for which the gateway computes the orientation."""
        # Without device time, the filter uses the arrivals.
        clock = self.tick_clock
        if clock is None:
            now, passed_ns = record.arrival_ns, float(record.arrival_ns - self._raw_at)
        else:
            if stamp.ticks is None:  # the CAN frame with the device time was lost
                return [self.refuse(record.size, "raw measurements without device time")]
            now, modulus = stamp.ticks, clock.modulus
            step = now - self._raw_at
            passed_ns = (step if modulus is None else step % modulus) * duration_ns(clock)
        t_ns = self._raw_ns + round(passed_ns) if self._raw_at >= 0 else 0
        rate, force = _vector(si, self._rate), _vector(si, self._acceleration)
        magnetic = _vector(si, self._magnetic) if raw.magnetometer else None
        reading = RawReading(t_ns, cast("Vector", rate), cast("Vector", force), magnetic)
        if now == self._raw_at or not is_plausible(reading):
            reason = "raw measurements out of range, or with the time of the previous ones"
            return [self.refuse(record.size, reason)]
        self._raw_ns, self._raw_at = t_ns, now
        clipped = any(
            value in limits for value, limits in zip(record.values, self._limits, strict=False)
        )
        return raw.take(stamp, reading, clipped=clipped)

    def _new_filter(self) -> RawSamples | None:
        """Return a filter for raw measurements; None if the device sends orientations."""
        make_raw = self._form.make_raw
        return None if make_raw is None else make_raw()

    def _si(self, values: Sequence[float | None]) -> tuple[float, ...]:
        """Return the measured components of a record in SI units."""
        # Measured components are never None. `map` ends with the shorter sequence.
        si: Iterator[float] = map(mul, cast("Sequence[float]", values), self._scales)
        return tuple(si) if self._zeros is None else tuple(map(add, si, self._zeros))

    def _ticks(self, values: Sequence[float | None]) -> int | None:
        """Return the device time of a record in ticks; None if it is unknown."""
        raw = None if self._time is None else values[self._time]
        if raw is None or self.tick_clock is None:
            return None
        scale, modulus = self._form.ticks_per_count, self.tick_clock.modulus
        try:
            ticks = int(raw) if scale is None else round(raw * scale)
        except (ValueError, OverflowError):  # not finite
            return None
        return ticks if modulus is None else ticks % modulus

    def _count(self, values: Sequence[float | None]) -> int | None:
        raw = None if self._counter is None else values[self._counter]
        try:
            return None if raw is None else int(raw)
        except (ValueError, OverflowError):
            return None

    def _is_valid(self, raw: float | None) -> bool:
        """Return whether the device marked the sample as valid; a missing mark counts as 1."""
        try:
            bits = 1 if raw is None else int(raw) & self._form.mask
        except (ValueError, OverflowError):
            return False
        return bits != 0 if self._form.equals is None else bits == self._form.equals


def _vector(si: tuple[float, ...], place: slice | None) -> Vector | None:
    return None if place is None else cast("Vector", si[place])


def _limits(form: SampleForm, slot: int) -> tuple[float, ...]:
    """Return the counts of a saturated rate or acceleration; empty if they are unknown."""
    place = (form.fields or {}).get(slot)
    if place is None or place.kind != "i" or slot >= SLOTS["magnetic"].start:
        return ()
    half = place.modulus // 2
    return (-half, 1 - half, half - 1)


def _gap(lost: int) -> DeviceEvent:
    return DeviceEvent("gap", f"{lost} samples lost", {"lost": lost})
