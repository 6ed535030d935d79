"""The pure half of the Xbus driver: chunks in, samples in SI and canonical orientation out.

Law: a function of the chunks fed; no clock, no port. A sample is stamped with the arrival of its
first byte: that of the chunk, less the bytes that followed and its own, at ten bits each; on USB,
where bytes take no time, that of the chunk.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_daemon.model import Corrupt, DeviceEvent, ImuSample, SyncPulse, TickClock
from jointfit_drivers.xbus._continuity import Continuity, Step
from jointfit_drivers.xbus._raw_orientation import RAW, Message
from jointfit_drivers.xbus._sync_lines import describe
from jointfit_protocols.orientation import OrientationGate, Quaternion, canonical
from jointfit_protocols.xbus import MAX_MESSAGE, Layout, MessageId, XbusCodec, XbusMessage
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, Trigger, decode_item, split, world_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_drivers.xbus._raw_orientation import XbusRaw
    from jointfit_protocols.corrupt import Corrupt as WireCorrupt
    from jointfit_protocols.xbus.mtdata2 import Value

_BITS = 10  # of one byte on the line, 8N1
_SILENCE_FLOOR_NS = 250_000_000
"""At high speed 1.5 messages take so little that a stalled host would look like a silent line."""
_COUNTER, _TIME = int(Item.PACKET_COUNTER), int(Item.SAMPLE_TIME_FINE)
_QUATERNION = int(Item.QUATERNION)
_STATUS_BYTE, _STATUS_WORD = int(Item.STATUS_BYTE), int(Item.STATUS_WORD)
_WANTED = {_COUNTER, _TIME, _QUATERNION, _STATUS_BYTE, _STATUS_WORD}
_ALIGNED = ("sensor", "local")


class _Orientation(NamedTuple):
    """A message with an orientation, not judged yet."""

    message: XbusMessage
    arrived_ns: int
    values: Mapping[int, Any]
    world_id: int
    pulses: list[Decoded]


class XbusDecoder:
    """Decoder of one Xbus device.

    Parameters
    ----------
    baud
        Speed of the line, for back-dating; None: USB.
    rate_hz
        Nominal rate, used until the stream has shown its own.
    wires
        Items that tell of edges, and the wire of the rig that each is about.
    raw
        Makes orientations of raw readings; None: the device sends them.
    """

    def __init__(
        self,
        baud: int | None,
        rate_hz: float,
        wires: Mapping[int, int] | None = None,
        raw: XbusRaw | None = None,
    ) -> None:
        self._wires = wires or {}
        self._raw = raw
        self._wanted = {*_WANTED, *self._wires, *(RAW if raw is not None else ())}
        self._layouts: dict[int, Layout | None] = {}
        """How the first message of each length is laid out; a device sends one or two lengths."""
        self._xbus = XbusCodec()
        self._byte_ns = 0.0 if baud is None else _BITS * 1e9 / baud
        self._silence_ns = max(1.5 * MAX_MESSAGE * self._byte_ns, _SILENCE_FLOOR_NS)
        self._continuity = Continuity(rate_hz)
        self._held: _Orientation | None = None
        self._tick_clock = TickClock(setup.TICK_NS, setup.WRAP_32_BIT)
        self._gate = OrientationGate()
        self._last_ns = self._arrival_ns = 0
        self._refused = self._refused_bytes = 0
        self._measuring = self._judged = False

    @property
    def tick_clock(self) -> TickClock:
        """100 us ticks; the modulus follows the model, or the first wrap seen."""
        modulus = self._continuity.modulus or setup.WRAP_32_BIT
        if modulus != self._tick_clock.modulus:  # asked for after every chunk, and changes once
            self._tick_clock = TickClock(setup.TICK_NS, modulus)
        return self._tick_clock

    @property
    def messages(self) -> int:
        """Well-formed messages so far."""
        return self._xbus.messages - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Bytes that belong to no message so far, or to one that made no sense."""
        return self._xbus.discarded + self._refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return what `chunk` completed, in wire order; never raises."""
        out: list[Decoded] = []
        if self._xbus.pending:
            quiet_ns = chunk.t_ns - self._last_ns - len(chunk.data) * self._byte_ns
            if quiet_ns > self._silence_ns:  # the rest of what waits will never come
                out = self._take(self._xbus.flush())
        self._last_ns = chunk.t_ns
        found = self._xbus.feed(chunk.data)
        return out + self._take(found) if found else out

    def flush(self) -> list[Decoded]:
        """Give up waiting: for the rest of a pending message, and for what would confirm one."""
        return self._take(self._xbus.flush()) + self._drop_held()

    def _take(self, found: list[XbusMessage | WireCorrupt]) -> list[Decoded]:
        out: list[Decoded] = []
        for event in found:
            if isinstance(event, XbusMessage):
                if event.mid == MessageId.MT_DATA2:
                    out += self._measurement(event)
                else:
                    out += self._told(event)
            else:
                out.append(Corrupt(event.discarded, event.reason))
        return out

    def _arrived(self, message: XbusMessage) -> int:
        """Return when the first byte of `message` came, monotonic ns."""
        since = self._xbus.fed - message.end + message.size
        at_ns = self._last_ns - round(since * self._byte_ns)
        # a line cannot be faster than its speed, but USB devices and ptys are: never backwards
        self._arrival_ns = max(self._arrival_ns, at_ns)
        return self._arrival_ns

    def _measurement(self, message: XbusMessage) -> list[Decoded]:
        """Return what an MTData2 holds, or what is wrong with it."""
        data = message.data
        layout = self._layouts.get(len(data))
        if layout is not None:
            known = layout.read(data)
            if known is not None:
                return self._said(message, known, layout.world_id)
        items = split(data)
        if items is None:
            return [self._refuse(message, "MTData2 items do not fill the message")]
        values: dict[int, Value] = {}
        world_id = 0
        for data_id, raw in items:
            kind = data_id & 0xFFF0
            if kind in self._wanted:
                value = decode_item(data_id, raw)
                if value is None:
                    return [self._refuse(message, f"MTData2 item 0x{data_id:04X} malformed")]
                values[kind] = value
                world_id = data_id if kind == _QUATERNION else world_id
        if len(data) not in self._layouts:
            self._layouts[len(data)] = Layout.of(items, self._wanted)
        return self._said(message, values, world_id)

    def _said(
        self, message: XbusMessage, values: Mapping[int, Any], world_id: int
    ) -> list[Decoded]:
        """Return what the items of an MTData2 give, after what its counter and time show."""
        raw = self._raw
        pulses = self._pulses(message, values) if self._wires else []
        ticks: int | None = values.get(_TIME)
        if raw is None:
            is_orientation = _QUATERNION in values
        else:  # a message without either, as of a receiver, gives no orientation
            is_orientation = ticks is not None and raw.is_complete(values)
        if not is_orientation:
            self._continuity.other()
            return pulses
        self._measuring = True
        arrived_ns = self._arrived(message)
        step = self._continuity.orientation(values.get(_COUNTER), ticks, arrived_ns)
        orientation = _Orientation(message, arrived_ns, values, world_id, pulses)
        return self._continue(step, orientation)

    def _continue(self, step: Step, orientation: _Orientation) -> list[Decoded]:
        """Return `orientation`, and what becomes of the one that was held for it."""
        held, self._held = self._held, orientation if step.held else None
        out: list[Decoded] = []
        if held is not None and not step.confirmed:
            out.append(self._refuse(held.message, "counter and time contradict the others"))
        if step.held:
            return out
        if step.restarted and held is not None:
            self._forget_orientation()
            text = f"its clock began anew at {held.values.get(_TIME)} ticks"
            out.append(DeviceEvent("restart", text))
        if step.counter_jumped and held is not None:
            text = f"its counter jumped to {held.values.get(_COUNTER)} while its time went on"
            out.append(DeviceEvent("counter", text))
        out += _gap(step.lost)
        if held is not None and step.confirmed:
            out += self._measured(held)
            out += _gap(step.lost_since)
        return out + self._measured(orientation)

    def _measured(self, orientation: _Orientation) -> list[Decoded]:
        """Return the sample of an orientation that belongs to the stream."""
        message, arrived_ns, values, world_id, pulses = orientation
        ticks: int | None = values.get(_TIME)
        counter: int | None = values.get(_COUNTER)
        if self._raw is not None and ticks is not None:
            return pulses + self._felt(orientation, ticks, self._raw)
        native: Quaternion = values[_QUATERNION]
        status: int | None = values.get(_STATUS_WORD, values.get(_STATUS_BYTE))
        out = pulses
        world = world_of(world_id) or "ENU"
        q = self._gate.admit(native if world == "ENU" else canonical(native, world))
        if q is None:
            out.append(self._refuse(message, "quaternion norm is not 1"))
        else:
            out.append(ImuSample(arrived_ns, q, native, ticks, counter, status))
        if not self._judged:
            out += self._judge()
        return out

    def _felt(self, orientation: _Orientation, ticks: int, raw: XbusRaw) -> list[Decoded]:
        """Return what raw readings give."""
        values = orientation.values
        said = Message(
            orientation.arrived_ns, ticks, values.get(_COUNTER), values.get(_STATUS_WORD)
        )
        found = raw.samples(said, values, self.tick_clock.modulus or setup.WRAP_32_BIT)
        if found is None:
            return [self._refuse(orientation.message, "raw readings that no sensor gives")]
        return found

    def _pulses(self, message: XbusMessage, values: Mapping[int, object]) -> list[Decoded]:
        """Return the edges that a message tells of."""
        found = [(wire, values.get(item)) for item, wire in self._wires.items()]
        return [
            SyncPulse(self._arrived(message), edge.time, wire, edge.frame)
            for wire, edge in found
            if isinstance(edge, Trigger)
        ]

    def _forget_orientation(self) -> None:
        self._gate.forget()
        if self._raw is not None:
            self._raw.forget()

    def _judge(self) -> list[Decoded]:
        """Return one warning where hardly any quaternion has norm 1."""
        self._judged, norm = self._gate.judged, self._gate.misconfigured_norm
        if norm is None:
            return []
        text = f"median quaternion norm is {norm:.4g}, expected 1: byte order or scale is wrong"
        return [DeviceEvent("warning", text, {"median_norm": norm})]

    def _refuse(self, message: XbusMessage, reason: str) -> Corrupt:
        self._refused += 1
        self._refused_bytes += message.size
        return Corrupt(message.size, reason)

    def _told(self, message: XbusMessage) -> list[Decoded]:
        """Return what a message other than a measurement says."""
        mid, data = message.mid, message.data
        if mid == MessageId.WAKE_UP:
            return [] if data else self._woke()  # a damaged measurement has data
        if mid in {MessageId.ERROR, MessageId.WARNING}:
            code = data[0] if data else 0
            kind = "error" if mid == MessageId.ERROR else "warning"
            return [DeviceEvent(kind, setup.error_text(code), {"code": code})]
        if mid == MessageId.PRODUCT_CODE:
            self._continuity.modulus = setup.fine_time_modulus(setup.decode_text(data))
        known = _info(mid, data)
        text = ", ".join(f"{key} {value}" for key, value in known.items())
        return [DeviceEvent("info", text, known)] if known else []

    def _woke(self) -> list[Decoded]:
        """Return a restart if the device had been measuring: it lost power, or was reset."""
        out = self._drop_held()
        self._continuity.forget()
        self._forget_orientation()
        if self._measuring:
            self._measuring = False
            out.append(DeviceEvent("restart", "it woke up anew"))
        return out

    def _drop_held(self) -> list[Decoded]:
        """Return the loss of an orientation that nothing confirmed."""
        held, self._held = self._held, None
        if held is None:
            return []
        return [self._refuse(held.message, "counter and time contradict the others")]


def _gap(lost: int) -> list[Decoded]:
    return [DeviceEvent("gap", f"{lost} messages lost", {"lost": lost})] if lost else []


def _info(mid: int, data: bytes) -> dict[str, object]:
    """Return what a reply says of the device; empty for other messages and malformed ones."""
    if mid == MessageId.ALIGNMENT_ROTATION_ACK:
        rotation = setup.decode_alignment(data)
        if rotation is None or rotation.frame >= len(_ALIGNED):
            return {}
        return {f"alignment_{_ALIGNED[rotation.frame]}": list(rotation.q)}
    if mid not in _TOLD or not data:
        return {}
    key, read = _TOLD[mid]
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
    return None if entries is None else [describe(entry) for entry in entries]


_TOLD: dict[int, tuple[str, Callable[[bytes], object]]] = {
    MessageId.DEVICE_ID: ("serial", setup.decode_device_id),
    MessageId.PRODUCT_CODE: ("model", setup.decode_text),
    MessageId.FIRMWARE: ("firmware", _firmware),
    MessageId.FILTER_PROFILE_ACK: ("filter_profile", setup.decode_filter_profile),
    MessageId.OUTPUT_CONFIGURATION_ACK: ("outputs", _outputs),
    MessageId.SYNC_SETTINGS_ACK: ("sync", _sync),
}
