"""Decoder of the mode UART-SHTP: converts rotation vectors or raw readings to samples.

Reports have an 8-bit number and no absolute time. A packet contains the time between measurement
and transmission. The stamp of a sample is the arrival of the first byte of its packet minus that
time. Packets have no checksum. The decoder therefore rejects packets with an impossible length or
content, and quaternions whose norm is not 1.

Invariant: the output depends only on the chunks fed; the decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.gateway_orientation import RawReading, RawStamp
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.refusals import Refusals
from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_protocols.bno085 import (
    ACCURACY,
    MOST_PAYLOAD,
    ROTATION_REPORTS,
    TICK_NS,
    HubReport,
    HubReportId,
    ShtpBufferStatus,
    ShtpChannel,
    ShtpCodec,
    ShtpPacket,
    base_time,
    decode_firmware,
    decode_gyro_rotations,
    decode_interval,
    decode_report,
    split_reports,
    unknown_report,
)
from jointfit_protocols.orientation import OrientationGate

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, Vector
    from jointfit_drivers.gateway_orientation import RawSamples

_COUNTS = 256
_MOST_LOST = 128
"""Smallest step of the report number, modulo 256, that counts as a decrease."""
_OLDEST = 10_000
"""Largest age of a measurement at transmission, in units of 100 us. A measurement with a larger age
is corrupt."""
_RESET_COMPLETE = b"\x01"
_PERIOD_COUNTS = 200
"""Number of readings after which their measured period replaces the nominal period."""
_STALE_COUNTS = 2
"""Largest number of gyroscope readings for which one acceleration is used."""
_SATURATED = 32_760
"""Smallest absolute raw value of a gyroscope or accelerometer that is out of range, counts."""
_NEWEST = NewestKnown((3,), "the host that configures the device")
"""Newest version of the SH-2 software that the reference manual describes."""
_CHANNELS = frozenset(map(int, ShtpChannel))
_RATE_COUNT, _FORCE_COUNT = 2.0**-9, 2.0**-8


class ShtpDecoder(SerialMessageDecoder[ShtpPacket | ShtpBufferStatus]):
    """Decoder of one device in the mode UART-SHTP.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    raw : RawSamples, optional
        Filter that computes orientations from raw readings; None if the device sends rotation
        vectors.
    preferred : int
        Kind of rotation vector that is used if the device sends several kinds. Their headings
        differ. Until this kind arrives, the kind that arrived first is used.
    """

    tick_clock = None  # reports have an age, but no time

    def __init__(
        self,
        baud: int | None,
        raw: RawSamples | None = None,
        preferred: int = HubReportId.ROTATION_VECTOR,
    ) -> None:
        super().__init__(ShtpCodec(), Refusals(), baud, MOST_PAYLOAD)
        self._gate, self._raw = OrientationGate(), raw
        self._preferred, self._selected = preferred, 0
        self._arrival_ns = 0
        self._sequences: dict[int, int] = {}
        self._measuring = False
        self._newer = NewerFirmwareDetector(_NEWEST)
        self._accuracy: int | None = None
        self._force: HubReport | None = None
        self._field: HubReport | None = None
        self._force_age = 0
        self._reading_ns = self._readings = self._first_ns = 0

    @override
    def _take(  # noqa: PLR0911 - one return for each channel
        self, message: ShtpPacket | ShtpBufferStatus
    ) -> list[Decoded]:
        if isinstance(message, ShtpBufferStatus):
            return []
        channel = message.channel
        if channel == ShtpChannel.EXECUTABLE:
            return self._reset() if message.payload == _RESET_COMPLETE else []
        if channel == ShtpChannel.GYRO_ROTATION:
            return self._gyro_rotations(message)
        if channel not in {ShtpChannel.CONTROL, ShtpChannel.INPUT, ShtpChannel.WAKE_INPUT}:
            content, known = f"packets on channel {channel}", channel in _CHANNELS
            return [] if known else self._newer.take_unknown(content, self._stamps.chunk_ns)
        reports = split_reports(message.payload)
        if reports is None:
            kind, out = unknown_report(message.payload), []
            if kind is not None:
                out = self._newer.take_unknown(f"reports 0x{kind:02X}", self._stamps.chunk_ns)
            return [
                *out, self._refusals.refuse(message.size - 2, "reports do not fill the packet")
            ]  # fmt: skip
        if channel == ShtpChannel.CONTROL:
            return [event for report in reports for event in self._device_events(report)]
        return self._reports(message, reports)

    def _device_events(self, report: bytes) -> list[Decoded]:
        """Return the events of a reply, and a warning if the firmware is newer than supported."""
        events = _device_events(report)
        firmware = decode_firmware(report)
        if firmware is None:
            return events
        return events + self._newer.take_version(".".join(map(str, firmware[0])))

    def _reports(self, packet: ShtpPacket, reports: list[bytes]) -> list[Decoded]:
        """Return the samples and events of a packet of measurements."""
        out: list[Decoded] = []
        base = 0
        sent_ns = self._arrival_of(packet)
        for data in reports:
            shift = base_time(data)
            if shift is not None:
                base += shift
                continue
            report = decode_report(data)
            if report is None:
                continue
            age = -(base + report.delay)
            if not -_OLDEST <= age <= _OLDEST:
                return [*out, self._refusals.refuse(packet.size - 2, "time out of range")]

            # A report may follow a later measurement of another sensor, but stamps must never
            # decrease.
            self._arrival_ns = max(self._arrival_ns, sent_ns - max(age, 0) * TICK_NS)
            if self._raw is not None:
                out += self._reading(report, self._raw)
            elif report.report_id in ROTATION_REPORTS and self._selects(report.report_id):
                out += self._orientation(packet, report)
        return out

    def _orientation(self, packet: ShtpPacket, report: HubReport) -> list[Decoded]:
        """Return the sample and the events of a rotation vector.

        The device sends the components in the order i, j, k, real.
        """
        i, j, k, real = report.values[:4]
        native = (real, i, j, k)
        q = self._gate.admit(native)
        if q is None:
            return [self._refusals.refuse(packet.size - 2, "quaternion norm is not 1")]
        _, out = self._step(report)
        self._measuring = True
        counter, status = report.sequence, report.status
        if status != self._accuracy:
            self._accuracy = status
            name = ACCURACY[status]
            text = f"accuracy of the orientation: {name}"
            out.append(DeviceEvent("info", text, {"accuracy": name}))
        out.append(ImuSample(self._arrival_ns, q, native, None, counter, status))
        return out

    def _gyro_rotations(self, packet: ShtpPacket) -> list[Decoded]:
        """Return the samples of gyro rotation vectors, which have neither number nor age."""
        kind = HubReportId.GYRO_ROTATION_VECTOR
        found = decode_gyro_rotations(packet.payload)
        if found is None:
            return [self._refusals.refuse(packet.size - 2, "reports do not fill the packet")]
        if self._raw is not None or not self._selects(kind):
            return []

        self._arrival_ns = max(self._arrival_ns, self._arrival_of(packet))
        out: list[Decoded] = []
        for values in found:
            i, j, k, real, *rate = values
            native = (real, i, j, k)
            q = self._gate.admit(native)
            if q is None:
                return [*out, self._refusals.refuse(packet.size - 2, "quaternion norm is not 1")]
            out += self._step(HubReport(kind, packet.sequence, 0, 0, values))[1]
            self._measuring = True
            turn = (rate[0], rate[1], rate[2])
            out.append(ImuSample(self._arrival_ns, q, native, None, packet.sequence, rate=turn))
        return out

    def _selects(self, kind: int) -> bool:
        """Return whether rotation vectors of this kind are used."""
        if kind == self._preferred or not self._selected:
            self._selected = kind
        return kind == self._selected

    def _step(self, report: HubReport) -> tuple[int, list[Decoded]]:
        """Return the increase of the report number, and an event if reports were lost.

        A decrease of the number counts as an increase by 1.
        """
        last = self._sequences.get(report.report_id)
        self._sequences[report.report_id] = report.sequence
        step = 1 if last is None else (report.sequence - last) % _COUNTS
        if not 1 < step < _MOST_LOST:
            return min(step, 1), []
        lost = step - 1
        return step, [DeviceEvent("gap", f"{lost} messages lost", {"lost": lost})]

    def _reading(self, report: HubReport, raw: RawSamples) -> list[Decoded]:
        """Add a raw reading; return the samples and events that a gyroscope reading completes."""
        kind = report.report_id
        if kind == HubReportId.ACCELEROMETER:
            self._force, self._force_age = report, 0
        elif kind == HubReportId.MAGNETIC_FIELD:
            self._field = report
        if kind != HubReportId.GYROSCOPE_UNCALIBRATED:
            return []

        step, out = self._step(report)
        self._force_age += step
        if step == 0 or self._force is None or self._force_age > _STALE_COUNTS:
            return out
        self._measuring = True
        reading = RawReading(
            self._time_of_reading(step, raw.period_ns),
            _vector(report),
            _vector(self._force),
            _vector(self._field) if raw.magnetometer and self._field is not None else None,
        )
        clipped = any(abs(v) >= _SATURATED * _RATE_COUNT for v in reading.rate)
        clipped |= any(abs(v) >= _SATURATED * _FORCE_COUNT for v in reading.force)
        stamp = RawStamp(self._arrival_ns, None, report.sequence, report.status)
        return out + raw.take(stamp, reading, clipped=clipped)

    def _time_of_reading(self, step: int, nominal_ns: float) -> int:
        """Return the time since the first reading, ns. It advances by the mean period per reading.

        The device has no clock, so the period is computed from the arrivals since the first
        reading. The first `_PERIOD_COUNTS` readings use the nominal period.
        """
        if self._readings == 0:
            self._first_ns, self._readings = self._arrival_ns, 1
            return 0
        self._readings += step
        period_ns = nominal_ns
        if self._readings > _PERIOD_COUNTS:
            period_ns = (self._arrival_ns - self._first_ns) / (self._readings - 1)
        self._reading_ns += max(1, round(step * period_ns))
        return self._reading_ns

    def _reset(self) -> list[Decoded]:
        """Return a restart event if the device measured before the reset."""
        self._gate.forget()
        self._sequences.clear()
        self._accuracy = None
        if not self._measuring:
            return []
        self._measuring = False
        return [DeviceEvent("restart", "device restarted: it lost its settings")]


def _vector(report: HubReport) -> Vector:
    x, y, z = report.values[:3]
    return (x, y, z)


def _device_events(report: bytes) -> list[Decoded]:
    """Return the events of a reply."""
    firmware = decode_firmware(report)
    if firmware is not None:
        version, part, build = firmware
        known: dict[str, object] = {
            "firmware": ".".join(map(str, version)), "part_number": part, "build": build,
        }  # fmt: skip
        text = ", ".join(f"{key} {value}" for key, value in known.items())
        return [DeviceEvent("info", text, known)]
    interval = decode_interval(report)
    if interval is None or not interval[1]:
        return []
    kind, interval_us = interval
    text = f"report 0x{kind:02X} every {interval_us} us"
    return [DeviceEvent("info", text, {f"report_0x{kind:02X}_us": interval_us})]
