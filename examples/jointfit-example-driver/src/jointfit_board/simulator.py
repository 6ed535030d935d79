"""Virtual board on a pseudo-terminal (pty), for the tests.

Like the real board, it sends nothing until it receives the start command.

Invariant: driver and simulator share the codec only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_simulators.imu_device import clean_wire
from jointfit_simulators.wires import PtyLine

from jointfit_board.frames import SCALE, BoardFrame, encode

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import Quaternion, WireNoise


class BoardDevice:
    """Device with the interface of `jointfit_simulators.imu_device.ImuDevice`.

    Parameters
    ----------
    link
        Symbolic link to the port that the host opens.
    streaming
        Whether the board already sends.
    wire_noise
        Function that disturbs the bytes of each frame to the host.
    """

    rate_hz = 100.0

    def __init__(
        self, link: Path, *, streaming: bool = False, wire_noise: WireNoise = clean_wire
    ) -> None:
        self._line, self._noise = PtyLine(link), wire_noise
        self.streaming = streaming
        self._counter = self.sent = 0
        self.unplug, self.plug = self._line.unplug, self._line.plug

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Send one sample now if the board was started."""
        self._counter += 1
        if self.streaming:
            w, x, y, z = (round(part * SCALE) for part in q_world_sensor)
            time_us = device_ns // 1000 & 0xFFFFFFFF
            frame = BoardFrame(self._counter & 0xFF, time_us, (w, x, y, z))
            self.sent += self._line.write(self._noise(encode(frame)))

    async def run(self) -> None:
        """Run the board until cancelled."""
        await self._line.serve(self._receive)

    def _receive(self, data: bytes) -> None:
        self.streaming |= b"S" in data
