"""Exchange of commands with an x-IMU3. A reply contains the key of its command.

A device sends measurements continuously, and no command stops them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_protocols.ximu3 import XImu3Codec, XImu3Data, XImu3Reply, encode_command

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

REPLY_S = 0.5
"""Longest wait for a reply, s, which equals the time-out of the x-IMU3 GUI."""
TRIES = 3
"""Number of times that a command is sent. The x-IMU3 GUI also sends it three times."""
_CERTAIN = 3
"""Number of measurement messages that identify the protocol. A single message may be noise."""


class XImu3Conversation:
    """Exchange of commands and replies with one device on one port.

    Parameters
    ----------
    port : SerialPort
        Open port.
    emit : Emit
        Function that receives all bytes from the first reply on.
    """

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        self._line = SerialConversation[XImu3Data | XImu3Reply](port, emit, XImu3Codec)
        self._certain = 0

    @property
    def received(self) -> int:
        """Number of bytes received so far."""
        return self._line.received

    @property
    def understood(self) -> bool:
        """Whether the received bytes certainly come from an x-IMU3."""
        return self._certain >= _CERTAIN

    def reset(self) -> None:
        """Discard the bytes received so far, for example before another speed is used."""
        self._line.reset()
        self._certain = 0

    async def request(
        self, key: str, value: object = None, *, tries: int = TRIES, wait_s: float = REPLY_S
    ) -> XImu3Reply | None:
        """Send a command until its reply arrives; return None if no reply arrives."""

        def is_reply(message: XImu3Data | XImu3Reply) -> bool:
            if isinstance(message, XImu3Data):
                self._certain += bool(message.values)
                return False
            return message.key == key and message.channel is None

        command = encode_command(key, value)
        reply = await self._line.ask(command, is_reply, tries=tries, wait_s=wait_s)
        return cast("XImu3Reply | None", reply)
