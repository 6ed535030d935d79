"""The driver: one WitMotion IMU on a serial port, orientation only, stamped on arrival.

Law: two halves. ``WitEvents`` is pure; ``WitImu.run`` opens, configures and reads. Between them
nothing but chunks.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, ClassVar, Literal

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, ImuSettings
from jointfit_daemon.model import Corrupt, ImuSample
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_protocols.orientation import OrientationGate, canonical
from pydantic import Field, field_validator

from jointfit_wit import frames

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_protocols.corrupt import CorruptBytes

_BITS = 10  # of one byte on the line, 8N1
_SILENCE_NS = 250_000_000  # longer than any stall of a host between two halves of a frame
_LISTEN_S = 0.5  # five frames at the factory rate of 10 Hz
_COMMAND_PAUSE_S = 0.1  # the vendor asks for it


class WitSettings(ImuSettings):
    """One ``[[imu]]`` table of rig.toml."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(115_200, gt=0, description="speed the device runs at, baud")
    world: Literal["ENU", "NED", "NWU"] = Field("ENU", description="world of its quaternion")
    world_to_sensor: bool = Field(False, description="its quaternion is the inverse")
    persist: bool = Field(False, description="store what had to be changed in the device's flash")

    @field_validator("rate_hz")
    @classmethod
    def _rate_the_device_has(cls, rate_hz: float) -> float:
        if rate_hz not in frames.RATES:
            raise ValueError(f"one of {', '.join(map(str, frames.RATES))} Hz, found {rate_hz:g}")
        return rate_hz


class WitEvents:
    """The pure half: chunks in, samples in SI and canonical orientation out."""

    tick_clock = None  # the quaternion frame has no time

    def __init__(self, settings: WitSettings) -> None:
        self._settings = settings
        self._byte_ns = _BITS * 1e9 / settings.baud
        self._wit = frames.WitDecoder()
        self._gate = OrientationGate()
        self._last_ns = self._arrival_ns = self._refused = 0

    @property
    def messages(self) -> int:
        """Well-formed frames so far."""
        return self._wit.frames - self._refused

    @property
    def discarded_bytes(self) -> int:
        """Bytes that belong to no frame so far, or to one that made no sense."""
        return self._wit.discarded + self._refused * frames.SIZE

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return what `chunk` completed, in wire order; never raises."""
        out: list[Decoded] = []
        if self._wit.pending and chunk.t_ns - self._last_ns > _SILENCE_NS:
            out = self.flush()  # the rest of what waits will never come
        self._last_ns = chunk.t_ns
        return out + self._take(self._wit.feed(chunk.data))

    def flush(self) -> list[Decoded]:
        """Give up waiting for the rest of a pending frame."""
        return self._take(self._wit.flush())

    def _take(self, found: list[frames.WitFrame | CorruptBytes]) -> list[Decoded]:
        out: list[Decoded] = []
        for event in found:
            if not isinstance(event, frames.WitFrame):
                out.append(Corrupt(event.discarded, event.reason))
            elif event.kind == frames.QUATERNION:
                out.append(self._sample(event))
        return out

    def _sample(self, frame: frames.WitFrame) -> ImuSample | Corrupt:
        w, x, y, z = (count * frames.SCALE for count in frame.counts)
        settings = self._settings
        turned = canonical((w, x, y, z), settings.world, world_to_sensor=settings.world_to_sensor)
        q = self._gate.admit(turned)
        if q is None:
            self._refused += 1
            return Corrupt(frames.SIZE, "quaternion norm is not 1")
        since = self._wit.fed - frame.end + frames.SIZE  # back to the frame's first byte
        at_ns = self._last_ns - round(since * self._byte_ns)
        self._arrival_ns = max(self._arrival_ns, at_ns)
        return ImuSample(self._arrival_ns, q, (w, x, y, z), ticks=None, counter=None)


class WitImu:
    """WitMotion IMU on a UART."""

    Settings: ClassVar[type[WitSettings]] = WitSettings
    wire: ClassVar[Wire] = "stream"

    def __init__(self, settings: WitSettings) -> None:
        self._settings = settings

    def decoder(self) -> WitEvents:
        """Return the pure half. Live and replay use the same."""
        return WitEvents(self._settings)

    async def run(self, emit: Emit) -> None:
        """Open the port, have the device send quaternions, read until cancelled.

        Raises
        ------
        DeviceLostError
            Port absent, taken, unplugged or silent; worth another try.
        DeviceMisconfiguredError
            Not a serial port, or not a WitMotion device at this speed.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            port.flush_input()  # drivers and bridges keep a few kilobytes of an earlier run
            if not await self._quaternions_come(port, emit):
                await self._ask_for_quaternions(port)
                if not await self._quaternions_come(port, emit):
                    raise DeviceMisconfiguredError(
                        f"{settings.id} ({settings.port}): sends frames but no quaternions, even "
                        "when told to: set content bit 9 with the vendor's tool"
                    )
            await port.pump(emit, settings.silence_s)

    async def _quaternions_come(self, port: SerialPort, emit: Emit) -> bool:
        """Listen before writing: most devices need not be changed. All heard is emitted."""
        settings, watch, heard = self._settings, frames.WitDecoder(), b""
        loop = asyncio.get_running_loop()
        until = loop.time() + _LISTEN_S
        while (left := until - loop.time()) > 0:
            chunk = await port.receive(left)
            if chunk is None:
                break
            emit(chunk)
            heard += chunk.data
            for event in watch.feed(chunk.data):
                if isinstance(event, frames.WitFrame) and event.kind == frames.QUATERNION:
                    return True
        if watch.frames:
            return False
        if not heard:
            raise DeviceLostError(f"{settings.id} ({settings.port}): silent: check its power")
        found = "it is of the 55 61 kind" if frames.OTHER_VARIANT in heard else "set `port`"
        raise DeviceMisconfiguredError(
            f"{settings.id} ({settings.port}): {len(heard)} bytes at {settings.baud} baud, none "
            f"of them a WitMotion frame: {found}, or `baud` (factory: 9600)"
        )

    async def _ask_for_quaternions(self, port: SerialPort) -> None:
        """Write content and rate; nothing acknowledges, so the stream is the proof."""
        rate = frames.RATES[int(self._settings.rate_hz)]
        commands = [
            frames.UNLOCK,
            frames.write_register(frames.CONTENT, frames.CONTENT_QUATERNION),
            frames.write_register(frames.RATE, rate),
        ]
        if self._settings.persist:
            commands.append(frames.SAVE)
        for command in commands:
            await port.write(command)
            await asyncio.sleep(_COMMAND_PAUSE_S)
