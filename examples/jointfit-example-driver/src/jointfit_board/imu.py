"""Driver for one board: `BoardDecoder` is pure; `BoardImu.run` opens, starts and reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, ImuSettings
from jointfit_daemon.model import Corrupt, ImuSample, TickClock
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.serial_imu import ArrivalStamps
from jointfit_protocols.orientation import OrientationGate
from pydantic import Field

from jointfit_board.frames import SCALE, SIZE, BoardCodec, BoardFrame

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_daemon.model import Chunk, Decoded

_LISTEN_S = 0.3
"""Time to receive the first bytes, s: thirty frames."""


class BoardSettings(ImuSettings):
    """One ``[[imu]]`` table of rig.toml."""

    port: str = Field(description="serial port, preferably a link under /dev/serial/by-id")
    baud: int = Field(115_200, gt=0, description="speed the board runs at, baud")


class BoardDecoder:
    """Converts chunks to samples in SI units with canonical orientation; no I/O."""

    tick_clock = TickClock(tick_ns=1000, modulus=1 << 32)

    def __init__(self, baud: int) -> None:
        self._codec, self._gate = BoardCodec(), OrientationGate()
        self._stamps = ArrivalStamps(baud, SIZE)
        self._rejected = 0

    @property
    def messages(self) -> int:
        """Number of valid frames."""
        return self._codec.frames - self._rejected

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes that belong to no frame or to a frame with an invalid quaternion."""
        return self._codec.discarded + self._rejected * SIZE

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples completed by `chunk`, in wire order; never raises."""
        out: list[Decoded] = []
        if self._stamps.is_silent_before(chunk.t_ns, len(chunk.data)):
            out = self.flush()  # the rest of an incomplete frame was lost
        self._stamps.start_chunk(chunk.t_ns)
        for event in self._codec.feed(chunk.data):
            if not isinstance(event, BoardFrame):
                out.append(Corrupt(event.discarded, event.reason))
                continue

            w, x, y, z = (count / SCALE for count in event.counts)
            q = self._gate.admit((w, x, y, z))
            if q is None:
                self._rejected += 1
                out.append(Corrupt(SIZE, "quaternion norm is not 1"))
                continue

            # back-date the arrival to the first byte of the frame
            at_ns = self._stamps.stamp(self._codec.fed - event.end + SIZE)
            out.append(ImuSample(at_ns, q, (w, x, y, z), event.time_us, event.counter))
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete frame."""
        return [Corrupt(event.discarded, event.reason) for event in self._codec.flush()]


class BoardImu:
    """The board on a UART."""

    Settings: ClassVar[type[BoardSettings]] = BoardSettings
    wire: ClassVar[Wire] = "stream"

    def __init__(self, settings: BoardSettings) -> None:
        self._settings = settings

    def decoder(self) -> BoardDecoder:
        """Return a new decoder, for live data and for replay."""
        return BoardDecoder(self._settings.baud)

    async def run(self, emit: Emit) -> None:
        """Open the port, start the board unless it already sends, and read until cancelled."""
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            port.flush_input()  # the system buffers a few kilobytes of an earlier run
            chunks = await _receive(port)
            if not chunks:  # read before you write: the board may be sending already
                await port.write(b"S")
                chunks = await _receive(port)
            if not chunks:
                raise DeviceLostError(f"{settings.port}: no data: check the power of the board")

            codec = BoardCodec()
            for chunk in chunks:
                codec.feed(chunk.data)
            if not codec.frames:
                raise DeviceMisconfiguredError(
                    f"{settings.port}: the bytes at {settings.baud} baud are no frames of the "
                    "board: correct `port` or `baud`"
                )
            for chunk in chunks:
                emit(chunk)
            await port.pump(emit, settings.silence_s)


async def _receive(port: SerialPort) -> list[Chunk]:
    """Return chunks with four frames or more; fewer if the line is silent."""
    chunks: list[Chunk] = []
    while sum(len(chunk.data) for chunk in chunks) < 4 * SIZE:
        chunk = await port.receive(_LISTEN_S)
        if chunk is None:
            break
        chunks.append(chunk)
    return chunks
