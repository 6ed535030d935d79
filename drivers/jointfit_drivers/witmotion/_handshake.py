"""Start of a WitMotion device: the driver requests the required frames, or raises an error.

The device does not acknowledge writes. The driver first listens, and reads the settings if the
firmware answers. If the content (the kinds of frames) or the rate differs, it writes both, and
listens again. The written registers are lost at power-off. The driver writes the flash memory, or
changes the speed of the device, only if ``persist`` permits it.

Source: protocol pages of the vendor. The unlock command permits access for 10 s, and commands must
be separated by 100 ms.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.witmotion._decoder import OTHER_VARIANT, kind_names
from jointfit_protocols.witmotion import (
    BAUD_CODES,
    FRAME_BYTES,
    RATE_CODES,
    SAVE,
    UNLOCK,
    WitMotionCodec,
    WitMotionFrame,
    WitMotionFrameKind,
    WitMotionRegister,
    content_bits,
    read_register,
    registers_of,
    write_register,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_drivers.witmotion._settings import WitMotionSettings

log = logging.getLogger(__name__)

LINE_SPEEDS = (115_200, 9_600, 921_600, 230_400, 460_800, 57_600, 38_400, 19_200)
"""Line speeds for the search, bit/s: usual speed and factory setting first."""
_LISTEN_S = 0.6
"""Longest time to receive the required frames, s. It suffices for five samples at the factory rate
of 10 Hz."""
_SEARCH_S = 0.25
"""Duration of the search at each other speed, s. It suffices for two samples at 10 Hz."""
_ANSWER_S = 0.3
"""Longest wait for the answer to a read command, s."""
_COMMAND_PAUSE_S = 0.1
"""Pause after each command, which the vendor requires, s."""
_ENOUGH = 2
"""Number of frames of a required kind that prove that the device sends this kind."""
_LEAST_RATE = 0.7
"""Share of `rate_hz` below which the measured rate counts as different."""
_LOGGED_BYTES = 20 * FRAME_BYTES


class _Reception(NamedTuple):
    """Result of one period of listening."""

    counts: dict[int, int]
    """Number of frames of each kind."""
    received: int
    """Number of received bytes."""
    other_frames: int
    """Number of frames with the start bytes 55 61, which other variants of the device send."""
    seconds: float
    registers: tuple[int, int, int, int] | None
    """Content of a received register frame; None if none was received."""


class WitMotionHandshake:
    """Makes one device send the required frames.

    Parameters
    ----------
    port, emit : SerialPort, Emit
        Open port, and function that receives the device's bytes when it sends the required frames.
    settings : WitMotionSettings
        Table of the device in rig.toml.
    """

    def __init__(self, port: SerialPort, emit: Emit, settings: WitMotionSettings) -> None:
        self._port, self._emit, self._settings = port, emit, settings
        self._path = settings.port
        self._kinds = {int(kind) for kind in settings.kinds}
        self._held: list[Chunk] = []  # all bytes since the input was flushed

    async def ensure_streaming(self) -> None:
        """Return when the device sends the frames that the settings require.

        Raises
        ------
        DeviceLostError
            The device is silent or unplugged, or stopped sending after its settings were written.
        DeviceMisconfiguredError
            The device uses another speed, is not a supported WitMotion device, or does not send the
            frames even on request.
        """
        settings = self._settings
        settings.require_line_speed()

        self._flush()  # system and USB bridge buffer bytes of an earlier run
        found = await self._listen(_LISTEN_S, self._is_complete)
        if found.other_frames and not found.counts:
            raise DeviceMisconfiguredError(f"{self._path}: {OTHER_VARIANT}")
        registers = await self._read_settings()
        if not found.counts and registers is None:
            found = await self._find_at_other_speed()
            registers = await self._read_settings()

        faults = await self._differences(found, registers)
        if faults:
            await self._configure(faults)

        data = b"".join(chunk.data for chunk in self._held)
        log.debug("%s: first bytes %s", settings.id, data[:_LOGGED_BYTES].hex(" "))
        for chunk in self._held:
            self._emit(chunk)

    def _flush(self) -> None:
        self._port.flush_input()
        self._held.clear()

    def _is_complete(self, counts: dict[int, int]) -> bool:
        return all(counts.get(kind, 0) >= _ENOUGH for kind in self._kinds)

    async def _listen(
        self, wait_s: float, until: Callable[[dict[int, int]], bool] | None = None
    ) -> _Reception:
        """Receive for `wait_s` seconds, or until `until` accepts the counts of the frames."""
        loop = asyncio.get_running_loop()
        codec, registers = WitMotionCodec(), None
        counts: dict[int, int] = {}
        began = loop.time()

        while (left := began + wait_s - loop.time()) > 0:
            chunk = await self._port.receive(left)
            if chunk is None:
                break
            self._held.append(chunk)
            for event in codec.feed(chunk.data):
                if not isinstance(event, WitMotionFrame):
                    continue
                if event.kind == WitMotionFrameKind.REGISTERS:
                    registers = registers_of(event.data)
                counts[event.kind] = counts.get(event.kind, 0) + 1
            if until is not None and until(counts):
                break

        counts.pop(WitMotionFrameKind.REGISTERS, None)
        seconds = max(loop.time() - began, 1e-3)
        return _Reception(counts, codec.fed, codec.other_frames, seconds, registers)

    async def _read_settings(self) -> tuple[int, int, int, int] | None:
        """Return the registers content, rate, speed and the next register; None without a reply."""
        await self._port.write(read_register(WitMotionRegister.CONTENT))
        answer = await self._listen(_ANSWER_S, lambda c: WitMotionFrameKind.REGISTERS in c)
        return answer.registers

    async def _differences(
        self, found: _Reception, registers: tuple[int, int, int, int] | None
    ) -> list[str]:
        """Return the differences between the device and the settings; empty if there are none."""
        faults = []
        missing = self._kinds - set(found.counts)
        if missing:
            faults.append(f"it sends {kind_names(set(found.counts))}, no {kind_names(missing)}")

        rate_hz = self._settings.rate_hz
        if registers is not None:
            rates = {code: rate for rate, code in RATE_CODES.items()}
            rate = rates.get(registers[1])
            if rate != rate_hz:
                present = f"rate code 0x{registers[1]:02X}" if rate is None else f"{rate} Hz"
                faults.append(f"it is set to {present}, not {rate_hz:g} Hz")
        elif not missing:
            # Without an answer, the stream can only prove a rate that is too low. Bytes that were
            # buffered arrive too fast, so a high rate proves nothing.
            measured = await self._listen(_LISTEN_S)
            sent = min(measured.counts.get(kind, 0) for kind in self._kinds) / measured.seconds
            if sent < _LEAST_RATE * rate_hz:
                faults.append(f"it sends {sent:.0f} samples per second, not {rate_hz:g}")
        return faults

    async def _configure(self, faults: list[str]) -> None:
        """Write content and rate, and check the frames that the device sends afterwards."""
        settings = self._settings
        log.warning("%s: writing its settings: %s", settings.id, "; ".join(faults))
        commands = [
            UNLOCK,
            write_register(WitMotionRegister.CONTENT, content_bits(*self._kinds)),
            write_register(WitMotionRegister.RATE, RATE_CODES[int(settings.rate_hz)]),
            *([SAVE] if settings.persist else []),
        ]
        await self._send(commands)

        self._flush()  # frames sent with the old settings
        found = await self._listen(_LISTEN_S, self._is_complete)
        missing = self._kinds - set(found.counts)
        if not found.received:
            raise DeviceLostError(
                f"{self._path}: stopped sending during configuration: check its power and cable"
            )
        if missing:
            remedy = (
                'set orientation = "gateway" if it sends raw measurements, or '
                if settings.orientation == "device"
                else ""
            )
            raise DeviceMisconfiguredError(
                f"{self._path}: {'; '.join(faults)}, even on request: {remedy}enable "
                f"{kind_names(missing)} with the WitMotion software"
            )

    async def _send(self, commands: list[bytes]) -> None:
        for command in commands:
            await self._port.write(command)
            await asyncio.sleep(_COMMAND_PAUSE_S)

    async def _find_at_other_speed(self) -> _Reception:
        """Find the device at another speed and change its speed to `baud`, or raise the error."""
        received = sum(len(chunk.data) for chunk in self._held)
        if not received:
            raise DeviceLostError(
                f"{self._path}: no data: check its power, and that its TX is connected to RX"
            )
        for baud in LINE_SPEEDS:
            if baud == self._settings.baud:
                continue
            try:
                self._port.set_baud(baud)
            except DeviceMisconfiguredError:  # the port does not support this speed
                continue
            self._flush()
            found = await self._listen(_SEARCH_S)
            if found.counts:
                return await self._move_from(baud)
            if found.other_frames:
                raise DeviceMisconfiguredError(f"{self._path}: {OTHER_VARIANT}")
        raise DeviceMisconfiguredError(
            f"{self._path}: {received} bytes, but no WitMotion frame at any usual speed: "
            "correct `port` or `driver`; `jointfit probe` recognizes the device on a port"
        )

    async def _move_from(self, baud: int) -> _Reception:
        """Change the speed of the device from `baud`, if ``persist`` permits this."""
        settings = self._settings
        code = BAUD_CODES.get(settings.baud)
        if not settings.persist or code is None:
            needs = settings.serial_bits_per_s or 0.0
            share = baud / needs if needs else 1.0
            fits = [rate for rate in RATE_CODES if rate <= share * settings.rate_hz]
            fitting = max(fits, default=min(RATE_CODES))
            slower = f" and rate_hz = {fitting}" if fitting < settings.rate_hz else ""
            raise DeviceMisconfiguredError(
                f"{self._path}: {settings.baud} baud, but no frame can be decoded; the device "
                f"sends at {baud}: set baud = {baud}{slower}, or persist = true once to change its "
                "speed"
            )
        log.warning("%s: changing its speed from %d to %d", settings.id, baud, settings.baud)
        await self._send([UNLOCK, write_register(WitMotionRegister.BAUD, code)])
        self._port.set_baud(settings.baud)
        await self._send([UNLOCK, SAVE])

        self._flush()
        found = await self._listen(_LISTEN_S, self._is_complete)
        if not found.counts:
            raise DeviceMisconfiguredError(
                f"{self._path}: the device sends at {baud} baud and did not change to "
                f"{settings.baud}: set baud = {baud}, or change it with the WitMotion software"
            )
        return found
