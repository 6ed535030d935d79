"""Virtual CAN wires: an SLCAN adapter on a pty, and python-can buses.

Several devices share one wire. Each may call ``run``; one of them serves the wire.

Invariant: frames sent while the host has not opened the bus are lost.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

import can

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

_NS_PER_MS = 1_000_000


class CanWire(Protocol):
    """A bus as a device sees it."""

    bitrate: int | None
    """Speed of a bus whose frames take their time, bit/s; None: they take none."""

    @property
    def is_open(self) -> bool:
        """Whether somebody listens, as far as the wire can tell."""

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Put `frames` on the bus; whether all of them went out."""

    async def run(self) -> None:
        """Serve until cancelled."""

    def unplug(self) -> None:
        """Take the wire away; again it does nothing."""

    def plug(self) -> None:
        """Put it back."""


class SlcanAdapter:
    """An SLCAN adapter with a pty for its serial port.

    Parameters
    ----------
    link
        Where the host finds the port.
    wire_noise
        What the serial line does to what is written at once.
    bus_bitrate
        Speed of the sensors on the bus, bit/s; at another one the host hears nothing. None: any.
    mute
        It obeys and answers nothing, like some cheap adapters.
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
        self._open = self._stamping = False
        self.bitrate: int | None = None
        """What the host set, bit/s."""
        self.received: list[CanFrame] = []
        """Frames the host sent."""

    @property
    def is_open(self) -> bool:
        """Whether the host opened the bus."""
        return self._open

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Pass `frames` to the host, whole or not at all."""
        if not self._open or self._bus_bitrate not in {None, self.bitrate}:
            return False
        stamp = time.monotonic_ns() // _NS_PER_MS if self._stamping else None
        return self._line.write(self._noise(b"".join(encode_frame(f, stamp) for f in frames)))

    def send_bytes(self, data: bytes) -> bool:
        """Write anything at all to the host."""
        return self._line.write(data)

    async def run(self) -> None:
        """Serve until cancelled; while another device serves the adapter, wait to take over."""
        async with self._serving:
            await self._line.serve(self._take)

    def unplug(self) -> None:
        """Pull the adapter out: it loses power and forgets."""
        self._line.unplug()
        self._open = self._stamping = False
        self.bitrate = None

    def plug(self) -> None:
        """Put it back."""
        self._line.plug()

    def _take(self, data: bytes) -> None:
        for item in self._decoder.feed(data, 0):
            answer = self._obey(item) if isinstance(item, SlcanLine) else REFUSED
            if not self._mute:
                self._line.write(self._noise(answer))

    def _obey(self, line: SlcanLine) -> bytes:
        """Do what a command says; return the answer."""
        known = {"V": b"V1013\r", "v": b"v0100\r", "N": b"NA123\r", "F": b"F00\r", "": DONE}
        if line.letter in known:
            return known[line.letter]
        if line.letter == "S" and not self._open and line.argument in set("012345678"):
            self.bitrate = BITRATES[int(line.argument)]
            return DONE
        if line.letter == "Z" and not self._open and line.argument in {"0", "1"}:
            self._stamping = line.argument == "1"
            return DONE
        if line.letter in "OL" and not self._open and self.bitrate is not None:
            self._open = True
            return DONE
        if line.letter == "C" and self._open:
            self._open = False
            return DONE
        return REFUSED


class PythonCanWire:
    """A bus of python-can: ``socketcan`` where the kernel has CAN, ``virtual`` in one process.

    Parameters
    ----------
    interface, channel
        As python-can names them.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._interface, self._channel = interface, channel
        self._bus: can.BusABC | None = None
        self.bitrate: int | None = None
        self.plug()

    @property
    def is_open(self) -> bool:
        """Whether the wire is plugged in: a bus does not tell who listens."""
        return self._bus is not None

    def send(self, frames: Iterable[CanFrame]) -> bool:
        """Send `frames`; False where the bus is away, down or full."""
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
        """Wait until cancelled: nothing is ever asked of a device on this bus."""
        await asyncio.get_running_loop().create_future()

    def unplug(self) -> None:
        """Leave the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(can.CanError, OSError):
                bus.shutdown()

    def plug(self) -> None:
        """Join the bus."""
        if self._bus is None:
            self._bus = can.Bus(
                interface=self._interface, channel=self._channel, ignore_config=True
            )
