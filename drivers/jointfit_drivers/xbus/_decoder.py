"""Decoder of Xbus devices: converts chunks to samples in SI units.

The orientation of a sample is *canonical*: a Hamilton unit quaternion, scalar first, from the
sensor to a world with x east, y north and z up (`jointfit_protocols.orientation`).

The stamp of a sample is the arrival of its first byte. On a serial line, this is the arrival of the
chunk minus the duration of the message and of all later bytes in the chunk, at ten bits per byte.
On USB, it is the arrival of the chunk.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.model import Corrupt, DeviceEvent, ImuSample, SyncPulse, TickClock
from jointfit_drivers.gateway_orientation import RawStamp
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.xbus._bus_ids import BusIdSelection
from jointfit_drivers.xbus._continuity import XbusContinuity, XbusStep
from jointfit_drivers.xbus._raw_orientation import RAW
from jointfit_drivers.xbus._sync_lines import describe_entry
from jointfit_protocols.orientation import OrientationGate, Quaternion, canonical
from jointfit_protocols.xbus import (
    MAX_MESSAGE,
    MTData2Layout,
    XbusCodec,
    XbusMessage,
    XbusMessageId,
)
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import (
    KNOWN_ITEMS,
    Item,
    Trigger,
    decode_item,
    split,
    world_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Chunk, Decoded, DeviceEventKind
    from jointfit_drivers.xbus._legacy_measurements import LegacyMeasurements
    from jointfit_drivers.xbus._raw_orientation import RawOrientation
    from jointfit_protocols.corrupt import CorruptBytes
    from jointfit_protocols.xbus.mtdata2 import Value

_BITS = 10
"""Number of bits of one byte on the line (8N1)."""
_SILENCE_FLOOR_NS = 250_000_000
"""Smallest silence after which an incomplete message is discarded, ns.

At high speed, the duration of 1.5 messages is so short that a delayed read by the host would look
like silence.
"""
_COUNTER, _TIME = int(Item.PACKET_COUNTER), int(Item.SAMPLE_TIME_FINE)
_QUATERNION = int(Item.QUATERNION)
_STATUS_BYTE, _STATUS_WORD = int(Item.STATUS_BYTE), int(Item.STATUS_WORD)
_WANTED = {_COUNTER, _TIME, _QUATERNION, _STATUS_BYTE, _STATUS_WORD}
"""Data items that the decoder reads."""
_ALIGNED = ("sensor", "local")
_MESSAGES = frozenset(map(int, XbusMessageId))
_MEASUREMENTS = (XbusMessageId.MT_DATA2, XbusMessageId.MT_DATA)
_NEWEST = NewestKnown((1,), "MT Manager")
"""Newest supported firmware version, 1.x. Firmware of all MTi series since 2012 has version 1.x."""


class _Orientation(NamedTuple):
    """A message with an orientation, from which no sample has been computed yet.

    The message may be held until the next orientation shows whether it is valid
    (`XbusContinuity`).
    """

    message: XbusMessage
    arrived_ns: int
    values: Mapping[int, Any]
    world_id: int
    pulses: list[Decoded]


class XbusDecoder:
    """Decoder of one Xbus device.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    rate_hz : float
        Nominal rate, Hz. It is used until the rate of the stream is measured.
    wires : mapping, optional
        Number of the rig's sync wire for each data item that reports edges.
    raw : RawOrientation, optional
        Filter that computes orientations from raw measurements; None if the device sends
        orientations.
    legacy : LegacyMeasurements, optional
        Reader of MTData messages; None for a device that sends MTData2 messages.
    bus_id : int, optional
        Bus id of the device whose measurements are used. None selects the device that sends the
        first measurement.
    """

    def __init__(
        self,
        baud: int | None,
        rate_hz: float,
        wires: Mapping[int, int] | None = None,
        raw: RawOrientation | None = None,
        legacy: LegacyMeasurements | None = None,
        *,
        bus_id: int | None = None,
    ) -> None:
        self._wires = wires or {}
        self._raw = raw
        self._legacy = legacy
        self._other_format_reported = False
        self._wanted = {*_WANTED, *self._wires, *(RAW if raw is not None else ())}
        self._layouts: dict[int, MTData2Layout | None] = {}
        """Layout of the MTData2 messages of each length; None if there is no layout. A device sends
        one or two lengths."""
        self._xbus = XbusCodec()
        self._bus_ids = BusIdSelection(bus_id)
        self._byte_ns = 0.0 if baud is None else _BITS * 1e9 / baud
        self._silence_ns = max(1.5 * MAX_MESSAGE * self._byte_ns, _SILENCE_FLOOR_NS)
        self._continuity = XbusContinuity(rate_hz)
        self._held: _Orientation | None = None
        self._tick_clock = TickClock(setup.TICK_NS, setup.WRAP_32_BIT)
        self._gate = OrientationGate()
        self._last_ns = self._arrival_ns = 0
        self._refused = self._refused_bytes = 0
        self._measuring = self._norm_checked = False
        self._newer = NewerFirmwareDetector(_NEWEST)

    @property
    def tick_clock(self) -> TickClock:
        """Unit and modulus of the device time, which is in ticks of 100 us.

        The product code or the first wrap of the device time determines the modulus.
        """
        modulus = self._continuity.modulus or setup.WRAP_32_BIT
        if modulus != self._tick_clock.modulus:  # read after every chunk, but changes only once
            self._tick_clock = TickClock(setup.TICK_NS, modulus)
        return self._tick_clock

    @property
    def messages(self) -> int:
        """Number of well-formed messages so far."""
        return self._xbus.messages - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far that belong to no message or to a rejected message."""
        return self._xbus.discarded + self._refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        if self._xbus.pending:
            quiet_ns = chunk.t_ns - self._last_ns - len(chunk.data) * self._byte_ns
            if quiet_ns > self._silence_ns:  # the rest of the pending message was lost
                out = self._take(self._xbus.flush())
        self._last_ns = chunk.t_ns
        found = self._xbus.feed(chunk.data)
        return out + self._take(found) if found else out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete message, and an orientation that no later message has confirmed."""
        return self._take(self._xbus.flush()) + self._drop_held()

    def _take(self, found: list[XbusMessage | CorruptBytes]) -> list[Decoded]:
        out: list[Decoded] = []
        for event in found:
            if not isinstance(event, XbusMessage):
                out.append(Corrupt(event.discarded, event.reason))
            elif event.mid not in _MEASUREMENTS:
                out += self._device_events(event)
            elif not self._bus_ids.admits(event.bid):
                out += self._bus_ids.report(event.bid)
            elif event.mid == XbusMessageId.MT_DATA2:
                out += self._decode_measurement(event)
            else:
                out += self._decode_legacy(event)
        return out

    def _arrival_of(self, message: XbusMessage) -> int:
        """Return the arrival of the first byte of `message`, monotonic ns."""
        since = self._xbus.fed - message.end + message.size
        at_ns = self._last_ns - round(since * self._byte_ns)
        # USB devices and pseudoterminals are faster than the configured speed. Stamps must not
        # decrease.
        self._arrival_ns = max(self._arrival_ns, at_ns)
        return self._arrival_ns

    def _decode_measurement(self, message: XbusMessage) -> list[Decoded]:
        """Return the content of an MTData2 message, or the reason why it is rejected."""
        data = message.data
        layout = self._layouts.get(len(data))
        if layout is not None:
            known = layout.read(data)
            if known is not None:
                return self._decode_values(message, known, layout.world_id)

        items = split(data)
        if items is None:
            return [self._refuse(message, "MTData2 items do not fill the message")]

        values: dict[int, Value] = {}
        world_id = 0
        out: list[Decoded] = []
        for data_id, raw in items:
            kind = data_id & 0xFFF0
            if kind in self._wanted:
                value = decode_item(data_id, raw)
                if value is None:
                    content = f"item 0x{data_id:04X} of {len(raw)} bytes"
                    out = self._newer.take_unknown(content, self._last_ns)
                    return [*out, self._refuse(message, f"MTData2 item 0x{data_id:04X} malformed")]
                values[kind] = value
                world_id = data_id if kind == _QUATERNION else world_id
            elif kind not in KNOWN_ITEMS:
                out += self._newer.take_unknown(f"item 0x{kind:04X}", self._last_ns)

        # A stored layout skips unknown items. It is therefore stored only when all kinds of unknown
        # items so far have occurred often enough to be reported.
        if len(data) not in self._layouts and self._newer.is_settled:
            self._layouts[len(data)] = MTData2Layout.of(items, self._wanted)
        return out + self._decode_values(message, values, world_id)

    def _decode_legacy(self, message: XbusMessage) -> list[Decoded]:
        """Return the content of an MTData message, or the reason why it cannot be decoded."""
        legacy = self._legacy
        if legacy is None or legacy.fault:
            if self._other_format_reported:
                return []
            self._other_format_reported = True
            text = 'the device sends MTData, the format of older devices: set format = "mtdata"'
            if legacy is not None:
                text = f"{legacy.fault}: set output_mode and output_settings"
            return [DeviceEvent("warning", text, {"format": "mtdata"})]

        values = legacy.read(message.data)
        if values is None:
            size = len(message.data)
            return [self._refuse(message, f"MTData of {size} bytes contradicts the output mode")]
        return self._decode_values(message, values, legacy.world_id)

    def _decode_values(
        self, message: XbusMessage, values: Mapping[int, Any], world_id: int
    ) -> list[Decoded]:
        """Check counter and time of an MTData2 or MTData message, and return its content."""
        pulses: list[Decoded] = []
        for item, wire in self._wires.items():
            edge = values.get(item)
            if isinstance(edge, Trigger):
                at_ns = self._arrival_of(message)
                pulses.append(SyncPulse(at_ns, edge.time, wire, edge.frame))

        ticks: int | None = values.get(_TIME)
        if self._raw is None:
            is_orientation = _QUATERNION in values
        else:
            is_orientation = ticks is not None and self._raw.is_complete(values)

        if not is_orientation:  # such as messages of a GNSS receiver
            self._continuity.other()
            return pulses

        self._measuring = True
        arrived_ns = self._arrival_of(message)
        step = self._continuity.orientation(values.get(_COUNTER), ticks, arrived_ns)
        orientation = _Orientation(message, arrived_ns, values, world_id, pulses)
        return self._continue(step, orientation)

    def _continue(self, step: XbusStep, orientation: _Orientation) -> list[Decoded]:
        """Return the samples of the held orientation, if it is confirmed, and of `orientation`."""
        held = self._held
        out = [] if step.confirmed else self._drop_held()
        self._held = orientation if step.held else None
        if step.held:
            return out

        if step.restarted and held is not None:
            self._forget_orientation()
            text = f"device clock restarted at {held.values.get(_TIME)} ticks"
            out.append(DeviceEvent("restart", text))

        if step.counter_jumped and held is not None:
            text = f"packet counter jumped to {held.values.get(_COUNTER)}, device time did not"
            out.append(DeviceEvent("counter", text))

        out += _gap(step.lost)
        if held is not None and step.confirmed:
            out += self._sample(held)
            out += _gap(step.lost_since)
        return out + self._sample(orientation)

    def _sample(self, orientation: _Orientation) -> list[Decoded]:
        """Return the sample of an accepted orientation."""
        message, arrived_ns, values, world_id, pulses = orientation
        ticks: int | None = values.get(_TIME)
        counter: int | None = values.get(_COUNTER)

        if self._raw is not None and ticks is not None:
            fields = RawStamp(arrived_ns, ticks, counter, values.get(_STATUS_WORD))
            modulus = self.tick_clock.modulus or setup.WRAP_32_BIT
            found = self._raw.samples(fields, values, modulus)
            if found is None:
                reason = "raw measurements out of range, or with the time of the previous ones"
                return [*pulses, self._refuse(message, reason)]
            return pulses + found

        native: Quaternion = values[_QUATERNION]
        status: int | None = values.get(_STATUS_WORD, values.get(_STATUS_BYTE))
        out = pulses
        world = world_of(world_id) or "ENU"
        q = self._gate.admit(native if world == "ENU" else canonical(native, world))
        if q is None:
            out.append(self._refuse(message, "quaternion norm is not 1"))
        else:
            out.append(ImuSample(arrived_ns, q, native, ticks, counter, status))

        # Warn once if hardly any quaternion has the norm 1.
        if not self._norm_checked:
            self._norm_checked, norm = self._gate.is_decided, self._gate.misconfigured_norm
            if norm is not None:
                text = f"median quaternion norm is {norm:.4g}, expected 1"
                text += ": byte order or scale is wrong"
                data = {"median_norm": norm} if isfinite(norm) else {}
                out.append(DeviceEvent("warning", text, data))
        return out

    def _forget_orientation(self) -> None:
        self._gate.forget()
        if self._raw is not None:
            self._raw.forget()

    def _refuse(self, message: XbusMessage, reason: str) -> Corrupt:
        self._refused += 1
        self._refused_bytes += message.size
        return Corrupt(message.size, reason, rejected=1)

    def _device_events(self, message: XbusMessage) -> list[Decoded]:
        """Return the events of a message that is not a measurement."""
        mid, data = message.mid, message.data
        if mid == XbusMessageId.WAKE_UP:
            if data:  # a WakeUp has no data, so this is a corrupt measurement
                return []
            out = self._drop_held()
            self._continuity.forget()
            self._forget_orientation()
            if self._measuring:  # the device lost power or was reset
                self._measuring = False
                out.append(DeviceEvent("restart", "device restarted (WakeUp received)"))
            return out

        if mid in {XbusMessageId.ERROR, XbusMessageId.WARNING}:
            code = data[0] if data else 0
            kind: DeviceEventKind = "error" if mid == XbusMessageId.ERROR else "warning"
            return [DeviceEvent(kind, setup.error_text(code), {"code": code})]

        if mid == XbusMessageId.PRODUCT_CODE:
            self._continuity.modulus = setup.fine_time_modulus(setup.decode_text(data))
        if self._legacy is not None:
            self._legacy.reply(mid, data)

        if mid not in _MESSAGES:
            return self._newer.take_unknown(f"message 0x{mid:02X}", self._last_ns)
        known = _device_property(mid, data)
        text = ", ".join(f"{key} {value}" for key, value in known.items())
        properties: list[Decoded] = [DeviceEvent("info", text, known)] if known else []
        if "firmware" in known:
            properties += self._newer.take_version(str(known["firmware"]))
        return properties

    def _drop_held(self) -> list[Decoded]:
        """Reject an orientation that no later message confirmed."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self._refuse(held.message, "counter and time disagree with the other messages")]


def _gap(lost: int) -> list[Decoded]:
    return [DeviceEvent("gap", f"{lost} messages lost", {"lost": lost})] if lost else []


def _device_property(mid: int, data: bytes) -> dict[str, object]:
    """Return the device property in a reply; empty for other replies and malformed messages."""
    if mid == XbusMessageId.ALIGNMENT_ROTATION_ACK:
        rotation = setup.decode_alignment(data)
        if rotation is None or rotation.frame >= len(_ALIGNED):
            return {}
        return {f"alignment_{_ALIGNED[rotation.frame]}": list(rotation.q)}

    if mid not in _PROPERTIES or not data:
        return {}
    key, read = _PROPERTIES[mid]
    value = read(data)
    return {} if value is None else {key: value}


def _firmware(data: bytes) -> str | None:
    firmware = setup.decode_firmware(data)
    return None if firmware is None else ".".join(map(str, firmware[:3]))


def _outputs(data: bytes) -> dict[str, int] | None:
    outputs = setup.decode_outputs(data)
    return None if outputs is None else {f"0x{data_id:04X}": rate for data_id, rate in outputs}


def _sync(data: bytes) -> list[str] | None:
    entries = setup.decode_sync(data)
    return None if entries is None else [describe_entry(entry) for entry in entries]


def _hexadecimal(data: bytes) -> str:
    return f"0x{data.hex().upper()}"


_PROPERTIES: dict[int, tuple[str, Callable[[bytes], object]]] = {
    XbusMessageId.DEVICE_ID: ("serial", setup.decode_device_id),
    XbusMessageId.PRODUCT_CODE: ("model", setup.decode_text),
    XbusMessageId.FIRMWARE: ("firmware", _firmware),
    XbusMessageId.FILTER_PROFILE_ACK: ("filter_profile", setup.decode_filter_profile),
    XbusMessageId.OUTPUT_CONFIGURATION_ACK: ("outputs", _outputs),
    XbusMessageId.SYNC_SETTINGS_ACK: ("sync", _sync),
    XbusMessageId.OUTPUT_MODE_ACK: ("output_mode", _hexadecimal),
    XbusMessageId.OUTPUT_SETTINGS_ACK: ("output_settings", _hexadecimal),
}
