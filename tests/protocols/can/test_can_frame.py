"""CAN records and candump logs are read without loss, and error frames are described."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.can import (
    RECORD_BYTES,
    CanFrame,
    describe_error,
    frame_bits,
    host_corrupt,
    host_count,
    host_dropped,
    pack_frames,
    unpack_frames,
)
from jointfit_protocols.corrupt import CorruptBytes
from tests.protocols.can.candump_oracle import parse_candump

stamps = st.integers(-(2**63), 2**63 - 1)
payloads = st.binary(max_size=8)


def frames_of(
    kind: str, largest: int, data: st.SearchStrategy[bytes] = payloads
) -> st.SearchStrategy[CanFrame]:
    flags = {flag: st.just(flag == kind) for flag in ("extended", "error")}
    return st.builds(CanFrame, stamps, st.integers(0, largest), data, remote=st.booleans(), **flags)


standard = frames_of("standard", 0x7FF)
extended = frames_of("extended", 0x1FFFFFFF)
errors = frames_of("error", 0x1FFFFFFF)
can_frames = standard | extended | errors


@given(st.lists(can_frames))
def test_packed_can_frame_unpacks_to_itself(frames: list[CanFrame]) -> None:
    wire = pack_frames(frames)
    assert len(wire) == RECORD_BYTES * len(frames)
    assert unpack_frames(wire) == frames


@given(st.binary(max_size=200))
def test_any_bytes_are_frames_or_counted(data: bytes) -> None:
    found = unpack_frames(data)
    lost = sum(item.discarded for item in found if isinstance(item, CorruptBytes))
    frames = [item for item in found if isinstance(item, CanFrame)]
    assert RECORD_BYTES * len(frames) + lost == len(data)


def test_a_broken_record_costs_no_other() -> None:
    good = CanFrame(1, 0x21, b"12345678")
    wire = pack_frames([good]) + b"\xff" * RECORD_BYTES + pack_frames([good]) + b"abc"
    found = unpack_frames(wire)
    assert [found[0], found[2]] == [good, good]
    assert [found[1][0], found[3][0]] == [RECORD_BYTES, 3]


def test_sizes_flags_and_identifiers_that_cannot_be_are_corrupt() -> None:
    good = bytearray(pack_frames([CanFrame(1, 0x21, b"12345678")]))
    for place, value in ((12, 8), (13, 9), (9, 0x08), (11, 0x20)):
        bad = bytearray(good)
        bad[place] = value
        assert isinstance(unpack_frames(bytes(bad))[0], CorruptBytes)


def test_notes_of_the_host_keep_their_number() -> None:
    """The host records the numbers of lost frames and of corrupt bytes in special frames."""
    for note in (host_dropped(5, 4722), host_corrupt(5, 2**40)):
        (back,) = unpack_frames(pack_frames([note]))
        assert isinstance(back, CanFrame)
        assert host_count(back) == host_count(note) > 0
    assert host_count(CanFrame(0, 0, b"xy", error=True)) == 0


def test_frame_lengths_are_those_of_the_standard() -> None:
    assert frame_bits(8, extended=False) == 111
    assert frame_bits(4, extended=False) == 79
    assert frame_bits(8, extended=True) == 131


@given(errors)
def test_every_error_frame_has_words(frame: CanFrame) -> None:
    assert describe_error(frame).text


def test_bus_off_is_serious_and_a_restart_is_not() -> None:
    assert describe_error(CanFrame(0, 0x40, bytes(8), error=True)).serious
    assert not describe_error(CanFrame(0, 0x100, bytes(8), error=True)).serious
    passive = describe_error(CanFrame(0, 0x04, b"\0\x10\0\0\0\0\0\0", error=True))
    assert passive.serious
    assert "passive" in passive.text


@pytest.mark.parametrize(
    ("can_id", "text", "serious"),
    [
        (0x001, "transmit timeout", False),
        (0x002, "arbitration lost", False),
        (0x008, "protocol violation", False),
        (0x010, "transceiver fault", True),
        (0x020, "no acknowledgment", True),
        (0x040, "bus off", True),
        (0x080, "bus error", False),
        (0x100, "controller restarted", False),
        (0x200, "CAN error class 0x200", False),
    ],
)
def test_error_classes_are_those_of_linux(can_id: int, text: str, serious: bool) -> None:
    found = describe_error(CanFrame(0, can_id, bytes(8), error=True))
    assert found.text.startswith(text)
    assert found.serious is serious


@pytest.mark.parametrize(
    ("state", "text", "serious"),
    [
        (0x01, "receive overflow", True),
        (0x02, "transmit overflow", False),
        (0x04, "error warning level", False),
        (0x08, "error warning level", False),
        (0x10, "error passive", True),
        (0x20, "error passive", True),
        (0x40, "error active again", False),
        (0x00, "CAN error class 0x4", False),
    ],
)
def test_controller_states_are_those_of_linux(state: int, text: str, serious: bool) -> None:
    found = describe_error(CanFrame(0, 0x004, bytes([0xFF, state, 0xFF]), error=True))
    assert found.text.startswith(text)
    assert found.serious is serious


def test_an_error_frame_without_the_state_of_the_controller_has_a_description() -> None:
    short = CanFrame(0, 0x004, b"\xff", error=True)
    assert describe_error(short) == ("CAN error class 0x4", False)
    two = describe_error(CanFrame(0, 0x004, b"\0\x03", error=True))
    assert two.text == "receive overflow: the controller lost frames; transmit overflow"


def test_a_record_holds_eight_bytes_and_no_more() -> None:
    (found,) = unpack_frames(pack_frames([CanFrame(-1, 0x7FF, bytes(range(8)))]))
    assert found == CanFrame(-1, 0x7FF, bytes(range(8)))
    with pytest.raises(ValueError, match="at most 8 bytes, not 9"):
        pack_frames([CanFrame(0, 1, bytes(9))])


def test_a_record_has_the_documented_layout() -> None:
    frames = [CanFrame(1, 2, b"ab"), CanFrame(3, 0x7FF, b"", remote=True)]
    assert pack_frames(frames).hex() == (
        "0100000000000000" "02000000" "00" "02" "0000" "6162000000000000"
        "0300000000000000" "ff070000" "02" "00" "0000" "0000000000000000"
    )  # fmt: skip
    notes = [host_dropped(0, 258), host_corrupt(0, 1)]
    assert [(note.can_id, note.data.hex()) for note in notes] == [
        (0x1000_0000, "0201000000000000"), (0x0800_0000, "0100000000000000"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "largest"), [(0, 0x7FF), (1, 0x1FFF_FFFF), (2, 0x7FF), (4, 0x1FFF_FFFF)]
)
def test_the_largest_identifier_depends_on_the_flags(flags: int, largest: int) -> None:
    for can_id in (largest, largest + 1):
        record = (1).to_bytes(8, "little") + can_id.to_bytes(4, "little")
        (found,) = unpack_frames(record + bytes([flags]) + bytes(11))
        assert isinstance(found, CanFrame) == (can_id == largest)


def candump_line(frame: CanFrame) -> str:
    digits = f"{frame.can_id:0{8 if frame.extended else 3}X}"
    body = "R" if frame.remote else frame.data.hex().upper()
    return f"({frame.t_ns // 10**9}.{frame.t_ns % 10**9:09d}) can0 {digits}#{body}\n"


@given(st.lists(standard | extended))
def test_a_candump_log_is_read_back(frames: list[CanFrame]) -> None:
    sent = [f._replace(t_ns=abs(f.t_ns) // 2, data=b"" if f.remote else f.data) for f in frames]
    assert parse_candump("".join(map(candump_line, sent)).encode()) == sent


@given(st.binary())
def test_any_text_is_frames_or_counted(log: bytes) -> None:
    lost = sum(item.discarded for item in parse_candump(log) if isinstance(item, CorruptBytes))
    assert lost <= len(log)


def test_lines_as_candump_writes_them() -> None:
    log = b"""# a comment

(1436509052.249713) vcan0 044#2A366C2BBA
(1436509053.5) can0 19FF0021#7FFF R
(1436509054.000001) can0 20000004#0001000000000000
(1436509055.000001) can0 123##1AABB
no line at all
(1436509056.1) can0 0F6#R
"""
    first, extended_, error, *corrupt, remote = parse_candump(log)
    assert first == CanFrame(1436509052_249713000, 0x44, bytes.fromhex("2A366C2BBA"))
    assert extended_ == CanFrame(1436509053_500000000, 0x19FF0021, b"\x7f\xff", True)
    assert isinstance(error, CanFrame)
    assert error.error
    assert error.can_id == 4
    assert [item.discarded for item in corrupt if isinstance(item, CorruptBytes)] == [36, 15]
    assert isinstance(remote, CanFrame)
    assert remote.remote
