"""Virtual WitMotion device on a pty, for the tests.

Like a real device, it sends quaternions only after configuration, acknowledges nothing, and accepts
commands only for 10 s after the unlock command.

Invariant: driver and simulator share the codec only.
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
"""Time after the unlock command in which commands are accepted, s."""
_COMMAND = 5
"""Length of a command, bytes."""


class WitDevice:
    """Device with the interface of `jointfit_simulators.imu_device.ImuDevice`.

    Parameters
    ----------
    link
        Symbolic link to the host's port.
    quaternions
        Whether the device sends quaternions from the start.
    wire_noise
        Noise applied to each frame to the host.
    """

    streaming = True  # from power-on, independent of the host
    rate_hz = 100.0

    def __init__(
        self, link: Path, *, quaternions: bool = True, wire_noise: WireNoise = clean_wire
    ) -> None:
        self._line = PtyLine(link)
        self._quaternions = quaternions
        self._noise = wire_noise
        self._unlocked_until = 0.0
        self.sent = 0
        """Number of quaternions written to the wire."""
        self.saved = 0
        """Number of commands to store the registers."""
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
        await self._line.serve(self._receive)

    def _receive(self, data: bytes) -> None:
        for at in range(0, len(data) - _COMMAND + 1, _COMMAND):
            self._execute(data[at : at + _COMMAND])

    def _execute(self, command: bytes) -> None:
        if command == frames.UNLOCK:
            self._unlocked_until = time.monotonic() + _UNLOCKED_S
        elif time.monotonic() > self._unlocked_until:
            return
        elif command == frames.SAVE:
            self.saved += 1
        elif command[2] == frames.CONTENT:
            self._quaternions = bool(command[4] << 8 & frames.CONTENT_QUATERNION)
