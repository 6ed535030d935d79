"""Exchange of LP-BUS commands and replies with one sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_protocols.lpms import LpBusCodec, LpBusMessage, encode
from jointfit_protocols.lpms.configuration import LpmsCommand

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from jointfit_daemon.driver import Emit
    from jointfit_daemon.model import Chunk
    from jointfit_drivers.ports.serial_port import SerialPort
    from jointfit_protocols.corrupt import CorruptBytes

MODE_S = 1.0
"""Longest wait for the acknowledgement of command mode, s. A sensor first sends its queued data."""
REPLY_S = 0.5
"""Longest wait for any other reply, s."""
_KEPT = 512
"""Number of received bytes that are stored in order to recognize text."""
_ACKNOWLEDGEMENTS = frozenset({LpmsCommand.ACK, LpmsCommand.NACK})


class LpBusConversation(SerialConversation[LpBusMessage]):
    """Commands and replies of one sensor on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Function that receives all bytes from the first reply on.
    sensor_id : int
        Address of the sensor.
    """

    def __init__(self, port: SerialPort, emit: Emit, sensor_id: int) -> None:
        super().__init__(port, emit, LpBusCodec)
        self._sensor_id = sensor_id
        self.last_bytes = b""
        """The most recently received bytes."""
        self.ids: set[int] = set()
        """Addresses that occurred in received messages."""

    @override
    def reset(self) -> None:
        super().reset()
        self.last_bytes = b""
        self.ids.clear()

    async def enter_command_mode(self, *, tries: int = 3, wait_s: float | None = None) -> bool:
        """Stop the stream, and return whether the sensor replied.

        Old firmware does not acknowledge this command. Without an acknowledgement, the driver sends
        a read command that exists in both generations of sensors. A reply shows that the sensor is
        in command mode.

        Parameters
        ----------
        tries
            Largest number of attempts.
        wait_s
            Longest wait for each acknowledgement, s. The default is `MODE_S`.
        """
        wait_s = MODE_S if wait_s is None else wait_s
        for _ in range(tries):
            if await self._exchange(LpmsCommand.COMMAND_MODE, {LpmsCommand.ACK}, wait_s=wait_s):
                return True
        replies = {LpmsCommand.IDENTIFY, LpmsCommand.NACK}
        wait_s = min(wait_s, REPLY_S)
        return await self._exchange(LpmsCommand.IDENTIFY, replies, wait_s=wait_s) is not None

    async def read(self, command: int) -> bytes | None:
        """Return the data of the reply to a read command; None if the sensor sends no data."""
        for _ in range(2):
            reply = await self._exchange(command, {command, LpmsCommand.NACK})
            if reply is not None:
                return None if reply.command == LpmsCommand.NACK else reply.data
        return None

    async def write(
        self, command: int, data: bytes = b"", *, wait_s: float = REPLY_S
    ) -> bool | None:
        """Send a command; return whether the sensor acknowledged it; None if no reply arrives."""
        reply = await self._exchange(command, _ACKNOWLEDGEMENTS, data, wait_s=wait_s)
        return None if reply is None else reply.command == LpmsCommand.ACK

    async def start_stream(self) -> bool | None:
        """Start the stream; return whether the sensor accepts the command; None without a reply."""
        for _ in range(3):
            replies = _ACKNOWLEDGEMENTS | {LpmsCommand.DATA}
            reply = await self._exchange(LpmsCommand.STREAM_MODE, replies)
            if reply is not None:
                return reply.command != LpmsCommand.NACK
        return None

    async def wait_for_data(self, wait_s: float) -> bool:
        """Return whether a data packet arrives within `wait_s` seconds."""
        return await self._wait_for({LpmsCommand.DATA}, wait_s) is not None

    async def _exchange(
        self, command: int, replies: Collection[int], data: bytes = b"", *, wait_s: float = REPLY_S
    ) -> LpBusMessage | None:
        """Send a command; return the first message whose command is in `replies`, or None."""
        await self.send(encode(command, data, self._sensor_id))
        return await self._wait_for(replies, wait_s)

    async def _wait_for(self, commands: Collection[int], wait_s: float) -> LpBusMessage | None:
        def is_reply(message: LpBusMessage) -> bool:
            self.ids.add(message.sensor_id)
            return message.command in commands

        return await self.receive(is_reply, wait_s)

    @override
    def _take(self, chunk: Chunk) -> Sequence[LpBusMessage | CorruptBytes]:
        self.last_bytes = (self.last_bytes + chunk.data)[-_KEPT:]
        return super()._take(chunk)
