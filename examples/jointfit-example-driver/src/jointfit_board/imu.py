"""Driver for one board: `BoardDecoder` is pure; `BoardImu.run` opens, starts and reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jointfit_daemon.model import ImuSample, TickClock
from jointfit_drivers.checked_samples import CheckedSamples
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_drivers.serial_decoder import SerialDecoder
from jointfit_drivers.serial_imu import SerialImuSettings
from jointfit_drivers.silence import explain_missing_messages

from jointfit_board.frames import SCALE, SIZE, BoardFrame, board_codec

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit, Wire
    from jointfit_daemon.model import Decoded

_LISTEN_S = 0.3
"""Time limit for the first frame, s. It is thirty sample periods."""


class BoardSettings(SerialImuSettings):
    """One self-built board on a serial port."""


class BoardDecoder(SerialDecoder[BoardFrame]):
    """Converts chunks to samples in SI units with canonical orientation, without I/O."""

    def __init__(self, settings: BoardSettings) -> None:
        clock = TickClock(tick_ns=1000, modulus=1 << 32)
        samples = CheckedSamples(settings.rate_hz, clock, counts=256)
        super().__init__(board_codec(), samples, settings.line_baud, longest=SIZE)

    def convert(self, message: BoardFrame, arrival_ns: int) -> list[Decoded]:
        """Return the sample of one frame after checks of its norm, time and counter."""
        w, x, y, z = (count / SCALE for count in message.counts)
        q = (w, x, y, z)  # already canonical: sensor to ENU, scalar first
        sample = ImuSample(
            arrival_ns=arrival_ns,
            q_world_sensor=q,
            q_native=q,
            ticks=message.time_us,
            counter=message.counter,
        )
        return self.samples.add(sample, message.size)


class BoardImu:
    """The board on a UART."""

    Settings: ClassVar[type[BoardSettings]] = BoardSettings
    wire: ClassVar[Wire] = "stream"
    usual_bauds: ClassVar[tuple[int, ...]] = (115_200, 57_600)

    def __init__(self, settings: BoardSettings) -> None:
        self._settings = settings

    def decoder(self) -> BoardDecoder:
        """Return a new decoder, for live data and for replay."""
        return BoardDecoder(self._settings)

    async def run(self, emit: Emit) -> None:
        """Open the port, start the board if it does not send, and read until cancelled."""
        settings = self._settings
        with SerialPort(settings.port, settings.baud) as port:
            port.flush_input()  # the system may have stored bytes of an earlier run
            conversation = SerialConversation(port, emit, board_codec)

            # Read before writing, because the board may already be sending.
            first = await conversation.receive(_is_frame, _LISTEN_S)
            if first is None:
                first = await conversation.ask(b"S", _is_frame, tries=2, wait_s=_LISTEN_S)
            if first is None:
                await explain_missing_messages(
                    port,
                    conversation,
                    baud=settings.baud,
                    speeds=self.usual_bauds,
                    family="the frames of the board",
                )
            await port.pump(emit, settings.lost_after_s)


def _is_frame(_: BoardFrame) -> bool:
    return True
