"""Common parts of drivers for IMUs on a serial line.

The module contains the keys of the connection, the stamps of messages, and configuration errors.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from jointfit_daemon.driver import (
    FASTEST_BAUD,
    SLOWEST_BAUD,
    DeviceLostError,
    DeviceMisconfiguredError,
    ImuSettings,
    port_path_fault,
)

_BITS = 10
"""Number of bits of one byte on the line (8N1)."""
_SILENCE_FLOOR_NS = 250_000_000
"""Smallest silence after which an incomplete message is discarded, ns.

At high line speed, the duration of 1.5 messages is so short that a delayed read by the host would
look like silence.
"""
_PERIODS_OF_SILENCE = 3
"""Smallest number of sample periods without data after which a device counts as lost. A device may
send nothing for two periods."""
_RATE_TOLERANCE = 1e-3
"""Largest relative difference between the configured rate and a rate that the device offers."""
_RATES_SHOWN = 12
"""Largest number of rates in one error message."""


class SerialImuSettings(ImuSettings):
    """Connection of an IMU on a serial port or USB."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(
        115_200, ge=SLOWEST_BAUD, le=FASTEST_BAUD, description="line speed of the device, baud"
    )
    transport: Literal["uart", "usb"] = Field(
        "uart",
        description="`uart`: a line at `baud`, also behind a USB bridge; stamps are back-dated by "
        "the duration of the received bytes. `usb`: the device's own USB port, where bytes have "
        "no duration",
    )

    @property
    def line_baud(self) -> int | None:
        """Line speed that determines the duration of bytes, baud; None for USB."""
        return self.baud if self.transport == "uart" else None

    @property
    def lost_after_s(self) -> float:
        """Time without a byte after which the device counts as lost, s."""
        return max(self.silence_s, _PERIODS_OF_SILENCE / self.rate_hz)

    def require_line_speed(self, speed: str = "the speed of the device") -> None:
        """Raise DeviceMisconfiguredError if the data need more bits per second than `baud`.

        In the error message, `speed` is the name of the device setting that corresponds to `baud`.
        """
        needs = self.serial_bits_per_s
        if needs is not None and needs > self.baud:
            raise DeviceMisconfiguredError(
                f"{self.port}: {self.rate_hz:g} Hz need {needs:g} bit/s, baud = {self.baud}: "
                f"lower `rate_hz`, or raise {speed} and `baud`"
            )

    def rate_divisor(self, base_hz: int, model: str) -> int:
        """Return the integer by which the device divides `base_hz` to send at `rate_hz`.

        In the error message, `model` is the name of the device.

        Raises
        ------
        DeviceMisconfiguredError
            `base_hz / rate_hz` is not an integer.
        """
        divisor = round(base_hz / self.rate_hz)
        if divisor < 1 or abs(base_hz / divisor - self.rate_hz) > _RATE_TOLERANCE * self.rate_hz:
            rates = [base_hz / k for k in range(1, base_hz + 1) if base_hz % k == 0]
            shown = ", ".join(f"{rate:g}" for rate in rates[:_RATES_SHOWN])
            raise DeviceMisconfiguredError(
                f"{self.port}: {self.rate_hz:g} Hz is not the {base_hz} Hz of {model} "
                f"divided by an integer: set rate_hz to one of {shown}"
            )
        return divisor

    def stopped_answering(self) -> DeviceLostError:
        """Return the error for a device that stopped answering during its configuration."""
        return DeviceLostError(
            f"{self.port}: the device stopped answering during configuration: check its power and "
            "cable"
        )

    @field_validator("port")
    @classmethod
    def _port_with_a_name(cls, port: str) -> str:
        if (fault := port_path_fault(port)) is not None:
            raise ValueError(fault)
        return port


class ArrivalStamps:
    """Computes the arrival of the first byte of each message on a serial line.

    The stamp is the arrival of the chunk minus the duration of the message and of all later bytes
    in the chunk, at ten bits per byte.

    Parameters
    ----------
    baud : int, optional
        Line speed, bit/s; None for USB, because its bytes arrive together.
    most_bytes : int
        Size of the largest message, bytes.
    """

    def __init__(self, baud: int | None, most_bytes: int) -> None:
        self._byte_ns = 0.0 if baud is None else _BITS * 1e9 / baud
        self._silence_ns = max(1.5 * most_bytes * self._byte_ns, _SILENCE_FLOOR_NS)
        self.chunk_ns = 0
        """Arrival of the current chunk, monotonic ns."""
        self._stamp_ns = 0

    def is_silent_before(self, t_ns: int, size: int) -> bool:
        """Return whether the silence before a chunk shows that the rest of a message was lost.

        `t_ns` is the arrival of the chunk, and `size` is its number of bytes.
        """
        return t_ns - self.chunk_ns - size * self._byte_ns > self._silence_ns

    def start_chunk(self, t_ns: int) -> None:
        """Compute later stamps relative to a chunk that arrived at `t_ns`."""
        self.chunk_ns = t_ns

    def stamp(self, bytes_since: int) -> int:
        """Return the arrival of a byte `bytes_since` bytes before the chunk's end, monotonic ns.

        A stamp is never earlier than the previous stamp. Otherwise USB devices and pseudoterminals,
        which are faster than `baud`, would have decreasing stamps.
        """
        at_ns = self.chunk_ns - round(bytes_since * self._byte_ns)
        self._stamp_ns = max(self._stamp_ns, at_ns)
        return self._stamp_ns
