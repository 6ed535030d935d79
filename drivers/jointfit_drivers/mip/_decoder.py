"""Decoder of MIP devices: converts chunks to samples in SI units.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

MIP is the packet protocol of MicroStrain. The time of a sample comes from a field of the same
packet. An orientation without time is stamped with its arrival, but it is rejected if earlier
orientations had a time. Two data sets contain orientations, with different delays. Only the
configured data set is decoded.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, TickClock
from jointfit_drivers.mip._device_replies import reply_events
from jointfit_drivers.mip._required_fields import GPS_TIMES, QUATERNIONS
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_drivers.timed_samples import RawVectors, TimedReading, TimedSamples
from jointfit_protocols.mip import MAX_PACKET, MipCodec, MipPacket
from jointfit_protocols.mip.data import (
    STANDARD_GRAVITY,
    DataSet,
    SensorField,
    SharedField,
    decode_field,
    gps_ns,
    known_fields,
)
from jointfit_protocols.orientation import canonical

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples
    from jointfit_drivers.mip._required_fields import RequiredFields

_CLOCK = TickClock(1, None)
_TIME = int(SharedField.REFERENCE_TIME)
_TIME_OF_WEEK = int(SharedField.GPS_TIME)
_RATE, _FORCE = int(SensorField.ANGULAR_RATE), int(SensorField.ACCELERATION)
_FIELD = int(SensorField.MAGNETIC_FIELD)
_DATA = 0x80
"""Lowest descriptor set with data. Lower descriptor sets contain commands."""
_FOREIGN = 20
"""Number of consecutive orientations in a data set that is not configured, after which a warning is
returned."""
_REPORT_NS = 10_000_000_000
"""Shortest time between two reports of invalid orientations, ns."""
_NEWEST = NewestKnown((1,), "SensorConnect")
"""Newest firmware that the vendor's software development kit describes."""


class MipDecoder(SerialMessageDecoder[MipPacket]):
    """Decoder of one MIP device.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    required : RequiredFields
        Data set and fields that the device must send.
    make_raw : callable, optional
        Function that returns a new filter of raw measurements; None if the device sends
        orientations.
    """

    tick_clock = _CLOCK

    def __init__(
        self,
        baud: int | None,
        required: RequiredFields,
        make_raw: Callable[[], RawSamples] | None = None,
    ) -> None:
        self._set, self._is_raw = int(required.data_set), make_raw is not None
        self._quaternion = int(QUATERNIONS[required.data_set])
        self._gps_time = int(GPS_TIMES[required.data_set])
        raw_fields = {_RATE, _FORCE, _FIELD} if self._is_raw else {self._quaternion}
        self._wanted = {_TIME, _TIME_OF_WEEK, self._gps_time, *raw_fields}
        self._needed = frozenset({_RATE, _FORCE} if self._is_raw else {self._quaternion})
        self._other = {int(one): int(field) for one, field in QUATERNIONS.items()}
        del self._other[self._set]

        self._samples = TimedSamples(make_raw, "give the time field the orientation's decimation")
        super().__init__(MipCodec(), self._samples, baud, MAX_PACKET)
        self._known = known_fields(self._set) or frozenset()
        self._newer = NewerFirmwareDetector(_NEWEST)
        self._foreign = 0
        self._invalid_since_ns: int | None = None
        self._invalid_reported_ns = -_REPORT_NS

    @override
    def _take(self, message: MipPacket) -> list[Decoded]:
        if message.descriptor_set == self._set:
            return self._decode_data(message)
        if message.descriptor_set < _DATA:
            return self._take_reply(message)
        return self._note_other_set(message)

    def _decode_data(self, packet: MipPacket) -> list[Decoded]:
        """Return the samples and events of a packet of the configured data set."""
        values: dict[int, tuple[Any, ...]] = {}
        unknown: list[Decoded] = []
        for descriptor, data in packet.fields:
            if descriptor in self._wanted:
                value = decode_field(self._set, descriptor, data)
                if value is None:
                    name = f"field 0x{descriptor:02X}"
                    unknown += self._take_unknown(f"{name} of {len(data)} bytes", packet)
                    return [*unknown, self._samples.refuse(packet.size, f"{name} malformed")]
                values[descriptor] = value
            elif descriptor not in self._known:
                unknown += self._take_unknown(f"field 0x{descriptor:02X}", packet)
        if unknown:
            return unknown + self._decode_values(packet, values)
        return self._decode_values(packet, values)

    def _take_unknown(self, content: str, packet: MipPacket) -> list[Decoded]:
        name = f"{content} of data set 0x{packet.descriptor_set:02X}"
        return self._newer.take_unknown(name, self._stamps.chunk_ns)

    def _take_reply(self, packet: MipPacket) -> list[Decoded]:
        """Return the events of a reply, and a warning if the firmware is newer than supported."""
        out: list[Decoded] = []
        for event in reply_events(packet):
            out.append(event)
            if isinstance(event, DeviceEvent) and "firmware" in event.data:
                out += self._newer.take_version(str(event.data["firmware"]))
        return out

    def _decode_values(
        self, packet: MipPacket, values: dict[int, tuple[Any, ...]]
    ) -> list[Decoded]:
        """Return the samples that the decoded fields of one packet contain."""
        if not self._needed <= values.keys():  # with different decimations, a packet lacks fields
            return []

        self._foreign = 0
        arrival_ns = self._arrival_of(packet)
        ticks: int | None = None
        if _TIME in values:
            ticks = int(values[_TIME][0])
        elif week_time := values.get(_TIME_OF_WEEK) or values.get(self._gps_time):
            time_of_week_s, week, _ = week_time
            ticks = gps_ns(week, time_of_week_s)
        if self._is_raw:
            x, y, z = values[_FORCE]
            force = (STANDARD_GRAVITY * x, STANDARD_GRAVITY * y, STANDARD_GRAVITY * z)
            field = cast("Vector | None", values.get(_FIELD))
            raw = RawVectors(cast("Vector", values[_RATE]), force, field)
            return self._samples.add(TimedReading(packet.size, arrival_ns, ticks, raw=raw))

        w, x, y, z, *flags = values[self._quaternion]
        native = (w, x, y, z)
        status = flags[0] if flags else None
        out: list[Decoded] = []
        if status is not None:
            out = self._note_validity(arrival_ns, is_valid=bool(status & 1))
            if not status & 1:  # use only the time
                return out + self._samples.add(TimedReading(packet.size, arrival_ns, ticks))
        q = canonical(native, "NED")
        reading = TimedReading(packet.size, arrival_ns, ticks, q, native, status)
        return out + self._samples.add(reading) if out else self._samples.add(reading)

    def _note_validity(self, arrival_ns: int, *, is_valid: bool) -> list[Decoded]:
        """Return an event while orientations are invalid, and when they are valid again."""
        since_ns = self._invalid_since_ns
        if is_valid:
            self._invalid_since_ns = None
            if since_ns is None or self._invalid_reported_ns < since_ns:
                return []
            lasted_s = (arrival_ns - since_ns) * 1e-9
            return [DeviceEvent("info", f"orientation valid again after {lasted_s:.1f} s")]

        if since_ns is None:
            self._invalid_since_ns = arrival_ns
        if arrival_ns - self._invalid_reported_ns < _REPORT_NS:
            return []
        self._invalid_reported_ns = arrival_ns
        text = (
            "the device marks its orientation as invalid, so it is not used: leave the sensor at "
            "rest until its filter is initialized, or select another estimator"
        )
        return [DeviceEvent("warning", text)]

    def _note_other_set(self, packet: MipPacket) -> list[Decoded]:
        """Return a warning about an unknown data set, or about orientations in a set not in use."""
        if known_fields(packet.descriptor_set) is None:
            return self._take_unknown("packets", packet)
        field = self._other.get(packet.descriptor_set)
        if all(descriptor != field for descriptor, _ in packet.fields):
            return []
        self._foreign += 1
        if self._foreign != _FOREIGN:
            return []
        name = "sensor" if packet.descriptor_set == DataSet.SENSOR else "filter"
        text = (
            f"orientations arrive in data set 0x{packet.descriptor_set:02X}, but not in "
            f'0x{self._set:02X}: set estimator = "{name}"'
        )
        return [DeviceEvent("warning", text, {"estimator": name})]
