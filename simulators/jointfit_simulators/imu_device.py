"""Protocol class of a virtual IMU, independent of the transport.

A device answers its handshake and encodes the orientations passed to `ImuDevice.push`. All
protocols thus send the same simulated motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

WireNoise = Callable[[bytes], bytes]
"""Function applied to the bytes sent to the host; the identity is a line without noise."""

Quaternion = tuple[float, float, float, float]
"""Hamilton unit quaternion (w, x, y, z), sensor coordinates to world coordinates (ENU, z up)."""


def clean_wire(data: bytes) -> bytes:
    """Return `data` as it is: a wire without noise."""
    return data


class ImuDevice(Protocol):
    """A virtual IMU on a wire."""

    @property
    def streaming(self) -> bool:
        """Whether the device was told to measure (on CAN: its bus is open)."""

    @property
    def rate_hz(self) -> float:
        """Samples per second, as the host's handshake (or the constructor) configured it."""

    @property
    def sent(self) -> int:
        """Samples written to the wire so far, whole."""

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Encode one sample and put it on the wire now.

        Parameters
        ----------
        device_ns
            The device's own clock, ns since its power-up; turned into its ticks here.
        q_world_sensor
            Unit quaternion, sensor to the sensor's own world (ENU).

        Notes
        -----
        A device that does not stream counts the sample as produced but sends nothing. Where the
        wire is full (nobody reads) the sample is lost whole and does not count as sent.
        """

    async def run(self) -> None:
        """Serve until cancelled: answer the handshake."""
