"""A virtual WitMotion device on a pty, for the tests.

Law: the same wire format as the driver's, nothing else in common with it. As real ones it sends no
quaternions until told to, acknowledges nothing, and obeys only for 10 s after it was unlocked.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from jointfit_simulators.imu_device import clean_wire
from jointfit_simulators.wires import PtyLine

from jointfit_wit import frames

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import Quaternion, WireNoise

_UNLOCKED_S = 10.0
_COMMAND = 5  # bytes


class WitDevice:
    """An ``ImuDevice``; see there.

    Parameters
    ----------
    link
        Where the host finds the port.
    quaternions
        Whether they are switched on from the start.
    wire_noise
        What the wire does to each frame on its way to the host.
    """

    streaming = True  # from power-on, whatever the host does
    rate_hz = 100.0

    def __init__(
        self, link: Path, *, quaternions: bool = True, wire_noise: WireNoise = clean_wire
    ) -> None:
        self._line = PtyLine(link)
        self._quaternions = quaternions
        self._noise = wire_noise
        self._unlocked_until = 0.0
        self.sent = 0
        """Quaternions written to the wire so far."""
        self.saved = 0
        """Times it was told to store its registers."""
        self.unplug, self.plug = self._line.unplug, self._line.plug

    def push(self, device_ns: int, q_world_sensor: Quaternion) -> None:  # noqa: ARG002 - no clock
        """Send one sample now."""
        w, x, y, z = (max(-32768, min(32767, round(part * 32768))) for part in q_world_sensor)
        if self._quaternions:
            self.sent += self._line.write(
                self._noise(frames.encode(frames.QUATERNION, (w, x, y, z)))
            )
        else:
            self._line.write(self._noise(frames.encode(frames.ACCELERATION, (0, 0, 2048, 0))))

    async def run(self) -> None:
        """Serve until cancelled."""
        await self._line.serve(self._take)

    def _take(self, data: bytes) -> None:
        for at in range(0, len(data) - _COMMAND + 1, _COMMAND):
            self._obey(data[at : at + _COMMAND])

    def _obey(self, command: bytes) -> None:
        if command == frames.UNLOCK:
            self._unlocked_until = time.monotonic() + _UNLOCKED_S
        elif time.monotonic() > self._unlocked_until:
            return
        elif command == frames.SAVE:
            self.saved += 1
        elif command[2] == frames.CONTENT:
            self._quaternions = bool(command[4] << 8 & frames.CONTENT_QUATERNION)
