"""The ``[[imu]]`` table of a BNO085."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field
from typing_extensions import override

from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_protocols.bno085 import RVC_BYTES, HubReportId

if TYPE_CHECKING:
    from collections.abc import Iterable

RVC_BAUD, SHTP_BAUD = 115_200, 3_000_000
"""Line speeds of the modes UART-RVC and UART-SHTP, bit/s. The pins PS0 and PS1 select the mode."""
RVC_HZ = 100
"""Output rate of the mode UART-RVC, Hz."""
MAX_RATE_HZ = 400
"""Highest rate of rotation vectors, Hz."""
_BITS = 10
_PACKET_BYTES = 31
"""Length, bytes, of a packet with base time, rotation vector, flags and some escape bytes."""
_REPORTS = {
    "rotation_vector": HubReportId.ROTATION_VECTOR,
    "game_rotation_vector": HubReportId.GAME_ROTATION_VECTOR,
    "arvr_rotation_vector": HubReportId.ARVR_ROTATION_VECTOR,
    "arvr_game_rotation_vector": HubReportId.ARVR_GAME_ROTATION_VECTOR,
    "gyro_rotation_vector": HubReportId.GYRO_ROTATION_VECTOR,
}


class Bno085Settings(SerialImuSettings, GatewaySettings):
    """One BNO085 or BNO086; `baud` = 115200 is UART-RVC, 3000000 is UART-SHTP."""

    report: Literal[
        "rotation_vector", "game_rotation_vector", "arvr_rotation_vector",
        "arvr_game_rotation_vector", "gyro_rotation_vector",
    ] = Field(
        "rotation_vector",
        description="orientation that UART-SHTP sends; `game`: without magnetometer, the heading "
        "drifts; `arvr`: gradual corrections during motion; `gyro`: with rates of turn and the "
        "shortest delay",
    )  # fmt: skip
    euler: Literal["zxy", "zyx"] = Field(
        "zxy",
        description="axes of yaw, pitch and roll in UART-RVC; accelerations that contradict them "
        "are reported",
    )

    @property
    def reports(self) -> tuple[HubReportId, ...]:
        """Ids of the reports that one sample consists of in UART-SHTP."""
        if self.orientation == "device":
            return (_REPORTS[self.report],)
        # The gyroscope report is last, because it completes a sample.
        field = (HubReportId.MAGNETIC_FIELD,) if self.magnetometer else ()
        return (HubReportId.ACCELEROMETER, *field, HubReportId.GYROSCOPE_UNCALIBRATED)

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        if self.transport == "usb":
            return None
        size = RVC_BYTES if self.baud == RVC_BAUD else _PACKET_BYTES * len(self.reports)
        return self.rate_hz * _BITS * size

    @override
    def contradictions(self) -> Iterable[tuple[str, str]]:
        if self.baud not in {RVC_BAUD, SHTP_BAUD, None}:
            yield (
                "baud",
                f"{self.baud} is no speed of a BNO085: expected {RVC_BAUD} (UART-RVC) or "
                f"{SHTP_BAUD} (UART-SHTP), as its pins PS0 and PS1 select",
            )
        if self.baud == RVC_BAUD and self.rate_hz not in {RVC_HZ, None}:
            yield "rate_hz", f"UART-RVC sends {RVC_HZ} Hz: set rate_hz = {RVC_HZ}"
        if self.baud == RVC_BAUD and self.orientation == "gateway":
            yield (
                "orientation",
                f"UART-RVC sends no rates of turn: connect UART-SHTP (baud = {SHTP_BAUD})",
            )
        if (self.rate_hz or 0) > MAX_RATE_HZ:
            yield "rate_hz", f"expected at most {MAX_RATE_HZ} Hz, found {self.rate_hz:g}"
