"""Requests and replies on a serial line: stale bytes, and bytes that are passed on."""

from __future__ import annotations

from typing import Any, cast

from jointfit_daemon.model import Chunk
from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_protocols.mip import MipCodec, MipPacket, encode

ACK = encode(0x01, ((0xF1, b"\x02\x00"),))
OLD = encode(0x80, ((0x04, bytes(12)),))


class ScriptedPort:
    """Port that receives the given chunks; None is a pause."""

    path = "port"

    def __init__(self, *chunks: Chunk | None) -> None:
        self._chunks = list(chunks)
        self.written: list[bytes] = []

    async def write(self, data: bytes) -> None:
        self.written.append(data)

    async def receive(self, _: float) -> Chunk | None:
        return self._chunks.pop(0) if self._chunks else None


async def conversed(*chunks: Chunk | None) -> tuple[MipPacket | None, list[Chunk]]:
    emitted: list[Chunk] = []
    port = cast("Any", ScriptedPort(*chunks))
    conversation = SerialConversation[MipPacket](port, emitted.append, MipCodec)
    reply = await conversation.ask(
        b"idle", lambda packet: packet.descriptor_set == 1, tries=1, wait_s=0.05
    )
    return reply, emitted


async def test_bytes_before_the_first_reply_are_discarded_and_those_after_it_emitted() -> None:
    reply, emitted = await conversed(Chunk(1, OLD + ACK[:3]), Chunk(2, ACK[3:] + OLD))
    assert reply is not None
    assert emitted == [Chunk(2, ACK + OLD)]


async def test_a_reply_behind_a_corrupt_length_is_found_after_a_pause_with_its_arrival() -> None:
    reply, emitted = await conversed(Chunk(7, b"ue\x80\xff" + ACK), None)
    assert reply is not None
    assert emitted == [Chunk(7, ACK)]


async def test_without_a_reply_nothing_is_emitted() -> None:
    assert await conversed(Chunk(1, OLD)) == (None, [])
