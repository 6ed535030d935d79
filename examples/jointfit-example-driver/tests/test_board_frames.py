"""Tests of the codec: documented bytes, streams that are split at any byte, and counted bytes."""

from __future__ import annotations

import random

import pytest

from jointfit_board.frames import SCALE, SIZE, BoardFrame, board_codec, encode


def decode(chunks: list[bytes]) -> tuple[list[BoardFrame], int]:
    codec = board_codec()
    found = [event for chunk in chunks for event in codec.feed(chunk)] + codec.flush()
    return [event for event in found if isinstance(event, BoardFrame)], codec.discarded


def test_codec_reproduces_documented_bytes() -> None:
    wire = bytes.fromhex("a55a 07 40420f00 ff3f 01c0 cc0c 9959 61")
    (frame,), lost = decode([wire])
    assert lost == 0
    assert (frame.counter, frame.time_us) == (7, 1_000_000)
    values = [count / SCALE for count in frame.counts]
    assert values == pytest.approx([0.5, -0.5, 0.1, 0.7], abs=1e-4)
    assert encode(frame) == wire


@pytest.mark.parametrize("seed", range(20))
def test_frames_do_not_depend_on_the_split_and_every_byte_is_counted(seed: int) -> None:
    chance = random.Random(seed)
    parts = [
        encode(BoardFrame(number, chance.randrange(1 << 32), (chance.randrange(-99, 99), 1, 2, 3)))
        if chance.random() < 0.6
        else chance.randbytes(chance.randrange(20))
        for number in range(30)
    ]
    wire = b"".join(parts)
    whole = decode([wire])
    assert decode([bytes((byte,)) for byte in wire]) == whole
    assert SIZE * len(whole[0]) + whole[1] == len(wire)
    assert len(whole[0]) >= sum(part[:2] == b"\xa5\x5a" for part in parts)
