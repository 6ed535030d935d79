"""Interface of a virtual IMU, independent of the transport.

A device answers the handshake of its driver, and encodes the orientations passed to
`ImuDevice.push`. All devices thus send the same simulated motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

WireNoise = Callable[[bytes], bytes]
"""Function that is applied to the bytes sent to the host. The identity is a line without noise."""

Quaternion = tuple[float, float, float, float]
"""Hamilton unit quaternion (w, x, y, z), from sensor coordinates to world coordinates (ENU, z up).
"""


def clean_wire(data: bytes) -> bytes:
    """Return `data` unchanged, as a wire without noise."""
    return data


class ImuDevice(Protocol):
    """A virtual IMU on a wire."""

    @property
    def streaming(self) -> bool:
        """Whether the device is in measurement mode; on CAN, whether its bus is open."""

    @property
    def rate_hz(self) -> float:
        """Sample rate, Hz, which the host or the constructor has set."""

    @property
    def sent(self) -> int:
        """Number of complete samples that were written to the wire."""

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Encode one sample and send it now.

        Parameters
        ----------
        device_ns
            Time of the device clock since power-up, ns. The device converts it to ticks.
        q_world_sensor
            Unit quaternion from the sensor to the sensor's own world (ENU).

        Notes
        -----
        A device that does not stream sends nothing. If the wire is full (no reader), the whole
        sample is lost and not counted as sent.
        """

    async def run(self) -> None:
        """Answer the handshake of the driver until cancelled."""
