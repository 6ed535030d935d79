"""Virtual BNO085 on a pseudo-terminal (pty), in the modes UART-RVC and UART-SHTP.

Invariants: in mode UART-RVC, the device sends from power-up and ignores the host. In mode
UART-SHTP, the device sends an advertisement after a reset. It sends a report only after the host
has set the interval of this report. A reset clears the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2, degrees
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.units import STANDARD_GRAVITY
from jointfit_protocols.bno085 import (
    ROTATION_REPORTS,
    HubReport,
    HubReportId,
    RvcFrame,
    ShtpChannel,
    ShtpCodec,
    ShtpPacket,
    encode_base_time,
    encode_feature,
    encode_firmware,
    encode_gyro_rotation,
    encode_report,
    encode_rvc,
    encode_shtp,
    encode_status,
)
from jointfit_protocols.bno085 import ShtpBufferStatus as _Status
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices._device_wire import SerialDevice
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg
from jointfit_simulators.imu_device import clean_wire

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Literal

    from jointfit_simulators.imu_device import Quaternion, WireNoise

_AGE = 12
"""Time between measurement and transmission, in units of 100 us."""
_MICROTESLA = 50.0
"""Magnitude of the magnetic field, uT."""
_ADVERTISEMENT = bytes.fromhex("00010400000000800653482d322e3000")
"""Part of an advertisement, with version and application names."""
_FASTEST_US = 2500
_RVC_BAUD, _SHTP_BAUD = 115_200, 3_000_000
_ITEMS = {
    HubReportId.ACCELEROMETER: Item.ACCELERATION,
    HubReportId.GYROSCOPE_UNCALIBRATED: Item.RATE_OF_TURN,
    HubReportId.GYROSCOPE: Item.RATE_OF_TURN,
    HubReportId.MAGNETIC_FIELD: Item.MAGNETIC_FIELD,
}


@dataclass(frozen=True, slots=True)
class Bno085DeviceOptions:
    """Mode and faults of a device."""

    mode: Literal["rvc", "shtp"] = "shtp"
    euler: Literal["zxy", "zyx"] = "zxy"
    """Axis order of yaw, pitch and roll in UART-RVC."""
    checks_speed: bool = False
    """Whether a host at another line speed receives invalid bytes."""
    least_interval_us: int = _FASTEST_US
    """Shortest report interval, us. It replaces a shorter requested interval."""
    accuracy: int = 3
    firmware: tuple[int, int, int] = (3, 12, 4)


class Bno085Device(SerialDevice):
    """`ImuDevice` on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    options
        Mode and faults.
    wire_noise
        Noise applied to each packet to the host.
    """

    garbage_bits = 0x2A

    def __init__(
        self,
        link: Path,
        *,
        options: Bno085DeviceOptions | None = None,
        wire_noise: WireNoise = clean_wire,
    ) -> None:
        self._options = options or Bno085DeviceOptions()
        super().__init__(link, wire_noise)
        self._inertial = InertialSignals()
        self._codec = ShtpCodec()
        self.intervals: dict[int, int] = {}
        """Time interval of each enabled report, us."""
        self._packets: dict[int, int] = {}
        self.counter = 0
        """Number of the next sample. The device sends it modulo 256."""

    # --- control by the simulation ------------------------------------------------------------

    @property
    def streaming(self) -> bool:
        """Whether the device sends samples."""
        return self._options.mode == "rvc" or bool(self.intervals)

    @property
    def rate_hz(self) -> float:
        """Sample rate, Hz; 0 while no report is enabled."""
        if self._options.mode == "rvc":
            return 100.0
        return 1e6 / min(self.intervals.values()) if self.intervals else 0.0

    @property
    @override
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""
        return len(self._sample((1.0, 0.0, 0.0, 0.0)))

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now, as described in `ImuDevice.push`."""
        self._inertial.update(device_ns, q_world_sensor)
        wire = self._sample(q_world_sensor)
        self.counter += 1
        if self._to_lose:
            self._to_lose -= 1
        elif self.streaming and self._write(wire):
            self.sent += 1

    def power_cycle(self) -> None:
        """Interrupt the power supply; settings and sequence numbers are reset."""
        self.intervals.clear()
        self._packets.clear()
        self.counter = 0
        if self._options.mode == "shtp":
            self._send(ShtpChannel.COMMAND, _ADVERTISEMENT)
            self._send(ShtpChannel.EXECUTABLE, b"\x01")

    @override
    async def run(self) -> None:
        """Run the device until cancelled."""
        if self._options.mode == "shtp" and not self.intervals:
            self.power_cycle()
        await super().run()

    # --- requests of the host -----------------------------------------------------------------

    @property
    @override
    def _same_speed(self) -> bool:
        wanted = _RVC_BAUD if self._options.mode == "rvc" else _SHTP_BAUD
        return not self._options.checks_speed or self._line.host_baud == wanted

    @override
    def _receive(self, data: bytes) -> None:
        if self._options.mode == "rvc" or not self._same_speed:
            return
        # The query of the buffer status has no length field, so the codec does not decode it.
        if encode_status(None) in data:
            self._write(encode_status(256))
        for event in self._codec.feed(data):
            if isinstance(event, ShtpPacket) and event.channel == ShtpChannel.CONTROL:
                self._answer(event.payload)
            elif isinstance(event, _Status):
                continue

    def _answer(self, request: bytes) -> None:
        kind = request[0] if request else 0
        if kind == HubReportId.PRODUCT_REQUEST:
            firmware = encode_firmware(self._options.firmware, 10_004_148, 230)
            self._send(ShtpChannel.CONTROL, firmware)
        elif kind == HubReportId.FEATURE_REQUEST:
            self._report_interval(request[1])
        elif kind == HubReportId.SET_FEATURE:
            wanted = int.from_bytes(request[5:9], "little")
            self.intervals[request[1]] = max(wanted, self._options.least_interval_us)
            if not wanted:
                del self.intervals[request[1]]
            self._report_interval(request[1])

    def _report_interval(self, report: int) -> None:
        interval_us = self.intervals.get(report, 0)
        self._send(ShtpChannel.CONTROL, encode_feature(report, interval_us, response=True))

    # --- samples ------------------------------------------------------------------------------

    def _sample(self, q: Quaternion) -> bytes:
        if self._options.mode == "rvc":
            return self._rvc(q)
        wire = b""
        if HubReportId.GYRO_ROTATION_VECTOR in self.intervals:
            w, x, y, z = q
            rate = self._inertial.value(Item.RATE_OF_TURN) or (0.0, 0.0, 0.0)
            values = encode_gyro_rotation((x, y, z, w, *rate))
            wire = self._packet(ShtpChannel.GYRO_ROTATION, values)
        kinds = sorted(self.intervals.keys() - {HubReportId.GYRO_ROTATION_VECTOR})
        if not kinds and wire:
            return wire
        reports = [self._report(kind, q) for kind in kinds]
        payload = encode_base_time(_AGE + len(reports)) + b"".join(reports)
        return wire + self._packet(ShtpChannel.INPUT, payload)

    def _report(self, kind: int, q: Quaternion) -> bytes:
        w, x, y, z = q
        values: tuple[float, ...] = (x, y, z, w)
        if kind not in ROTATION_REPORTS:
            values = self._inertial.value(_ITEMS[HubReportId(kind)]) or (0.0, 0.0, 0.0)
            if kind == HubReportId.MAGNETIC_FIELD:
                values = tuple(_MICROTESLA * value for value in values)
            if kind == HubReportId.GYROSCOPE_UNCALIBRATED:
                values = (*values, 0.0, 0.0, 0.0)
        elif kind in {HubReportId.ROTATION_VECTOR, HubReportId.ARVR_ROTATION_VECTOR}:
            values = (*values, 0.05)
        return encode_report(HubReport(kind, self.counter, self._options.accuracy, 1, values))

    def _rvc(self, q: Quaternion) -> bytes:
        yaw, pitch, roll = (round(angle * 100) for angle in euler_deg(q, self._options.euler))
        force = self._inertial.value(Item.ACCELERATION) or (0.0, 0.0, 0.0)
        x, y, z = (round(1000 * value / STANDARD_GRAVITY) for value in force)
        return encode_rvc(RvcFrame(self.counter & 0xFF, (yaw, pitch, roll), (x, y, z)))

    def _packet(self, channel: int, payload: bytes) -> bytes:
        number = self._packets.get(channel, 0)
        self._packets[channel] = number + 1
        return encode_shtp(channel, number, payload)

    def _send(self, channel: int, payload: bytes) -> None:
        self._write(self._packet(channel, payload))


def euler_deg(q: Quaternion, order: Literal["zxy", "zyx"]) -> tuple[float, float, float]:
    """Return yaw, pitch and roll of an orientation, degrees, for an order of the axes."""
    if order == "zyx":
        roll, pitch, yaw = roll_pitch_yaw_deg(q)
        return yaw, pitch, roll
    w, x, y, z = q
    sine = max(-1.0, min(1.0, 2 * (y * z + w * x)))
    yaw = atan2(-2 * (x * y - w * z), 1 - 2 * (x * x + z * z))
    roll = atan2(-2 * (x * z - w * y), 1 - 2 * (x * x + y * y))
    return degrees(yaw), degrees(asin(sine)), degrees(roll)
