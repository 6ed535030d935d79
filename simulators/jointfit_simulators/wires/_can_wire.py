"""Virtual CAN wires: an SLCAN adapter on a pseudo-terminal (pty), and python-can buses.

Several devices share one wire. Each device may call ``run``, and one of the calls serves the wire.

Invariant: frames sent while the host has not opened the bus are lost.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

import can

from jointfit_daemon.units import NS_PER_MS
from jointfit_protocols.can.slcan import (
    BITRATES,
    DONE,
    REFUSED,
    SlcanCodec,
    SlcanLine,
    encode_frame,
)
from jointfit_simulators.imu_device import clean_wire
from jointfit_simulators.wires._pty_line import PtyLine

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from jointfit_protocols.can import CanFrame
    from jointfit_simulators.imu_device import WireNoise

_ANSWERS = {"V": b"V1013\r", "v": b"v0100\r", "N": b"NA123\r", "F": b"F00\r", "": DONE}
"""Answers to queries of version, serial number and status flags, and to an empty line."""


class CanWire(Protocol):
    """CAN bus to which a device is connected."""

    bitrate: int | None
    """Bit rate that determines the transmission time of a frame, bit/s; None for no delay."""

    @property
    def is_open(self) -> bool:
        """Whether the host receives, as far as the wire can detect it."""

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Send `frames`; return whether all were sent."""

    async def run(self) -> None:
        """Run the bus until cancelled."""

    def unplug(self) -> None:
        """Disconnect the wire; do nothing if it is disconnected."""

    def plug(self) -> None:
        """Connect the wire."""


class SlcanAdapter:
    """SLCAN adapter whose serial port is a pseudo-terminal (pty).

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    wire_noise
        Noise applied to each write on the serial line.
    bus_bitrate
        Bit rate of the sensors, bit/s. At another rate, the host receives nothing. None accepts any
        rate.
    mute
        Whether the adapter executes commands without an answer, as some adapters do.
    """

    def __init__(
        self,
        link: Path,
        *,
        wire_noise: WireNoise = clean_wire,
        bus_bitrate: int | None = None,
        mute: bool = False,
    ) -> None:
        self._line = PtyLine(link)
        self._noise, self._bus_bitrate, self._mute = wire_noise, bus_bitrate, mute
        self._decoder = SlcanCodec(115_200, "adapter")
        self._serving = asyncio.Lock()
        self.is_open = False
        """Whether the host has opened the bus."""
        self._stamping = False
        self.bitrate: int | None = None
        """Bit rate that the host has set, bit/s."""

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Send all `frames` to the host or none; return whether they were sent."""
        if not self.is_open or self._bus_bitrate not in {None, self.bitrate}:
            return False
        stamp = time.monotonic_ns() // NS_PER_MS if self._stamping else None
        return self._line.write(self._noise(b"".join(encode_frame(f, stamp) for f in frames)))

    async def run(self) -> None:
        """Serve the adapter until cancelled; wait while another device serves it."""
        async with self._serving:
            await self._line.serve(self._receive)

    def unplug(self) -> None:
        """Disconnect the adapter, which then loses power and its settings."""
        self._line.unplug()
        self.is_open = self._stamping = False
        self.bitrate = None

    def plug(self) -> None:
        """Connect the adapter."""
        self._line.plug()

    def _receive(self, data: bytes) -> None:
        for item in self._decoder.feed(data, 0):
            answer = self._execute(item) if isinstance(item, SlcanLine) else REFUSED
            if not self._mute:
                self._line.write(self._noise(answer))

    def _execute(self, line: SlcanLine) -> bytes:
        """Execute a command and return the answer."""
        if line.letter in _ANSWERS:
            return _ANSWERS[line.letter]

        if line.letter == "S" and not self.is_open and line.argument in set("012345678"):
            self.bitrate = BITRATES[int(line.argument)]
        elif line.letter == "Z" and not self.is_open and line.argument in {"0", "1"}:
            self._stamping = line.argument == "1"
        elif line.letter in "OL" and not self.is_open and self.bitrate is not None:
            self.is_open = True
        elif line.letter == "C" and self.is_open:
            self.is_open = False
        else:
            return REFUSED
        return DONE


class PythonCanWire:
    """Bus of python-can: ``socketcan``, or ``virtual`` within one process.

    Parameters
    ----------
    interface, channel
        Names of interface and channel in python-can.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._interface, self._channel = interface, channel
        self._bus: can.BusABC | None = None
        self.bitrate: int | None = None
        self.plug()

    @property
    def is_open(self) -> bool:
        """Whether the wire is connected; receivers on a bus cannot be detected."""
        return self._bus is not None

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Send `frames`; return False if the bus is missing, down or full."""
        if self._bus is None:
            return False

        try:
            for frame in frames:
                message = can.Message(
                    arbitration_id=frame.can_id,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                    data=frame.data,
                )
                self._bus.send(message, timeout=0)
        except (can.CanError, OSError):
            return False
        return True

    async def run(self) -> None:
        """Wait until cancelled, because the devices on this bus receive nothing."""
        await asyncio.get_running_loop().create_future()

    def unplug(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(can.CanError, OSError):
                bus.shutdown()

    def plug(self) -> None:
        """Open the bus."""
        if self._bus is None:
            self._bus = can.Bus(
                interface=self._interface, channel=self._channel, ignore_config=True
            )
