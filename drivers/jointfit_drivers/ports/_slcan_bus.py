"""A CAN bus through an SLCAN adapter on a serial port: handshake, then reception of frames.

The SLCAN backend of python-can takes hundreds of microseconds per frame, so it is not used. The
adapter opens its bus as a normal node (``O``) and not as a silent listener, because a single sensor
needs a second node that acknowledges its frames. The adapter never sends a frame.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_protocols.can import CanFrame, host_corrupt
from jointfit_protocols.can.slcan import BITRATES, SlcanCodec, SlcanLine
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from jointfit_daemon.driver import CanBusSettings
    from jointfit_daemon.model import Chunk

log = logging.getLogger(__name__)

_QUIET_S = 0.03
"""Pause after which the output of an earlier session has been received completely, s."""
_OLD_READS = 10
"""Largest number of reads of old output, for an adapter that never pauses."""
_ANSWER_S = 0.3
"""Longest wait for an answer, s. Adapters answer within milliseconds, or not at all."""
_NOT_SLCAN = 8
"""Number of bytes outside SLCAN lines that indicates another type of device, if there is no valid
line."""


class SlcanBus:
    """One adapter for `can_bus.SharedBus`.

    Parameters
    ----------
    settings : CanBusSettings
        Table ``[can.NAME]`` of rig.toml. The key ``channel`` is the serial port.
    """

    def __init__(self, settings: CanBusSettings) -> None:
        self._settings = settings
        self._port = SerialPort(settings.channel, settings.baud, "channel")
        baud = settings.baud if settings.transport == "uart" else None
        self._decoder = SlcanCodec(baud, bitrate=settings.bitrate)
        self._understood = 0  # frames and answers of the handshake
        self._early: list[tuple[int, list[CanFrame]]] = []  # read together with the answer to `O`
        self._reading: asyncio.Task[None] | None = None

    async def open(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Open the port, set the bit rate, open the bus, and start reading.

        Raises
        ------
        DeviceLostError
            The port is absent or in use, or the adapter refuses to open the bus.
        DeviceMisconfiguredError
            The file is not a serial port, the device does not answer as an SLCAN adapter, or it
            refuses the bit rate.
        """
        self._port.__enter__()
        try:
            await self._handshake()
        except BaseException:
            self._port.__exit__()
            raise

        self._reading = asyncio.create_task(
            self._read(deliver, failed), name=f"slcan {self._settings.channel}"
        )

    def listen(self, ids: Collection[tuple[int, bool]] | None) -> None:
        """Do nothing, so that all frames are accepted: SLCAN filters do not support lists."""

    async def close(self) -> None:
        """Stop reading, then close the bus and the port."""
        reading, self._reading = self._reading, None
        if reading is None:
            return

        try:
            reading.cancel()
            await asyncio.wait({reading})
            with suppress(DeviceLostError, TimeoutError):
                async with asyncio.timeout(0.1):
                    await self._port.write(b"C\r")
                    # Closing the port would discard bytes that are not sent yet.
                    await asyncio.sleep(4 * 10 / self._settings.baud)
        finally:
            self._port.__exit__()

    async def _read(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Deliver frames until cancelled or until the port fails."""
        feed = self._decoder.feed

        def take(chunk: Chunk) -> None:
            frames, corrupt = [], 0
            for item in feed(chunk.data, chunk.t_ns):
                if isinstance(item, CanFrame):
                    frames.append(item)
                elif isinstance(item, CorruptBytes):
                    corrupt += item.discarded
            if corrupt:
                frames.append(host_corrupt(chunk.t_ns, corrupt))
            if frames:
                deliver(chunk.t_ns, frames)

        try:
            while self._early:
                deliver(*self._early.pop(0))
            await self._port.pump(take, None)  # each subscriber checks its own silence
        except Exception as error:  # noqa: BLE001 - every subscriber raises it
            failed(error)

    async def _handshake(self) -> None:
        """Open the adapter's bus, also if an earlier session left the bus open."""
        settings = self._settings
        await self._port.write(b"\r\r\rC\r")  # end an incomplete command, then close the bus
        for _ in range(_OLD_READS):
            if not await self._receive_answers(_QUIET_S):
                break

        self._port.flush_input()
        self._decoder.flush()
        self._early.clear()

        await self._ask(b"V\r", "V")
        if await self._ask(b"S%d\r" % BITRATES.index(settings.bitrate)) == "\a":
            raise DeviceMisconfiguredError(
                f"{settings.channel}: the adapter refuses {settings.bitrate} bit/s: "
                "set `bitrate` of the [can] table to the bit rate of adapter and sensors"
            )

        answer = await self._ask(b"O\r")
        lost = self._decoder.discarded_bytes
        if lost > _NOT_SLCAN and not self._understood:
            raise DeviceMisconfiguredError(
                f"{settings.channel}: no SLCAN adapter found at {settings.baud} baud "
                "(bytes arrive, but no SLCAN message): set `channel` to the adapter's port "
                "and `baud` to its speed"
            )
        if answer == "\a":
            raise DeviceLostError(
                f"{settings.channel}: the adapter refuses to open its bus: check "
                "power and wiring of the bus, or plug the adapter in again"
            )
        if answer is None:
            log.debug("%s: the adapter sends no answers; reading anyway", settings.channel)

    async def _ask(self, command: bytes, expected: str = "") -> str | None:
        """Send `command`; return the letter of its answer (`expected` or BELL).

        Return None if no such answer arrives within 0.3 s.
        """
        await self._port.write(command)
        loop = asyncio.get_running_loop()
        until = loop.time() + _ANSWER_S
        while (left := until - loop.time()) > 0:
            for line in await self._receive_answers(left):
                if line.letter in {expected, "\a"}:
                    return line.letter
        return None

    async def _receive_answers(self, timeout_s: float) -> list[SlcanLine]:
        """Return the answers in the next chunk, count valid lines, and store early frames."""
        chunk = await self._port.receive(timeout_s)
        if chunk is None:
            return []
        found = self._decoder.feed(chunk.data, chunk.t_ns)
        lines = [item for item in found if isinstance(item, SlcanLine)]
        # A single CR does not identify an adapter, because every device with text replies sends it.
        frames = [item for item in found if isinstance(item, CanFrame)]
        if frames:  # frames that follow the answer to `O` in the same chunk
            self._early.append((chunk.t_ns, frames))
        self._understood += len(frames)
        self._understood += sum(line.letter != "" for line in lines)
        return lines
