"""The ``[[imu]]`` table of an LPMS sensor on a serial port or USB."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field
from typing_extensions import override

from jointfit_drivers.lpms._convention_settings import LpmsConventionSettings
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_protocols.lpms import OVERHEAD
from jointfit_protocols.lpms.configuration import TABLES, CommandTable
from jointfit_protocols.lpms.measurement import PacketLayout

if TYPE_CHECKING:
    from collections.abc import Iterator


class LpmsSettings(SerialImuSettings, LpmsConventionSettings):
    """One LP-Research LPMS sensor on a serial port or USB."""

    generation: Literal[1, 3] = Field(
        description="1: B2, CU2, URS2, CURS2, AL2, ME1; 3: LPMS3, IG1, BE1, NAV3. A read "
        "command of one generation erases the settings of the other",
    )
    sensor_id: int = Field(1, ge=0, le=65535, description="address of the sensor in its messages")
    precision: Literal["float32", "int16"] = Field(
        "float32", description="format of the data that the driver sets in the sensor"
    )
    persist: bool = Field(
        False,
        description="store changed settings in the sensor's flash; otherwise they last until the "
        "sensor loses power",
    )
    tick_hz: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="ticks of the sensor's time per second; default: 400 for generation 1, 500 for "
        "generation 3. A wrong value is reported",
    )
    device_time: Literal["auto", "ticks", "seconds"] = Field(
        "auto",
        description="format of the sensor's time; auto: seconds for generation 1 with firmware up "
        "to 1.3.4, otherwise ticks",
    )

    @property
    def table(self) -> CommandTable:
        """Commands of the configured generation."""
        return TABLES[self.generation]

    @property
    def ticks_per_s(self) -> int:
        """Number of ticks of device time per second."""
        return self.tick_hz or self.table.tick_hz

    @property
    def data_bytes(self) -> int:
        """Size of a data packet including its framing, bytes."""
        sizes = PacketLayout(self.table, self.table.quaternion).sizes
        return sizes[self.precision == "int16"] + OVERHEAD

    @property
    @override
    def serial_bits_per_s(self) -> float | None:
        return None if self.line_baud is None else self.rate_hz * 10 * self.data_bytes

    @override
    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield a rate that the generation does not support, or that exceeds the tick rate."""
        known: Any = (self.generation, self.rate_hz)  # None: key cannot be read
        if None in known:
            return
        rates = self.table.rates_hz
        if self.rate_hz not in rates:
            listed = ", ".join(map(str, rates))
            yield "rate_hz", f"generation {self.generation} has {listed} Hz, not {self.rate_hz:g}"
        elif self.rate_hz > self.ticks_per_s:
            yield (
                "rate_hz",
                f"{self.rate_hz:g} Hz exceeds {self.ticks_per_s} ticks of device time per second: "
                "lower `rate_hz`, or set `tick_hz` to the tick rate of the sensor",
            )
