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
    """Return `data` unchanged: a wire without noise."""
    return data


class ImuDevice(Protocol):
    """A virtual IMU on a wire."""

    @property
    def streaming(self) -> bool:
        """Whether the device is in measurement mode (on CAN: whether its bus is open)."""

    @property
    def rate_hz(self) -> float:
        """Samples per second, as configured by the host or the constructor."""

    @property
    def sent(self) -> int:
        """Number of complete samples written to the wire."""

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Encode one sample and send it now.

        Parameters
        ----------
        device_ns
            Time of the device clock since power-up, ns; the device converts it to ticks.
        q_world_sensor
            Unit quaternion, sensor to the sensor's own world (ENU).

        Notes
        -----
        A device that does not stream counts the sample but sends nothing. On a full wire (no
        reader) the whole sample is lost and not counted as sent.
        """

    async def run(self) -> None:
        """Serve until cancelled: answer the handshake."""
