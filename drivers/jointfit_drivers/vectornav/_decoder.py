"""Decoder of VectorNav devices: converts chunks to samples in SI units.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, TickClock
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_drivers.timed_samples import RawVectors, TimedReading, TimedSamples
from jointfit_drivers.vectornav._rate_check import RateCheck
from jointfit_protocols.orientation import canonical
from jointfit_protocols.vectornav import (
    MAX_MESSAGE,
    UNKNOWN_HEADER,
    BinaryPacket,
    Field,
    TextMessage,
    VectorNavCodec,
    VectorNavMessage,
    error_text,
)
from jointfit_protocols.vectornav.registers import Register, decode_output, decode_rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples
    from jointfit_protocols.corrupt import CorruptBytes

_CLOCK = TickClock(1, None)
_TIMES = (int(Field.TIME_STARTUP), int(Field.TIME_GROUP_STARTUP))
_QUATERNIONS = (int(Field.QUATERNION), int(Field.ATTITUDE_QUATERNION))
_RATES = (int(Field.ANGULAR_RATE), int(Field.IMU_ANGULAR_RATE))
_FORCES = (int(Field.ACCELERATION), int(Field.IMU_ACCELERATION))
_FIELDS = (int(Field.IMU_MAGNETIC_FIELD), int(Field.MAGNETIC_AND_PRESSURE))
_NAMES = {Register.MODEL: "model", Register.SERIAL: "serial", Register.FIRMWARE: "firmware"}
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_SMALL = 1e-4
"""Largest difference between an element of a rotation matrix and of the identity that counts as no
rotation."""
_NEWEST = NewestKnown((3,), "VectorNav Control Center")
"""Newest supported firmware: the version of the VN-100 in 2024. Other models have lower
versions."""


class _Places:
    """Positions of the decoded fields in one type of output; None for missing fields."""

    __slots__ = ("field", "force", "quaternion", "rate", "time")

    def __init__(self, places: dict[int, slice]) -> None:
        def first(fields: tuple[int, ...]) -> slice | None:
            return next((places[field] for field in fields if field in places), None)

        self.time, self.quaternion = first(_TIMES), first(_QUATERNIONS)
        self.rate, self.force = first(_RATES), first(_FORCES)
        field = first(_FIELDS)
        self.field = None if field is None else slice(field.start, field.start + 3)


class VectorNavDecoder(SerialMessageDecoder[VectorNavMessage]):
    """Decoder of one VectorNav device.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    world_to_sensor : bool
        Whether the quaternion converts world to sensor coordinates.
    make_raw : callable, optional
        Function that returns a new filter of raw measurements; None if the device sends
        orientations.
    rate_hz : float, optional
        Configured rate, Hz; None to skip the check of the rate.
    output : int
        Number of the binary output that the driver configures.
    """

    tick_clock = _CLOCK

    def __init__(
        self,
        baud: int | None,
        *,
        world_to_sensor: bool = False,
        make_raw: Callable[[], RawSamples] | None = None,
        rate_hz: float | None = None,
        output: int = 1,
    ) -> None:
        self._inverse, self._is_raw = world_to_sensor, make_raw is not None
        self._samples = TimedSamples(make_raw, "add the field TimeStartup to this binary output")
        super().__init__(VectorNavCodec(), self._samples, baud, MAX_MESSAGE)
        self._rate_check = None if rate_hz is None else RateCheck(rate_hz)
        self._register = Register.BINARY_OUTPUT + output - 1
        self._newer = NewerFirmwareDetector(_NEWEST)
        self._places: dict[bytes, _Places] = {}  # by header; a device has three outputs

    @override
    def _take(self, message: VectorNavMessage) -> list[Decoded]:
        if isinstance(message, BinaryPacket):
            return self._decode_output(message)

        # The check of the rate starts when the device confirms its output.
        if self._rate_check is not None and message.register == self._register:
            output = decode_output(message.values[1:])
            if output is not None and output.divisor:
                self._rate_check.start(output.divisor)
        out = list(_text_events(message))
        if message.register == Register.FIRMWARE and len(message.values) > 1:
            out += self._newer.take_version(message.values[1])
        return out

    @override
    def _take_corrupt(self, found: CorruptBytes) -> list[Decoded]:
        out = super()._take_corrupt(found)
        if found.reason == UNKNOWN_HEADER:  # noise rarely has the same size twice
            content = f"binary outputs of {found.discarded} bytes with an unknown header"
            out += self._newer.take_unknown(content, self._stamps.chunk_ns)
        return out

    def _decode_output(self, packet: BinaryPacket) -> list[Decoded]:
        """Return the content of a binary output; nothing if required fields are missing."""
        header = packet.layout.header
        places = self._places.get(header)
        if places is None:
            if len(self._places) >= _MOST_KINDS:
                self._places.clear()
            places = self._places[header] = _Places(packet.layout.places)

        values = packet.values
        ticks = None if places.time is None else int(values[places.time][0])
        if self._is_raw:
            if places.rate is None or places.force is None:
                return []
            field = None if places.field is None else _vector(values[places.field])
            raw = RawVectors(_vector(values[places.rate]), _vector(values[places.force]), field)
            arrival_ns = self._arrival_of(packet)
            reading = TimedReading(packet.size, arrival_ns, ticks, raw=raw)
            return self._check_rate(ticks) + self._samples.add(reading)

        if places.quaternion is None:
            return []
        x, y, z, w = values[places.quaternion]
        native = (w, x, y, z)
        q = canonical(native, "NED", world_to_sensor=self._inverse)
        arrival_ns = self._arrival_of(packet)
        reading = TimedReading(packet.size, arrival_ns, ticks, q, native)
        return self._check_rate(ticks) + self._samples.add(reading)

    def _check_rate(self, ticks: int | None) -> list[Decoded]:
        warning = None
        if ticks is not None and self._rate_check is not None:
            warning = self._rate_check.add(ticks)
        return [] if warning is None else [warning]


_MOST_KINDS = 16
"""Largest number of output types whose positions are stored."""


def _vector(values: tuple[Any, ...]) -> Vector:
    return cast("Vector", values)


def _text_events(message: TextMessage) -> Iterator[Decoded]:
    """Yield the events of a reply or an error."""
    if message.error is not None:
        yield DeviceEvent("warning", error_text(message.error), {"code": message.error})

    register, values = message.register, message.values[1:]
    known: dict[str, object] = {}
    if register in _NAMES and values:
        known = {_NAMES[Register(register)]: values[0]}
    elif register is not None and 0 <= register - Register.BINARY_OUTPUT < 3:  # noqa: PLR2004 - three outputs
        output = decode_output(values)
        if output is not None:
            number = register - Register.BINARY_OUTPUT + 1
            fields = [f"0x{field:02X}" for field in output.fields]
            known = {f"output_{number}": [output.ports, output.divisor, *fields]}
    if known:
        yield DeviceEvent(
            "info", ", ".join(f"{key} {value}" for key, value in known.items()), known
        )

    rotation = decode_rotation(values) if register == Register.ROTATION else None
    if rotation is not None:
        data = {"reference_frame": list(rotation)}
        yield DeviceEvent("info", f"reference_frame {data['reference_frame']}", data)
        pairs = zip(rotation, _IDENTITY, strict=True)
        if not all(abs(found - expected) <= _SMALL for found, expected in pairs):
            text = (
                f"a reference frame rotation is stored (register 26: {data['reference_frame']}): "
                "the sensor axes differ from the printed axes. Reset the rotation with VectorNav "
                "Control Center before a calibration, or leave it unchanged"
            )
            yield DeviceEvent("warning", text, data)
