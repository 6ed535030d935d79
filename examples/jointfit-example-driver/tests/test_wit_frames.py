"""Codec of WitMotion frames: documented bytes, any split of the stream, counted bytes."""

from __future__ import annotations

import random

import pytest

from jointfit_wit.frames import QUATERNION, WitCodec, WitFrame, encode, write_register


def decode(chunks: list[bytes]) -> tuple[list[WitFrame], int]:
    codec = WitCodec()
    found = [event for chunk in chunks for event in codec.feed(chunk)] + codec.flush()
    return [event for event in found if isinstance(event, WitFrame)], codec.discarded


def test_codec_reproduces_documented_bytes() -> None:
    wire = bytes.fromhex("5559004000c0cd0c9a597a")
    (frame,), lost = decode([wire])
    assert lost == 0
    values = [count / 32768 for count in frame.counts]
    assert values == pytest.approx([0.5, -0.5, 0.1, 0.7], abs=1e-4)
    assert encode(QUATERNION, frame.counts) == wire
    assert write_register(0x02, 0x0201).hex() == "ffaa020102"


@pytest.mark.parametrize("seed", range(20))
def test_frames_do_not_depend_on_the_split_and_every_byte_is_counted(seed: int) -> None:
    chance = random.Random(seed)
    parts = [
        encode(QUATERNION, (chance.randrange(-99, 99), 1, 2, 3))
        if chance.random() < 0.6
        else chance.randbytes(chance.randrange(20))
        for _ in range(30)
    ]
    wire = b"".join(parts)
    whole = decode([wire])
    assert decode([bytes((byte,)) for byte in wire]) == whole
    assert 11 * len(whole[0]) + whole[1] == len(wire)
    assert len(whole[0]) >= sum(part[:2] == b"\x55\x59" for part in parts)
