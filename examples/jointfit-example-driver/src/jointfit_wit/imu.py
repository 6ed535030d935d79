"""Driver for one WitMotion IMU on a serial port: orientation only, stamped on arrival.

``WitDecoder`` converts chunks to samples without I/O; ``WitImu.run`` opens, configures and reads.

Invariant: the two exchange chunks only.
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

_BITS = 10
"""Bits of one byte on the line (8N1)."""
_SILENCE_NS = 250_000_000
"""Silence that ends an incomplete frame, ns; longer than the stalls of a host within a frame."""
_LISTEN_S = 0.5
"""Time to detect quaternions, s: five frames at the factory rate of 10 Hz."""
_COMMAND_PAUSE_S = 0.1
"""Pause after a command, as required by the vendor, s."""


class WitSettings(ImuSettings):
    """One ``[[imu]]`` table of rig.toml."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(115_200, gt=0, description="speed the device runs at, baud")
    world: Literal["ENU", "NED", "NWU"] = Field("ENU", description="world of its quaternion")
    world_to_sensor: bool = Field(False, description="its quaternion is the inverse")
    persist: bool = Field(False, description="store changed settings in the device's flash")

    @field_validator("rate_hz")
    @classmethod
    def _check_rate(cls, rate_hz: float) -> float:
        if rate_hz not in frames.RATES:
            raise ValueError(
                f"expected one of {', '.join(map(str, frames.RATES))} Hz, found {rate_hz:g}"
            )
        return rate_hz


class WitDecoder:
    """Converts chunks to samples in SI units with canonical orientation; no I/O."""

    tick_clock = None  # the quaternion frame has no time

    def __init__(self, settings: WitSettings) -> None:
        self._settings = settings
        self._byte_ns = _BITS * 1e9 / settings.baud
        self._codec = frames.WitCodec()
        self._gate = OrientationGate()
        self._last_ns = self._arrival_ns = self._rejected = 0

    @property
    def messages(self) -> int:
        """Number of valid frames."""
        return self._codec.frames - self._rejected

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes that belong to no frame or to a frame with an invalid quaternion."""
        return self._codec.discarded + self._rejected * frames.SIZE

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples completed by `chunk`, in wire order; never raises."""
        out: list[Decoded] = []
        if self._codec.pending and chunk.t_ns - self._last_ns > _SILENCE_NS:
            out = self.flush()
        self._last_ns = chunk.t_ns
        return out + self._convert(self._codec.feed(chunk.data))

    def flush(self) -> list[Decoded]:
        """Discard an incomplete frame."""
        return self._convert(self._codec.flush())

    def _convert(self, found: list[frames.WitFrame | CorruptBytes]) -> list[Decoded]:
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
            self._rejected += 1
            return Corrupt(frames.SIZE, "quaternion norm is not 1")

        # back-date the arrival to the first byte of the frame; stamps never decrease
        since = self._codec.fed - frame.end + frames.SIZE
        at_ns = self._last_ns - round(since * self._byte_ns)
        self._arrival_ns = max(self._arrival_ns, at_ns)
        return ImuSample(self._arrival_ns, q, (w, x, y, z), ticks=None, counter=None)


class WitImu:
    """WitMotion IMU on a UART."""

    Settings: ClassVar[type[WitSettings]] = WitSettings
    wire: ClassVar[Wire] = "stream"

    def __init__(self, settings: WitSettings) -> None:
        self._settings = settings

    def decoder(self) -> WitDecoder:
        """Return a new decoder, for live data and for replay."""
        return WitDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Open the port, configure the device to send quaternions, read until cancelled.

        Raises
        ------
        DeviceLostError
            The port is absent, in use, unplugged or silent; the daemon retries.
        DeviceMisconfiguredError
            Not a serial port, or not a WitMotion device at this speed.
        """
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            port.flush_input()  # system and bridge buffer a few kilobytes of an earlier run
            if not await self._receives_quaternions(port, emit):
                await self._request_quaternions(port)
                if not await self._receives_quaternions(port, emit):
                    raise DeviceMisconfiguredError(
                        f"{settings.id} ({settings.port}): the device sends frames but no "
                        "quaternions, even on request: set content bit 9 with the vendor's tool"
                    )
            await port.pump(emit, settings.silence_s)

    async def _receives_quaternions(self, port: SerialPort, emit: Emit) -> bool:
        """Return whether the device sends quaternions; all received chunks are emitted.

        Reading before writing leaves a configured device unchanged.
        """
        settings, codec, received = self._settings, frames.WitCodec(), b""
        loop = asyncio.get_running_loop()
        until = loop.time() + _LISTEN_S
        while (left := until - loop.time()) > 0:
            chunk = await port.receive(left)
            if chunk is None:
                break
            emit(chunk)
            received += chunk.data
            for event in codec.feed(chunk.data):
                if isinstance(event, frames.WitFrame) and event.kind == frames.QUATERNION:
                    return True
        if codec.frames:
            return False

        where = f"{settings.id} ({settings.port})"
        if not received:
            raise DeviceLostError(f"{where}: no data: check its power")
        remedy = (
            "the device is a Bluetooth or SD model (55 61), which has none"
            if frames.OTHER_VARIANT in received
            else "set `port`, or `baud` (factory: 9600)"
        )
        raise DeviceMisconfiguredError(
            f"{where}: {len(received)} bytes at {settings.baud} baud without a valid WitMotion "
            f"frame: {remedy}"
        )

    async def _request_quaternions(self, port: SerialPort) -> None:
        """Write content and rate; the device acknowledges nothing."""
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
