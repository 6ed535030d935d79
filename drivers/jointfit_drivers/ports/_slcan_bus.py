"""An SLCAN adapter on a serial port, as a bus: handshake, then frames.

Law: knows SLCAN and serial ports, nothing of sensors or of python-can, whose own SLCAN costs
hundreds of microseconds a frame. The adapter is opened as a normal node (``O``), not as a silent
listener, for a lone sensor needs somebody to acknowledge its frames. Nothing is ever sent on the
bus.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_protocols.can import CanFrame, host_corrupt
from jointfit_protocols.can.slcan import BITRATES, SlcanCodec, SlcanLine, bitrate_code
from jointfit_protocols.corrupt import Corrupt

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from jointfit_daemon.driver import CanBusSettings
    from jointfit_daemon.model import Chunk

log = logging.getLogger(__name__)

_QUIET_S = 0.03  # nothing for so long: what an earlier session left in the adapter has come out
_OLD_READS = 10  # but an adapter that never falls quiet is not waited for
_ANSWER_S = 0.3  # adapters answer in milliseconds; some answer nothing at all
_NOT_SLCAN = 8  # bytes that are no SLCAN, with nothing that is, show another kind of device


class SlcanBus:
    """One adapter, for ``can_bus.SharedBus``.

    Parameters
    ----------
    settings
        Its ``[can.NAME]`` table; ``channel`` is the serial port.
    """

    def __init__(self, settings: CanBusSettings) -> None:
        self._settings = settings
        self._port = SerialPort(settings.channel, settings.baud)
        baud = settings.baud if settings.transport == "uart" else None
        self._decoder = SlcanCodec(baud, bitrate=settings.bitrate)
        self._understood = 0  # frames and answers of the handshake
        self._early: list[tuple[int, list[CanFrame]]] = []  # read together with the answer to `O`
        self._is_open = False
        self._reading: asyncio.Task[None] | None = None

    async def open(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Open the port, tell the adapter its bit rate, open the bus, begin to read.

        Raises
        ------
        DeviceLostError
            The port is absent or taken; the adapter refuses to open.
        DeviceMisconfiguredError
            The port is none, what answers is not SLCAN, or the bit rate is not one of its nine.
        """
        code = bitrate_code(self._settings.bitrate)
        if code is None:
            known = ", ".join(str(rate) for rate in BITRATES)
            raise DeviceMisconfiguredError(
                f"{self._settings.channel}: SLCAN has no bit rate {self._settings.bitrate}: "
                f"set `bitrate` of the [can] table to one of {known}"
            )
        self._port.__enter__()
        self._is_open = True
        try:
            await self._handshake(code)
        except BaseException:
            self._exit_port()
            raise
        self._reading = asyncio.create_task(
            self._read(deliver, failed), name=f"slcan {self._settings.channel}"
        )

    def listen(self, ids: Collection[tuple[int, bool]] | None) -> None:
        """Take everything: the acceptance filter of SLCAN cannot hold a list."""

    async def close(self) -> None:
        """Stop reading, close the bus and the port."""
        reading, self._reading = self._reading, None
        if reading is not None:
            reading.cancel()
            await asyncio.wait({reading})
        if not self._is_open:
            return
        try:
            with suppress(DeviceLostError, TimeoutError):
                async with asyncio.timeout(0.1):
                    await self._port.write(b"C\r")
                    # Closing the port throws away what is not sent yet.
                    await asyncio.sleep(4 * 10 / self._settings.baud)
        finally:
            self._exit_port()

    def _exit_port(self) -> None:
        if self._is_open:
            self._is_open = False
            self._port.__exit__(None, None, None)

    async def _read(
        self, deliver: Callable[[int, list[CanFrame]], None], failed: Callable[[Exception], None]
    ) -> None:
        """Hand on frames until cancelled or until the port fails."""
        feed = self._decoder.feed

        def take(chunk: Chunk) -> None:
            frames, corrupt = [], 0
            for item in feed(chunk.data, chunk.t_ns):
                if isinstance(item, CanFrame):
                    frames.append(item)
                elif isinstance(item, Corrupt):
                    corrupt += item.discarded
            if corrupt:
                frames.append(host_corrupt(chunk.t_ns, corrupt))
            if frames:
                deliver(chunk.t_ns, frames)

        try:
            while self._early:
                deliver(*self._early.pop(0))
            await self._port.pump(take, None)  # silence is each subscriber's own matter
        except Exception as error:  # noqa: BLE001 - handed to every subscriber, who raises it
            failed(error)

    async def _handshake(self, code: int) -> None:
        """Bring the adapter, whatever state it was left in, to an open bus."""
        settings = self._settings
        await self._port.write(b"\r\r\rC\r")  # ends a half-sent command, then closes the bus
        for _ in range(_OLD_READS):
            if not await self._heard(_QUIET_S):
                break
        self._port.flush_input()
        self._decoder.flush()
        self._early.clear()
        await self._ask(b"V\r", "V")
        if await self._ask(b"S%d\r" % code) == "\a":
            raise DeviceMisconfiguredError(
                f"{settings.channel}: the adapter refuses {settings.bitrate} bit/s: "
                "set `bitrate` of the [can] table to what adapter and sensors share"
            )
        answer = await self._ask(b"O\r")
        self._check_is_slcan()
        if answer == "\a":
            raise DeviceLostError(f"{settings.channel}: the adapter refuses to open its bus")
        if answer is None:
            log.debug("%s: the adapter answers nothing; reading all the same", settings.channel)

    async def _ask(self, command: bytes, expected: str = "") -> str | None:
        """Send `command`; return the letter of the answer, `expected` or BELL, or None."""
        await self._port.write(command)
        loop = asyncio.get_running_loop()
        until = loop.time() + _ANSWER_S
        while (left := until - loop.time()) > 0:
            for line in await self._heard(left):
                if line.letter in {expected, "\a"}:
                    return line.letter
        return None

    async def _heard(self, timeout_s: float) -> list[SlcanLine]:
        """Return the answers in the next chunk; note what speaks for and against SLCAN."""
        chunk = await self._port.receive(timeout_s)
        if chunk is None:
            return []
        found = self._decoder.feed(chunk.data, chunk.t_ns)
        lines = [item for item in found if isinstance(item, SlcanLine)]
        # A bare CR proves nothing: everything that answers in lines of text sends some.
        frames = [item for item in found if isinstance(item, CanFrame)]
        if frames:  # they follow the answer to `O`: the bus was closed before
            self._early.append((chunk.t_ns, frames))
        self._understood += len(frames)
        self._understood += sum(line.letter != "" for line in lines)
        return lines

    def _check_is_slcan(self) -> None:
        """Refuse a device that talks, but never SLCAN."""
        lost = self._decoder.discarded_bytes
        if lost > _NOT_SLCAN and not self._understood:
            raise DeviceMisconfiguredError(
                f"{self._settings.channel}: no SLCAN adapter answers at {self._settings.baud} baud "
                f"({lost} bytes came, no SLCAN among them): set `channel` to the adapter's port "
                "and `baud` to its speed"
            )
