"""Decoder of LPMS sensors on a serial line: converts chunks to samples.

A data packet does not state which outputs it contains. The driver reads the mask of outputs before
the stream begins. The reply is part of the recorded bytes, and the decoder takes the mask from this
reply. Without a reply, the decoder finds the quaternion by its norm.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample, TickClock
from jointfit_daemon.units import NS_PER_S
from jointfit_drivers.lpms._orientation import LpmsConvention, LpmsOrientation
from jointfit_drivers.lpms._output_search import ArrivedPacket, OutputSearch
from jointfit_drivers.lpms._tick_rate import TickRateCheck
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_drivers.time_continuity import TimeContinuity
from jointfit_protocols.lpms import MAX_MESSAGE, LpBusCodec, LpBusMessage
from jointfit_protocols.lpms.configuration import (
    LpmsCommand,
    LpmsConfiguration,
    decode_configuration,
    decode_firmware,
    decode_text,
    identify_generation,
    sends_seconds,
)
from jointfit_protocols.lpms.measurement import TICK_MODULUS, PacketLayout, seconds_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.lpms._settings import LpmsSettings
    from jointfit_protocols.lpms.measurement import LpmsMeasurement

_SECONDS_CLOCK = TickClock(1_000, None)
"""Clock of firmware that sends device time in seconds, which are converted to microseconds."""
_MOST_SECONDS = 1e9
_DATA = int(LpmsCommand.DATA)
_TEXT_BYTES = 256
"""Number of bytes without a message after which the bytes are checked for text."""
_HALF = TICK_MODULUS // 2


class _Packet(NamedTuple):
    """A data packet that is not accepted yet."""

    message: LpBusMessage
    arrival_ns: int
    ticks: int
    measurement: LpmsMeasurement
    quaternion: Sequence[float]
    """Values of the quaternion as sent. They are stored because the outputs may change while the
    packet is held."""


class LpmsDecoder(SerialMessageDecoder[LpBusMessage]):
    """Decoder of one LPMS sensor.

    Parameters
    ----------
    settings : LpmsSettings
        Table of the device in rig.toml.
    """

    def __init__(self, settings: LpmsSettings) -> None:
        super().__init__(LpBusCodec(), Refusals(), settings.line_baud, MAX_MESSAGE)
        self._table = settings.table
        self._sensor_id = settings.sensor_id
        self._continuity = TimeContinuity()
        self._orientation = LpmsOrientation(LpmsConvention.of(settings), _NORM_REMEDY)
        self._layout = PacketLayout(self._table, self._table.quaternion)
        self._configuration = LpmsConfiguration()
        self._search = OutputSearch(self._table)
        self._held: _Packet | None = None
        self._ticks_per_s = settings.ticks_per_s
        self._ticks_clock = TickClock(0, TICK_MODULUS, ticks_per_s=self._ticks_per_s)
        self._auto_time = settings.device_time == "auto"
        self._is_seconds = settings.device_time == "seconds"
        self._check = self._new_check()
        self._last_tick = self._unwrapped = 0
        self._id_reported = False
        self._sizes: set[int] = set()
        self._noise = b""

    @property
    def tick_clock(self) -> TickClock:
        """Unit and modulus of the device time."""
        return _SECONDS_CLOCK if self._is_seconds else self._ticks_clock

    @override
    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        if self._codec.messages or len(self._noise) >= _TEXT_BYTES:
            return super().feed(chunk)

        # Warn once if the device sends text instead of messages.
        out: list[Decoded] = []
        self._noise += chunk.data[:_TEXT_BYTES]
        if len(self._noise) >= _TEXT_BYTES and is_text(self._noise):
            out.append(DeviceEvent("warning", f"the sensor sends text: {TEXT_REMEDY}"))
        return out + super().feed(chunk)

    @override
    def flush(self) -> list[Decoded]:
        """Discard an incomplete message and an unconfirmed packet; return samples and events."""
        out = super().flush() + self._decode_packets(self._search.flush())
        return out + self._drop_held()

    @override
    def _take(self, message: LpBusMessage) -> list[Decoded]:
        if message.command == _DATA and message.data:
            packet = ArrivedPacket(message, self._arrival_of(message))
            if self._configuration.outputs is not None:
                return self._decode_packet(packet)
            return self._decode_packets(self._search.take(packet))

        out = self._property_events(message)
        if self._configuration.outputs is not None:
            for packet in self._search.release():
                out += self._decode_packet(packet)
        return out

    def _decode_packets(self, ready: list[ArrivedPacket]) -> list[Decoded]:
        """Return the samples and events of packets whose outputs the search determined."""
        if ready:
            self._layout = self._search.layout
        out, self._search.events = self._search.events, []
        return out + [event for packet in ready for event in self._decode_packet(packet)]

    def _decode_packet(self, arrived: ArrivedPacket) -> list[Decoded]:
        """Check the time of a data packet; return the samples and events that it completes."""
        message, arrival_ns = arrived
        measurement = self._layout.decode(message.data)
        if measurement is None or "quaternion" not in self._layout.places:
            return self._length_warning(message)  # a valid packet with other outputs

        out: list[Decoded] = []
        if not self._check.done:
            out += self._time_warning(measurement.tick, arrival_ns)
        if message.sensor_id != self._sensor_id and not self._id_reported:
            self._id_reported = True
            found, wanted = message.sensor_id, self._sensor_id
            text = f"the sensor has sensor id {found}, expected {wanted}: set `sensor_id`"
            out.append(DeviceEvent("warning", text, {"sensor_id": found}))

        ticks = self._device_ticks(measurement.tick)
        if ticks is None:
            return [
                *out,
                self._refusals.refuse(message.size, "device time is not a number of seconds"),
            ]
        device_ns = ticks * 1_000 if self._is_seconds else ticks * NS_PER_S // self._ticks_per_s
        step = self._continuity.add(device_ns, arrival_ns)
        values = measurement.values[self._layout.places["quaternion"]]
        packet = _Packet(message, arrival_ns, ticks, measurement, values)

        held = self._held
        if not step.restarted:
            out += self._drop_held()
        self._held = packet if step.held else None
        if step.held:
            return out

        if step.restarted and held is not None:
            self._orientation.forget()
            text = f"device clock restarted at {held.measurement.tick} ticks"
            out += [DeviceEvent("restart", text), *self._sample(held)]
        if step.lost:
            out.append(DeviceEvent("gap", f"{step.lost} messages lost", {"lost": step.lost}))
        return out + self._sample(packet)

    def _device_ticks(self, tick: int) -> int | None:
        """Return the device time in ticks of `tick_clock`, without wraps; None if it is invalid."""
        if self._is_seconds:
            seconds = seconds_of(tick)
            is_time = isfinite(seconds) and 0 <= seconds < _MOST_SECONDS
            return round(seconds * 1e6) if is_time else None

        step = (tick - self._last_tick + _HALF) % TICK_MODULUS - _HALF
        self._last_tick = tick
        self._unwrapped += step
        return self._unwrapped

    def _sample(self, packet: _Packet) -> list[Decoded]:
        """Return the sample and the events of an accepted packet."""
        measurement = packet.measurement
        converted = self._orientation.convert(packet.quaternion, floats=measurement.floats)
        out, self._orientation.events = self._orientation.events, []

        if converted is None:
            return [*out, self._refusals.refuse(packet.message.size, "quaternion norm is not 1")]
        native, q = converted
        ticks = packet.ticks if self._is_seconds else measurement.tick
        return [*out, ImuSample(packet.arrival_ns, q, native, ticks, None)]

    def _property_events(self, message: LpBusMessage) -> list[Decoded]:
        """Return the events of a reply, which may change the layout of later data packets."""
        command, data = message.command, message.data
        part = decode_configuration(self._table, command, data)
        if part is not None:
            self._configuration = self._configuration.merge(part)
            mask, rate_hz, floats = self._configuration
            if part.outputs is not None:
                self._layout = PacketLayout(self._table, part.outputs)
            known: dict[str, object] = {}
            if mask is not None:
                known["outputs"] = self._table.names(mask)
            if rate_hz is not None:
                known["rate_hz"] = rate_hz
            if floats is not None:
                known["precision"] = "float32" if floats else "int16"
        elif command == self._table.read_firmware and data:
            known = self._take_firmware(data)
        elif command == LpmsCommand.IDENTIFY and identify_generation(data) == 1:
            known = {"model": decode_text(data)}
        else:
            known = {}

        text = ", ".join(f"{key} {value}" for key, value in known.items())
        return [DeviceEvent("info", text, known)] if known else []

    def _take_firmware(self, data: bytes) -> dict[str, object]:
        """Return the firmware version, and set the format of the device time accordingly."""
        version = decode_firmware(self._table, data)
        if version is None:
            return {}
        if self._auto_time and self._table.generation == 1:
            self._is_seconds = sends_seconds(version)
            self._check = self._new_check()
        return {"firmware": version}

    def _new_check(self) -> TickRateCheck:
        return TickRateCheck(self._ticks_per_s, is_seconds=self._is_seconds)

    # --- findings in the stream ---------------------------------------------------------------

    def _time_warning(self, tick: int, arrival_ns: int) -> list[Decoded]:
        """Return a warning if the unit of device time differs from the configured unit."""
        fault = self._check.feed(tick, arrival_ns)
        if fault is None:
            return []
        if fault.is_seconds:
            text = 'device time is float seconds, not ticks: set device_time = "seconds"'
        elif self._is_seconds:
            text = 'device time is not float seconds: set device_time = "ticks"'
        else:
            hz = fault.usual_hz
            remedy = f"set tick_hz = {hz}" if hz else "set `tick_hz`, and check `rate_hz`"
            text = (
                f"device time counts {fault.ticks_per_s:.4g} ticks a second, expected "
                f"{self._ticks_per_s}: {remedy}"
            )
        return [DeviceEvent("warning", text, {"ticks_per_s": round(fault.ticks_per_s, 1)})]

    def _length_warning(self, message: LpBusMessage) -> list[Decoded]:
        """Return a warning, once per length, because the packet length does not fit the outputs."""
        size = len(message.data)
        if size in self._sizes:
            return []
        self._sizes.add(size)
        floats, shorts = self._layout.sizes
        names = " + ".join(self._layout.places) or "no output"
        cause = "the outputs were changed, or the firmware is newer than jointfitd"
        if self._configuration.outputs is None:
            cause = (
                "no reply of the sensor names the outputs, and no quaternion was found by its norm"
            )
        text = (
            f"data packets have {size} bytes, expected {floats} (32 bit) or {shorts} (16 bit) for "
            f"{names}; {cause}: let the driver connect again, or enable only the quaternion"
        )
        return [DeviceEvent("warning", text, {"data_bytes": size})]

    def _drop_held(self) -> list[Decoded]:
        """Reject a packet that no later packet confirmed."""
        held, self._held = self._held, None
        if held is None:
            return []
        reason = "device time disagrees with the other messages"
        return [self._refusals.refuse(held.message.size, reason)]


def is_text(data: bytes) -> bool:
    """Return whether `data` are lines of printable ASCII, like the text format of a sensor."""
    printable = sum(0x20 <= byte < 0x7F or byte in b"\r\n\t" for byte in data)  # noqa: PLR2004 - ASCII
    return bool(data) and printable >= _TEXT_SHARE * len(data)


_TEXT_SHARE = 0.95
"""Smallest share of printable bytes in text. The first line may be incomplete."""
TEXT_REMEDY = "set its output format to LP-BUS (binary) with LpmsControl, then restart it"
_NORM_REMEDY = "remove `scale`, and check with LpmsControl that the quaternion is enabled"
