"""Wire of a simulated IMU, independent of its protocol: power, losses, wrong speed."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

from jointfit_simulators.imu_device import WireNoise, clean_wire
from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_simulators.wires import CanWire

_BITS = 10
"""Number of bits per byte on a serial line (8N1)."""


class SerialDevice(ABC):
    """Base class of IMUs on a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    wire_noise
        Noise applied to each message to the host.
    baud
        Line speed of the device, bit/s. At another speed, both sides receive invalid bytes. None
        accepts any speed (USB).
    """

    garbage_bits: ClassVar[int] = 0x7F
    """Bit mask of the invalid bytes at a wrong speed. They contain no message."""

    def __init__(
        self, link: Path, wire_noise: WireNoise = clean_wire, baud: int | None = None
    ) -> None:
        self._line = PtyLine(link)
        self._noise = wire_noise
        self.baud = baud
        """Line speed of the device, bit/s; None accepts any speed."""
        self._timer: asyncio.TimerHandle | None = None
        self._epoch_ns = self._last_ns = self._to_lose = 0
        self.sent = 0
        """Number of complete samples written to the wire."""

    @property
    @abstractmethod
    def sample_bytes(self) -> int:
        """Number of bytes of a sample on the wire."""

    @property
    def line_ns(self) -> int:
        """Transmission time of a sample at the speed of the host's port, ns."""
        baud = self._line.host_baud
        return self.sample_bytes * _BITS * 1_000_000_000 // baud if baud else 0

    def edge(self, device_ns: int) -> None:  # noqa: B027 - most devices have no sync input
        """Ignore an edge on the sync input, because no message reports it."""

    def lose(self, count: int) -> None:
        """Lose the next `count` samples, which are numbered but not sent."""
        self._to_lose += count

    def unplug(self) -> None:
        """Disconnect the wire."""
        self._line.unplug()

    def plug(self) -> None:
        """Connect the wire; the device remained powered."""
        self._line.plug()

    async def run(self) -> None:
        """Run the device until cancelled."""

        def receive(data: bytes) -> None:
            self._receive(data if self._same_speed else bytes(byte ^ 0x55 for byte in data))

        try:
            await self._line.serve(receive)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    @abstractmethod
    def _receive(self, data: bytes) -> None:
        """Execute the commands of the host."""

    @property
    def _same_speed(self) -> bool:
        return self.baud in {None, self._line.host_baud}

    def _after(self, delay_s: float, act: Callable[[], None]) -> None:
        """Call `act` after `delay_s` seconds; this call replaces an earlier delayed call."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(delay_s, act)

    def _write(self, wire: bytes) -> bool:
        """Send bytes to the host; return whether all bytes were sent."""
        if not self._same_speed:  # replace each byte by an invalid one
            wire = bytes((byte * 7 + 1) & self.garbage_bits for byte in wire)
        return self._line.write(self._noise(wire))


class CanDevice:
    """Base class of IMUs on a CAN wire.

    Parameters
    ----------
    wire
        CAN bus, which several devices may share.
    """

    def __init__(self, wire: CanWire) -> None:
        self.wire = wire
        self._epoch_ns = self._last_ns = 0
        self.sent = 0
        """Number of complete samples written to the wire."""

    @property
    def streaming(self) -> bool:
        """Whether the bus is open."""
        return self.wire.is_open

    def edge(self, device_ns: int) -> None:
        """Ignore an edge on the sync input, because no message reports it."""

    def unplug(self) -> None:
        """Disconnect the wire."""
        self.wire.unplug()

    def plug(self) -> None:
        """Connect the wire; the device remained powered."""
        self.wire.plug()

    async def run(self) -> None:
        """Run the device until cancelled."""
        await self.wire.run()
