"""Decoder of XCDI sensors: converts records of CAN frames to samples in SI units.

The stamp of a sample is the arrival of the first frame in its group, because arbitration may delay
the later frames. A record of 24 bytes is a message of this sensor, a frame of another device, a
count of losses on the host, or a rejected record.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no bus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent, ImuSample, TickClock
from jointfit_drivers.bus_events import BusEvents
from jointfit_drivers.xcdi._continuity import XcdiContinuity
from jointfit_protocols import can
from jointfit_protocols.orientation import OrientationGate
from jointfit_protocols.xcdi import (
    OVERFLOW,
    QUATERNION_SCALE,
    TICK_NS,
    TICKS_MODULUS,
    TickUnit,
    XcdiCodec,
    XcdiError,
    XcdiGroup,
)

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, DeviceEventKind
    from jointfit_protocols.orientation import Quaternion
    from jointfit_protocols.xcdi import ByteOrder, XcdiIds

_UNDECIDED = 100
"""Number of groups after which an undetermined unit of SampleTime is reported."""
_TIMELESS = 20
"""Number of quaternions after which a missing SampleTime is reported."""


class XcdiDecoder:
    """Decoder of one XCDI sensor.

    Parameters
    ----------
    ids : XcdiIds
        Identifiers of the sensor.
    unit : str
        Unit of SampleTime: ``100us``, ``1us``, or ``auto`` to determine it from the data.
    byte_order : ByteOrder
        Byte order of the payloads.
    rate_hz : float
        Configured sample rate, Hz.
    """

    def __init__(self, ids: XcdiIds, unit: str, byte_order: ByteOrder, rate_hz: float) -> None:
        self._xcdi = XcdiCodec(ids, byte_order)
        self._continuity = XcdiContinuity()
        self._held: XcdiGroup | None = None
        self._gate = OrientationGate()
        self._unit = TickUnit(rate_hz)
        self._configured = TICK_NS.get(unit)
        self.tick_clock: TickClock | None = None
        """Unit of SampleTime; None until it is determined."""
        if self._configured is not None:
            self.tick_clock = TickClock(self._configured, TICKS_MODULUS)
        self._measured_ns: int | None = None  # measured duration of a tick
        self._has_time = self._has_counter = False
        self._incomplete = self._timed = 0
        self._refused = 0
        self._bus = BusEvents()
        self._reported_topics: set[str] = set()

    @property
    def messages(self) -> int:
        """Number of well-formed frames received from this sensor."""
        return self._xcdi.messages - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes in rejected records, plus bytes on an adapter's line outside frames."""
        return self._bus.discarded_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        for item in can.unpack_frames(chunk.data):
            if not isinstance(item, can.CanFrame):
                out.append(self._bus.discard(item.discarded, item.reason))
            elif item.error:
                out += self._bus.add_error_frame(item)
            else:
                message = self._xcdi.feed(item)
                if isinstance(message, XcdiGroup):
                    self._group(message, out)
                elif isinstance(message, XcdiError):
                    known = message.code == OVERFLOW
                    text = _OVERFLOWED if known else f"device reports error {message.code}"
                    out += self._bus.limit_event("error", text, message.t_ns)
                elif message is not None:
                    out.append(self._bus.discard(can.RECORD_BYTES, message.reason))
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete group, and a group that no later group has confirmed."""
        self._xcdi.flush()
        out: list[Decoded] = []
        self._drop_held(out)
        return out

    def _group(self, group: XcdiGroup, out: list[Decoded]) -> None:
        """Check counter and time of `group`, and append its sample."""
        ticks, counter = group.ticks, group.counter
        self._has_time = self._has_time or ticks is not None
        self._has_counter = self._has_counter or counter is not None

        torn = ticks is None and (self._has_time or (counter is None and self._has_counter))
        broken = torn or self._xcdi.incomplete != self._incomplete
        self._incomplete = self._xcdi.incomplete

        clock = self.tick_clock
        host_ticks = None if clock is None else group.t_ns // clock.tick_ns
        step = self._continuity.group(ticks, counter, broken=broken, host_ticks=host_ticks)

        held = self._held
        if held is not None and not step.confirmed:
            self._drop_held(out)

        if step.shared:
            self._refuse("two sensors share these identifiers", out)
            out += self._once("warning", "shared", _SHARED)
            return
        self._reported_topics.discard("shared")
        self._held = group if step.held else None
        if step.held:
            return

        first = held if held is not None and step.confirmed else group
        if step.restarted:
            self._gate.forget()
            self._unit.restart()
            out.append(DeviceEvent("restart", f"device clock restarted at {first.ticks} ticks"))

        out += _gap(step.lost)
        if first is not group:
            self._sample(first, out)
            out += _gap(step.lost_since)
        self._sample(group, out)

    def _drop_held(self, out: list[Decoded]) -> None:
        """Discard a group that no later group confirmed."""
        held, self._held = self._held, None
        if held is not None:
            # The norm is checked, because a wrong byte order also makes time and counter jump.
            self._gate.admit(_native(held))
            self._check_norm(out)
            self._refuse("counter and time disagree with the other messages", out)

    def _sample(self, group: XcdiGroup, out: list[Decoded]) -> None:
        """Append the sample of an accepted group."""
        ticks = group.ticks

        native = _native(group)
        q = self._gate.admit(native)
        if q is None:
            self._refuse("quaternion norm is not 1", out)
            self._check_norm(out)
            return

        if ticks is None:
            if self._xcdi.ungrouped == _TIMELESS and not self._timed:
                out += self._once("warning", "timeless", _NO_TIME)
        else:
            self._measure(ticks, group, out)
        out.append(ImuSample(group.t_ns, q, native, ticks, group.counter, group.status))

    def _measure(self, ticks: int, group: XcdiGroup, out: list[Decoded]) -> None:
        """Determine or correct the unit of SampleTime, or check the configured unit."""
        self._timed += 1
        tick_ns = self._unit.feed(ticks, group.counter, group.t_ns)

        rate = self._unit.ticks_per_s
        if tick_ns is None:
            if self._timed == _UNDECIDED and rate is not None:
                known = "10 000 or 1 000 000: set `sample_time_unit`"
                text = f"SampleTime counts {rate:.4g} ticks a second, expected {known}"
                out += self._once("warning", "unit", text)
            return

        before, self._measured_ns = self._measured_ns, tick_ns
        if before == tick_ns:
            return
        name = next(key for key, value in TICK_NS.items() if value == tick_ns)
        if self._configured is not None:
            if self._configured != tick_ns:
                counts = f"SampleTime counts {rate:.4g} ticks a second"
                text = f"{counts}: set `sample_time_unit` = {name!r}"
                out += self._once("warning", "unit", text)
                return
            self._reported_topics.discard("unit")

        self.tick_clock = TickClock(tick_ns, TICKS_MODULUS)
        data = {"sample_time_unit": name, "ticks_per_s": rate}
        text = f"SampleTime counts in {name}"
        if before is not None:
            text += ": corrected from arrivals; check `rate_hz`"
        out.append(DeviceEvent("info", text, data))

    def _check_norm(self, out: list[Decoded]) -> None:
        norm = self._gate.misconfigured_norm
        if norm is not None:
            text = f"median quaternion norm is {norm:.4g}, expected 1: change `byte_order`"
            out += self._once("warning", "norm", text, {"median_norm": norm})

    def _once(
        self, kind: DeviceEventKind, topic: str, text: str, data: dict[str, object] | None = None
    ) -> list[Decoded]:
        if topic in self._reported_topics:
            return []
        self._reported_topics.add(topic)
        return [DeviceEvent(kind, text, data or {})]

    def _refuse(self, reason: str, out: list[Decoded]) -> None:
        """Discard the quaternion frame that was just decoded."""
        self._refused += 1
        out.append(self._bus.discard(can.RECORD_BYTES, reason, rejected=1))


def _gap(lost: int) -> list[Decoded]:
    return [DeviceEvent("gap", f"{lost} groups lost", {"lost": lost})] if lost else []


def _native(group: XcdiGroup) -> Quaternion:
    a, b, c, d = group.quaternion
    s = QUATERNION_SCALE
    return (a * s, b * s, c * s, d * s)


_NO_TIME = (
    f"{_TIMELESS} quaternions without SampleTime: samples are stamped on arrival; set "
    "`ids.sample_time`, or switch the output on with Xsens MT Manager over the sensor's UART"
)
_OVERFLOWED = "its output buffer overflowed, frames are lost: lower its rate or raise the bit rate"
_SHARED = (
    "counters and times contradict each other: two sensors use the same CAN identifiers, so "
    "none of their samples is used: give each sensor identifiers of its own with Xsens MT Manager "
    "over the sensor's UART, and set `ids`"
)
