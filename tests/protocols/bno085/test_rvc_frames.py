"""The UART-RVC codec decodes the frame of the data sheet, and counts every byte.

The result does not depend on how the byte stream is split.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.bno085 import RVC_BYTES, RvcCodec, RvcFrame, encode_rvc
from tests.protocols.bno085.adafruit_oracle import adafruit

if TYPE_CHECKING:
    from jointfit_protocols.corrupt import CorruptBytes

EXAMPLE = bytes.fromhex("aaaade010092ff25088dfeecffd103000000e7")
"""Frame with its checksum, from the data sheet 1000-3927."""

int16 = st.integers(-(2**15), 2**15 - 1)
triples = st.tuples(int16, int16, int16)
frames = st.builds(
    RvcFrame, st.integers(0, 255), triples, triples, st.binary(min_size=3, max_size=3)
)
false_heads = st.sampled_from([b"\xaa", b"\xaa\xaa", b"\xaa\xaa\xaa", b"\xaa\xaa\xde\x01"])
wires = st.lists(frames.map(encode_rvc) | st.binary(max_size=40) | false_heads, max_size=8).map(
    b"".join
)


def decode(pieces: list[bytes]) -> tuple[list[RvcFrame | CorruptBytes], RvcCodec]:
    codec = RvcCodec()
    found = [event for piece in pieces for event in codec.feed(piece)]
    return found + codec.flush(), codec


def test_the_message_of_the_data_sheet() -> None:
    (frame,), _ = decode([EXAMPLE])
    assert frame == RvcFrame(222, (1, -110, 2085), (-371, -20, 977), bytes(3), 19)
    assert isinstance(frame, RvcFrame)
    assert encode_rvc(frame) == EXAMPLE


@given(wires, st.lists(st.integers(0, 300), max_size=6))
def test_frames_do_not_depend_on_the_cut_and_every_byte_is_counted(
    wire: bytes, cuts: list[int]
) -> None:
    whole, codec = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole
    used = sum(RVC_BYTES if isinstance(item, RvcFrame) else item.discarded for item in whole)
    assert used == len(wire) == codec.messages * RVC_BYTES + codec.discarded


@given(frames)
def test_frames_survive_both_directions(frame: RvcFrame) -> None:
    assert decode([encode_rvc(frame)])[0] == [frame._replace(end=RVC_BYTES)]


@pytest.mark.parametrize("place", range(2, RVC_BYTES))
def test_one_flipped_bit_is_detected_and_the_next_frame_is_found(place: int) -> None:
    damaged = bytearray(EXAMPLE)
    damaged[place] ^= 0x10
    found, codec = decode([bytes(damaged) + EXAMPLE])
    assert [item.number for item in found if isinstance(item, RvcFrame)] == [222]
    assert codec.discarded == RVC_BYTES


@given(st.lists(frames, min_size=1, max_size=4))
def test_the_package_of_adafruit_reads_the_same_values(sent: list[RvcFrame]) -> None:
    package = adafruit("adafruit_bno08x_rvc")
    for frame in sent:
        theirs = package.BNO08x_RVC._parse_frame(encode_rvc(frame)[2:])
        assert theirs[:3] == pytest.approx([angle * 0.01 for angle in frame.angles])
        assert theirs[3:] == pytest.approx([count * 0.0098067 for count in frame.acceleration])
