"""Exchange of MIP commands and replies with one device."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_protocols.mip import MipCodec, MipPacket, commands

if TYPE_CHECKING:
    from jointfit_daemon.driver import Emit
    from jointfit_drivers.ports.serial_port import SerialPort

REPLY_S = 1.0
"""Longest wait for a reply, s."""


class MipReply(NamedTuple):
    """Reply of the device to one command."""

    code: int
    packet: MipPacket

    @property
    def is_ok(self) -> bool:
        """Whether the command was accepted."""
        return self.code == commands.OK

    def data(self, descriptor: int) -> bytes:
        """Return the data of a field in the reply; empty if the reply does not contain it."""
        return commands.reply_data(self.packet, descriptor) or b""


class MipConversation(SerialConversation[MipPacket]):
    """Commands and replies of one device on one port."""

    def __init__(self, port: SerialPort, emit: Emit) -> None:
        super().__init__(port, emit, MipCodec)

    async def command(
        self,
        command_set: int,
        command: int,
        data: bytes = b"",
        *,
        tries: int = 3,
        wait_s: float = REPLY_S,
    ) -> MipReply | None:
        """Send a command, at most `tries` times, and return its reply; None if no reply arrives."""

        def is_reply(packet: MipPacket) -> bool:
            known = packet.descriptor_set == command_set
            return known and commands.reply_code(packet, command) is not None

        request = commands.encode_command(command_set, command, data)
        packet = await self.ask(request, is_reply, tries=tries, wait_s=wait_s)
        if packet is None:
            return None
        return MipReply(commands.reply_code(packet, command) or commands.OK, packet)
